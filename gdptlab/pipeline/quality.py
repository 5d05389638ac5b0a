"""Whether to trust a calibration, in plain words, before a frame is taken."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gdptlab._checks import LARGEST, numbers, positive, table
from gdptlab.calibration import Calibration, checked
from gdptlab.denoising import noise_level, signal_to_noise
from gdptlab.fit.bounds import expected_error
from gdptlab.fit.mismatch import MODEL, mismatch_error_um
from gdptlab.pipeline.without_stage import FilmReport

AMBIGUOUS = 0.95
"""Correlation from which on the images of two depths are mistaken for each other. Chosen between 0.9 and 0.99 on the
planar beads, whose optics are symmetric about focus: 0.92, 0.89 and 0.20 of the depths are ambiguous at 0.9, 0.95 and
0.99, and with the astigmatic sample none is."""

DIP = 0.02
"""Least fall of the correlation between a depth and an ambiguous one, which tells it from mere neighbours. Chosen
between 0.005 and 0.08 on the same: the fraction of ambiguous depths falls from 0.91 to 0.85 with the planar beads;
below 0.01 neighbours count in the sample."""

SIGNAL = (10.0, 2.0)
"""Signal-to-noise ratios of an image below which a calibration is looked at, and is bad. Convention: of a peak of 2
standard deviations of a pixel hardly anything is visible."""

NEXT = (0.85, 0.6)
"""Correlations of neighbouring images below which a calibration is looked at, and is bad. Chosen on the sample's stack
with every 1st to 6th of its images: the correlation falls from 0.99 to 0.86, and the RMS error of z grows from 0.3 % to
1.1 % of the range of depths. Where images correlate by 0.6, z between them is a guess."""

ERROR = (0.02, 0.05)
"""Expected errors of z, as fractions of the range of depths, above which a calibration is looked at, and is bad.
Convention: with 5 %, ten depths are told apart."""

FEW_BEADS = (5, 2)
"""Numbers of averaged beads below which a calibration is looked at, and is bad. Derived: the noise of the average falls
with the square root of their number, with 5 to less than half; what is peculiar to a single bead cannot be seen."""

UNEVEN = 0.02
"""RMS difference of the heights of the beads, as a fraction of the range of depths, above which the plane of the beads
is bad. Derived: it goes into z as an error does, see `ERROR`."""

DRIFT = 0.25
"""Drift of the beads, as a fraction of a template, above which it is bad. Convention: the template of the first slice
then holds half as much of the last slice's image."""

JUMP = 0.1
"""Drift from a slice to the next, as a fraction of a template, above which a spot that jumped is taken for no bead.
Derived: the planar beads drift by a thousandth of a template from slice to slice; a tenth leaves room for coarse
stages, and spots of two beads that are taken for one jump by more."""

KINDS = (0.03, 0.1)
"""Fractions of the particles that images of one kind do not explain above which a calibration from a film is looked at,
and is bad. Chosen on the channel's films: 0.001 to 0.004 with one kind, 0.4 with two kinds, 5 and 3 um."""


