"""Pictures that tell whether to trust a calibration, and what was measured with it.

Each function takes data and returns a matplotlib Figure.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from gdptlab.assessment import match
from gdptlab.calibration import Calibration
from gdptlab.pipeline.beads import ScanReport
from gdptlab.pipeline.quality import depth_quality
from gdptlab.pipeline.settings import Settings
from gdptlab.plots.calibration_map import draw_similarity
from gdptlab.plots.frames import circled
from gdptlab.plots.style import COLOURS, MARK, bare, depth_label, grey, panels, styled

NUMBERED = 60
"""Number of beads of a scan whose numbers are shown, the brightest: more would cover each other."""


@styled
def calibration_page(calibration: Calibration, shown: int = 8) -> Figure:
    """Show all that `quality.report` speaks of, on one page.

    Parameters
    ----------
    calibration : Calibration
        From `Calibration.from_scan`.
    shown : int
        How many of the calibration's images are shown.

    Returns
    -------
    Figure
        The scan where it is sharpest with its beads, numbered as in `calibration.report.beads`; images of the average
        bead; self-similarity; and against z the signal-to-noise ratio, the expected error, the drift, and how much
        images differ.
    """
    made, z_um = calibration.report, calibration.z_um
    if made is None:
        raise ValueError("calibration: got one without a report on beads, allowed is one from Calibration.from_scan")
    depths = depth_quality(calibration, made.noise)
    figure = panels(1, 10, 11.6)[0]
    figure.clear()
    top, strip, bottom = figure.subfigures(3, 1, height_ratios=[5.6, 1.3, 5.2])
    left, right = top.subplots(1, 2, width_ratios=[1.5, 1])
    _beads(left, made)
    alike = draw_similarity(right, calibration.self_similarity(), z_um)
    figure.colorbar(alike, ax=right, label="correlation (line: 0.95)", shrink=0.6)
    right.set_title("Alike: images of two depths")

    which = np.rint(np.linspace(0, len(calibration) - 1, shown)).astype(int)
    for panel, k in zip(strip.subplots(1, shown), which, strict=True):
        panel.imshow(calibration.stack[k])
        panel.set_title(f"{depth_label(z_um[k])} µm", loc="center")
        bare(panel)

    (signal, error), (drift, differ) = bottom.subplots(2, 2, sharex=True)
    signal.semilogy(z_um, depths["signal_to_noise"], color=COLOURS[0])
    signal.axhline(10, color="0.6", lw=1, ls=":", label="well above it: good")
    signal.legend(fontsize="small")
    for k in np.flatnonzero(made.clipped > 0):
        signal.axvspan(z_um[k] - 0.5, z_um[k] + 0.5, color=COLOURS[4], alpha=0.4, lw=0)
    signal.set(
        ylabel="signal / noise of a pixel", title="Visible" + (" (shaded: clipped)" if made.clipped.any() else "")
    )
    error.semilogy(z_um, depths["z_std_um"], color=COLOURS[0], label="noise of a frame")
    error.semilogy(z_um, depths["own_error_um"], "--", color=COLOURS[1], label="noise of the calibration")
    error.set(ylabel="expected error of z (µm)", title="Least error")
    error.legend(fontsize="small")
    for values, name, colour, line in zip(made.drift_px.T, "xy", COLOURS, ("-", "--"), strict=False):
        drift.plot(z_um, values, line, color=colour, label=name)
    drift.set(xlabel="z (µm)", ylabel="drift of the beads (px)", title="Drift")
    drift.legend(fontsize="small")
    differ.plot(z_um, 1 - depths["next_correlation"], color=COLOURS[0], label="from the next slice")
    differ.plot(z_um, 1 - depths["ambiguous_correlation"], ".", color=MARK, label="from the ambiguous depth, if any")
    differ.axhline(0.05, color="0.6", lw=1, ls=":", label="mistaken for it")
    differ.set(xlabel="z (µm)", ylabel="1 − correlation", yscale="log", title="Different")
    differ.legend(fontsize="small")
    for panel in (signal, error, differ):
        panel.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter("{x:g}")
    return figure


def _beads(axes: Axes, made: ScanReport) -> None:
    """Draw the scan and its beads: used ones circled, the others marked with the reason."""
    axes.imshow(made.overview, **grey(made.overview, 0.3))
    stroke = [withStroke(linewidth=2.5, foreground="black")]
    marks = zip(
        made.beads["verdict"].value_counts().sort_index(key=lambda v: v != "used").items(),
        ("o", "x", "s", "^", "D"),
        ("#56B4E9", "#E69F00", "#CC79A7", "#F0E442", "#009E73"),
        strict=False,
    )
    for (verdict, count), marker, colour in marks:
        here = made.beads[made.beads["verdict"] == verdict]
        face = colour if marker == "x" else "none"
        size = {"o": 130, "x": 25}.get(marker, 60)
        axes.scatter(
            here["x_px"],
            here["y_px"],
            s=size,
            marker=marker,
            facecolor=face,
            edgecolor=None if marker == "x" else colour,
            lw=1.6,
            label=f"{verdict} ({count})",
            path_effects=stroke,
        )
    for bead in made.beads.head(NUMBERED).itertuples():
        style = {"textcoords": "offset points", "xytext": (6, 6), "fontsize": "small", "color": "white"}
        axes.annotate(str(bead.Index), (bead.x_px, bead.y_px), **style, path_effects=stroke)
    axes.set(xlabel="x (px)", ylabel="y (px)", title="Beads of the scan, where it is sharpest")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), fontsize="small", frameon=False)


@styled
def measured_page(frame: NDArray, table: pd.DataFrame, settings: Settings, calibration: Calibration) -> Figure:
    """Show whether to trust what was measured in a frame.

    Parameters
    ----------
    frame : array (rows, columns)
    table : DataFrame
        Its particles, as from `locate`.
    settings : Settings
    calibration : Calibration

    Returns
    -------
    Figure
        The frame with its particles. Of the correlation, how many are found above each C_m, in frames as they are,
        in frames with their sign turned, and beside lone particles; of the joint fit, amplitude and chi2. And
        particles from the surest to the least sure, above the images they are taken for.
    """
    figure = panels(1, 10, 12.4)[0]
    figure.clear()
    top, middle, bottom = figure.subfigures(3, 1, height_ratios=[6.6, 2.8, 3])
    whole = top.subplots()
    limits = calibration.z_um[0], calibration.z_um[-1]
    circles = circled(whole, frame, table, limits, area=150)
    top.colorbar(circles, ax=whole, label="z (µm)", shrink=0.85)
    left, right = middle.subplots(1, 2)
    left.hist(table["z_um"], np.linspace(*limits, 21), color=COLOURS[0])
    left.set(xlabel="z (µm)", ylabel="particles", title="Where they are")
    if settings.arguments["method"] == "joint":
        _even(right, table)
    else:
        _cm_histogram(right, settings)

    pictures = bottom.subplots(2, 8)
    near, (down, across) = calibration.size // 2, np.array(frame.shape) - 1
    x, y = table["x_px"].round(), table["y_px"].round()
    uncut = table[(x >= near) & (y >= near) & (x <= across - near) & (y <= down - near)]
    ranked = uncut.sort_values("cm", ascending=False, kind="stable")
    picked = ranked.iloc[np.unique(np.rint(np.linspace(0, len(ranked) - 1, 8)).astype(int))] if len(ranked) else ranked
    for panel in pictures.ravel():
        bare(panel)
    for (seen, taken), particle in zip(pictures.T, picked.itertuples(), strict=False):
        x, y = round(particle.x_px), round(particle.y_px)
        seen.imshow(frame[y - near : y + near + 1, x - near : x + near + 1])
        taken.imshow(calibration.stack[np.abs(calibration.z_um - particle.z_um).argmin()])
        seen.set_title(f"$C_m$ {particle.cm:.2f}", loc="center", fontsize="small")
        taken.set_title(f"{depth_label(particle.z_um)} µm", loc="center", fontsize="small")
    pictures[0, 0].set_ylabel("seen")
    pictures[1, 0].set_ylabel("taken for")
    return figure


def _cm_histogram(axes: Axes, settings: Settings) -> None:
    """Draw how C_m is distributed, of particles and of finds that are false for certain."""
    bins = np.arange(0.2, 1.0001, 0.025)
    axes.hist(settings.found["cm"], bins, color=COLOURS[0], alpha=0.8, label="frames as they are")
    none = {"with their sign turned": settings.false, "beside lone particles": settings.side_lobes}
    for (name, finds), colour, line in zip(none.items(), COLOURS[1:], ("-", "--"), strict=False):
        axes.hist(finds["cm"], bins, histtype="step", color=colour, lw=1.8, ls=line, label=f"{name}: all false")
    axes.axvline(settings.threshold, color="black", lw=1.2, ls=":", label=f"threshold {settings.threshold:.2f}")
    axes.set(xlabel="$C_m$", ylabel="finds", yscale="symlog", title="Particles, and what is none")
    axes.set_ylim(0, None)
    axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(0, -0.2), ncols=2)


def _even(axes: Axes, table: pd.DataFrame) -> None:
    """Draw chi2 against the amplitude of each particle."""
    axes.plot(table["amplitude"], table["chi2"], "o", color=COLOURS[0], ms=4, mew=0, alpha=0.8)
    axes.axhline(1, color="0.6", lw=1, ls=":")
    axes.axvline(table["amplitude"].median(), color="0.6", lw=1, ls=":")
    axes.set(xlabel="amplitude (1: the calibration's)", ylabel="chi2", title="As bright as each other, and explained")
    axes.set_xlim(0, None)


@styled
def symptoms(cases: Mapping[str, tuple[NDArray, pd.DataFrame, pd.DataFrame]], columns: int = 3) -> Figure:
    """Show what goes wrong in frames whose particles are known.

    Parameters
    ----------
    cases : dict of (frame, measured, true)
        By the name of the symptom: an image (rows, columns), what `locate` found in it, and its particles.
    columns : int
        Of panels.

    Returns
    -------
    Figure
        Circles are particles found at the right depth (within 10 µm), crosses are finds that are wrong, and squares
        particles that were missed.
    """
    rows = -(-len(cases) // columns)
    figure, axes = panels(columns, 10, 3.55 * rows + 0.35, rows=rows)
    for panel in axes.ravel()[len(cases) :]:
        panel.set_visible(False)
    for panel, (name, (frame, measured, true)) in zip(axes.ravel(), cases.items(), strict=False):
        panel.imshow(frame, **grey(frame))
        pairs = match(measured, true)
        missed, wrong = true.drop(pairs["true"]), measured.drop(pairs["measured"])
        parts = {"right": measured.loc[pairs["measured"]], "wrong": wrong, "missed": missed}
        styles = (
            {"marker": "o", "s": 110, "lw": 1.8, "facecolor": "none", "edgecolor": "#56B4E9"},
            {"marker": "X", "s": 70, "lw": 0.8, "facecolor": "#D55E00", "edgecolor": "white"},
            {"marker": "s", "s": 110, "lw": 1.8, "facecolor": "none", "edgecolor": "#F0E442"},
        )
        for (label, part), style in zip(parts.items(), styles, strict=True):
            panel.scatter(part["x_px"], part["y_px"], label=label, **style)
        bare(panel)
        panel.set_title(name + "\n" + ", ".join(f"{len(part)} {label}" for label, part in parts.items()))
        panel.set(xlim=(-0.5, frame.shape[1] - 0.5), ylim=(frame.shape[0] - 0.5, -0.5))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    around = {"facecolor": "0.4", "frameon": True, "labelcolor": "white"}
    figure.legend(handles, labels, loc="outside lower center", ncols=3, **around)
    return figure


@styled
def depth_against_truth(cases: Mapping[str, pd.DataFrame], limits_um: tuple[float, float] = (-50, 50)) -> Figure:
    """Plot measured against true depth, a panel for each case.

    Parameters
    ----------
    cases : dict of DataFrame
        Pairs as from `match`, by the name of the case.
    limits_um : (float, float)
        Of z.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(len(cases), 10, 2.9, sharey=True)
    for panel, (name, pairs) in zip(axes, cases.items(), strict=True):
        panel.plot(limits_um, limits_um, color="0.6", lw=1)
        panel.plot(pairs["z_um"], pairs["z_um"] + pairs["dz_um"], "o", color=COLOURS[0], ms=3.5, alpha=0.8, mew=0)
        panel.set(title=name, xlabel="true z (µm)", aspect="equal")
    axes[0].set_ylabel("measured z (µm)")
    return figure
