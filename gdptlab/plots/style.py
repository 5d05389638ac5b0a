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

FIGURES = Path(__file__).parents[2] / "figures"
"""Folder of the figures that the repository keeps."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of lines: those of M. Okabe and K. Ito, which colour-blind readers can tell apart."""

MARKERS = ("o", "s", "^", "D", "v", "P")
"""Markers of points, in the order of `COLOURS`."""

ALIKE = 0.7
"""Correlation at which the scale of colours of self-similarity begins: images less alike than that are not mistaken
for one another."""

DEPTH = "viridis"
"""Scale of colours of z."""

GREY, WARMTH = plt.get_cmap("gray", 48), plt.get_cmap("cividis", 32)
"""Scales of few colours, for images and for their correlation: files are half as large, and look the same."""

MARK = "#D55E00"
"""Colour of the mark that points something out."""

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


def use() -> None:
    """Set the common style for pictures that a notebook draws itself, in the cell that draws them."""
    # Loads the notebook's backend. If `styled` were the first to load it, what it sets would be lost with the style.
    plt.switch_backend(plt.get_backend())
    plt.rcParams.update(STYLE)


def folder() -> Path:
    """Folder into which notebooks write: `figures/` if the environment asks for it, else one that git ignores.

    ``GDPTLAB_SAVE=1`` in the environment stands for `FIGURES`. Otherwise it is `figures/mine/`, so that a run with
    other settings leaves the repository's figures as they are.
    """
    chosen = FIGURES if os.environ.get("GDPTLAB_SAVE") == "1" else FIGURES / "mine"
    chosen.mkdir(exist_ok=True)
    return chosen


def save(figure: Figure, name: str, into: str | os.PathLike | None = None) -> None:
    """Write a figure, whole or not at all; the same figure always gives the same file.

    Parameters
    ----------
    figure : Figure
    name : str
        Name of the file, ending in `.png`.
    into : path, optional
        A folder; `folder()` if not given.

    Raises
    ------
    ValueError
        If the name does not end in `.png`.
    """
    if Path(name).suffix != ".png":
        raise ValueError(f"name: got {os.fspath(name)!r}, allowed are names that end in .png")
    with written_whole(Path(folder() if into is None else into) / name) as temporary:
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
    """Make a figure, `width` by `height` inches, and its axes, (rows, columns)."""
    figure, axes = plt.subplots(rows, columns, figsize=(width, height), layout="constrained", squeeze=False, **settings)
    return figure, axes


def grey(image: NDArray, beyond: float = 0.4) -> dict[str, object]:
    """Give the limits of grey, as settings of `imshow`: `beyond` % of the pixels are darker, and as many brighter."""
    low, high = np.percentile(image, (beyond, 100 - beyond))
    return {"vmin": float(low), "vmax": float(high), "cmap": GREY}


def stretched(image: NDArray, gamma: float = 0.5) -> NDArray:
    """Scale an image to 0 ... 1 such that its dim particles show and its bright ones are not saturated.

    With s the image between its smallest and its largest value, a dark image becomes s^gamma, and a bright one
    1 - (1 - s)^gamma.
    """
    low, high = float(image.min()), float(image.max())
    scaled = (image - low) / max(high - low, 1)
    return scaled**gamma if np.median(scaled) < 0.5 else 1 - (1 - scaled) ** gamma


def is_dark(axes: Axes) -> bool:
    """Whether most of the picture on these axes is darker than the middle of its scale."""
    shown = axes.images[0]
    return bool(2 * np.median(np.asarray(shown.get_array())) < sum(shown.get_clim()))


def scale_bar(axes: Axes, um_per_px: float, length_um: float) -> None:
    """Draw a bar of `length_um` on an image of which one pixel is `um_per_px` wide."""
    rows, columns = axes.images[0].get_array().shape
    left, y = 0.06 * columns, 0.93 * rows
    colour, other = ("white", "black") if is_dark(axes) else ("black", "white")
    around = [withStroke(linewidth=2, foreground=other)]
    axes.plot([left, left + length_um / um_per_px], [y, y], color=colour, lw=2.5, solid_capstyle="butt")
    axes.text(left, y - 0.03 * rows, f"{length_um:g} µm", color=colour, va="bottom", path_effects=around)


def depth_label(z_um: float) -> str:
    """Write a depth in whole µm, with its sign: −10, 0, +10."""
    return f"{round(z_um):+d}".replace("-", "−") if round(z_um) else "0"


def bare(axes: Axes) -> None:
    """Take away the ticks and the frame of an image."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def extent(z_um: NDArray) -> tuple[float, float, float, float]:
    """Give the `extent` of `imshow` for a picture with a pixel for each pair of evenly spaced depths."""
    half = (z_um[1] - z_um[0]) / 2
    return (z_um[0] - half, z_um[-1] + half) * 2
