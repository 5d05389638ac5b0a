"""Measured against true positions: matching, recall, precision, errors.

As in the standard assessment of R. Barnkob and M. Rossi, Exp. Fluids 61 (2020) 110.
"""

from collections.abc import Callable, Iterable

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import LARGEST, function, generator, iterable, number, positive, real_array
from gdptlab._checks import table as check_table

RESAMPLES = 1000
"""Number of draws of the bootstrap. Convention: the ends of a 95 % interval are then known to about a tenth of its
width; the time grows with their number."""

FAR_PX = 1e5
"""Distance in x, px, by which the frames of a film are set apart to be matched at once; any above a frame's width."""

AXES = {"dx_px": "x_px", "dy_px": "y_px", "dz_um": "z_um"}
"""Column of a position, by the column of its error."""


def match(
    measured: pd.DataFrame, true: pd.DataFrame, *, within_px: float = 2.0, within_um: float = 10.0
) -> pd.DataFrame:
    """Pair measured with true particles, one to one, frame by frame, nearest in the plane first.

    Parameters
    ----------
    measured, true : DataFrame
        Columns `x_px`, `y_px`, `z_um`; with `frame` in both, or in neither (one frame). Rows with NaN or
        numbers beyond 1e12 have no pair.
    within_px : float
        Largest difference in x, and in y, of a pair.
    within_um : float
        Largest difference in z; a tenth of the measured height is usual.

    Returns
    -------
    DataFrame
        A row for each pair: `measured` and `true`, the row labels in the two tables, `dx_px`, `dy_px`,
        `dz_um`, measured minus true, and `z_um`, the true depth.

    Raises
    ------
    TypeError
        If a table is none, or a column does not hold real numbers.
    ValueError
        If a column is missing, or row labels repeat.
    """
    positive("within_px", within_px)
    positive("within_um", within_um)
    for name, table in (("measured", measured), ("true", true)):
        check_table(name, table, AXES.values())
        if not table.index.is_unique:
            raise ValueError(f"{name}: got row labels that repeat, allowed are unique ones (see reset_index)")
    if ("frame" in measured) != ("frame" in true):
        raise ValueError("measured, true: got a column frame in only one of them, allowed is in both or in neither")
    if "frame" in true:
        parts = [
            _match_frame(measured[measured["frame"] == frame], part, within_px, within_um)
            for frame, part in true.groupby("frame")
        ]
    else:
        parts = [_match_frame(measured, true, within_px, within_um)]
    return pd.concat(parts, ignore_index=True) if parts else _match_frame(measured, true, within_px, within_um)


def _match_frame(measured: pd.DataFrame, true: pd.DataFrame, within_px: float, within_um: float) -> pd.DataFrame:
    """Pairs, as from `match`, of the particles of one frame."""
    from scipy.spatial import KDTree  # here, as it takes longer to import than all else of the package

    measured, true = (t.loc[(t[list(AXES.values())].abs() <= LARGEST).all(axis=1)] for t in (measured, true))
    here, there = (t[list(AXES.values())].to_numpy(dtype=float) for t in (measured, true))
    # In units of what is allowed, a pair is allowed if no difference is above 1.
    scale = np.maximum([within_px, within_px, within_um], 1 / LARGEST)
    near = KDTree(here / scale).query_ball_tree(KDTree(there / scale), 1, p=np.inf) if len(here) and len(there) else []
    i = np.repeat(np.arange(len(near)), [len(n) for n in near]).astype(int)
    j = np.array([k for n in near for k in n], dtype=int)
    difference = here[i] - there[j]
    free_here, free_there, chosen = np.ones(len(here), bool), np.ones(len(there), bool), []
    for pair in np.argsort(np.hypot(difference[:, 0], difference[:, 1]), kind="stable"):
        if free_here[i[pair]] and free_there[j[pair]]:
            free_here[i[pair]] = free_there[j[pair]] = False
            chosen.append(pair)
    chosen = np.array(chosen, dtype=int)
    pairs = {"measured": measured.index[i[chosen]], "true": true.index[j[chosen]]}
    pairs |= dict(zip(AXES, difference[chosen].T, strict=True))
    return pd.DataFrame(pairs | {"z_um": there[j[chosen], 2]})


