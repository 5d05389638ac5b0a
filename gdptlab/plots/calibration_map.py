"""How a shape becomes a depth: the four parts of the paper's Figure 2.

Each part draws on the figure (or the part of a figure) that it is given, so that a notebook can show it alone and,
at the end, all four together.
"""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from gdptlab.calibration import Calibration
from gdptlab.denoising import signal_to_noise
from gdptlab.plots.style import ALIKE, COLOURS, MARK, WARMTH, bare, depth_label, extent, grey, panels, scale_bar, styled


def draw_similarity(axes: Axes, values: NDArray, z_um: NDArray) -> AxesImage:
    """Draw the correlation (N, N) of the images of a stack with each other, over their depths (N,)."""
    shown = axes.imshow(values, extent=extent(z_um), origin="lower", cmap="cividis", vmin=ALIKE, vmax=1)
    axes.contour(z_um, z_um, values, levels=[0.95], colors="black", linewidths=0.8)
    axes.set(xlabel="z of one image (µm)", ylabel="z of the other (µm)")
    axes.spines[:].set_visible(False)
    return shown


@styled
def calibration_quality(calibration: Calibration) -> Figure:
    """Show what limits z before any frame is taken: images that are alike, and images lost in noise.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    Figure
        Self-similarity of the templates, and signal-to-noise ratio of the stack against z.
    """
    z_um = calibration.z_um
    figure, [[left, right]] = panels(2, 9, 3.6)
    shown = draw_similarity(left, calibration.self_similarity(), z_um)
    figure.colorbar(shown, ax=left, label="correlation (line: 0.95)", extend="min")
    left.set_title("Alike: templates correlated with each other")
    right.plot(z_um, signal_to_noise(calibration.stack), "o-")
    right.set(xlabel="z (µm)", ylabel="signal / noise of a pixel", ylim=(0, None), title="Visible: signal to noise")
    return figure


