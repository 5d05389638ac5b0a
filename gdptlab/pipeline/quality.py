"""Whether to trust a calibration, in plain words, before a frame is taken."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gdptlab._checks import positive
from gdptlab.calibration import Calibration
from gdptlab.denoising import noise_level, signal_to_noise
from gdptlab.fit.bounds import expected_error

TWIN = 0.95
"""Correlation from which on images at two depths are mistaken for each other."""

DIP = 0.02
"""How far the correlation falls between two depths, at least, that are not just neighbours."""


def depth_quality(calibration: Calibration, noise: float | None = None) -> pd.DataFrame:
    """What limits z at each depth of a calibration.

    Parameters
    ----------
    calibration : Calibration
    noise : float, optional
        Standard deviation of a pixel of the frames without light, counts; that of the stack if not given.

    Returns
    -------
    DataFrame
        A row for each image: `z_um`; `signal_to_noise`, its height over the noise of a pixel; `z_std_um`, the least
        error of z in such frames (`fit.expected_error`); `own_error_um`, what the stack's noise
        adds to it at every particle; `next_alike`, the correlation with the next image; and of the image most alike
        among those that are not just neighbours its correlation `twin` and depth `twin_um` (NaN if there is none).
    """
    z_um, alike = calibration.z_um, calibration.self_similarity()
    twins = np.array([_twin(row, k) for k, row in enumerate(alike)])
    none = twins < 0
    each = np.arange(len(calibration))
    own_noise = max(noise_level(calibration.stack), 1e-9)
    noise = own_noise if noise is None else positive("noise", noise)
    following = np.append(np.diagonal(alike, 1), alike[-1, -2])
    return pd.DataFrame(
        {
            "z_um": z_um,
            "signal_to_noise": signal_to_noise(calibration.stack) * own_noise / noise,
            "z_std_um": expected_error(calibration, noise=noise)["z_std_um"],
            "own_error_um": calibration.model.own_error[:, 2],
            "next_alike": following,
            "twin": np.where(none, np.nan, alike[each, twins]),
            "twin_um": np.where(none, np.nan, z_um[twins]),
        }
    )


def _twin(alike: NDArray, k: int) -> int:
    """Index of the largest of `alike` beyond a dip about k; -1 if there is none."""
    best, value = -1, 0.0
    for side in (range(k, len(alike)), range(k, -1, -1)):
        values = alike[side]
        beyond = np.flatnonzero(values - np.minimum.accumulate(values) >= DIP)
        if len(beyond) and values[beyond].max() > value:
            best, value = side[beyond[values[beyond].argmax()]], values[beyond].max()
    return best


def report(calibration: Calibration) -> pd.DataFrame:
    """Say what is good and what is not about a calibration.

    Parameters
    ----------
    calibration : Calibration
        However it was made. Of one from `Calibration.from_scan` the beads are judged as well.

    Returns
    -------
    DataFrame
        A row for each question (the index): `verdict`, "good", "look" or "bad"; `finding`, with numbers; and `advice`,
        empty where all is well.
    """
    made = calibration.report
    depths = depth_quality(calibration, made.noise if made else None)
    span = calibration.z_um[-1] - calibration.z_um[0]
    error = np.hypot(depths["z_std_um"], depths["own_error_um"])
    rows = {}

    def say(question: str, bad: bool, look: bool, finding: str, advice: str) -> None:
        verdict = "bad" if bad else "look" if look else "good"
        rows[question] = (verdict, finding, advice if verdict != "good" else "")

    weak = depths["signal_to_noise"] < 10
    say(
        "signal",
        depths["signal_to_noise"].min() < 2,
        bool(weak.any()),
        f"signal / noise {_from_to(depths['signal_to_noise'], '.0f')}; below 10 at {100 * weak.mean():.0f} % of depths",
        "More light, more beads, or leave the faintest slices out.",
    )
    say(
        "step",
        depths["next_alike"].min() < 0.6,
        depths["next_alike"].min() < 0.85,
        f"neighbouring slices are alike to {_from_to(depths['next_alike'], '.2f')}",
        "Scan in finer steps where images change fast.",
    )
    twins = depths[depths["twin"] >= TWIN]
    say(
        "ambiguity",
        len(twins) > len(depths) / 4,
        len(twins) > 0,
        f"{100 * len(twins) / len(depths):.0f} % of depths have a twin, alike to {TWIN} or more"
        + (f", {(twins['twin_um'] - twins['z_um']).abs().median():.0f} µm away (median)" if len(twins) else ""),
        "Above and below focus look alike: a cylindrical lens helps, or particles on one side of focus only.",
    )
    say(
        "error of z",
        error.max() > 0.05 * span,
        error.max() > 0.02 * span,
        f"noise alone makes {_from_to(error, '.2g')} µm, median {error.median():.2g} of {span:.0f} µm",
        "More light; see the figure for the depths that are worst.",
    )
    own = float((depths["own_error_um"] > depths["z_std_um"]).mean())
    say(
        "the stack's fraction",
        False,
        own > 0.5,
        f"at {100 * own:.0f} % of depths the calibration's noise is worse than the frame's",
        "Average more beads, or more exposures of each slice.",
    )
    if made:
        _judge_beads(calibration, float(error.median()), say)
    return pd.DataFrame.from_dict(rows, orient="index", columns=["verdict", "finding", "advice"])


def _judge_beads(calibration: Calibration, error_um: float, say: Callable[..., None]) -> None:
    """Say what is good about the beads of a scan; `error_um` is the expected error of z."""
    made, z_um = calibration.report, calibration.z_um
    used, span = made.beads[made.beads["verdict"] == "used"], z_um[-1] - z_um[0]
    say(
        "beads",
        len(used) < 2,
        len(used) < 5,
        f"{len(used)} of {len(made.beads)} averaged"
        + (f", alike to {used['alike'].min():.2f} or better" if len(used) > 1 else ""),
        "Noise and quirks of a few beads go into every z. See what the page marks as beads: are they? If so, scan "
        "more, or farther apart; if not, give the places of some in `beads_px`.",
    )
    fraction = float(np.mean(made.clipped > 0))
    say(
        "clipping",
        bool(made.clipped[calibration.subset].max() > 0.5),
        fraction > 0,
        f"{100 * fraction:.0f} % of the slices have beads cut off at the end of the camera's range",
        "Expose more briefly: a flat top hides where the focus is.",
    )
    step = float(np.median(np.diff(z_um)))
    uneven = float(used["offset_um"].std(ddof=0))
    say(
        "the plane of beads",
        uneven > 0.02 * span,
        uneven > max(step / 2, error_um),
        f"beads come into focus {uneven:.2g} µm apart (RMS over the field)",
        "The field is curved or tilted, which goes into z unless it is corrected.",
    )
    drift = float(np.ptp(made.drift_px, axis=0).max())
    jump = float(np.abs(np.diff(made.drift_px, axis=0)).max())
    jumps = jump > max(2, calibration.size / 10)
    say(
        "drift",
        jumps or drift > calibration.size / 4,
        drift > 1,
        f"beads wander by {drift:.1f} px in all, and by {jump:.1f} px at most from a slice to the next",
        "No stage leaps like that: what was taken for a bead is none, or has a neighbour. Choose others (`beads_px`)."
        if jumps
        else "Followed, and harmless to z; if it is the optics', not the stage's, x and y of particles depend on z.",
    )


def _from_to(values: pd.Series, form: str) -> str:
    return f"{values.min():{form}} to {values.max():{form}}"