class Judgement(NamedTuple):
    """Row of a report: the question; whether the answer is bad, or is to be looked at; finding and advice, in words."""

    question: str
    bad: bool
    look: bool
    finding: str
    advice: str


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
        adds to it at every particle; `next_correlation`, the correlation with the next image; and of the image with the
        highest correlation among those that are not just neighbours its correlation `ambiguous_correlation` and depth
        `ambiguous_um` (NaN if there is none).
    """
    z_um, correlation = checked(calibration).z_um, calibration.self_similarity()
    other = np.array([_ambiguous(row, k) for k, row in enumerate(correlation)])
    none = other < 0
    each = np.arange(len(calibration))
    own_noise = max(noise_level(calibration.stack), 1e-9)
    noise = own_noise if noise is None else float(np.clip(positive("noise", noise), 1 / LARGEST, LARGEST))
    following = np.append(np.diagonal(correlation, 1), correlation[-1, -2])
    return pd.DataFrame(
        {
            "z_um": z_um,
            "signal_to_noise": signal_to_noise(calibration.stack) * own_noise / noise,
            "z_std_um": expected_error(calibration, noise=noise)["z_std_um"],
            "own_error_um": calibration.model.own_error[:, 2],
            "next_correlation": following,
            "ambiguous_correlation": np.where(none, np.nan, correlation[each, other]),
            "ambiguous_um": np.where(none, np.nan, z_um[other]),
        }
    )


def _ambiguous(correlation: NDArray, k: int) -> int:
    """Index of the largest correlation (N,) of image k beyond a dip about it; -1 if there is none."""
    best, value = -1, 0.0
    for side in (range(k, len(correlation)), range(k, -1, -1)):
        values = correlation[side]
        beyond = np.flatnonzero(values - np.minimum.accumulate(values) >= DIP)
        if len(beyond) and values[beyond].max() > value:
            best, value = side[beyond[values[beyond].argmax()]], values[beyond].max()
    return best


def report(calibration: Calibration, mismatch: pd.DataFrame | None = None) -> pd.DataFrame:
    """Say what is good and what is not about a calibration.

    A focus that moved since the scan shifts all z alike, which neither the calibration nor a film shows. A bead that
    sticks to a wall does: its z must be that of the wall, and stay.

    Parameters
    ----------
    calibration : Calibration
        However it was made. Of one from `Calibration.from_scan` the beads are judged as well, of one from `from_film`
        the scale of its depths.
    mismatch : DataFrame, optional
        From `fit.pattern_mismatch`, of some frames of a film: whether their particles look as the calibration's.

    Returns
    -------
    DataFrame
        A row for each question (the index): `verdict`, "good", "look" or "bad"; `finding`, with numbers; and `advice`,
        empty where all is well.
    """
    made = checked(calibration).report
    depths = depth_quality(calibration, made.noise if made else None)
    span = float(calibration.z_um[-1] - calibration.z_um[0])
    error_um = np.hypot(depths["z_std_um"], depths["own_error_um"])
    judgements = [_signal(depths), _step(depths), _ambiguity(depths), _error(error_um, span), _own_noise(depths)]
    if isinstance(made, FilmReport):
        judgements += [_scale(made, span), _sides(made), _kinds(made)]
    elif made:
        judgements += [
            _beads(made.beads),
            _clipping(made.clipped, calibration.subset),
            _plane(made.beads, calibration.z_um, float(error_um.median())),
            _drift(made.drift_px, calibration.size),
        ]
    if mismatch is not None:
        for name in table("mismatch", mismatch, columns := ["n", "mismatch", "own"])[columns]:
            numbers("mismatch", mismatch[name].dropna())
        judgements.append(_mismatch(mismatch, span))
    verdicts = ["bad" if each.bad else "look" if each.look else "good" for each in judgements]
    advice = ["" if v == "good" else each.advice for each, v in zip(judgements, verdicts, strict=True)]
    return pd.DataFrame(
        {"verdict": verdicts, "finding": [each.finding for each in judgements], "advice": advice},
        index=[each.question for each in judgements],
    )


def _signal(depths: pd.DataFrame) -> Judgement:
    """Whether images stand out of the noise at each of N depths."""
    ratio = depths["signal_to_noise"]
    weak = float((ratio < SIGNAL[0]).mean())
    finding = f"signal / noise {_from_to(ratio, '.0f')}; below {SIGNAL[0]:g} at {100 * weak:.0f} % of depths"
    advice = "More light, more beads, or leave the faintest slices out."
    return Judgement("signal", bool(ratio.min() < SIGNAL[1]), weak > 0, finding, advice)


def _step(depths: pd.DataFrame) -> Judgement:
    """Whether the N depths lie near enough to each other."""
    correlation = depths["next_correlation"]
    finding = f"neighbouring slices correlate by {_from_to(correlation, '.2f')}"
    advice = "Scan in finer steps where images change fast."
    return Judgement("step", bool(correlation.min() < NEXT[1]), bool(correlation.min() < NEXT[0]), finding, advice)


def _ambiguity(depths: pd.DataFrame) -> Judgement:
    """Whether images of N depths look like those of others."""
    mistaken = depths[depths["ambiguous_correlation"] >= AMBIGUOUS]
    fraction = len(mistaken) / len(depths)
    finding = f"{100 * fraction:.0f} % of depths are ambiguous, with a correlation of {AMBIGUOUS} or more to another"
    if fraction:
        finding += f", {(mistaken['ambiguous_um'] - mistaken['z_um']).abs().median():.0f} µm away (median)"
    advice = "Above and below focus look the same: a cylindrical lens helps, or particles on one side of focus only."
    return Judgement("ambiguity", fraction > 0.25, fraction > 0, finding, advice)


def _error(error_um: pd.Series, span: float) -> Judgement:
    """Whether noise makes errors of z (N,) that are small against the range of depths, µm."""
    finding = f"noise alone makes {_from_to(error_um, '.2g')} µm, median {error_um.median():.2g} of {span:.0f} µm"
    advice = "More light; see the figure for the depths that are worst."
    look, bad = (bool(error_um.max() > fraction * span) for fraction in ERROR)
    return Judgement("error of z", bad, look, finding, advice)


def _own_noise(depths: pd.DataFrame) -> Judgement:
    """Whether the noise of the stack matters beside that of the frames."""
    own = float((depths["own_error_um"] > depths["z_std_um"]).mean())
    finding = f"at {100 * own:.0f} % of depths the calibration's noise is worse than the frame's"
    return Judgement(
        "noise of the stack", False, own > 0.5, finding, "Average more beads, or more exposures of each slice."
    )


def _beads(beads: pd.DataFrame) -> Judgement:
    """Whether enough beads were averaged."""
    used = beads[beads["verdict"] == "used"]
    finding = f"{len(used)} of {len(beads)} averaged"
    if len(used) > 1:
        finding += f", with a correlation of {used['correlation'].min():.2f} or better to their average"
    advice = (
        "Noise and peculiarities of a few beads go into every z. See what the page marks as beads: are they? If so, "
        "scan more, or farther apart; if not, give the positions of some in `beads_px`."
    )
    return Judgement("beads", len(used) < FEW_BEADS[1], len(used) < FEW_BEADS[0], finding, advice)


def _clipping(clipped: NDArray, subset: NDArray) -> Judgement:
    """Whether beads are cut off at the end of the camera's range, of the fraction of them in each slice (N,)."""
    fraction = float(np.mean(clipped > 0))
    finding = f"{100 * fraction:.0f} % of the slices have beads cut off at the end of the camera's range"
    advice = "Expose more briefly: a flat top hides where the focus is."
    return Judgement("clipping", bool(clipped[subset].max() > 0.5), fraction > 0, finding, advice)


