"""Settings of `locate` from the frames themselves, each of which can be given instead.

The threshold of C_m: how often does what is certainly no particle reach it? In a frame with its sign turned every
bright particle is dark, so whatever is found there is false: noise, gaps between particles, rings about them. It is
as noisy and as crowded as the frame itself, so about as many of its finds lie above any C_m as of the frame's own
that are false for the same reasons. What it does not show are false finds on particles: part of a ring may look like a
whole one at another depth. Such side-lobes are counted on the calibration's own images, each alone on noise. The
threshold is the lowest at which both kinds are few. (What it cannot see are particles that come out at a wrong depth.)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import choice, image_array, iterable, positive, whole
from gdptlab.calibration import Calibration
from gdptlab.denoising import noise_level
from gdptlab.fit.pattern import particle_light
from gdptlab.locate import METHODS, locate

LOWEST = 0.2
"""C_m from which on finds are counted, the least threshold that is chosen. Chosen between 0.1 and 0.3 on the planar
beads and the sample, whose thresholds stay 0.51 and 0.32; below 0.1 noise makes more finds than can be counted."""

DEPTHS = 25
"""Largest number of the calibration's images on which side-lobes are counted. Chosen between 10 and 51 on the same,
with the same thresholds; the time grows with the number."""

EXPLAINED = 0.5
"""Least median fraction of the light around a particle that the particle explains, with which the joint fit is chosen.
Chosen on the planar beads and on synthetic frames: with a calibration of all beads of the scan it is 0.68 to 0.96, in
synthetic crowds, few photons and debris included, 0.79 to 0.98. With a calibration of one of the planar beads, which
differ, it falls to 0.31 where the fit takes most beads for two or three."""

MOST_CHI2 = 1.5
"""Median chi2 of particles above which it is not. Derived: it is 1 where the model holds."""

FEWEST = 5
"""Fewest particles by which the joint fit is judged. Convention: a median of fewer says little."""

LEAST_CM = 0.5
"""Least median C_m with which the joint fit is chosen. As the threshold of `locate`: a crowd of wrong images, too, can
explain anything."""


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings for `locate` and `batch`, and how they were chosen. Made by `choose_settings`.

    Attributes
    ----------
    arguments : dict
        For use as `batch(frames, calibration, **settings.arguments)`.
    table : DataFrame
        A row for each setting (the index): `value`, `how` ("by itself" or "given") and `why`, in words.
    threshold : float
        The threshold of C_m, also where `arguments` has none as the joint fit needs none.
    found, false : DataFrame
        What correlation finds in the frames looked at, and in the same with their sign turned, from a C_m of `LOWEST`
        on: the columns of `locate`, and `frame`.
    side_lobes : DataFrame
        What it finds beside a lone particle, likewise; `frame` is the image of the calibration.
    """

    arguments: dict[str, object]
    table: pd.DataFrame
    threshold: float
    found: pd.DataFrame
    false: pd.DataFrame
    side_lobes: pd.DataFrame

    @property
    def inverted(self) -> bool:
        """Whether frames with their sign turned fit the calibration better than the frames themselves."""
        return _above(self.false["cm"], 0.5) > 2 * _above(self.found["cm"], 0.5)


