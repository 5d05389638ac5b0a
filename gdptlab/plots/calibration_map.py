"""How a shape becomes a depth: the parts of the paper's Figure 2 (notebook 02)."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from gdptlab.calibration import Calibration
from gdptlab.denoising import signal_to_noise
from gdptlab.plots.style import (
    ALIKE,
    COLOURS,
    MARK,
    MARKERS,
    WARMTH,
    bare,
    depth_label,
    extent,
    grey,
    panels,
    scale_bar,
    styled,
)


@styled
def self_similarity(maps: Mapping[str, NDArray], z_um: NDArray) -> Figure:
    """Show how alike images of a particle at two depths are, a map for each microscope.

    Parameters
    ----------
    maps : dict of arrays (N, N)
        Correlations, by name.
    z_um : array (N,)

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(len(maps), 3.6 * len(maps) + 1, 3.6)
    for panel, (name, values) in zip(axes, maps.items(), strict=True):
        shown = draw_similarity(panel, values, z_um)
        panel.set_title(name)
    figure.colorbar(shown, ax=axes, label="correlation (line: 0.95)", extend="min", shrink=0.9)
    return figure


def draw_similarity(axes: Axes, values: NDArray, z_um: NDArray) -> object:
    shown = axes.imshow(values, extent=extent(z_um), origin="lower", cmap="cividis", vmin=ALIKE, vmax=1)
    axes.contour(z_um, z_um, values, levels=[0.95], colors="black", linewidths=0.8)
    axes.set(xlabel="z of one image (µm)", ylabel="z of the other (µm)")
    axes.spines[:].set_visible(False)
    return shown


@styled
def calibration_quality(calibration: Calibration) -> Figure:
    """Show what limits z before any frame is taken: images alike, and images lost in noise.

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


@styled
def correlation_peak(window: NDArray, template: NDArray, map_: NDArray, um_per_px: float) -> Figure:
    """Show one normalised cross-correlation (the paper's Figure 2d): image, template, map and its peak C_m.

    Parameters
    ----------
    window : array (rows, columns)
        Part of a frame.
    template : array (n, n)
    map_ : array (rows - n + 1, columns - n + 1)
        Entry [r, c] belongs to the part of the window that starts there.
    um_per_px : float

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(9, 2.9), layout="constrained")
    _correlation_peak(figure, window, template, map_, um_per_px)
    return figure


