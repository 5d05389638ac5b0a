"""Pictures: one function for each figure of the paper, and a few more for the notebooks.

Each takes data, computes nothing of its own but means and scales, and returns a matplotlib Figure. In pictures of
images y points down and the centre of the first pixel is (0, 0), as everywhere in this package.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from gdptlab.calibration import Calibration
from gdptlab.files import written_whole

FIGURES = Path(__file__).parents[1] / "figures"
"""Where the figures of the paper are written."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of lines: those of M. Okabe and K. Ito, which colour-blind readers can tell apart."""

MARKERS = ("o", "s", "^", "D", "v", "P")
ALIKE = 0.7
"""Where the scale of colours of self-similarity begins: what is less alike is not mistaken."""

DEPTH = "viridis"
"""Scale of colours of z."""

GREY, WARMTH = plt.get_cmap("gray", 48), plt.get_cmap("cividis", 32)
"""Scales of few colours, of images and of their correlation: the eye misses nothing, and files are half as large."""

MARK = "#D55E00"
"""Colour of what a picture points at."""

STYLE = {
    "figure.dpi": 80,
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": plt.cycler(color=COLOURS),
    "image.cmap": "gray",
    "image.interpolation": "auto",
    "image.interpolation_stage": "data",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
}


def save(figure: Figure, name: str | os.PathLike, folder: str | os.PathLike = FIGURES) -> None:
    """Write a figure into `folder`, whole or not at all; the same figure always gives the same file.

    Parameters
    ----------
    figure : Figure
    name : str
        Of the file, ending in `.png`.
    folder : path, optional
        The repository's `figures/` if not given.
    """
    if Path(name).suffix != ".png":
        raise ValueError(f"name: got {os.fspath(name)!r}, allowed are names that end in .png")
    with written_whole(Path(folder) / name) as temporary:
        figure.savefig(temporary, dpi=150, metadata={"Software": None})


def _styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Draw in the common style, and leave the figure to the caller alone."""

    @wraps(draw)
    def styled(*args: object, **settings: object) -> Figure:
        opened = set(plt.get_fignums())
        try:
            with plt.rc_context(STYLE):
                figure = draw(*args, **settings)
                figure.draw_without_rendering()  # ticks are made late, and would miss the style
            return figure
        finally:  # or a notebook would show it a second time
            for number in set(plt.get_fignums()) - opened:
                plt.close(number)

    return styled


def _panels(columns: int, width: float, height: float, *, rows: int = 1, **settings: object) -> tuple[Figure, NDArray]:
    figure, axes = plt.subplots(rows, columns, figsize=(width, height), layout="constrained", squeeze=False, **settings)
    return figure, axes


def _grey(image: NDArray, beyond: float = 0.4) -> dict[str, object]:
    """Grey values that show an image's dim and bright particles both; `beyond`, in %, is darker, and brighter."""
    low, high = np.percentile(image, (beyond, 100 - beyond))
    return {"vmin": float(low), "vmax": float(high), "cmap": GREY}


def _is_dark(axes: Axes) -> bool:
    """Whether most of the picture on these axes is darker than half-way."""
    shown = axes.images[0]
    return bool(2 * np.median(np.asarray(shown.get_array())) < sum(shown.get_clim()))


def _scale_bar(axes: Axes, um_per_px: float, length_um: float) -> None:
    rows, columns = axes.images[0].get_array().shape
    left, y = 0.06 * columns, 0.93 * rows
    colour, other = ("white", "black") if _is_dark(axes) else ("black", "white")
    around = [withStroke(linewidth=2, foreground=other)]
    axes.plot([left, left + length_um / um_per_px], [y, y], color=colour, lw=2.5, solid_capstyle="butt")
    axes.text(left, y - 0.03 * rows, f"{length_um:g} µm", color=colour, va="bottom", path_effects=around)


def _depth(z_um: float) -> str:
    """Whole µm, with a sign: −10, 0, +10."""
    return f"{round(z_um):+d}".replace("-", "−") if round(z_um) else "0"


def _bare(axes: Axes) -> None:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _extent(z_um: NDArray) -> tuple[float, float, float, float]:
    """Of a picture with a pixel for each pair of (evenly spaced) depths."""
    half = (z_um[1] - z_um[0]) / 2
    return (z_um[0] - half, z_um[-1] + half) * 2


