"""A panel with knobs for a notebook: turn one, and see at once what `locate` makes of a frame.

Needs ipywidgets, which the package does not: `pip install ipywidgets`.
"""

from time import perf_counter

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import real_array
from gdptlab.calibration import Calibration
from gdptlab.locate import METHODS, locate
from gdptlab.plots.style import COLOURS, DEPTH, STYLE, grey

BINS = np.arange(0, 1.0001, 0.025)
"""Edges of the histogram of C_m."""


class Knobs:
    """What is behind the panel: settings in, a picture out.

    Parameters
    ----------
    frame : array (rows, columns)
    calibration : Calibration

    Attributes
    ----------
    table : DataFrame
        Particles at the last settings.
    """

    def __init__(self, frame: ArrayLike, calibration: Calibration) -> None:
        self._frame, self._calibration = real_array("frame", frame, 2), calibration
        self._found: dict[tuple, tuple[pd.DataFrame, float]] = {}
        self.table = pd.DataFrame()
        with plt.rc_context(STYLE):
            self._figure = Figure(figsize=(10, 4.6), dpi=80)
            self._canvas = FigureCanvasAgg(self._figure)
            image, chart = (
                self._figure.add_axes((0.06, 0.1, 0.46, 0.8)),
                self._figure.add_axes((0.62, 0.14, 0.36, 0.74)),
            )
            image.imshow(self._frame, **grey(self._frame), interpolation="nearest")
            image.set(xlabel="x (px)", ylabel="y (px)")
            z_um = calibration.z_um
            self._dots = image.scatter([], [], c=[], s=90, lw=1.8, cmap=DEPTH, vmin=z_um[0], vmax=z_um[-1])
            self._dots.set_facecolor("none")
            self._figure.colorbar(self._dots, ax=image, label="z (µm)", shrink=0.8)
            self._title = image.set_title("")
            self._bars = chart.bar(BINS[:-1], np.zeros(len(BINS) - 1), np.diff(BINS), align="edge", color=COLOURS[0])
            self._line = chart.axvline(0.5, color="black", ls="--", lw=1.2)
            chart.set(xlabel="$C_m$", ylabel="particles", xlim=(0, 1), title="How sure")
            self._chart, self._behind = chart, None
        self._moving = (self._dots, self._title, *self._bars, self._line)
        for artist in self._moving:
            artist.set_animated(True)

    def __call__(self, threshold: float, n_sub: int, refine: bool, method: str) -> NDArray[np.uint8]:
        """Picture (rows, columns, 3), red, green and blue, of what `locate` finds with these settings."""
        self.table, took = self.found(threshold, n_sub, refine, method)
        table = self.table
        self._dots.set_offsets(table[["x_px", "y_px"]])
        self._dots.set_edgecolor(self._dots.to_rgba(table["z_um"]))
        counts = np.histogram(table["cm"], BINS)[0]
        for bar, count in zip(self._bars, counts, strict=True):
            bar.set_height(count)
        self._line.set(xdata=[threshold, threshold], visible=method == "correlation")
        self._title.set_text(f"{len(table)} particles, {took:.0f} ms")
        self._draw(max(counts.max(), 1))
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def found(self, threshold: float, n_sub: int, refine: bool, method: str) -> tuple[pd.DataFrame, float]:
        """What `locate` finds, and how long it took (ms). Kept, so that to and fro costs nothing."""
        turned = (threshold, n_sub, refine) if method == "correlation" else ()
        if turned not in self._found:
            if n_sub != len(self._calibration.subset):
                self._calibration = self._calibration.with_subset(n_sub)
            settings = {"threshold": threshold, "refine": refine} if turned else {}
            start = perf_counter()
            table = locate(self._frame, self._calibration, method=method, **settings)
            self._found[turned] = table, 1000 * (perf_counter() - start)
        return self._found[turned]

    def _draw(self, highest: int) -> None:
        """Draw what moves upon what does not, which is drawn anew only if bars outgrow their axes, or shrink a lot."""
        if self._behind is None or not 0.4 < highest / self._chart.get_ylim()[1] < 1:
            self._chart.set_ylim(0, 1.25 * highest)
            with plt.rc_context(STYLE):
                self._canvas.draw()
            self._behind = self._canvas.copy_from_bbox(self._figure.bbox)
        self._canvas.restore_region(self._behind)
        for artist in self._moving:
            artist.axes.draw_artist(artist)


def panel(frame: ArrayLike, calibration: Calibration, *, threshold: float = 0.5) -> object:
    """Make the panel: sliders for the threshold and N_sub, a box for refinement, a list of methods.

    Parameters
    ----------
    frame : array (rows, columns)
    calibration : Calibration
    threshold : float
        To begin with.

    Returns
    -------
    ipywidgets.VBox
        To be the last line of a cell.

    Raises
    ------
    ImportError
        If ipywidgets is not installed.
    TypeError, ValueError
        If `locate` refuses an argument.
    """
    try:
        import ipywidgets
    except ImportError:
        raise ImportError("ipywidgets is not installed; the panel needs it: pip install ipywidgets") from None
    n_sub = len(calibration.subset)
    wide = {"style": {"description_width": "6em"}, "continuous_update": False}
    controls = {
        "threshold": ipywidgets.FloatSlider(threshold, min=0.1, max=0.99, step=0.01, description="threshold", **wide),
        "n_sub": ipywidgets.IntSlider(n_sub, min=2, max=min(len(calibration), 40), description="N_sub", **wide),
        "refine": ipywidgets.Checkbox(True, description="refine"),
        "method": ipywidgets.Dropdown(options=METHODS, description="method"),
    }
    knobs, picture = Knobs(frame, calibration), ipywidgets.Image(format="png")

    def turn(*_: object) -> None:
        image = knobs(**{name: control.value for name, control in controls.items()})
        picture.value = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        for name in ("threshold", "refine"):
            controls[name].disabled = controls["method"].value == "joint"

    for control in controls.values():
        control.observe(turn, "value")
    turn()
    knobs.found(threshold, n_sub, True, "joint")  # the slowest, so that it is there when it is asked for
    rows = [ipywidgets.HBox(list(controls.values())[:2]), ipywidgets.HBox(list(controls.values())[2:]), picture]
    return ipywidgets.VBox(rows)
