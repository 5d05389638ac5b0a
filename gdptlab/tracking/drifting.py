"""Drift of stage and focus, from particles that do not move: what is stuck to a wall."""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, hstack
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsqr

from gdptlab._checks import positions
from gdptlab.tracking.tracks import must_be_tracks, positions_of

FEWEST = 2
"""Least number of particles in a frame from which the error of its drift is told."""


def drift(tracks: pd.DataFrame, particles: ArrayLike) -> pd.DataFrame:
    """Drift from frame to frame, from particles that are known to rest.

    In least squares every position is that of its particle plus the drift of its frame, so that particles may be
    missing in some frames, as long as frames are connected by particles that are in both.

    Parameters
    ----------
    tracks : DataFrame
        From `link`: `frame`, `particle`, and positions as there.
    particles : array (k,)
        Numbers of the particles that rest: stuck to a wall, say. Choose those that cover the whole film, and look at
        the error: it tells when one of them moves by itself.

    Returns
    -------
    DataFrame
        A row for each frame with one of them: `frame`; columns of positions, as `x_um`, `y_um`, `z_um`, the drift
        since the first of these frames; `x_se_um` and so on, its standard error from how much the particles differ
        in the frame (not counting that of the first frame), NaN where there is only one; and `n`, how many there are.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, a particle is not in the table, or no particle connects some frames with
        the others.

    Examples
    --------
    >>> rest = pd.DataFrame({"frame": [0, 0, 1, 1], "particle": [3, 5, 3, 5], "x_um": [1.0, 7, 1.5, 7.5], "y_um": 0.0})
    >>> drift(rest.assign(z_um=[0.0, 4, 2, 6]), [3, 5])[["frame", "x_um", "z_um", "n"]].round(6)
       frame  x_um  z_um  n
    0      0   0.0   0.0  2
    1      1   0.5   2.0  2
    """
    must_be_tracks(tracks)
    columns, chosen = positions_of("tracks", tracks), np.asarray(particles)
    if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "iu"):
        raise ValueError(f"particles: got {particles!r}, allowed is a list of whole numbers")
    chosen = np.unique(chosen)
    absent = sorted(set(chosen.tolist()) - set(tracks["particle"].tolist()))
    if absent or not len(chosen):
        raise ValueError(f"particles: got {absent or 'none'}, allowed are numbers in the column particle of tracks")
    rest = tracks[tracks["particle"].isin(chosen)]
    frame, frames = pd.factorize(rest["frame"], sort=True)
    particle, _ = pd.factorize(rest["particle"])
    position = rest[columns].to_numpy(dtype=float)
    row, ones = np.arange(len(rest)), np.ones(len(rest))
    of_frame = coo_array((ones, (row, frame)), shape=(len(rest), len(frames)))
    of_particle = coo_array((ones, (row, particle)), shape=(len(rest), len(chosen)))
    pieces = connected_components(of_frame.T @ of_particle @ of_particle.T @ of_frame, directed=False)
    if pieces[0] > 1:
        apart = frames[np.flatnonzero(pieces[1] != pieces[1][0])[0]]
        raise ValueError(f"particles: got none that are in frame {apart} and in frames before it, needed is one")
    unknown, middle = hstack([of_frame, of_particle]).tocsr(), position.mean(axis=0)
    solved = [lsqr(unknown, p, atol=1e-12, btol=1e-12)[0] for p in (position - middle).T]
    moved = np.stack([s[: len(frames)] for s in solved], axis=1)
    residual = position - middle - np.stack([unknown @ s for s in solved], axis=1)
    n = np.bincount(frame)
    squares = np.stack([np.bincount(frame, r**2) for r in residual.T], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.sqrt(squares / (n * (n - 1))[:, None])
    error[n < FEWEST] = np.nan
    made = {"frame": np.asarray(frames)}
    made |= {name: moved[:, axis] - moved[0, axis] for axis, name in enumerate(columns)}
    made |= {f"{name[0]}_se{name[1:]}": error[:, axis] for axis, name in enumerate(columns)}
    return pd.DataFrame(made | {"n": n})


def without_drift(table: pd.DataFrame, drift: pd.DataFrame) -> pd.DataFrame:
    """Subtract a drift from positions.

    Parameters
    ----------
    table : DataFrame
        `frame`, and positions in the columns that the drift is in.
    drift : DataFrame
        From `drift`; between its frames it is taken to be even, and beyond them to rest.

    Returns
    -------
    DataFrame
        Copy with positions as they would be if stage and focus were where they were in the first frame of the drift.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or the columns of the one are not in the other.
    """
    positions("drift", drift, ["frame"])
    columns = positions_of("drift", drift)
    positions("table", table, ["frame", *columns])
    if drift.empty or not (np.diff(drift["frame"]) > 0).all():
        raise ValueError("drift: got frames that do not increase, or none, allowed is a table from `drift`")
    moved = {name: np.interp(table["frame"], drift["frame"], drift[name]) for name in columns}
    return table.assign(**{name: table[name] - values for name, values in moved.items()})
