"""From positions, frame by frame, to tracks and velocities of single particles.

Linking is trackpy's (J. C. Crocker and D. G. Grier, J. Colloid Interface Sci. 179 (1996) 298): of all ways to
pair the particles of one frame with those of the next, the one with the least sum of squared distances. Here a
distance is taken from where the particle is expected, in units of the search range, which differs between the axes:
depth is known least. Of the sound nothing is assumed, so tracks can be used to measure it.
"""

import warnings
from collections.abc import Iterable, Iterator
from numbers import Real
from typing import Protocol, runtime_checkable

import numpy as np
import pandas as pd
import trackpy
from numpy.typing import ArrayLike, NDArray
from trackpy.predict import NearestVelocityPredict

from gdptlab._checks import LARGEST, rate, whole
from gdptlab._checks import table as check_table
from gdptlab.assessment import match

IN_CHANNEL = ["x_channel_um", "y_channel_um", "z_um"]
"""Columns of a position in a channel, whose middle is at y = z = 0 (see `experiment.Film.to_channel`)."""

IN_UM = ["x_um", "y_um", "z_um"]
"""Columns of a position in µm, x and y from the centre of the first pixel (see `pipeline.in_um`)."""

POSITIONS = (IN_CHANNEL, IN_UM, ["x_px", "y_px", "z_um"])
"""Columns of a position; of a table that has several of these, the first are used."""

LEAST_ROWS = 5
"""Least number of positions in a window from which a velocity is fitted. Derived: a parabola has three coefficients,
and two degrees of freedom are left to tell the scatter."""


@runtime_checkable
class Flow(Protocol):
    """Flow along x through a channel whose middle is at y = z = 0, such as an `experiment.Channel`."""

    width_um: float
    height_um: float

    def velocity(self, y_channel_um: ArrayLike, z_um: ArrayLike) -> NDArray[np.float64]:
        """Velocity along x (µm/s) at positions across the channel."""


def positions_of(name: str, table: pd.DataFrame) -> list[str]:
    """Columns of the positions in a table: the first of `POSITIONS` that it has all of.

    Raises
    ------
    TypeError, ValueError
        If it is no table, or has none of them; if a position is not finite, or beyond 1e12.
    """
    check_table(name, table, ())
    columns = next((columns for columns in POSITIONS if set(columns) <= set(table)), None)
    if columns is None:
        allowed = ", or ".join(map(", ".join, POSITIONS))
        raise ValueError(f"{name}: got columns {list(table)}, needed are {allowed}")
    check_table(name, table, columns)
    if not (table[columns].abs() <= LARGEST).all(axis=None):
        raise ValueError(f"{name}: got positions that are NaN or beyond {LARGEST:g}, allowed are numbers to there")
    return columns


def frames_of(name: str, table: pd.DataFrame) -> NDArray[np.int64]:
    """Frames (n,) of a table.

    Raises
    ------
    TypeError, ValueError
        If it is no table, has none, or they are not whole numbers.
    """
    frames = check_table(name, table, ["frame"])["frame"]
    if frames.dtype.kind not in "iu":
        raise TypeError(f"{name}: got frames of type {frames.dtype}, allowed are whole numbers")
    return frames.to_numpy(dtype=np.int64)


def must_be_tracks(tracks: pd.DataFrame) -> None:
    """Raise TypeError or ValueError unless a table has whole frames, and each particle at most once in a frame."""
    check_table("tracks", tracks, ["frame", "particle"])
    frames_of("tracks", tracks)
    if tracks.duplicated(["frame", "particle"]).any():
        raise ValueError("tracks: got a particle twice in a frame, allowed is once")


