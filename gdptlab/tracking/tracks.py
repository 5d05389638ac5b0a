"""From positions, frame by frame, to tracks and velocities of single particles.

Linking is trackpy's (J. C. Crocker and D. G. Grier, J. Colloid Interface Sci. 179 (1996) 298): of all ways to
pair the particles of one frame with those of the next, the one with the least sum of squared distances. Here a
distance is taken from where the flow would have carried the particle, in units of how far it may be off, which
differs between the axes: depth is known least. Of the sound nothing is assumed, so tracks can be used to measure it.
"""

from collections.abc import Iterable
from numbers import Real
from typing import Protocol, runtime_checkable

import numpy as np
import pandas as pd
import trackpy
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d

from gdptlab._checks import positive, whole
from gdptlab._checks import table as check_table
from gdptlab.assessment import match


@runtime_checkable
class Flow(Protocol):
    """What `link` needs to know of a flow, such as an `experiment.Channel`."""

    width_um: float
    height_um: float

    def velocity(self, y_um: ArrayLike, z_um: ArrayLike) -> NDArray[np.float64]:
        """Velocity along x (µm/s) at positions across the channel."""


POSITION = ["x_um", "y_um", "z_um"]
"""Columns of a position in the channel."""


def link(
    table: pd.DataFrame,
    channel: Flow,
    frame_rate_hz: float,
    *,
    reach_um: tuple[float, float, float] = (1.5, 1.5, 4.0),
    memory: int = 8,
    min_rows: int = 10,
) -> pd.DataFrame:
    """Link positions of successive frames to tracks.

    Parameters
    ----------
    table : DataFrame
        Positions in the channel, `x_um`, `y_um` and `z_um` (see `Film.to_channel`), of each `frame`, a whole number.
    channel : Channel, or another `Flow`
        It says how far downstream a particle is to be expected.
    frame_rate_hz : float
    reach_um : (x, y, z)
        Half axes of the ellipsoid, around the expected position, in which a particle is looked for. To be chosen
        larger than errors and than what sound moves it by in a frame (the default's: 0.6 µm along y and z), and
        smaller than what is between particles.
    memory : int
        Longest gap, in frames, that a track may have; there it is continued by the flow alone.
    min_rows : int
        Tracks of fewer rows are left out: they are most often nobody's.

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
    >>> from gdptlab.experiment import Channel
    >>> table = pd.DataFrame({"frame": [0, 0, 2], "x_um": [7.0, 60.0, 7.8], "y_um": [9.0, 50.0, 9.4], "z_um": 0.0})
    >>> link(table, Channel(), 25.0, min_rows=2)  # in one frame of the three it was not found
       frame  x_um  y_um  z_um  particle
    0      0   7.0   9.0   0.0         0
    1      2   7.8   9.4   0.0         0
    """
    check_table("table", table, ["frame", *POSITION])
    if not isinstance(channel, Flow):
        raise TypeError(f"channel: got {channel!r}, allowed is a Channel")
    positive("frame_rate_hz", frame_rate_hz)
    reach = _reach(reach_um)
    whole("memory", memory, 0, 10_000)
    whole("min_rows", min_rows, 1, 2**31)
    if not np.isfinite(table[POSITION].to_numpy(dtype=float)).all():
        raise ValueError("table: got positions that are NaN or infinite, allowed are finite ones")
    if table["frame"].dtype.kind not in "iu":
        raise TypeError(f"table: got frames of type {table['frame'].dtype}, allowed are whole numbers")
    if table.empty:
        return table.assign(particle=np.zeros(0, dtype=np.int64)).reset_index(drop=True)
    half = np.array([channel.width_um, channel.height_um]) / 2

    def expected(frame: int, particles: Iterable) -> NDArray[np.float64]:
        """Positions (n, 3) at a frame of trackpy's particles, seen last at theirs."""
        particles = list(particles)
        place = np.array([p.pos for p in particles]).reshape(-1, 3)
        waited_s = (frame - np.array([p.t for p in particles])) / frame_rate_hz
        inside = np.clip(place[:, 1:], -half, half)  # by their errors some are measured outside
        return place + np.outer(channel.velocity(*inside.T) * waited_s, [1, 0, 0])

    trackpy.quiet()  # or it reports every frame
    ordered = table.sort_values("frame", kind="stable", ignore_index=True)
    frames = range(ordered["frame"].iloc[0], ordered["frame"].iloc[-1] + 1)
    places = np.split(ordered[POSITION].to_numpy(dtype=float), np.searchsorted(ordered["frame"], frames[1:]))
    linked = trackpy.link_iter(  # not `link`: that upsets recent pandas
        zip(frames, places, strict=True),
        tuple(reach),
        memory=memory,
        predictor=expected,
        adaptive_stop=reach.min() / 20,  # where too many are in reach of each other, it is made smaller for them
        adaptive_step=0.8,
        link_strategy="recursive",  # the others would first be compiled, for longer than they save
    )
    number = pd.Series([particle for _, particles in linked for particle in particles])
    ordered = ordered.drop(columns="particle", errors="ignore")
    kept = (number.groupby(number).transform("size") >= min_rows).to_numpy()
    ordered, number = ordered[kept], number[kept]
    tracks = ordered.assign(particle=pd.factorize(number)[0].astype(np.int64))
    return tracks.sort_values(["frame", "particle"], ignore_index=True)