def count_valid(
    measured: pd.DataFrame,
    true: pd.DataFrame,
    frames: ArrayLike,
    *,
    within_px: float = 2.0,
    within_um: float = 10.0,
) -> NDArray[np.intp]:
    """Count the valid particles of each frame: measured ones that `match` pairs with a true one.

    Parameters
    ----------
    measured, true, within_px, within_um
        As in `match`, with the column `frame` in both.
    frames : int array (n,)
        Frames that are counted, increasing.

    Returns
    -------
    int array (n,)
    """
    numbers = np.asarray(frames)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or (np.diff(numbers) <= 0).any():
        raise ValueError(f"frames: got {frames!r}, allowed are increasing whole numbers")
    for name, table in (("measured", measured), ("true", true)):
        check_table(name, table, ["frame", *AXES.values()])
    true = true[true["frame"].isin(numbers)]
    # All frames at once, each far from the others: `match` frame by frame takes longer than the evaluation.
    far_apart = (t.assign(x_px=t["x_px"] + FAR_PX * t["frame"]).drop(columns="frame") for t in (measured, true))
    pairs = match(*far_apart, within_px=within_px, within_um=within_um)
    return np.bincount(np.searchsorted(numbers, true["frame"].loc[pairs["true"]]), minlength=len(numbers))


def scores(measured: pd.DataFrame, true: pd.DataFrame, *, within_px: float = 2.0, within_um: float = 10.0) -> pd.Series:
    """Recall, precision and root-mean-square errors of a measurement.

    Parameters
    ----------
    measured, true, within_px, within_um
        As in `match`.

    Returns
    -------
    Series
        `n_true`, `n_measured`, `n_matched`; `recall` = matched / true and `precision` = matched / measured
        (NaN if there are none to divide by); `sigma_x_px`, `sigma_y_px`, `sigma_z_um`, the RMS errors of the
        pairs, and `bias_z_um`, their mean error in z (NaN without pairs).
    """
    pairs = match(measured, true, within_px=within_px, within_um=within_um)
    return _summary(pairs, len(true), len(measured))


def scores_by_z(
    measured: pd.DataFrame,
    true: pd.DataFrame,
    edges_um: ArrayLike,
    *,
    within_px: float = 2.0,
    within_um: float = 10.0,
) -> pd.DataFrame:
    """`scores` against depth.

    Parameters
    ----------
    measured, true, within_px, within_um
        As in `match`.
    edges_um : array (n + 1,)
        Increasing edges of the bins of z. True and matched particles are counted by their true depth, those
        measured by their measured one; so are the matched in `precision`, which never exceeds 1.

    Returns
    -------
    DataFrame
        A row for each bin, with its middle in the first column, `z_um`, and the columns of `scores`.
    """
    edges = np.asarray(real_array("edges_um", edges_um, 1), dtype=float)
    if len(edges) < 2 or (np.diff(edges) <= 0).any():
        raise ValueError(f"edges_um: got {edges}, allowed are two or more increasing numbers")
    pairs = match(measured, true, within_px=within_px, within_um=within_um)
    found = measured.loc[pairs["measured"]]
    parts = [pd.cut(t["z_um"], edges, labels=False, include_lowest=True) for t in (pairs, true, measured, found)]
    rows = [
        _summary(pairs[parts[0] == k], int((parts[1] == k).sum()), int((parts[2] == k).sum()))
        for k in range(len(edges) - 1)
    ]
    table = pd.DataFrame(rows).assign(z_um=(edges[1:] + edges[:-1]) / 2).set_index("z_um").reset_index()
    right = np.array([(parts[3] == k).sum() for k in range(len(edges) - 1)])
    table["precision"] = right / table["n_measured"]  # NaN if there are none
    return table


