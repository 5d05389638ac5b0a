"""From tracks to the strength of the sound: U of eqs (1a, 1b), and with it the acoustic energy density E_ac.

A particle's path across the channel has a closed form (`Focusing.path`) with two unknowns: where the particle was,
which is its own, and the rate 2πU/w, which is everybody's. Both are fitted to all tracks at once, for y and for z.

Errors are larger than the standard deviations of positions say, and there is a remedy for each reason. A crowd closes
in: in each second of the film all are enlarged by one factor, so that the middle half of the residuals is as it should
be. A few measurements are far off: residuals are taken to have the distribution of Student's t with `FREEDOM` degrees
of freedom, in which those weigh little. Errors of one track correlate (a neighbour stays a neighbour), and so are those
of all particles at one depth (they share the calibration): the interval comes from how much the result owes to each
track, and to each slice of depth, not from the number of rows.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import KDTree

from gdptlab._checks import LARGEST, generator, instance, instances, positive
from gdptlab._checks import rate as check_rate
from gdptlab._checks import table as check_table
from gdptlab.experiment.channel import IN_CHANNEL, Focusing
from gdptlab.experiment.film import Film
from gdptlab.tracking.tracks import frames_of, identify

FREEDOM = 4.0
"""Degrees of freedom of Student's t. Convention of robust fits: at 5 standard deviations a residual weighs a sixth of
what it would otherwise; with many more, outliers count in full, and with 1, those of normal errors lose half their
weight."""

SLICE_UM = 4.0
"""Depth, µm, over which the error of a calibration is one and the same. Derived: two of the paper's 2 µm between
images, over which interpolation along z correlates; with less, the interval is too narrow, with more, too wide."""

ROUNDS = 200
"""Largest number of steps of the fit. Derived: with steps of `LONGEST_STEP` the rate changes by a factor of e**60; a
fit that needs more does not converge."""

LONGEST_STEP = 0.3
"""Longest step of the fit, of the logarithm of the rate. Derived: a third more or less, over which paths bend
little."""

OFF_WALL, OFF_AXIS = 1e-4, 1e-6
"""Least distances of a position from the walls, where nothing moves, and from the axis, where a derivative is 0 / 0, as
fractions of the channel's extent. Derived: far below any error of measurement, far above rounding."""


POSITION = list(IN_CHANNEL.values())
"""Columns of a position in the channel."""


@dataclass(frozen=True)
class _Rate:
    """Fit along one axis.

    log_ratio: logarithm of the fitted rate over that of the `Focusing`.
    tracks, slices: what each track (G,), and each slice of depth (S,), contributed; their squares sum to the variance.
    """

    log_ratio: float
    tracks: NDArray[np.float64]
    slices: NDArray[np.float64]


def fit_energy(
    tracks: pd.DataFrame, focusing: Focusing, frame_rate_hz: float, *, confidence: float = 0.95
) -> pd.DataFrame:
    """Fit the radiation velocities, and the acoustic energy density, to tracks.

    The sound is on in all frames. Since E_ac = 3 η U / (2 Φ a² k), an error of the contrast factor Φ or of the
    radius a, as `focusing` has them, is one of E_ac; it is not in the interval. U does not depend on them.

    Parameters
    ----------
    tracks : DataFrame
        From `tracks.link`, of positions that have standard deviations: `frame`, `particle`,
        `y_channel_um`, `y_std_um`, `z_um`, `z_std_um`. Three tracks or more; those of a single row say nothing.
    focusing : Focusing
        Channel, suspension, and whether U_z = U_y or U_z = U_y w/h. Its E_ac is where the search begins, no more.
    frame_rate_hz : float
    confidence : float
        Of the intervals, between 0 and 1.

    Returns
    -------
    DataFrame
        Columns `value`, `std`, `low` and `high`. Rows: `U_y_um_s`, `U_z_um_s`, the amplitudes, fitted
        separately; `E_y_J_m3`, `E_z_J_m3`, the energy density that each tells of; `E_J_m3`, from both, weighted by
        their variances (meaningless if the two contradict each other); `U_z/U_y`.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, a column is missing, a standard deviation is not above 0, there are too few
        tracks, or the particles do not move enough for a fit.
    """
    columns = ["frame", "particle", "y_channel_um", "y_std_um", "z_um", "z_std_um"]
    check_table("tracks", tracks, columns)
    instance("focusing", focusing, Focusing)
    rate = check_rate("frame_rate_hz", frame_rate_hz)
    if not 0 < positive("confidence", confidence) < 1:
        raise ValueError(f"confidence: got {confidence}, allowed is between 0 and 1")
    stds = tracks[["y_std_um", "z_std_um"]]
    if not ((tracks[columns].abs() <= LARGEST).all(axis=None) and (stds >= 1 / LARGEST).all(axis=None)):
        raise ValueError(f"tracks: got NaN, numbers beyond {LARGEST:g}, or a standard deviation of 0, allowed are none")
    tracks = tracks[tracks.groupby("particle")["frame"].transform("size") > 1]
    number = tracks["particle"].nunique()
    if number < 3:
        raise ValueError(f"tracks: got {number} of two or more rows, allowed are 3 or more")
    y, z = (_fit(tracks, focusing, axis, rate) for axis in "yz")
    weight = 1 / np.array([_variance(y.tracks, y.slices), _variance(z.tracks, z.slices)])
    both = _mixed((y, z), weight / weight.sum())
    energy = focusing.acoustics.energy_density_J_m3
    scales = {
        "U_y_um_s": (focusing.amplitude_um_s("y"), y),
        "U_z_um_s": (focusing.amplitude_um_s("z"), z),
        "E_y_J_m3": (energy, y),
        "E_z_J_m3": (energy, z),
        "E_J_m3": (energy, both),
        "U_z/U_y": (focusing.amplitude_um_s("z") / focusing.amplitude_um_s("y"), _mixed((y, z), np.array([-1.0, 1.0]))),
    }
    return pd.DataFrame({name: _interval(*what, confidence) for name, what in scales.items()}).T


