"""One style for all figures: colours safe for the colour-blind, fonts, scale bars, and how figures are saved."""

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from gdptlab._files import written_whole

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


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
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


def panels(columns: int, width: float, height: float, *, rows: int = 1, **settings: object) -> tuple[Figure, NDArray]:
    figure, axes = plt.subplots(rows, columns, figsize=(width, height), layout="constrained", squeeze=False, **settings)
    return figure, axes


def grey(image: NDArray, beyond: float = 0.4) -> dict[str, object]:
    """Grey values that show an image's dim and bright particles both; `beyond`, in %, is darker, and brighter."""
    low, high = np.percentile(image, (beyond, 100 - beyond))
    return {"vmin": float(low), "vmax": float(high), "cmap": GREY}


def is_dark(axes: Axes) -> bool:
    """Whether most of the picture on these axes is darker than half-way."""
    shown = axes.images[0]
    return bool(2 * np.median(np.asarray(shown.get_array())) < sum(shown.get_clim()))


def scale_bar(axes: Axes, um_per_px: float, length_um: float) -> None:
    rows, columns = axes.images[0].get_array().shape
    left, y = 0.06 * columns, 0.93 * rows
    colour, other = ("white", "black") if is_dark(axes) else ("black", "white")
    around = [withStroke(linewidth=2, foreground=other)]
    axes.plot([left, left + length_um / um_per_px], [y, y], color=colour, lw=2.5, solid_capstyle="butt")
    axes.text(left, y - 0.03 * rows, f"{length_um:g} µm", color=colour, va="bottom", path_effects=around)


def depth_label(z_um: float) -> str:
    """Whole µm, with a sign: −10, 0, +10."""
    return f"{round(z_um):+d}".replace("-", "−") if round(z_um) else "0"


def bare(axes: Axes) -> None:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def extent(z_um: NDArray) -> tuple[float, float, float, float]:
    """Of a picture with a pixel for each pair of (evenly spaced) depths."""
    half = (z_um[1] - z_um[0]) / 2
    return (z_um[0] - half, z_um[-1] + half) * 2
