"""Frames, particles and calibration images as pictures (notebooks 00, 01 and 03)."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from gdptlab.plots.style import COLOURS, DEPTH, bare, depth_label, grey, is_dark, panels, scale_bar, styled


@styled
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
    figure, [[axes]] = panels(1, 6.4, 5.4)
    circles = circled(axes, image, particles, z_limits_um)
    if window_px:
        contrast = "white" if is_dark(axes) else "black"
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


def circled(
    axes: Axes, image: NDArray, particles: pd.DataFrame, z_limits_um: tuple[float, float], area: float = 330
) -> PathCollection:
    """Draw a frame and a circle, coloured by z, round each of its particles."""
    axes.imshow(image, **grey(image))
    circles = axes.scatter(
        particles["x_px"], particles["y_px"], c=particles["z_um"], s=area, lw=2.2, marker="o", cmap=DEPTH
    )
    circles.set(facecolor="none", clim=z_limits_um)
    # A scatter that is not filled takes its colours from the map only if told so.
    circles.set_edgecolor(circles.to_rgba(particles["z_um"]))
    circles.set_path_effects([withStroke(linewidth=3, foreground="white" if is_dark(axes) else "black")])
    axes.set(xlabel="x (px)", ylabel="y (px)", title=f"{len(particles)} particles")
    return circles


@styled
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


@styled
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
    figure, axes = panels(columns, width, rows * width / columns + 0.45, rows=rows)
    for line, (name, stack) in zip(axes, stacks.items(), strict=True):
        for panel, image in zip(line, stack, strict=True):
            scaled = stack if common_scale else image
            panel.imshow(image, vmin=float(np.min(scaled)), vmax=float(np.max(scaled)))
            bare(panel)
        line[0].set_ylabel(name)
        scale_bar(line[0], um_per_px, 10)
    for k, (panel, z) in enumerate(zip(axes[0], z_um, strict=True)):
        panel.set_title(f"z = {depth_label(z)} µm" if k == 0 else depth_label(z), loc="center")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    return figure


@styled
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
    figure, [axes] = panels(len(tables) + 1, 10, 3.2)
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


@styled
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
    figure, [axes] = panels(3, 9, 3.2)
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
        bare(panel)
    scale_bar(axes[0], um_per_px, 10)
    return figure


@styled
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
    figure, [axes] = panels(len(images), 3.5 * len(images), 3.8)
    for letter, panel, (name, image) in zip("abcdefgh", axes, images.items(), strict=False):
        panel.imshow(image, **grey(image, 1.5))
        bare(panel)
        panel.set_title(f"({letter}) {name}")
        scale_bar(panel, um_per_px, 50)
    return figure