def link(
    table: pd.DataFrame,
    *,
    search_range: tuple[float, float, float] = (1.5, 1.5, 4.0),
    predictor: Flow | str | None = None,
    frame_rate_hz: float | None = None,
    memory: int = 8,
    min_rows: int = 10,
) -> pd.DataFrame:
    """Link positions of successive frames to tracks.

    Parameters
    ----------
    table : DataFrame
        Positions of each `frame`, a whole number: `x_channel_um`, `y_channel_um`, `z_um`; or, if it does not have
        these, `x_um`, `y_um`, `z_um`; or `x_px`, `y_px`, `z_um`.
    search_range : (x, y, z)
        Half axes of the ellipsoid, around the expected position, in which a particle is looked for, in the units of
        the positions. To be chosen larger than errors, and than what a particle moves in a frame unpredicted; and
        smaller than the distance between particles. The default is for the paper's experiment in µm, where sound moves
        particles by 0.6 µm in a frame.
    predictor : optional
        Where a particle is expected. None: where it was. "nearest velocity": moved on as the particle nearest to it
        moved between the two frames before (trackpy's), for flows that change little from frame to frame. A `Flow`,
        such as an `experiment.Channel`: carried by it; positions then are those in the channel (see
        `experiment.Film.to_channel`).
    frame_rate_hz : float, optional
        Needed with a `Flow`.
    memory : int
        Longest gap, in frames, that a track may have; there the prediction alone continues it.
    min_rows : int
        Tracks of fewer rows are left out: they are most often of false finds.

    Returns
    -------
    DataFrame
        Those rows of `table` that are in a track, by frame and then by `particle`, the last column: the number of the
        track, from 0 on in the order in which they begin. Row labels are new.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, a column is missing, a position is not finite or a frame not whole.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": [0, 0, 2], "x_um": [7.0, 60.0, 7.8], "y_um": [9.0, 50.0, 9.4], "z_um": 0.0})
    >>> link(table, min_rows=2)  # in frame 1 the particle was not found
       frame  x_um  y_um  z_um  particle
    0      0   7.0   9.0   0.0         0
    1      2   7.8   9.4   0.0         0
    """
    frames_of("table", table)
    columns, ranges = positions_of("table", table), _search_range(search_range)
    whole("memory", memory, 0, 10_000)
    whole("min_rows", min_rows, 1, 2**31)
    if isinstance(predictor, Flow):
        rate("frame_rate_hz", frame_rate_hz)
        check_table("table", table, IN_CHANNEL)
    elif predictor is not None and not (isinstance(predictor, str) and predictor == "nearest velocity"):
        raise TypeError(f"predictor: got {predictor!r}, allowed are None, 'nearest velocity' and a Channel")
    if table.empty:
        return table.assign(particle=np.zeros(0, dtype=np.int64)).reset_index(drop=True)
    ordered = table.sort_values("frame", kind="stable", ignore_index=True).drop(columns="particle", errors="ignore")
    number = pd.Series(np.concatenate(list(_linked(ordered, columns, ranges, predictor, frame_rate_hz, memory))))
    kept = (number.groupby(number).transform("size") >= min_rows).to_numpy()
    tracks = ordered[kept].assign(particle=pd.factorize(number[kept])[0].astype(np.int64))
    return tracks.sort_values(["frame", "particle"], ignore_index=True)


def _search_range(search_range: tuple[float, float, float]) -> NDArray[np.float64]:
    """Search range along x, y and z (3,), if it is one."""
    ranges = tuple(search_range) if isinstance(search_range, tuple | list) else ()
    if len(ranges) != 3 or not all(isinstance(r, Real) and 0 < r < np.inf for r in ranges):
        raise ValueError(f"search_range: got {search_range!r}, allowed are three finite numbers above 0: x, y, z")
    return np.array(ranges, dtype=float)


def _linked(
    ordered: pd.DataFrame,
    columns: list[str],
    ranges: NDArray,
    predictor: Flow | str | None,
    frame_rate_hz: float | None,
    memory: int,
) -> Iterator[NDArray[np.int64]]:
    """Numbers (n,) of the tracks that the rows of each frame belong to, for a table sorted by frame."""
    trackpy.quiet()  # or it reports every frame
    frames = range(ordered["frame"].iloc[0], ordered["frame"].iloc[-1] + 1)
    positions = np.split(ordered[columns].to_numpy(dtype=float), np.searchsorted(ordered["frame"], frames[1:]))
    nearest = NearestVelocityPredict(pos_columns=columns) if predictor == "nearest velocity" else None
    if nearest:
        nearest.t_column, predict = "frame", nearest.predict
    else:
        predict = _carried(predictor, frame_rate_hz) if predictor else None
    linked = trackpy.link_iter(  # not `link`: that upsets recent pandas
        zip(frames, positions, strict=True),
        tuple(ranges),
        memory=memory,
        predictor=predict,
        adaptive_stop=ranges.min() / 20,  # where too many are in the range of each other, it is made smaller for them
        adaptive_step=0.8,
        link_strategy="recursive",  # the others would first be compiled, for longer than they save
    )
    for (frame, numbers), here in zip(linked, positions, strict=True):
        if nearest and len(here):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that no particle is in both frames: then it predicts rest
                nearest.observe(pd.DataFrame(here, columns=columns).assign(frame=frame, particle=numbers))
        yield np.array(numbers, dtype=np.int64)