def choose_settings(
    frames: Iterable[ArrayLike],
    calibration: Calibration,
    *,
    threshold: float | None = None,
    method: str | None = None,
    refine: bool | None = None,
    min_distance_px: float | None = None,
    false_fraction: float = 0.01,
    looked_at: int = 3,
) -> Settings:
    """Choose what `locate` is told, from some frames.

    Parameters
    ----------
    frames : iterable of arrays (rows, columns)
        Of the film to be measured; only some are looked at: of a sequence, evenly spread over all of it, and of
        anything else the first.
    calibration : Calibration
    threshold : float, optional
        Lowest C_m of a particle, used as it is. If not given, the lowest at which no more than `false_fraction` of the
        finds are false, to judge by the frames with their sign turned and by the side-lobes of lone particles.
    method : str, optional
        "correlation" or "joint". If not given, joint where its model holds: where the particles that it finds look
        like the calibration's (median C_m at least `LEAST_CM`), each explains what nothing else would (at least
        `EXPLAINED`), and what remains is noise (median chi2 at most `MOST_CHI2`).
    refine : bool, optional
        Of "correlation"; True if not given.
    min_distance_px : float, optional
        Of "correlation"; a quarter of a template if not given.
    false_fraction : float
        Fraction of false finds that is put up with.
    looked_at : int
        How many frames are looked at; for the method, which takes longest, the middle one of them.

    Returns
    -------
    Settings

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or a frame is refused by `locate`; if a setting is given that the method
        given does not have.
    """
    if positive("false_fraction", false_fraction) >= 1:
        raise ValueError(f"false_fraction: got {false_fraction}, allowed is above 0 and below 1")
    given = {"threshold": threshold, "refine": refine, "min_distance_px": min_distance_px}
    given = {name: value for name, value in given.items() if value is not None}
    _must_go_together(method, given)
    whole("looked_at", looked_at, 1, 10_000)
    looked = [image_array("image", frame, 2) for frame in spread(frames, looked_at)]
    if not looked:
        raise ValueError("frames: got none, needed is one or more")
    others = {name: value for name, value in given.items() if name != "threshold"}
    found, false = (_found([sign * frame for frame in looked], calibration, others) for sign in (1, -1))
    side_lobes, alone = _side_lobes(calibration, noise_level(looked[len(looked) // 2]), others)
    reasons = {"refine": "the whole stack is walked", "min_distance_px": "a quarter of a template"}
    if threshold is None:
        finds = (table["cm"] for table in (found, false, side_lobes, alone))
        threshold, reasons["threshold"] = _threshold(*finds, false_fraction)
    if method is not None:
        given["method"] = method
    elif given:
        method, reasons["method"] = "correlation", "only it has the settings given"
    else:
        method, reasons["method"] = _method(looked[len(looked) // 2], calibration)
    arguments = {"method": method}
    if method == "correlation":
        arguments |= {"threshold": threshold, "refine": True, "min_distance_px": calibration.size / 4} | given
    rows = [
        (name, value, *(("given", "") if name in given else ("by itself", reasons[name])))
        for name, value in arguments.items()
    ]
    table = pd.DataFrame(rows, columns=["setting", "value", "how", "why"]).set_index("setting")
    return Settings(arguments, table, threshold, found, false, side_lobes)


def spread(frames: Iterable[ArrayLike], n: int) -> list[ArrayLike]:
    """Up to `n` frames (rows, columns), evenly spread over a sequence, the first of anything else."""
    sequence = hasattr(frames, "__len__") and hasattr(frames, "__getitem__") and not isinstance(frames, dict)
    if sequence and getattr(frames, "ndim", 1):
        middles = (np.arange(n) + 0.5) * len(frames) / n
        return [frames[k] for k in np.unique(middles.astype(int)).tolist()] if len(frames) else []
    return list(islice(iterable("frames", frames), n))


def _must_go_together(method: str | None, given: dict[str, object]) -> None:
    """Raise TypeError or ValueError unless the given settings belong to the given method."""
    if method is not None:
        choice("method", method, METHODS)
    if positive("threshold", given.get("threshold", 1.0)) > 1:
        raise ValueError(f"threshold: got {given['threshold']}, allowed is above 0 and at most 1")
    if method == "joint" and given:
        raise ValueError(f"{', '.join(given)}: got one with method 'joint', which has none of them")


def _found(frames: list[NDArray], calibration: Calibration, settings: dict[str, object]) -> pd.DataFrame:
    """What correlation finds in frames (rows, columns) from a C_m of `LOWEST` on."""
    tables = [locate(frame, calibration, threshold=LOWEST, **settings) for frame in frames]
    return pd.concat([table.assign(frame=i) for i, table in enumerate(tables)], ignore_index=True)


def _above(cm: pd.Series, threshold: float) -> int:
    """Number of C_m (n,) that reach a threshold."""
    return int((cm >= threshold).sum())


def _side_lobes(
    calibration: Calibration, noise: float, settings: dict[str, object]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """What is found beside, and at, the position of lone particles."""
    size, rng = calibration.size, np.random.default_rng(0)
    middle, beside, at = size - 1, [], []
    for k in np.unique(np.rint(np.linspace(0, len(calibration) - 1, DEPTHS)).astype(int)):
        frame = rng.normal(0, max(noise, 1e-9), (2 * size - 1, 2 * size - 1))
        near = slice(middle - size // 2, middle + size // 2 + 1)
        frame[near, near] += particle_light(calibration)[k]
        finds = locate(frame, calibration, threshold=LOWEST, **settings).assign(frame=k)
        own = np.hypot(finds["x_px"] - middle, finds["y_px"] - middle) < size / 4
        at.append(finds[own])
        beside.append(finds[~own])
    return pd.concat(beside, ignore_index=True), pd.concat(at, ignore_index=True)


def _threshold(
    found: pd.Series, false: pd.Series, side_lobes: pd.Series, alone: pd.Series, fraction: float
) -> tuple[float, str]:
    """Lowest threshold with so small a fraction of false finds, and the reason in words."""
    for threshold in np.arange(LOWEST, 0.99, 0.01).round(2).tolist():
        n, n_false, n_side, n_alone = (_above(cm, threshold) for cm in (found, false, side_lobes, alone))
        if n and n_false / n + n_side / max(n_side + n_alone, 1) <= fraction:
            turned = f"{n} found from there on, {n_false} with the frames' sign turned"
            return threshold, f"{turned}; {n_side} beside {n_alone} lone particles"
    return 0.5, "nothing is found that is not found with the frames' sign turned, too"


def _method(frame: NDArray, calibration: Calibration) -> tuple[str, str]:
    """What method a frame is for, and the reason in words."""
    table = locate(frame, calibration, method="joint")
    if len(table) < FEWEST:
        return "correlation", f"{len(table)} particles are too few to see if the joint fit's model holds"
    chi2, cm = float(table["chi2"].median()), float(table["cm"].median())
    explained = float((1 - table["chi2"] / table["chi2_without"]).median())
    method = "joint" if explained >= EXPLAINED and chi2 <= MOST_CHI2 and cm >= LEAST_CM else "correlation"
    return method, (
        f"joint finds {len(table)} particles with a median C_m of {cm:.2f}, each of which explains "
        f"{100 * explained:.0f} % of the light around it, and leaves a chi2 of {chi2:.1f}"
    )