@_styled
def frame_with_particles(
    image: NDArray,
    particles: pd.DataFrame,
    *,
    z_limits_um: tuple[float, float] = (-50, 50),
    window_px: int | None = None,
) -> Figure:
    """Show a frame and a circle, coloured by z, round each of its particles.

    Parameters
    ----------
    image : array (rows, columns)
    particles : DataFrame
        Columns `x_px`, `y_px`, `z_um`.
    z_limits_um : (float, float)
        Ends of the scale of colours.
    window_px : int, optional
        Size of the templates; a dashed line then bounds the places where one fits into the frame.

    Returns
    -------
    Figure
    """
    figure, [[axes]] = _panels(1, 6.4, 5.4)
    circles = _circled(axes, image, particles, z_limits_um)
    if window_px:
        contrast = "white" if _is_dark(axes) else "black"
        near, (down, across) = window_px // 2, np.array(image.shape) - 1 - window_px // 2
        axes.plot(
            [near, across, across, near, near],
            [near, near, down, down, near],
            "--",
            color=contrast,
            lw=1,
        )
    figure.colorbar(circles, label="z (µm)", shrink=0.85)
    return figure


def _circled(
    axes: Axes, image: NDArray, particles: pd.DataFrame, z_limits_um: tuple[float, float], area: float = 330
) -> PathCollection:
    """Draw a frame and a circle, coloured by z, round each of its particles."""
    axes.imshow(image, **_grey(image))
    circles = axes.scatter(
        particles["x_px"], particles["y_px"], c=particles["z_um"], s=area, lw=2.2, marker="o", cmap=DEPTH
    )
    circles.set(facecolor="none", clim=z_limits_um)
    # A scatter that is not filled takes its colours from the map only if told so.
    circles.set_edgecolor(circles.to_rgba(particles["z_um"]))
    circles.set_path_effects([withStroke(linewidth=3, foreground="white" if _is_dark(axes) else "black")])
    axes.set(xlabel="x (px)", ylabel="y (px)", title=f"{len(particles)} particles")
    return circles