def _carried(flow: Flow, frame_rate_hz: float) -> object:
    """Predictor of trackpy's kind: particles carried along x by a flow."""
    half = np.array([flow.width_um, flow.height_um]) / 2

    def expected(frame: int, particles: Iterable) -> NDArray[np.float64]:
        """Positions (n, 3) at a frame of trackpy's particles, seen last at theirs."""
        particles = list(particles)
        position = np.array([p.pos for p in particles]).reshape(-1, 3)
        waited_s = (frame - np.array([p.t for p in particles])) / frame_rate_hz
        inside = np.clip(position[:, 1:], -half, half)  # by their errors some are measured outside
        return position + np.outer(flow.velocity(*inside.T) * waited_s, [1, 0, 0])

    return expected


# -------------------- velocities


def velocities(tracks: pd.DataFrame, frame_rate_hz: float | None = None, *, window: int = 11) -> pd.DataFrame:
    """Velocities along tracks, each from a parabola through the neighbouring frames.

    Least squares, weighted if positions have standard deviations, frames without a measurement left out. The standard
    deviation of a velocity follows from those of the positions, enlarged where they scatter about the parabola by
    more than they should; or, if positions have none, from the scatter alone. Positions that are off in the same way in
    many successive frames, and a calibration that is off in depth, it cannot know of.

    Parameters
    ----------
    tracks : DataFrame
        From `link`: `frame`, `particle`, positions as there, and `x_std_um` and so on if they are known.
    frame_rate_hz : float, optional
        If not given, the time of each row is in its column `t_s`.
    window : int
        Frames, centred, from 5 to 1001; odd. The longer, the less noise, and the more of a bend is taken for straight.

    Returns
    -------
    DataFrame
        Copy with `vx_um_s`, `vx_std_um_s` and so on (of positions in px, `vx_px_s`); NaN where fewer than `LEAST_ROWS`
        frames of the window have a measurement.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, a column is missing, a standard deviation is not above 0, or a
        particle is in a frame twice.
    """
    must_be_tracks(tracks)
    columns = positions_of("tracks", tracks)
    axes = [(column[0], column.rpartition("_")[2]) for column in columns]  # such as x, µm
    stds = [f"{axis}_std_{unit}" for axis, unit in axes]
    weighted = set(stds) <= set(tracks)
    window = checked_window(window)
    if weighted and not (check_table("tracks", tracks, stds)[stds] > 0).all(axis=None):
        raise ValueError("tracks: got a standard deviation that is NaN or not above 0, allowed are those above 0")
    if frame_rate_hz is not None:
        t_s = tracks["frame"].to_numpy() / rate("frame_rate_hz", frame_rate_hz)
    elif "t_s" in tracks:
        t_s = check_table("tracks", tracks, ["t_s"])["t_s"].to_numpy(dtype=float)
    else:
        raise ValueError("frame_rate_hz: got None, allowed is that if tracks have a column t_s")
    position = tracks[columns].to_numpy(dtype=float)
    weight = tracks[stds].to_numpy(dtype=float) ** -2.0 if weighted else np.ones_like(position)
    fitted, std = _slopes(tracks, t_s, position, weight, window, least=1.0 if weighted else 0.0)
    made = {}
    for k, (axis, unit) in enumerate(axes):
        made[f"v{axis}_{unit}_s"], made[f"v{axis}_std_{unit}_s"] = fitted[:, k], std[:, k]
    return tracks.assign(**made)


def checked_window(window: int) -> int:
    """Window of `velocities`, frames, if it is one."""
    if whole("window", window, LEAST_ROWS, 1001) % 2 == 0:
        raise ValueError(f"window: got {window}, allowed are odd numbers")
    return window


