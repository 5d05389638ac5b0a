"""Pictures of how long things take: of frames, of their parts, of films, of a camera that does not wait.

Each function takes data and returns a matplotlib Figure.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from gdptlab.plots.style import COLOURS, MARKERS, panels, styled

GREY = "0.45"
"""Grey of lines that are not measured, or that only tell what is least possible."""


@styled
def frame_times(times: pd.DataFrame, floors: Mapping[str, pd.Series] | None = None) -> Figure:
    """Plot the time of a frame against whatever was varied, a panel for each.

    Parameters
    ----------
    times : DataFrame
        `varied`, the name of what was varied, with its unit; `value`; `method`; `ms`.
    floors : dict of Series, optional
        Milliseconds, indexed by value, of what is only for comparison, by its name: drawn as broken grey lines
        in the last panel.

    Returns
    -------
    Figure
    """
    names, methods = times["varied"].unique(), times["method"].unique()
    figure, [axes] = panels(len(names), 3.1 * len(names), 3.6, sharey=True)
    for panel, varied in zip(axes, names, strict=True):
        here = times[times["varied"] == varied]
        for i, method in enumerate(methods):
            line = here[here["method"] == method].sort_values("value")
            panel.plot(line["value"], line["ms"], color=COLOURS[i], marker=MARKERS[i], label=method)
        values = np.sort(here["value"].unique())
        panel.set(xscale="log", yscale="log", xlabel=varied)
        panel.set_xticks(values, labels=[f"{v:g}" for v in values])
        panel.xaxis.set_minor_locator(NullLocator())
        panel.grid(axis="y", color="0.9", lw=0.8)
    for name, dashes in zip(floors or {}, [(1, 1.5), (5, 2)], strict=False):
        axes[-1].plot(floors[name].index, floors[name], color=GREY, lw=1.4, ls=(0, dashes), label=name)
    axes[0].set_ylabel("one frame (ms)")
    axes[0].yaxis.set_major_formatter(FuncFormatter(lambda ms, _: f"{ms:g}"))
    axes[0].yaxis.set_minor_formatter(NullFormatter())
    handles, labels = axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


@styled
def breakdown(parts: pd.Series) -> Figure:
    """Show what the parts of an evaluation take, one after the other.

    Parameters
    ----------
    parts : Series
        Milliseconds, indexed by the name of the part, in order.

    Returns
    -------
    Figure
    """
    figure, axes = panels(1, 9, 0.45 * len(parts) + 0.8)
    panel = axes[0, 0]
    end = parts.cumsum()
    panel.barh(parts.index, parts, left=end - parts, color=[COLOURS[i % len(COLOURS)] for i in range(len(parts))])
    for row, (ms, right) in enumerate(zip(parts, end, strict=True)):
        panel.annotate(f"{ms:.1f} ms", (right, row), (4, 0), textcoords="offset points", va="center")
    panel.invert_yaxis()
    panel.set(xlabel="time since the frame arrived (ms)", xlim=(0, 1.1 * end.iloc[-1]))
    return figure


@styled
def scaling(rates: pd.Series) -> Figure:
    """Plot frames per second against processes, beside what as many times one would be.

    Parameters
    ----------
    rates : Series
        Frames per second, indexed by the number of processes; the smallest is the measure of the line.

    Returns
    -------
    Figure
    """
    figure, axes = panels(1, 4.2, 3.2)
    panel, (first, *_) = axes[0, 0], rates.index
    ideal = rates[first] / first * np.array([0, rates.index.max()])
    panel.plot([0, rates.index.max()], ideal, color=GREY, ls="--", label="in proportion")
    panel.plot(rates.index, rates, color=COLOURS[0], marker=MARKERS[0], ls="none", ms=7, label="measured")
    panel.set(xlabel="processes", ylabel="frames per second", xticks=rates.index, xlim=(0, None), ylim=(0, None))
    panel.legend(loc="upper left")
    return figure


@styled
def real_time(used: pd.DataFrame, period_s: float, dropped: int) -> Figure:
    """Plot how long after its arrival each frame was understood.

    Parameters
    ----------
    used : DataFrame
        A row for each frame evaluated: `t_s`, when it arrived, and `decision_s`, when it was understood.
    period_s : float
        Time between frames.
    dropped : int
        How many frames nobody saw.

    Returns
    -------
    Figure
    """
    figure, axes = panels(2, 10, 3.1, width_ratios=[2.6, 1], sharey=True)
    line, fraction = axes[0]
    late_ms = 1e3 * (used["decision_s"] - used["t_s"])
    line.plot(used["t_s"], late_ms, ".", color=COLOURS[0], ms=5)
    fraction.hist(late_ms, bins=30, orientation="horizontal", color=COLOURS[0])
    for panel in (line, fraction):
        panel.axhline(1e3 * period_s, color=COLOURS[1], ls="--")
    at = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "right"}
    line.annotate("next frame", (1, 1e3 * period_s), (0, 3), color=COLOURS[1], **at)
    line.set(xlabel="the frame arrived at t (s)", ylabel="understood after (ms)")
    line.set_ylim(0, 1.15 * max(late_ms.max(), 1e3 * period_s))
    line.set_title(f"{len(used)} frames evaluated, {dropped} dropped")
    fraction.set(xlabel="frames")
    return figure