def _correlation_peak(
    figure: Figure | SubFigure, window: NDArray, template: NDArray, map_: NDArray, um_per_px: float
) -> None:
    axes = figure.subplots(1, 3, width_ratios=[1, 1, 1.15])
    n = len(template)
    row, column = np.unravel_index(map_.argmax(), map_.shape)
    axes[0].imshow(window, **grey(window))
    axes[0].plot(column + n // 2, row + n // 2, "+", color=MARK, ms=12, mew=2)
    axes[0].set_title("image")
    # On a canvas of the same size, so that both are seen at one scale.
    pad = (len(window) - n) // 2
    extent = (pad - 0.5, pad + n - 0.5, pad + n - 0.5, pad - 0.5)
    axes[1].imshow(template, extent=extent)
    axes[1].set(xlim=axes[0].get_xlim(), ylim=axes[0].get_ylim(), title="template")
    for panel in axes[:2]:
        bare(panel)
    scale_bar(axes[0], um_per_px, 20)
    reach_x, reach_y = ((m - 1) / 2 for m in map_.shape[::-1])
    shown = axes[2].imshow(
        map_, extent=(-reach_x - 0.5, reach_x + 0.5, reach_y + 0.5, -reach_y - 0.5), cmap="cividis", vmin=0, vmax=1
    )
    axes[2].plot(column - reach_x, row - reach_y, "+", color=MARK, ms=12, mew=2)
    axes[2].set(xlabel="shift x (px)", ylabel="shift y (px)", title=f"peak $C_m$ = {map_.max():.2f}")
    figure.colorbar(shown, ax=axes[2], label="correlation", shrink=0.9)


@styled
def expected_profiles(calibration: Calibration, z_um: Sequence[float] = ()) -> Figure:
    """Show the map of expected C_m profiles (the paper's Figure 2a), and some of them as curves.

    Parameters
    ----------
    calibration : Calibration
    z_um : sequence of float
        Depths whose profiles are drawn beside the map.

    Returns
    -------
    Figure
    """
    figure, [[left, right]] = panels(2, 9, 3.4)
    _expected_map(figure, left, calibration)
    subset_z = calibration.z_um[calibration.subset]
    for colour, marker, z in zip(COLOURS, MARKERS, z_um, strict=False):
        k = int(np.abs(calibration.z_um - z).argmin())
        label = f"z = {depth_label(calibration.z_um[k])} µm"
        right.plot(subset_z, calibration.expected[k], marker=marker, color=colour, label=label)
        left.axhline(calibration.z_um[k], color=colour, lw=1.5)
    right.set(xlabel="z of the subset image (µm)", ylabel="expected $C_m$", ylim=(None, 1.02), title="Rows of the map")
    right.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _expected_map(figure: Figure | SubFigure, axes: Axes, calibration: Calibration) -> None:
    low, high, *_ = extent(calibration.z_um)
    count = len(calibration.subset)
    shown = axes.imshow(
        calibration.expected,
        extent=(0.5, count + 0.5, low, high),
        origin="lower",
        aspect="auto",
        cmap="cividis",
        vmin=np.floor(10 * calibration.expected.min()) / 10,
        vmax=1,
    )
    axes.spines[:].set_visible(False)
    axes.set(xlabel="subset image", ylabel="z of the particle (µm)", title="Expected $C_m$ profiles, one in each row")
    axes.set_xticks(np.arange(1, count + 1, max(1, count // 9)))
    figure.colorbar(shown, ax=axes, label="$C_m$")


@styled
def correlation_maps(
    frame: NDArray, maps: NDArray, calibration: Calibration, particle: tuple[float, float] | None = None
) -> Figure:
    """Show a frame and its correlation maps (the paper's Figure 2b).

    Parameters
    ----------
    frame : array (rows, columns)
    maps : array (n_sub, r, c)
        Correlation of the frame with the calibration's subset, at the resolution of the search.
    calibration : Calibration
    particle : (float, float), optional
        x and y in px of a particle to mark.

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(9.4, 4.4), layout="constrained")
    _correlation_maps(figure, frame, maps, calibration, particle)
    return figure


def _correlation_maps(
    figure: Figure | SubFigure,
    frame: NDArray,
    maps: NDArray,
    calibration: Calibration,
    particle: tuple[float, float] | None,
) -> None:
    rows = int(np.floor(np.sqrt(len(maps))))
    columns = -(-len(maps) // rows)
    left, right = figure.subfigures(1, 2, width_ratios=[1, 1.05])
    axes = left.subplots()
    axes.imshow(frame, **grey(frame))
    axes.set(xlabel="x (px)", ylabel="y (px)", title="Frame")
    grid = right.subplots(rows, columns, squeeze=False).ravel()
    scale = 2 if calibration.half_resolution else 1
    first = calibration.search_templates.shape[-1] // 2 * scale
    end_y, end_x = (first + scale * (n - 1) for n in maps.shape[1:])
    extent = (first - scale / 2, end_x + scale / 2, end_y + scale / 2, first - scale / 2)
    for panel, map_, z in zip(grid, maps, calibration.z_um[calibration.subset], strict=False):
        shown = panel.imshow(map_, extent=extent, cmap=WARMTH, vmin=0, vmax=1)
        panel.set_title(f"{depth_label(z)} µm", fontsize="small", pad=2)
    for panel in grid:
        bare(panel)
    for panel in grid[len(maps) :]:
        panel.set_visible(False)
    right.colorbar(shown, ax=grid, label="correlation", shrink=0.8)
    if particle is not None:
        for panel in (axes, *grid[: len(maps)]):
            size = 22 if panel is axes else 12
            panel.plot(*particle, "o", color=MARK, mfc="none", ms=size, mew=1.8 if panel is axes else 1.2)


@styled
def profile_match(profile: NDArray, calibration: Calibration, likeness: NDArray) -> Figure:
    """Show how a measured C_m profile finds its z (the paper's Figure 2c).

    Parameters
    ----------
    profile : array (n_sub,)
        Measured C_m in each of the subset's maps.
    calibration : Calibration
    likeness : array (N,)
        How well the profile agrees with that expected at each depth of the calibration.

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(9, 3.2), layout="constrained")
    _profile_match(figure, profile, calibration, likeness)
    return figure


def _profile_match(figure: Figure | SubFigure, profile: NDArray, calibration: Calibration, likeness: NDArray) -> None:
    left, right = figure.subplots(1, 2)
    subset_z, z_um, best = calibration.z_um[calibration.subset], calibration.z_um, int(likeness.argmax())
    left.plot(subset_z, calibration.expected.T, color="0.85", lw=0.8, zorder=0)
    left.plot(subset_z, calibration.expected[best], color=COLOURS[0], label=f"expected at {depth_label(z_um[best])} µm")
    left.plot(subset_z, profile, "o", color=MARK, label="measured")
    left.set(xlabel="z of the subset image (µm)", ylabel="$C_m$", ylim=(None, 1.02), title="Measured profile")
    left.legend(loc="lower center", fontsize="small")
    right.plot(z_um, likeness, color=COLOURS[0])
    right.plot(z_um[best], likeness[best], "o", color=MARK, ms=7)
    right.annotate(f"{depth_label(z_um[best])} µm", (z_um[best], likeness[best]), (6, -14), textcoords="offset points")
    right.set(xlabel="z of the expected profile (µm)", ylabel="agreement", title="z is where the two agree best")


@styled
def fig2_calibration_map(
    calibration: Calibration,
    frame: NDArray,
    maps: NDArray,
    particle: tuple[float, float],
    profile: NDArray,
    likeness: NDArray,
    peak: tuple[NDArray, NDArray, NDArray],
    um_per_px: float,
) -> Figure:
    """Draw the paper's Figure 2: from the calibration stack to a particle's z.

    Parameters
    ----------
    calibration : Calibration
        For (a): the subset of its stack, and its map of expected profiles.
    frame, maps, particle
        For (b), as in `correlation_maps`.
    profile, likeness
        For (c), as in `profile_match`.
    peak : (window, template, map)
        For (d), as in `correlation_peak`.
    um_per_px : float

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(9, 13.6), layout="constrained")
    a, b, c, d = figure.subfigures(4, 1, height_ratios=[3.4, 4.4, 3.1, 2.9])
    for part, letter, title in (
        (a, "a", "Calibration: subset of the stack, and the profile expected at each depth"),
        (b, "b", "Evaluation: the frame correlated with each image of the subset"),
        (c, "c", "The particle in the circle: measured profile against the expected ones"),
        (d, "d", "What $C_m$ is: the peak of a normalised cross-correlation"),
    ):
        part.suptitle(f"({letter})  {title}", x=0.01, ha="left", weight="bold", fontsize=11)
    pictures, map_ = a.subfigures(1, 2, width_ratios=[0.75, 1])
    count = len(calibration.subset)
    rows = int(np.floor(np.sqrt(count)))
    grid = pictures.subplots(rows, -(-count // rows), squeeze=False).ravel()
    for number, (panel, k) in enumerate(zip(grid, calibration.subset, strict=False), 1):
        panel.imshow(calibration.stack[k])
        panel.set_title(f"{number}: {depth_label(calibration.z_um[k])} µm", fontsize="small", pad=2)
    for panel in grid:
        bare(panel)
    for panel in grid[count:]:
        panel.set_visible(False)
    scale_bar(grid[0], um_per_px, 10)
    _expected_map(map_, map_.subplots(), calibration)
    _correlation_maps(b, frame, maps, calibration, particle)
    _profile_match(c, profile, calibration, likeness)
    _correlation_peak(d, *peak, um_per_px)
    return figure