def _mixed(rates: tuple[_Rate, _Rate], weight: NDArray) -> _Rate:
    """Weighted sum (weights (2,)) of the logarithms of two fits, with the errors that both have from the same cause."""
    logs, of_tracks, of_slices = zip(*((r.log_ratio, r.tracks, r.slices) for r in rates), strict=True)
    return _Rate(float(weight @ logs), weight @ of_tracks, weight @ of_slices)


def _scale(residuals: pd.Series) -> float:
    """Standard deviation about 0 of residuals (n,), of which a few may be far off."""
    return stats.median_abs_deviation(residuals, center=lambda values, axis: 0.0, scale="normal")


def _variance(of_tracks: NDArray, of_slices: NDArray) -> float:
    """Variance of a logarithm of a rate from what tracks (G,) and slices (S,) contributed."""
    return float((of_tracks**2).sum() + (of_slices**2).sum())


def _interval(scale: float, rate: _Rate, confidence: float) -> dict[str, float]:
    """Value and interval of `scale` times a rate; degrees of freedom after Satterthwaite, one for each contribution."""
    variance = _variance(rate.tracks, rate.slices)
    freedom = max(variance**2 / ((rate.tracks**4).sum() + (rate.slices**4).sum()), 1)
    std = np.sqrt(variance)
    value, half = scale * np.exp(rate.log_ratio), stats.t.ppf((1 + confidence) / 2, freedom) * std
    return {"value": value, "std": value * std, "low": value * np.exp(-half), "high": value * np.exp(half)}


def _fit(tracks: pd.DataFrame, focusing: Focusing, axis: str, frame_rate_hz: float) -> _Rate:
    """Gauss-Newton for the rate, and for each track where it was at the middle of its time."""
    extent, start_per_s = focusing.extent_um(axis), 1 / focusing.focusing_time_s(axis)
    position, std = (tracks[name].to_numpy(dtype=float) for name in (IN_CHANNEL[axis], f"{axis}_std_um"))
    track, number = np.unique(tracks["particle"], return_inverse=True)[1], tracks["particle"].nunique()

    def total(values: NDArray) -> NDArray:
        """Sum of `values` over each track."""
        return np.bincount(track, values, number)

    rows = total(np.ones(len(tracks)))
    t = tracks["frame"].to_numpy() / frame_rate_hz
    second = np.floor(t)
    t = t - (total(t) / rows)[track]
    middle, log_ratio = total(position) / rows, 0.0
    for _ in range(ROUNDS):
        middle = np.where(middle < 0, -1, 1) * np.clip(np.abs(middle), OFF_AXIS * extent, (0.5 - OFF_WALL) * extent)
        rate = start_per_s * np.exp(log_ratio)
        path = extent / np.pi * np.arctan(np.tan(np.pi * middle / extent)[track] * np.exp(-rate * t))
        swing = np.sin(2 * np.pi * path / extent)
        by_middle = swing / np.sin(2 * np.pi * middle / extent)[track]
        by_log = -rate * t * extent / (2 * np.pi) * swing
        off = pd.Series(np.abs(position - path) / std)
        noise = std * np.maximum(off.groupby(second).transform(_scale).to_numpy(), 1e-9)
        square = ((position - path) / noise) ** 2
        weight = (FREEDOM + 1) / (FREEDOM + square) / noise**2
        own = total(weight * by_middle**2)
        alone = by_log - (total(weight * by_middle * by_log) / own)[track] * by_middle  # what no `middle` can do
        pull = weight * alone * (position - path)
        information = (weight * alone**2).sum()
        if not information > 0:
            raise ValueError(f"tracks: got some that do not move along {axis}, allowed are those that sound moves")
        step = float(np.clip(pull.sum() / information, -LONGEST_STEP, LONGEST_STEP))
        log_ratio += step
        middle = middle + total(weight * by_middle * (position - path - by_log * step)) / own
        if abs(step) < 1e-7:
            break
    else:
        raise ValueError(f"tracks: got some whose motion along {axis} fits no rate, allowed are those that sound moves")
    # How fast the pull falls as the rate rises; less than `information`, for far residuals lose weight meanwhile.
    stiffness = total((FREEDOM + 1) * (FREEDOM - square) / (FREEDOM + square) ** 2 / noise**2 * alone**2)
    slices = pd.factorize(np.floor(tracks["z_um"].to_numpy() / SLICE_UM))[0]
    # Of tracks the jackknife: by how much the result would change without this one.
    fitted = _Rate(log_ratio, total(pull) / (stiffness.sum() - stiffness), np.bincount(slices, pull) / stiffness.sum())
    if not 0 < _variance(fitted.tracks, fitted.slices) < 1:
        raise ValueError(f"tracks: got some that hardly move along {axis}, allowed are those that sound moves")
    return fitted


