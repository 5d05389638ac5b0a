"""Settings of `locate` from the frames themselves, each of which can be given instead.

The threshold of C_m: how often does what is certainly no particle reach it? In a frame with its sign turned every
bright particle is dark, so whatever is found there is false: noise, gaps between particles, rings about them. It is
as noisy and as crowded as the frame itself, so about as many of its finds lie above any C_m as of the frame's own
that are false for the same reasons. The threshold is the lowest at which they are few. (What it cannot see are
particles that are there and come out at a wrong depth.)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab.calibration import Calibration
from gdptlab.check import choice, positive, whole
from gdptlab.locate import METHODS, locate

LOWEST = 0.2
"""C_m from which on finds are counted."""

EVEN = 0.1
"""Largest spread of brightness, its share, with which the joint fit is chosen: it takes particles to be alike."""

EXPLAINED = 1.5
"""Largest median chi2 of particles with which the joint fit is chosen."""


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
    """

    arguments: dict[str, object]
    table: pd.DataFrame
    threshold: float
    found: pd.DataFrame
    false: pd.DataFrame

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
    false_share: float = 0.01,
    looked_at: int = 3,
) -> Settings:
    """Choose what `locate` is told, from some frames.

    Parameters
    ----------
    frames : iterable of arrays (rows, columns)
        Of the film to be measured; only some are looked at, from the first on.
    calibration : Calibration
    threshold : float, optional
        Lowest C_m of a particle, used as it is. If not given, the lowest at which no more than `false_share` as many
        are found in the frames with their sign turned as in the frames.
    method : str, optional
        "correlation" or "joint". If not given, joint where its model holds: where it finds particles alike in
        brightness (spread at most `EVEN`) and explains what is around them (median chi2 at most `EXPLAINED`).
    refine : bool, optional
        Of "correlation"; True if not given.
    min_distance_px : float, optional
        Of "correlation"; a quarter of a template if not given.
    false_share : float
        Share of false finds that is put up with.
    looked_at : int
        How many frames are looked at.

    Returns
    -------
    Settings

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or a frame is refused by `locate`; if a setting is given that the method
        given does not have.
    """
    if positive("false_share", false_share) >= 1:
        raise ValueError(f"false_share: got {false_share}, allowed is above 0 and below 1")
    if threshold is not None and positive("threshold", threshold) > 1:
        raise ValueError(f"threshold: got {threshold}, allowed is above 0 and at most 1")
    if method is not None:
        choice("method", method, METHODS)
    given = {"threshold": threshold, "refine": refine, "min_distance_px": min_distance_px}
    given = {name: value for name, value in given.items() if value is not None}
    if method == "joint" and given:
        raise ValueError(f"{', '.join(given)}: got one with method 'joint', which has none of them")
    looked = [np.asarray(frame) for frame in islice(frames, whole("looked_at", looked_at, 1, 10_000))]
    if not looked:
        raise ValueError("frames: got none, needed is one or more")
    others = {name: value for name, value in given.items() if name != "threshold"}
    # As floats: an unsigned 3 with its sign turned is 65533.
    found, false = (
        pd.concat(
            [
                locate(sign * frame.astype(float), calibration, threshold=LOWEST, **others).assign(frame=i)
                for i, frame in enumerate(looked)
            ],
            ignore_index=True,
        )
        for sign in (1, -1)
    )
    reasons = {"refine": "the whole stack is walked", "min_distance_px": "a quarter of a template"}
    if threshold is None:
        threshold, reasons["threshold"] = _threshold(found["cm"], false["cm"], false_share)
    if method is not None:
        given["method"] = method
    elif given:
        method, reasons["method"] = "correlation", "only it has the settings given"
    else:
        method, reasons["method"] = _method(looked[0], calibration)
    arguments = {"method": method}
    if method == "correlation":
        arguments |= {"threshold": threshold, "refine": True, "min_distance_px": calibration.size / 4} | given
    rows = [
        (name, value, *(("given", "") if name in given else ("by itself", reasons[name])))
        for name, value in arguments.items()
    ]
    table = pd.DataFrame(rows, columns=["setting", "value", "how", "why"]).set_index("setting")
    return Settings(arguments, table, threshold, found, false)


def _above(cm: pd.Series, threshold: float) -> int:
    return int((cm >= threshold).sum())


def _threshold(found: pd.Series, false: pd.Series, share: float) -> tuple[float, str]:
    """Lowest threshold with so small a share of false finds, and the reason in words."""
    for threshold in np.arange(LOWEST, 0.99, 0.01).round(2).tolist():
        n, n_false = _above(found, threshold), _above(false, threshold)
        if n and n_false <= share * n:
            return threshold, f"{n} found from there on, {n_false} with the frames' sign turned"
    return 0.5, "nothing is found that is not found with the frames' sign turned, too"


def _method(frame: NDArray, calibration: Calibration) -> tuple[str, str]:
    """What method a frame is for, and the reason in words."""
    table = locate(frame, calibration, method="joint")
    if len(table) < 5:
        return "correlation", "too few particles to see if they are alike, as joint takes them to be"
    brightness, chi2 = table["brightness"], float(table["chi2"].median())
    spread = float(1.4826 * (brightness - brightness.median()).abs().median() / brightness.median())
    method = "joint" if spread <= EVEN and chi2 <= EXPLAINED else "correlation"
    return method, f"particles differ by {100 * spread:.0f} % in brightness, and joint leaves a chi2 of {chi2:.1f}"
