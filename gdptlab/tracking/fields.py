"""What many tracks say together: mean values on a grid, profiles, mean squared displacements."""

import warnings
from collections.abc import Iterable, Mapping
from numbers import Integral

import numpy as np
import pandas as pd
import trackpy
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import iterable, real_array, whole
from gdptlab._checks import rate as check_rate
from gdptlab._checks import table as check_table
from gdptlab.tracking.tracks import must_be_tracks, positions_of


def mean_field(
    table: pd.DataFrame, cells: Mapping[str, int | ArrayLike], values: Iterable[str] | None = None
) -> pd.DataFrame:
    """Mean values, such as velocities, in the cells of a grid; of one axis, a profile.

    Parameters
    ----------
    table : DataFrame
        As from `velocities`. Rows outside the grid, or with a value that is NaN, are left out.
    cells : dict of int or array (n + 1,)
        By the columns that are the axes of the grid, one to three: how many cells of equal size, from the least to the
        largest number in the column; or the increasing edges of the cells, in the column's unit. Each cell holds its
        lower edge, the last one also its upper edge.
    values : iterable of str, optional
        Columns of which the means are taken; without it those of the velocity, `vx_um_s` and so on.

    Returns
    -------
    DataFrame
        A row for each cell, the last axis fastest: the middle of the cell along each axis; `n`, how many rows it holds,
        and `n_particles`, how many particles they are of (without a column `particle`, each row is one); of each value
        the mean, NaN in an empty cell, and the standard error of the mean, as in `vx_se_um_s`. Errors of the rows of
        one particle are not independent, those of different particles are taken to be: the standard error is from
        the sums of deviations of each particle, NaN for a single one. xarray makes a grid of it by
        `field.set_index(list(cells)).to_xarray()`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form or a column is missing.
    """
    if not isinstance(cells, Mapping) or not 1 <= len(cells) <= 3:
        raise TypeError(f"cells: got {cells!r}, allowed is a dict of one to three columns and their cells")
    check_table("table", table, ())
    if values is None:
        values = [name for name in (f"v{a}_{unit}_s" for a in "xyz" for unit in ("um", "px")) if name in table]
    if isinstance(values, str):
        raise TypeError(f"values: got {values!r}, allowed is a list of columns")
    values = list(iterable("values", values))
    if not values:
        raise ValueError("values: got none, and table has no velocities, needed is a column or more")
    if set(cells) & set(values):
        raise ValueError(f"values: got {values}, some of which are axes of the grid, allowed are others")
    check_table("table", table, [*cells, *values])
    edges = {axis: _edges(table[axis], cell, axis) for axis, cell in cells.items()}
    shape = [len(edge) - 1 for edge in edges.values()]
    where = [_cell(table[axis].to_numpy(dtype=float), edge) for axis, edge in edges.items()]
    inside = np.all([number >= 0 for number in where], axis=0) & np.isfinite(table[values].astype(float)).all(axis=1)
    cell = np.ravel_multi_index([number[inside] for number in where], shape)
    value = table.loc[inside, values].to_numpy(dtype=float)
    number = table["particle"] if "particle" in table else pd.Series(np.arange(len(table)), table.index)
    n, n_particles, mean, error = _clustered(cell, pd.factorize(number[inside])[0], value, int(np.prod(shape)))
    middles = np.meshgrid(*((edge[1:] + edge[:-1]) / 2 for edge in edges.values()), indexing="ij")
    field = {axis: middle.ravel() for axis, middle in zip(edges, middles, strict=True)}
    field |= {"n": n, "n_particles": n_particles}
    for name, means, errors in zip(values, mean.T, error.T, strict=True):
        head, underscore, tail = name.partition("_")
        field |= {name: means, f"{head}_se{underscore}{tail}": errors}
    return pd.DataFrame(field)


def _edges(column: pd.Series, cells: int | ArrayLike, axis: str) -> NDArray[np.float64]:
    """Edges (n + 1,) of the cells along an axis."""
    if isinstance(cells, Integral) and not isinstance(cells, bool):
        whole(f"cells[{axis!r}]", cells, 1, 100_000)
        if not column.notna().any() or column.min() == column.max():
            raise ValueError(f"cells[{axis!r}]: got {cells} cells for one or no number, needed are edges of cells")
        return np.linspace(column.min(), column.max(), cells + 1)
    real_array(f"cells[{axis!r}]", cells, 1)
    edges = np.asarray(cells, dtype=np.float64)
    if len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise ValueError(f"cells[{axis!r}]: got {cells!r}, allowed are two or more increasing edges, or their number")
    return edges


def _cell(values: NDArray, edges: NDArray) -> NDArray[np.int64]:
    """Number of the cell that each value (n,) lies in; -1 outside, and for NaN."""
    number = np.searchsorted(edges, values, side="right") - 1
    number[values == edges[-1]] = len(edges) - 2
    return np.where((values >= edges[0]) & (values <= edges[-1]), number, -1)


def _clustered(
    cell: NDArray, particle: NDArray, value: NDArray, size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Rows and particles in each of `size` cells, means and their standard errors (size, k), of values (n, k).

    With r the deviations of a cell's n rows from its mean, summed over each of its G particles, the squared standard
    error is G / (G - 1) sum_g (sum_i r_gi)^2 / n^2: the usual one if each particle has one row.
    """
    n = np.bincount(cell, minlength=size)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack([np.bincount(cell, v, size) for v in value.T], axis=1) / n[:, None]
        pairs, pair = np.unique(np.stack([cell, particle]), axis=1, return_inverse=True)
        n_particles = np.bincount(pairs[0].astype(int), minlength=size)
        deviation = value - mean[cell]
        sums = np.stack([np.bincount(pair.ravel(), d, pairs.shape[1]) for d in deviation.T], axis=1)
        squares = np.stack([np.bincount(pairs[0].astype(int), s**2, size) for s in sums.T], axis=1)
        error = np.sqrt(squares * (n_particles / (n_particles - 1))[:, None]) / n[:, None]
    return n, n_particles, mean, np.where(n_particles[:, None] > 1, error, np.nan)


def mean_squared_displacement(tracks: pd.DataFrame, frame_rate_hz: float, *, longest: int = 25) -> pd.DataFrame:
    """Mean squared displacement of all particles against the time between (trackpy's `emsd`).

    Errors of measurement add twice their variance to it at any time; a mean flow adds its square.

    Parameters
    ----------
    tracks : DataFrame
        From `link`: `frame`, `particle` and positions.
    frame_rate_hz : float
    longest : int
        Frames of the longest time between.

    Returns
    -------
    DataFrame
        A row for each time between: `lag_s`; `msd_x_um2`, `msd_y_um2`, `msd_z_um2` (of positions in px, `msd_x_px2`),
        and `n`, trackpy's estimate of how many of the displacements are independent.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, a column is missing, or no track has two rows.
    """
    must_be_tracks(tracks)
    columns, rate = positions_of("tracks", tracks), check_rate("frame_rate_hz", frame_rate_hz)
    if not tracks.duplicated("particle").any():
        raise ValueError("tracks: got none of two or more rows, needed is one")
    floats, most = tracks.astype(dict.fromkeys(columns, float)), whole("longest", longest, 1, 10**6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of how trackpy calls pandas
        found = trackpy.emsd(floats, 1.0, rate, max_lagtime=most, detail=True, pos_columns=columns)
    made = {"lag_s": found["lagt"]} | {
        f"msd_{column[0]}_{column.rpartition('_')[2]}2": found[f"<{column}^2>"] for column in columns
    }
    return pd.DataFrame(made | {"n": found["N"]}).reset_index(drop=True)
