"""Frames, particles in space, and images of one particle beside each other."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from gdptlab.plots.style import DEPTH, GREY, bare, depth_label, grey, is_dark, panels, scale_bar, stretched, styled


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
        Size of the templates. A dashed line then bounds the positions at which a template fits into the frame.

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
    axes: Axes,
    image: NDArray,
    particles: pd.DataFrame,
    z_limits_um: tuple[float, float] = (-50, 50),
    area: float = 330,
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


def draw_in_space(
    axes: Axes,
    particles: pd.DataFrame,
    um_per_px: float,
    z_limits_um: tuple[float, float] = (-50, 50),
    true: pd.DataFrame | None = None,
) -> PathCollection:
    """Draw particles in space, to scale, on axes with the projection "3d"; true ones, if given, as crosses."""
    if true is not None:
        x, y = true["x_px"] * um_per_px, true["y_px"] * um_per_px
        axes.scatter(x, y, true["z_um"], marker="x", color="0.35", s=22, lw=1, depthshade=False, label="true")
    x, y, z = particles["x_px"] * um_per_px, particles["y_px"] * um_per_px, particles["z_um"]
    low, high = z_limits_um
    dots = axes.scatter(x, y, z, c=z, cmap=DEPTH, vmin=low, vmax=high, s=42, depthshade=False, label="measured")
    axes.set_xlabel("x (µm)", labelpad=9)
    axes.set_ylabel("y (µm)", labelpad=11)
    axes.set(zlabel="z (µm)", zlim=z_limits_um)
    axes.set(zticks=np.linspace(low, high, 3))
    axes.yaxis.set_inverted(True)  # as in the image
    spans = [np.diff(limits).item() for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(np.abs(spans), zoom=1.02)
    return dots


@styled
def particles_3d(
    particles: pd.DataFrame,
    um_per_px: float,
    *,
    true: pd.DataFrame | None = None,
    elevation: float = 24,
    azimuth: float = -62,
) -> Figure:
    """Show particles where they are in space, to scale.

    Parameters
    ----------
    particles : DataFrame
        Columns `x_px`, `y_px`, `z_um`.
    um_per_px : float
        Size of a pixel in the object.
    true : DataFrame, optional
        True particles, drawn as crosses.
    elevation, azimuth : float
        Direction of view, degrees.

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(6.8, 4.4), layout="constrained")
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    dots = draw_in_space(axes, particles, um_per_px, true=true)
    axes.view_init(elev=elevation, azim=azimuth)
    figure.colorbar(dots, label="z (µm)", shrink=0.6, pad=0.08)
    if true is not None:
        axes.legend(loc="upper left")
    return figure


@styled
def contact_sheet(stacks: Mapping[str, NDArray], z_um: Sequence[float], um_per_px: float) -> Figure:
    """Show images of one particle, a row for each stack and a column for each depth; each has its own scale of grey.

    Parameters
    ----------
    stacks : dict of arrays (N, n, n)
        By the name of the row.
    z_um : sequence (N,)
    um_per_px : float
        Size of a pixel in the object.

    Returns
    -------
    Figure
    """
    columns, rows = len(z_um), len(stacks)
    width = 10.0
    figure, axes = panels(columns, width, rows * width / columns + 0.45, rows=rows)
    for line, (name, stack) in zip(axes, stacks.items(), strict=True):
        for panel, image in zip(line, stack, strict=True):
            panel.imshow(image)
            bare(panel)
        line[0].set_ylabel(name)
        scale_bar(line[0], um_per_px, 10)
    for k, (panel, z) in enumerate(zip(axes[0], z_um, strict=True)):
        panel.set_title(f"z = {depth_label(z)} µm" if k == 0 else depth_label(z), loc="center")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    return figure


@styled
def side_by_side(images: Mapping[str, NDArray], um_per_px: float, bar_um: float = 50) -> Figure:
    """Show frames side by side, stretched such that dim particles show and bright ones are not saturated.

    Parameters
    ----------
    images : dict of arrays (rows, columns)
        By the title of each.
    um_per_px : float
        Size of a pixel in the object.
    bar_um : float
        Length of the scale bar.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(len(images), 10, 10 / len(images) + 0.4)
    for panel, (title, image) in zip(axes, images.items(), strict=True):
        panel.imshow(stretched(image), cmap=GREY, vmin=0, vmax=1)
        bare(panel)
        panel.set_title(title)
        scale_bar(panel, um_per_px, bar_um)
    return figure