def expected_profiles(figure: Figure | SubFigure, calibration: Calibration) -> None:
    """Draw (a): the stack, the subset taken from it, and the C_m profile that is expected at each depth.

    Parameters
    ----------
    figure : Figure or SubFigure
        To draw on.
    calibration : Calibration
    """
    z_um, subset, stack = calibration.z_um, calibration.subset, calibration.stack
    shown = np.unique(np.linspace(0, len(stack) - 1, min(len(stack), 17)).astype(int))
    upper, lower = figure.subfigures(2, 1, height_ratios=[1, 1.9])
    strips = upper.subplots(2, max(len(shown), len(subset)), squeeze=False)
    below = np.rint(subset * (len(shown) - 1) / (len(stack) - 1)).astype(int)  # each under the slice it is taken from
    if len(np.unique(below)) < len(subset):
        below = np.arange(len(subset))
    for panel in strips.flat:
        bare(panel)
    for strip, chosen, columns, colour in (
        (strips[0], shown, np.arange(len(shown)), "0.6"),
        (strips[1], subset, below, MARK),
    ):
        for panel, k in zip(strip[columns], chosen, strict=True):
            panel.imshow(stack[k])
            panel.set_title(depth_label(z_um[k]), loc="center", fontsize="small", pad=2)
            panel.spines[:].set(visible=True, color=colour, linewidth=1.5)
    strips[0, 0].set_ylabel(f"stack,\nN = {len(stack)}", fontsize="small")
    strips[1, 0].set_ylabel(f"subset,\n$N_{{sub}}$ = {len(subset)}", fontsize="small", color=MARK)

    map_, rows = lower.subplots(1, 2)
    low, high, *_ = extent(z_um)
    drawn = map_.imshow(
        calibration.expected,
        extent=(0.5, len(subset) + 0.5, low, high),
        origin="lower",
        aspect="auto",
        cmap="cividis",
        vmin=np.floor(10 * calibration.expected.min()) / 10,
        vmax=1,
    )
    map_.plot(np.arange(len(subset)) + 1, z_um[subset], ".", color=MARK, ms=5)
    map_.set(xlabel="number of the subset image", ylabel="z of the particle (µm)", title="Map of expected profiles")
    map_.set_xticks(np.arange(1, len(subset) + 1, max(1, len(subset) // 9)))
    lower.colorbar(drawn, ax=map_, label="$C_m$")
    for colour, k in zip(COLOURS, np.linspace(0, len(stack) - 1, 6).astype(int)[1:-1], strict=False):
        label = f"z = {depth_label(z_um[k])} µm"
        rows.plot(z_um[subset], calibration.expected[k], "o-", color=colour, label=label)
        map_.axhline(z_um[k], color=colour, lw=1.5)
    rows.set(xlabel="z of the subset image (µm)", ylabel="expected $C_m$", ylim=(None, 1.02), title="Rows of the map")
    rows.legend(fontsize="small")


def maps_around(
    figure: Figure | SubFigure, frame: NDArray, maps: NDArray, calibration: Calibration, particle: pd.Series
) -> None:
    """Draw (b): the frame, and what each correlation map shows around one particle, with its C_m.

    Parameters
    ----------
    figure : Figure or SubFigure
        To draw on.
    frame : array (rows, columns)
    maps : array (N_sub, r, c)
        Correlation of the frame with the subset, at the resolution of the search.
    calibration : Calibration
    particle : Series
        `x_px`, `y_px` of the particle.
    """
    scale = 2 if calibration.half_resolution else 1
    margin, half = calibration.search_templates.shape[-1] // 2, calibration.size // 2
    column, row = (round(particle[name] / scale) - margin for name in ("x_px", "y_px"))
    around = half // scale
    count = -(-len(maps) // 3)
    left, right = figure.subfigures(1, 2, width_ratios=[1.1, 1])
    axes = left.subplots()
    axes.imshow(frame, **grey(frame))
    corner = particle["x_px"] - half, particle["y_px"] - half
    axes.add_patch(Rectangle(corner, 2 * half, 2 * half, fill=False, color=MARK, lw=1.8))
    axes.set(xlabel="x (px)", ylabel="y (px)", title="Frame, and the particle that is followed")
    grid = right.subplots(3, count, squeeze=False).ravel()
    right.suptitle("Its surroundings in each correlation map: $C_m$", fontsize=10)
    for panel in grid:
        panel.set_visible(False)
    for panel, map_, z in zip(grid, maps, calibration.z_um[calibration.subset], strict=False):
        r, c = max(row - around, 0), max(column - around, 0)
        part = map_[r : row + around + 1, c : column + around + 1]
        panel.set_visible(True)
        shown = panel.imshow(part, cmap=WARMTH, vmin=0, vmax=1)
        peak = map_[row - 1 : row + 2, column - 1 : column + 2].max()
        panel.plot(column - c, row - r, "+", color=MARK, ms=8)
        panel.set_title(f"{depth_label(z)} µm: {peak:.2f}", loc="center", fontsize="small", pad=2)
        bare(panel)
    right.colorbar(shown, ax=grid.tolist(), label="correlation", shrink=0.8)


def profile_match(figure: Figure | SubFigure, profile: NDArray, calibration: Calibration, agreement: NDArray) -> None:
    """Draw (c): how a measured C_m profile finds its z.

    Parameters
    ----------
    figure : Figure or SubFigure
        To draw on.
    profile : array (N_sub,)
        Measured C_m in each of the subset's maps.
    calibration : Calibration
    agreement : array (N,)
        Correlation of the profile with the profile expected at each depth.
    """
    left, right = figure.subplots(1, 2)
    subset_z, z_um, best = calibration.z_um[calibration.subset], calibration.z_um, int(agreement.argmax())
    left.plot(subset_z, calibration.expected.T, color="0.85", lw=0.8, zorder=0)
    left.plot(subset_z, calibration.expected[best], color=COLOURS[0], label=f"expected at {depth_label(z_um[best])} µm")
    left.plot(subset_z, profile, "o", color=MARK, label="measured")
    left.set(xlabel="z of the subset image (µm)", ylabel="$C_m$", ylim=(None, 1.02), title="Measured profile")
    left.legend(loc="lower center", fontsize="small")
    right.plot(z_um, agreement, color=COLOURS[0])
    right.plot(z_um[best], agreement[best], "o", color=MARK, ms=7)
    title = f"z is where the two agree best: {depth_label(z_um[best])} µm"
    right.set(xlabel="z of the expected profile (µm)", ylabel="agreement", title=title)


def correlation_peak(
    figure: Figure | SubFigure, window: NDArray, template: NDArray, map_: NDArray, um_per_px: float
) -> None:
    """Draw (d): one normalised cross-correlation, with its peak C_m.

    Parameters
    ----------
    figure : Figure or SubFigure
        To draw on.
    window : array (rows, columns)
        Part of a frame.
    template : array (n, n)
    map_ : array (rows - n + 1, columns - n + 1)
        Entry [r, c] belongs to the part of the window that starts there.
    um_per_px : float
        Size of a pixel in the object.
    """
    axes = figure.subplots(1, 3, width_ratios=[1, 1, 1.15])
    n = len(template)
    row, column = np.unravel_index(map_.argmax(), map_.shape)
    axes[0].imshow(window, **grey(window))
    axes[0].plot(column + n // 2, row + n // 2, "+", color=MARK, ms=12, mew=2)
    axes[0].set_title("image")
    pad = (len(window) - n) // 2  # on a canvas of the same size, so that both are seen at one scale
    axes[1].imshow(template, extent=(pad - 0.5, pad + n - 0.5, pad + n - 0.5, pad - 0.5))
    axes[1].set(xlim=axes[0].get_xlim(), ylim=axes[0].get_ylim(), title="template")
    for panel in axes[:2]:
        bare(panel)
    scale_bar(axes[0], um_per_px, 20)
    y, x = ((m - 1) / 2 for m in map_.shape)
    shown = axes[2].imshow(map_, extent=(-x - 0.5, x + 0.5, y + 0.5, -y - 0.5), cmap="cividis", vmin=0, vmax=1)
    axes[2].plot(column - x, row - y, "+", color=MARK, ms=12, mew=2)
    axes[2].set(xlabel="shift x (px)", ylabel="shift y (px)", title=f"peak $C_m$ = {map_.max():.2f}")
    figure.colorbar(shown, ax=axes[2], label="correlation", shrink=0.9)