def _slopes(
    tracks: pd.DataFrame, t_s: NDArray, position: NDArray, weight: NDArray, window: int, least: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes of parabolas through positions (n, 3) in a window about each row, and their stds; both (n, 3).

    Variances are those of the weights, enlarged by chi-square over the degrees of freedom, and not below `least` times.
    """
    moments, right = np.zeros((5, len(tracks), 3)), np.zeros((3, len(tracks), 3))
    number, squares = np.zeros(len(tracks)), np.zeros((len(tracks), 3))
    row = pd.factorize(tracks["particle"])[0]
    column = (tracks["frame"] - tracks["frame"].min()).to_numpy(dtype=int)
    key = row.astype(np.int64) * (column.max(initial=0) + window) + column  # no other track within a window
    order = np.argsort(key, kind="stable")
    for offset in range(-(window // 2), window // 2 + 1):
        at = np.minimum(np.searchsorted(key[order], key + offset), len(key) - 1)
        there = np.flatnonzero(key[order][at] == key + offset)
        other = order[at[there]]
        dt, dx = (t_s[other] - t_s[there])[:, None], position[other] - position[there]
        number[there] += 1
        squares[there] += weight[other] * dx**2
        for power in range(5):
            moments[power, there] += weight[other] * dt**power
            if power < 3:
                right[power, there] += weight[other] * dt**power * dx
    enough = number >= LEAST_ROWS
    normal = np.moveaxis(moments[np.add.outer(range(3), range(3))], (0, 1), (-2, -1))[enough]
    right = np.moveaxis(right, 0, -1)[enough]
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError as error:
        raise ValueError("tracks: got times in which no velocity can be told, allowed are those that differ") from error
    fitted = np.einsum("naij,naj->nai", inverse, right)
    chi2 = squares[enough] - (fitted * right).sum(axis=-1)
    excess = np.maximum(chi2 / (number[enough] - 3)[:, None], least)
    slope, std = np.full((2, *position.shape), np.nan)
    slope[enough], std[enough] = fitted[..., 1], np.sqrt(inverse[..., 1, 1] * excess)
    return slope, std


# -------------------- against the truth


def identify(
    tracks: pd.DataFrame, true: pd.DataFrame, *, within_px: float = 2.0, within_um: float = 10.0
) -> NDArray[np.int64]:
    """Which true particle is each measured one?

    Parameters
    ----------
    tracks : DataFrame
        Measured, linked or not: `frame`, `x_px`, `y_px`, `z_um`.
    true : DataFrame
        As from `Film.truth`: `frame`, `particle` (0 or above), `x_px`, `y_px`, `z_um`.
    within_px, within_um : float
        As in `assessment.match`, which decides. Where true particles are nearer to each other than this, it does so by
        their distance alone, and sound brings them there.

    Returns
    -------
    array (n,)
        Number of the true particle of each row; -1: of none.

    Raises
    ------
    ValueError
        If a column is missing or a tolerance is not above 0.
    """
    check_table("tracks", tracks, ["frame", "x_px", "y_px", "z_um"])
    check_table("true", true, ["frame", "particle", "x_px", "y_px", "z_um"])
    if len(true) and true["particle"].dtype.kind not in "iu":
        raise TypeError(f"true: got particles of type {true['particle'].dtype}, allowed are whole numbers")
    tracks, true = tracks.reset_index(drop=True), true.reset_index(drop=True)
    pair = match(tracks, true, within_px=within_px, within_um=within_um)
    who = np.full(len(tracks), -1)
    who[pair["measured"]] = true["particle"].to_numpy()[pair["true"]]
    return who


def link_scores(
    tracks: pd.DataFrame, true: pd.DataFrame, *, within_px: float = 2.0, within_um: float = 10.0
) -> pd.Series:
    """How many links are right? A link joins a particle of a track with the next one of that track.

    Parameters
    ----------
    tracks : DataFrame
        From `link`, with `x_px`, `y_px`, `z_um`; of all frames of `true`, or of some of both.
    true, within_px, within_um
        As in `identify`.

    Returns
    -------
    Series
        `n_tracks`, `n_links`. Fractions of the links: `right`, both ends are the same true particle; `wrong`, they
        are two; `nobody`, an end is a false find. `found`, right links over those of the truth (from each particle's
        frame to its next), so that missed particles count, too. `n_gaps`, links over one or more frames without a
        measurement, and `gaps_right`, the fraction of them. `n_particles`, true ones that are in tracks; `broken`,
        the fraction of them that are in more than one; `pieces`, tracks for each. NaN if there are none to divide by.

    Raises
    ------
    ValueError
        If a column is missing or a tolerance is not above 0.
    """
    check_table("tracks", tracks, ["particle"])
    who = identify(tracks, true, within_px=within_px, within_um=within_um)
    ordered = tracks.assign(who=who).sort_values(["particle", "frame"])
    after = ordered.shift(-1)
    linked = (ordered["particle"] == after["particle"]).to_numpy()
    here, there = ordered["who"].to_numpy()[linked], after["who"].to_numpy()[linked]
    gap = (after["frame"] - ordered["frame"]).to_numpy()[linked] > 1
    known = (here >= 0) & (there >= 0)
    right = known & (here == there)
    pieces = ordered[ordered["who"] >= 0].groupby("who")["particle"].nunique()
    possible = len(true) - true["particle"].nunique()
    return pd.Series(
        {
            "n_tracks": tracks["particle"].nunique(),
            "n_links": len(here),
            "right": _fraction(right),
            "wrong": _fraction(known & ~right),
            "nobody": _fraction(~known),
            "found": right.sum() / possible if possible else np.nan,
            "n_gaps": gap.sum(),
            "gaps_right": _fraction(right[gap]),
            "n_particles": len(pieces),
            "broken": _fraction(pieces > 1),
            "pieces": pieces.mean(),
        }
    )


def _fraction(yes: NDArray[np.bool_] | pd.Series) -> float:
    """Fraction of what is true in an array (n,); NaN if it is empty."""
    return float(np.mean(yes)) if len(yes) else np.nan