@_styled
def particles_3d(
    particles: pd.DataFrame,
    um_per_px: float,
    *,
    z_limits_um: tuple[float, float] = (-50, 50),
    true: pd.DataFrame | None = None,
) -> Figure:
    """Show particles where they are in space, to scale.

    Parameters
    ----------
    particles : DataFrame
        Columns `x_px`, `y_px`, `z_um`.
    um_per_px : float
        Size of a pixel in the object.
    z_limits_um : (float, float)
    true : DataFrame, optional
        True particles, drawn as crosses.

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(6.8, 4.4), layout="constrained")
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    if true is not None:
        x, y = true["x_px"] * um_per_px, true["y_px"] * um_per_px
        axes.scatter(x, y, true["z_um"], marker="x", color="0.35", s=22, lw=1, depthshade=False, label="true")
    x, y = particles["x_px"] * um_per_px, particles["y_px"] * um_per_px
    low, high = z_limits_um
    dots = axes.scatter(
        x,
        y,
        particles["z_um"],
        c=particles["z_um"],
        cmap=DEPTH,
        vmin=low,
        vmax=high,
        s=42,
        depthshade=False,
        label="measured",
    )
    axes.set(xlabel="x (µm)", ylabel="y (µm)", zlabel="z (µm)", zlim=z_limits_um)
    axes.set(zticks=np.linspace(low, high, 3))
    axes.yaxis.set_inverted(True)  # as in the image
    spans = [np.diff(limits).item() for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(np.abs(spans), zoom=0.92)
    axes.view_init(elev=24, azim=-62)
    figure.colorbar(dots, label="z (µm)", shrink=0.6, pad=0.08)
    if true is not None:
        axes.legend(loc="upper left")
    return figure


@_styled
def contact_sheet(
    stacks: Mapping[str, NDArray], z_um: Sequence[float], um_per_px: float, *, common_scale: bool = False
) -> Figure:
    """Show images of one particle, a row for each stack and a column for each depth.

    Parameters
    ----------
    stacks : dict of arrays (N, n, n)
        By the name of the row.
    z_um : sequence (N,)
    um_per_px : float
        Size of a pixel in the object.
    common_scale : bool
        One scale of grey for all images of a row. If not, each image has its own, to show its shape.

    Returns
    -------
    Figure
    """
    columns, rows = len(z_um), len(stacks)
    width = 10.0
    figure, axes = _panels(columns, width, rows * width / columns + 0.45, rows=rows)
    for line, (name, stack) in zip(axes, stacks.items(), strict=True):
        for panel, image in zip(line, stack, strict=True):
            scaled = stack if common_scale else image
            panel.imshow(image, vmin=float(np.min(scaled)), vmax=float(np.max(scaled)))
            _bare(panel)
        line[0].set_ylabel(name)
        _scale_bar(line[0], um_per_px, 10)
    for k, (panel, z) in enumerate(zip(axes[0], z_um, strict=True)):
        panel.set_title(f"z = {_depth(z)} µm" if k == 0 else _depth(z), loc="center")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    return figure


@_styled
def width_and_peak(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """Plot how wide and how bright a particle's image is against its depth.

    Parameters
    ----------
    tables : dict of DataFrame
        By the microscope's name: columns `z_um`, `width_x_um`, `width_y_um`, `peak_counts`.

    Returns
    -------
    Figure
    """
    figure, [axes] = _panels(len(tables) + 1, 10, 3.2)
    highest = max(t[["width_x_um", "width_y_um"]].to_numpy().max() for t in tables.values())
    for panel, (colour, (name, table)) in zip(axes, zip(COLOURS, tables.items(), strict=False), strict=False):
        panel.plot(table["z_um"], table["width_x_um"], color=colour, label="along x")
        panel.plot(table["z_um"], table["width_y_um"], color="black", ls=(0, (4, 2)), label="along y")
        panel.set(title=name, xlabel="z (µm)", ylabel="RMS width (µm)", ylim=(0, 1.08 * highest))
        panel.legend()
        axes[-1].plot(table["z_um"], table["peak_counts"], color=colour, label=name)
    axes[-1].set(title="Brightest pixel", xlabel="z (µm)", ylabel="light (counts)", ylim=(0, None))
    axes[-1].legend(fontsize="small")
    return figure


@_styled
def compared_images(images: Mapping[str, NDArray], um_per_px: float) -> Figure:
    """Show two images of one particle and their difference.

    Parameters
    ----------
    images : dict of two arrays (rows, columns)
        By name.
    um_per_px : float

    Returns
    -------
    Figure
    """
    (name, first), (other, second) = images.items()
    figure, [axes] = _panels(3, 9, 3.2)
    top = max(first.max(), second.max())
    for panel, title, image in zip(axes, (name, other), (first, second), strict=False):
        shown = panel.imshow(image, vmin=0, vmax=top)
        panel.set_title(title)
    figure.colorbar(shown, ax=axes[:2], label="light (counts)", shrink=0.8)
    difference = 100 * (second - first) / top
    reach = np.abs(difference).max()
    shown = axes[2].imshow(difference, cmap="PuOr", vmin=-reach, vmax=reach)
    axes[2].set_title("second − first")
    figure.colorbar(shown, ax=axes[2], label="% of the peak", shrink=0.8)
    for panel in axes:
        _bare(panel)
    _scale_bar(axes[0], um_per_px, 10)
    return figure


@_styled
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
    figure, [axes] = _panels(len(maps), 3.6 * len(maps) + 1, 3.6)
    for panel, (name, values) in zip(axes, maps.items(), strict=True):
        shown = _similarity(panel, values, z_um)
        panel.set_title(name)
    figure.colorbar(shown, ax=axes, label="correlation (line: 0.95)", extend="min", shrink=0.9)
    return figure


def _similarity(axes: Axes, values: NDArray, z_um: NDArray) -> object:
    shown = axes.imshow(values, extent=_extent(z_um), origin="lower", cmap="cividis", vmin=ALIKE, vmax=1)
    axes.contour(z_um, z_um, values, levels=[0.95], colors="black", linewidths=0.8)
    axes.set(xlabel="z of one image (µm)", ylabel="z of the other (µm)")
    axes.spines[:].set_visible(False)
    return shown


@_styled
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
    figure, [[left, right]] = _panels(2, 9, 3.6)
    shown = _similarity(left, calibration.self_similarity(), z_um)
    figure.colorbar(shown, ax=left, label="correlation (line: 0.95)", extend="min")
    left.set_title("Alike: templates correlated with each other")
    right.plot(z_um, calibration.signal_to_noise(), "o-")
    right.set(xlabel="z (µm)", ylabel="signal / noise of a pixel", ylim=(0, None), title="Visible: signal to noise")
    return figure


@_styled
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
    axes[0].imshow(window, **_grey(window))
    axes[0].plot(column + n // 2, row + n // 2, "+", color=MARK, ms=12, mew=2)
    axes[0].set_title("image")
    # On a canvas of the same size, so that both are seen at one scale.
    pad = (len(window) - n) // 2
    extent = (pad - 0.5, pad + n - 0.5, pad + n - 0.5, pad - 0.5)
    axes[1].imshow(template, extent=extent)
    axes[1].set(xlim=axes[0].get_xlim(), ylim=axes[0].get_ylim(), title="template")
    for panel in axes[:2]:
        _bare(panel)
    _scale_bar(axes[0], um_per_px, 20)
    reach_x, reach_y = ((m - 1) / 2 for m in map_.shape[::-1])
    shown = axes[2].imshow(
        map_, extent=(-reach_x - 0.5, reach_x + 0.5, reach_y + 0.5, -reach_y - 0.5), cmap="cividis", vmin=0, vmax=1
    )
    axes[2].plot(column - reach_x, row - reach_y, "+", color=MARK, ms=12, mew=2)
    axes[2].set(xlabel="shift x (px)", ylabel="shift y (px)", title=f"peak $C_m$ = {map_.max():.2f}")
    figure.colorbar(shown, ax=axes[2], label="correlation", shrink=0.9)


@_styled
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
    figure, [[left, right]] = _panels(2, 9, 3.4)
    _expected_map(figure, left, calibration)
    subset_z = calibration.z_um[calibration.subset]
    for colour, marker, z in zip(COLOURS, MARKERS, z_um, strict=False):
        k = int(np.abs(calibration.z_um - z).argmin())
        label = f"z = {_depth(calibration.z_um[k])} µm"
        right.plot(subset_z, calibration.expected[k], marker=marker, color=colour, label=label)
        left.axhline(calibration.z_um[k], color=colour, lw=1.5)
    right.set(xlabel="z of the subset image (µm)", ylabel="expected $C_m$", ylim=(None, 1.02), title="Rows of the map")
    right.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _expected_map(figure: Figure | SubFigure, axes: Axes, calibration: Calibration) -> None:
    low, high, *_ = _extent(calibration.z_um)
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


@_styled
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
    axes.imshow(frame, **_grey(frame))
    axes.set(xlabel="x (px)", ylabel="y (px)", title="Frame")
    grid = right.subplots(rows, columns, squeeze=False).ravel()
    scale = 2 if calibration.half_resolution else 1
    first = calibration.search_templates.shape[-1] // 2 * scale
    end_y, end_x = (first + scale * (n - 1) for n in maps.shape[1:])
    extent = (first - scale / 2, end_x + scale / 2, end_y + scale / 2, first - scale / 2)
    for panel, map_, z in zip(grid, maps, calibration.z_um[calibration.subset], strict=False):
        shown = panel.imshow(map_, extent=extent, cmap=WARMTH, vmin=0, vmax=1)
        panel.set_title(f"{_depth(z)} µm", fontsize="small", pad=2)
    for panel in grid:
        _bare(panel)
    for panel in grid[len(maps) :]:
        panel.set_visible(False)
    right.colorbar(shown, ax=grid, label="correlation", shrink=0.8)
    if particle is not None:
        for panel in (axes, *grid[: len(maps)]):
            size = 22 if panel is axes else 12
            panel.plot(*particle, "o", color=MARK, mfc="none", ms=size, mew=1.8 if panel is axes else 1.2)


@_styled
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
    left.plot(subset_z, calibration.expected[best], color=COLOURS[0], label=f"expected at {_depth(z_um[best])} µm")
    left.plot(subset_z, profile, "o", color=MARK, label="measured")
    left.set(xlabel="z of the subset image (µm)", ylabel="$C_m$", ylim=(None, 1.02), title="Measured profile")
    left.legend(loc="lower center", fontsize="small")
    right.plot(z_um, likeness, color=COLOURS[0])
    right.plot(z_um[best], likeness[best], "o", color=MARK, ms=7)
    right.annotate(f"{_depth(z_um[best])} µm", (z_um[best], likeness[best]), (6, -14), textcoords="offset points")
    right.set(xlabel="z of the expected profile (µm)", ylabel="agreement", title="z is where the two agree best")


@_styled
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
        panel.set_title(f"{number}: {_depth(calibration.z_um[k])} µm", fontsize="small", pad=2)
    for panel in grid:
        _bare(panel)
    for panel in grid[count:]:
        panel.set_visible(False)
    _scale_bar(grid[0], um_per_px, 10)
    _expected_map(map_, map_.subplots(), calibration)
    _correlation_maps(b, frame, maps, calibration, particle)
    _profile_match(c, profile, calibration, likeness)
    _correlation_peak(d, *peak, um_per_px)
    return figure


@_styled
def fig3_image_types(images: Mapping[str, NDArray], um_per_px: float) -> Figure:
    """Draw the paper's Figure 3: one scene in several kinds of image.

    Parameters
    ----------
    images : dict of arrays (rows, columns)
        By the name of the kind.
    um_per_px : float

    Returns
    -------
    Figure
    """
    figure, [axes] = _panels(len(images), 3.5 * len(images), 3.8)
    for letter, panel, (name, image) in zip("abcdefgh", axes, images.items(), strict=False):
        panel.imshow(image, **_grey(image, 1.5))
        _bare(panel)
        panel.set_title(f"({letter}) {name}")
        _scale_bar(panel, um_per_px, 50)
    return figure


@_styled
def z_errors(pairs: Mapping[str, pd.DataFrame], edges_um: Sequence[float]) -> Figure:
    """Plot the error in z of every particle against its true depth, with the mean in each bin of depth.

    Parameters
    ----------
    pairs : dict of DataFrame
        As `match` returns: columns `z_um` (true) and `dz_um`; by name.
    edges_um : sequence of float
        Of the bins.

    Returns
    -------
    Figure
    """
    figure, [axes] = _panels(len(pairs), 9, 3.3, sharey=True)
    edges = np.asarray(edges_um, dtype=float)
    for panel, colour, (name, table) in zip(axes, COLOURS, pairs.items(), strict=False):
        panel.axhline(0, color="black", lw=0.8)
        panel.plot(table["z_um"], table["dz_um"], ".", color=colour, alpha=0.35, mew=0, ms=6, label="a particle")
        mean = table.groupby(pd.cut(table["z_um"], edges), observed=False)["dz_um"].mean()
        panel.plot((edges[1:] + edges[:-1]) / 2, mean, "k-o", mfc="white", label="mean")
        panel.set(title=name, xlabel="true z (µm)")
    axes[0].set_ylabel("error in z (µm)")
    axes[0].legend()
    return figure


SCORES = {"recall": "recall", "precision": "precision", "sigma_z_um": "σ$_z$ (µm)"}


@_styled
def score_curves(
    tables: Mapping[str, pd.DataFrame],
    x_label: str,
    *,
    columns: Sequence[str] = tuple(SCORES),
    chosen: float | None = None,
    log: bool = False,
) -> Figure:
    """Plot recall, precision and error in z of several measurements against depth or against a setting.

    Parameters
    ----------
    tables : dict of DataFrame
        By name: the index is drawn along x, columns as in `assess.scores`; a column `recall_std`, say, is
        drawn as error bars, or `recall_low` and `recall_high` are.
    x_label : str
        Label, with unit, of the index.
    columns : sequence of str
        Panels, of `recall`, `precision`, `sigma_z_um`.
    chosen : float, optional
        Setting in use, marked by a vertical line.
    log : bool
        Logarithmic scale along x.

    Returns
    -------
    Figure
    """
    figure, [axes] = _panels(len(columns), max(3.4 * len(columns), 6), 3.1)
    for panel, column in zip(axes, columns, strict=True):
        for colour, marker, (name, table) in zip(COLOURS, MARKERS, tables.items(), strict=False):
            spread = table.get(f"{column}_std")
            if f"{column}_low" in table:
                ends = table[column] - table[f"{column}_low"], table[f"{column}_high"] - table[column]
                spread = np.maximum(ends, 0)
            panel.errorbar(
                table.index, table[column], yerr=spread, color=colour, marker=marker, mfc="none", label=name, capsize=2
            )
        ends = (t.get(f"{column}_high", t[column] + t.get(f"{column}_std", 0)) for t in tables.values())
        top = max(end.max() for end in ends)
        panel.set(xlabel=x_label, ylabel=SCORES[column], xscale="log" if log else "linear")
        ticks = np.unique(np.concatenate([t.index for t in tables.values()]))
        if log:
            panel.set_xticks(ticks, labels=[f"{t:g}" for t in ticks], fontsize="small")
            panel.minorticks_off()
        elif np.issubdtype(ticks.dtype, np.integer):
            panel.xaxis.get_major_locator().set_params(integer=True)
        panel.set_ylim(0, 1.05 if column != "sigma_z_um" else 1.08 * top)
        if chosen is not None:
            panel.axvline(chosen, color="0.6", lw=1, ls=":", zorder=0)
    if len(tables) > 1 and len(columns) == 1:
        axes[0].legend(loc="center left", bbox_to_anchor=(1, 0.5))
    elif len(tables) > 1:
        axes[0].legend(loc="lower left")
    return figure