def _reach(reach_um: tuple[float, float, float]) -> NDArray[np.float64]:
    reach = tuple(reach_um) if isinstance(reach_um, tuple | list) else ()
    if len(reach) != 3 or not all(isinstance(r, Real) and 0 < r < np.inf for r in reach):
        raise ValueError(f"reach_um: got {reach_um!r}, allowed are three finite numbers above 0: x, y, z")
    return np.array(reach, dtype=float)


# -------------------- velocities


def velocities(tracks: pd.DataFrame, frame_rate_hz: float, *, window: int = 11) -> pd.DataFrame:
    """Velocities along tracks, each from a parabola through the neighbouring frames.

    Weighted least squares, frames without a measurement left out. A standard deviation follows from those of the
    positions, enlarged where they scatter about the parabola by more than they should. Positions that are
    off in the same way in many successive frames, and a calibration that is off in depth, it cannot know of.

    Parameters
    ----------
    tracks : DataFrame
        From `link`, of positions that have standard deviations: `frame`, `particle`, and `x_um`, `x_std_um` and so on.
    frame_rate_hz : float
    window : int
        Frames, centred, from 5 to 1001; odd. The longer, the less noise, and the more of a bend is taken for straight.

    Returns
    -------
    DataFrame
        Copy with `vx_um_s`, `vx_std_um_s` and so on; NaN where fewer than 5 frames of the window have a measurement.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, a column is missing, a standard deviation is not above 0, or a
        particle is in a frame twice.
    """
    stds = [f"{axis}_std_um" for axis in "xyz"]
    check_table("tracks", tracks, ["frame", "particle", *POSITION, *stds])
    step_s = 1 / positive("frame_rate_hz", frame_rate_hz)
    if whole("window", window, 5, 1001) % 2 == 0:
        raise ValueError(f"window: got {window}, allowed are odd numbers")
    if not (np.isfinite(tracks[POSITION]).all(axis=None) and (tracks[stds] > 0).all(axis=None)):
        raise ValueError("tracks: got NaN, or a standard deviation of 0, allowed are finite numbers and above 0")
    if tracks.duplicated(["frame", "particle"]).any():
        raise ValueError("tracks: got a particle twice in a frame, allowed is once")
    if tracks.empty:
        return tracks.assign(**{f"v{axis}{kind}_um_s": 0.0 for axis in "xyz" for kind in ("", "_std")})
    row = pd.factorize(tracks["particle"])[0]
    column = (tracks["frame"] - tracks["frame"].min()).to_numpy()
    grid = np.zeros((row.max() + 1, column.max() + 1))
    offset_s = step_s * np.arange(-(window // 2), window // 2 + 1)

    def moment(values: NDArray, power: int) -> NDArray:
        """Sum over the window of each row of `tracks` of `values`, of the same rows, times offset ** power."""
        dense = grid.copy()
        dense[row, column] = values
        return correlate1d(dense, offset_s**power, axis=1, mode="constant")[row, column]

    number = np.rint(moment(np.ones(len(tracks)), 0))
    enough = number >= 5
    columns = {}
    for axis in "xyz":
        weight = tracks[f"{axis}_std_um"].to_numpy() ** -2.0
        place = tracks[f"{axis}_um"].to_numpy()
        normal = np.stack([moment(weight, power) for power in range(5)])[np.add.outer(range(3), range(3))]
        right = np.stack([moment(weight * place, power) for power in range(3)])
        inverse = np.linalg.inv(np.moveaxis(normal, -1, 0)[enough])
        fitted = np.einsum("nij,jn->in", inverse, right[:, enough])
        squares = moment(weight * place**2, 0)[enough] - (fitted * right[:, enough]).sum(axis=0)
        excess = np.maximum(squares / np.maximum(number[enough] - 3, 1), 1)
        for name, values in (("", fitted[1]), ("_std", np.sqrt(inverse[:, 1, 1] * excess))):
            columns[f"v{axis}{name}_um_s"] = np.full(len(tracks), np.nan)
            columns[f"v{axis}{name}_um_s"][enough] = values
    return tracks.assign(**columns)


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
        `n_tracks`, `n_links`. Shares of the links: `right`, both ends are the same true particle; `wrong`, they
        are two; `nobody`, an end is none. `found`, right links over those of the truth (from each particle's frame to
        its next), so that missed particles count, too. `n_gaps`, links over one or more frames without a
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
    return float(np.mean(yes)) if len(yes) else np.nan