def imitate(
    tracks: pd.DataFrame, film: Film, others: Iterable[Film], rng: int | np.random.Generator
) -> Iterator[pd.DataFrame]:
    """Tracks as other films would give them, not measured, but made of their true paths and the errors of this one.

    Each particle of another film borrows all from one of this film, of the three that began nearest to it in the
    cross-section: errors, standard deviations, frames in which it was missed or out of view, breaks of its track,
    the stretch in which its track ran on along somebody else. So errors stay as far off, as lasting and as typical of a
    depth and a time as they were. Tracks of false finds stay where they are.

    Parameters
    ----------
    tracks : DataFrame
        From `link`, measured in `film`: `frame`, `particle`, positions in px and in the channel, and standard
        deviations in µm.
    film : Film
    others : iterable of Film
        Of the same length, frame rate and view as `film`; about as many particles.
    rng : int or numpy.random.Generator

    Yields
    ------
    DataFrame
        `frame`, `particle`, positions in the channel and their standard deviations in µm.
    """
    stds = [f"{axis}_std_um" for axis in "xyz"]
    check_table("tracks", tracks, ["frame", "particle", "x_px", "y_px", *POSITION, *stds])
    frames_of("tracks", tracks)
    rng = generator("rng", rng)
    here, start = _paths(instance("film", film, Film))
    who = pd.Series(identify(tracks, film.truth()))
    owner = who.groupby(tracks["particle"].to_numpy()).agg(lambda part: part.mode().iloc[0])
    lent = tracks.rename(columns={"particle": "track"})[["frame", "track", *POSITION, *stds]]
    lent["lender"] = lent["track"].map(owner)
    false_finds = lent[lent["lender"] < 0].assign(particle=-1)
    lent = lent.merge(here.rename(columns={"particle": "lender"}), on=["frame", "lender"], suffixes=("", "_true"))
    for name in POSITION:
        lent[name] -= lent.pop(f"{name}_true")
    start = start.loc[np.unique(lent["lender"])]
    if start.empty:
        raise ValueError("tracks: got none of a particle of the film, needed is one or more")
    tree = KDTree(start)
    for other in instances("others", others, Film):
        there, borrowers = _paths(other)
        near = tree.query(borrowers, k=[*range(1, min(3, len(start)) + 1)])[1]
        chosen = start.index.to_numpy()[rng.permuted(near, axis=1)[:, 0]]
        there["lender"] = there["particle"].map(dict(zip(borrowers.index, chosen, strict=True)))
        made = there.merge(lent, on=["frame", "lender"], suffixes=("", "_off"))
        for name in POSITION:
            made[name] += made[f"{name}_off"]
        made = pd.concat([made, false_finds], ignore_index=True)
        made["particle"] = made.groupby(["particle", "track"]).ngroup()
        yield made[["frame", "particle", *POSITION, *stds]].sort_values(["frame", "particle"], ignore_index=True)


def _paths(film: Film) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Of the particles in view: where they are in each frame, and y and z at the start by their number."""
    seen = film.to_channel(film.truth())[["frame", "particle", *POSITION]]
    start = film.trajectories.start.set_index("particle")[POSITION[1:]]
    return seen, start.loc[seen["particle"].unique()]
