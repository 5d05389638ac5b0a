"""Sliders for a notebook: move one, and the picture is drawn again.

They need ipywidgets, which the package does not: without it the picture is drawn once, with its first settings.
"""

from collections.abc import Callable, Sequence
from inspect import signature
from time import perf_counter

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from gdptlab.calibration import Calibration
from gdptlab.locate import METHODS, locate
from gdptlab.plots.frames import frame_with_particles


def slide(draw: Callable[..., Figure], **choices: Sequence) -> Figure:
    """Show sliders above a picture that a function draws.

    Nothing is drawn twice before a slider is moved, so that a notebook that runs by itself does not wait.

    Parameters
    ----------
    draw : callable
        Each argument has a default, with which the picture is drawn at first. Returns a Figure.
    **choices : sequences
        For each argument that shall have a slider, its values; the default must be among them.

    Returns
    -------
    Figure
        The picture at the defaults.

    Raises
    ------
    ValueError
        If a default is not among the values.
    """
    defaults = {name: parameter.default for name, parameter in signature(draw).parameters.items()}
    for name, values in choices.items():
        if defaults[name] not in values:
            raise ValueError(f"{name}: got the default {defaults[name]!r}, allowed is one of {list(values)}")
    try:
        import ipywidgets
        from IPython.display import display
    except ImportError:
        return draw()
    sliders = {
        name: ipywidgets.SelectionSlider(
            options=list(values), value=defaults[name], description=name, continuous_update=False
        )
        for name, values in choices.items()
    }
    picture = ipywidgets.Output()

    def redraw(_: object) -> None:
        figure = draw(**{name: slider.value for name, slider in sliders.items()})
        plt.close(figure)
        with picture:
            picture.clear_output(wait=True)
            display(figure)

    for slider in sliders.values():
        slider.observe(redraw, "value")
    display(ipywidgets.VBox([*sliders.values(), picture]))
    figure = draw()
    plt.close(figure)  # or the notebook shows it a second time
    return figure


def panel(frame: ArrayLike, calibration: Calibration, *, threshold: float = 0.5) -> Figure:
    """Show a frame with what `locate` finds in it, under sliders for its settings.

    Parameters
    ----------
    frame : array (rows, columns)
    calibration : Calibration
    threshold : float
        To begin with.

    Returns
    -------
    Figure
        The frame and its particles at the first settings.

    Raises
    ------
    TypeError, ValueError
        If `locate` refuses an argument.
    """
    own = len(calibration.subset)

    def draw(
        threshold: float = threshold, n_sub: int = own, refine: bool = True, method: str = "correlation"
    ) -> Figure:
        trial = calibration if n_sub == len(calibration.subset) else calibration.with_subset(n_sub)
        settings = {"threshold": threshold, "refine": refine} if method == "correlation" else {}
        start = perf_counter()
        table = locate(frame, trial, method=method, **settings)
        figure = frame_with_particles(frame, table, z_limits_um=(calibration.z_um[0], calibration.z_um[-1]))
        figure.axes[0].set_title(f"{len(table)} particles, {1e3 * (perf_counter() - start):.0f} ms")
        return figure

    thresholds = sorted({threshold, *(k / 20 for k in range(2, 20))})
    subsets = sorted({own, *range(2, min(len(calibration), 20) + 1)})
    return slide(draw, threshold=thresholds, n_sub=subsets, refine=(True, False), method=METHODS)