def _plane(beads: pd.DataFrame, z_um: NDArray, error_um: float) -> Judgement:
    """Whether beads come into focus together; `error_um` is the expected error of z."""
    uneven = float(beads.loc[beads["verdict"] == "used", "offset_um"].std(ddof=0))
    step, span = float(np.median(np.diff(z_um))), z_um[-1] - z_um[0]
    finding = f"beads come into focus {uneven:.2g} µm apart (RMS over the field)"
    advice = "The field is curved or tilted, which goes into z unless it is corrected (`flattened`, or field=True)."
    look = uneven > max(step / 2, error_um)
    return Judgement("the plane of beads", bool(uneven > UNEVEN * span), look, finding, advice)


def _scale(made: FilmReport, span: float) -> Judgement:
    """Whether a film's depths are known well, over the range of depths, um."""
    worst = float(made.z_std_um.max()) / span
    finding = (
        f"by the {made.scaled_by}: to {100 * made.scale_std:.1f} %, a depth to {made.z_std_um.max():.2g} µm or less"
    )
    advice = "More frames to measure (`fitted`), with new particles in each. The sign is not known: see `reverse`."
    return Judgement("scale of depth", worst > ERROR[1], worst > ERROR[0], finding, advice)


def _sides(made: FilmReport) -> Judgement:
    """Whether a film's images tell the two sides of focus apart."""
    finding = f"the sharpest image lies {'inside' if made.focus_inside else 'at an end of'} the range of depths"
    advice = (
        "Either all particles lie on one side of focus, or images of both sides look alike and were taken for one "
        "another: then depths are distances from focus, and wrong. A film cannot tell which."
    )
    return Judgement("sides of focus", False, not made.focus_inside, finding, advice)


def _kinds(made: FilmReport) -> Judgement:
    """Whether a film shows one kind of particle."""
    finding = f"{100 * made.misfits:.1f} % of the particles are not explained by images of one kind"
    advice = "Two kinds of particle, or sizes that differ: their images lie on no curve. Use a suspension of one kind."
    return Judgement("one kind", made.misfits > KINDS[1], made.misfits > KINDS[0], finding, advice)


def _drift(drift_px: NDArray, size: int) -> Judgement:
    """Whether beads stay where they are, of the drift of their mean (N, 2) and the size of a template, px."""
    drift, jump = float(np.ptp(drift_px, axis=0).max()), float(np.abs(np.diff(drift_px, axis=0)).max())
    jumps = jump > max(2, JUMP * size)
    finding = f"beads wander by {drift:.1f} px in all, and by {jump:.1f} px at most from a slice to the next"
    advice = "Followed, and harmless to z; if it is the optics', not the stage's, x and y of particles depend on z."
    if jumps:
        advice = "No stage jumps like that: a spot is no bead, or has a neighbour. Choose other beads (`beads_px`)."
    return Judgement("drift", jumps or drift > DRIFT * size, drift > 1, finding, advice)


def _mismatch(mismatch: pd.DataFrame, span: float) -> Judgement:
    """Whether the mean image of a film's particles is the calibration's, of `span` µm."""
    error_um, known = mismatch_error_um(mismatch), mismatch.dropna()
    finding = f"{mismatch['n'].sum()} particles, in too few places to compare"
    if len(known):
        finding = (
            f"mean images of {known['n'].sum()} particles differ by {_from_to(100 * known['mismatch'], '.1f')} %; "
            f"the calibration's noise alone makes {_from_to(100 * known['own'], '.1f')} %, and its model up to "
            f"{100 * MODEL:.1f} %"
        )
    finding += f"; this may stand for {error_um:.2g} µm of z" if error_um else ""
    finding += "; a focus that moved, which shifts all z alike, cannot be seen"
    advice = "The optics changed since the scan: scan again, or carry the error along (`with_depth_error`)."
    return Judgement("the film's images", error_um > ERROR[1] * span, error_um > 0, finding, advice)


def _from_to(values: pd.Series, form: str) -> str:
    """Least and largest of values (N,), in words."""
    return f"{values.min():{form}} to {values.max():{form}}"