def standard_assessment(
    locator: Callable[[NDArray], pd.DataFrame],
    frames: Iterable[NDArray],
    true: pd.DataFrame,
    *,
    edges_um: ArrayLike | None = None,
    within_px: float = 2.0,
    within_um: float = 10.0,
    confidence: float = 0.95,
    rng: np.random.Generator | int = 0,
) -> pd.DataFrame:
    """Let any locator measure frames with known particles, and score it, with confidence intervals.

    The intervals are those of the bootstrap over frames: particles of one frame share its noise and each
    other's light, frames are independent.

    Parameters
    ----------
    locator : callable
        Takes a frame, returns a table with columns `x_px`, `y_px`, `z_um`: `partial(locate,
        calibration=calibration)`, say, or somebody else's.
    frames : iterable of arrays (rows, columns)
        Two or more; ten or more for intervals worth their name.
    true : DataFrame
        Columns `frame` (0 for the first), `x_px`, `y_px`, `z_um`.
    edges_um : array (n + 1,), optional
        Increasing edges of bins of z, for a row of each; without it there is one row, for all depths.
    within_px, within_um
        As in `match`.
    confidence : float
        Of the intervals, between 0 and 1.
    rng : Generator or int
        Of the bootstrap.

    Returns
    -------
    DataFrame
        The columns of `scores`, and for each but the counts the ends of its interval, as in `recall_low` and
        `recall_high`. With `edges_um` the index is `z_um`, the middle of the bins.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or there are fewer than two frames.
    """
    function("locator", locator)
    check_table("true", true, ["frame", *AXES.values()])
    if not 0 < number("confidence", confidence) < 1:
        raise ValueError(f"confidence: got {confidence}, allowed is above 0 and below 1")
    tables, allowed = [], {"within_px": within_px, "within_um": within_um}
    rng = generator("rng", rng)
    for k, frame in enumerate(iterable("frames", frames)):
        measured = check_table("locator", locator(frame), AXES.values())
        here = true[true["frame"] == k].drop(columns="frame")
        measured = measured.drop(columns="frame", errors="ignore")
        if edges_um is None:
            tables.append(scores(measured, here, **allowed).to_frame().T)
        else:
            tables.append(scores_by_z(measured, here, edges_um, **allowed).set_index("z_um"))
    if len(tables) < 2:
        raise ValueError(f"frames: got {len(tables)}, allowed are two or more")
    sums = np.stack([_sums(table) for table in tables])
    drawn = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), RESAMPLES)
    best, again = _from_sums(sums.sum(axis=0)), _from_sums(np.einsum("rf,fbs->rbs", drawn, sums))
    tail = (1 - confidence) / 2
    columns = {}
    for name, values in best.items():
        columns[name] = values
        if not name.startswith("n_"):
            draws = np.where(np.isfinite(again[name]), again[name], values)  # one may hold no particle
            columns[f"{name}_low"], columns[f"{name}_high"] = np.quantile(draws, (tail, 1 - tail), axis=0)
    return pd.DataFrame(columns, index=tables[0].index)


def _sums(table: pd.DataFrame) -> NDArray[np.float64]:
    """Sums (rows, 8), which add up over frames, of a table of scores."""
    counts = table[["n_true", "n_measured", "n_matched"]].to_numpy(dtype=float)
    matched = counts[:, 2]
    squares = [table[f"sigma_{c[1:]}"] ** 2 * matched for c in AXES]
    right = table["precision"] * counts[:, 1]
    more = np.stack([right, *squares, table["bias_z_um"] * matched], axis=1).astype(float)
    return np.concatenate([counts, np.nan_to_num(more)], axis=1)


def _from_sums(sums: NDArray) -> dict[str, NDArray]:
    """Scores, by their names, from sums (..., 8)."""
    true, measured, matched, right, *squares, error = np.moveaxis(sums, -1, 0)
    per_true, per_measured, per_matched = (1 / np.where(n > 0, n, np.nan) for n in (true, measured, matched))
    return {
        "n_true": true,
        "n_measured": measured,
        "n_matched": matched,
        "recall": matched * per_true,
        "precision": right * per_measured,
        **{f"sigma_{c[1:]}": np.sqrt(s * per_matched) for c, s in zip(AXES, squares, strict=True)},
        "bias_z_um": error * per_matched,
    }


def _summary(pairs: pd.DataFrame, n_true: int, n_measured: int) -> pd.Series:
    """Scores, as from `scores`, of pairs and of the numbers of particles."""
    n = len(pairs)
    root_mean_square = {f"sigma_{c[1:]}": np.sqrt((pairs[c] ** 2).mean()) for c in AXES}
    return pd.Series(
        {
            "n_true": n_true,
            "n_measured": n_measured,
            "n_matched": n,
            "recall": n / n_true if n_true else np.nan,
            "precision": n / n_measured if n_measured else np.nan,
            **root_mean_square,
            "bias_z_um": pairs["dz_um"].mean(),
        }
    )
