"""Pictures of a monitor at work, while it works and afterwards.

Each takes data and returns a matplotlib Figure. What concerns the middle third of the height is
blue, of the width orange, as everywhere.
"""

import sys
from collections.abc import Callable, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gdptlab.experiment.channel import Channel
from gdptlab.live.monitor import Monitor, Result, Status
from gdptlab.plots.experiment import LINES, TRIGGER_COLOURS, limit_to_channel
from gdptlab.plots.style import COLOURS, DEPTH, MARKERS, bare, grey, panels, styled

SWITCH_S = 5e-4
"""Time, s, after which drawing gives way to the monitor's threads; Python's own switch interval is ten times that."""

FONT = {"family": "monospace", "size": 9}
"""Font of the panel's numbers."""


@styled
def live_panel(
    result: Result | None,
    recent: pd.DataFrame,
    status: Status,
    *,
    channel: Channel,
    to_channel: Callable[[pd.DataFrame], pd.DataFrame],
    level: float = 0.9,
    seconds: float = 10.0,
) -> Figure:
    """Show what a monitor sees at this moment.

    It only reads what `Monitor.latest`, `Monitor.recent` and `Monitor.status` give, so it can be drawn as rarely as
    one likes. About 0.2 s of one core.

    Parameters
    ----------
    result : Result or None
        The frame last looked at, if there is one.
    recent : DataFrame
    status : Status
    channel : Channel
    to_channel : callable
        As of `monitor.MiddleThird`.
    level : float
        Fraction that triggers.
    seconds : float
        How far the curves go back.

    Returns
    -------
    Figure
        The frame with its particles, coloured by depth; the cross-section with the middle thirds; fractions and
        triggers (named 'h' and 'w'; thick where on); latencies; and the status in words.
    """
    figure, axes = plt.subplot_mosaic(
        [["frame", "section", "words"], ["frame", "fractions", "late"]],
        figsize=(10.5, 4.4),
        width_ratios=[1.25, 1, 1],
    )
    figure.subplots_adjust(left=0.01, right=0.985, bottom=0.12, top=0.92, wspace=0.28, hspace=0.42)
    half = channel.height_um / 2
    limit_to_channel(axes["section"], channel)
    axes["section"].set(xlabel="y (µm)", ylabel="z (µm)")
    bare(axes["frame"])
    if result is not None:
        if np.ndim(result.image) == 2:
            axes["frame"].imshow(result.image, **grey(result.image))
        axes["frame"].set_title(f"frame {result.frame}: {result.error or f'{len(result.table)} particles'}")
        if len(result.table):
            here = to_channel(result.table)
            colour = {"cmap": DEPTH, "vmin": -half, "vmax": half}
            rings = axes["frame"].scatter(here["x_px"], here["y_px"], s=120, lw=1.6, c=here["z_um"], **colour)
            rings.set_edgecolor(rings.to_rgba(here["z_um"]))
            rings.set_facecolor("none")
            axes["section"].scatter(
                here["y_channel_um"], here["z_um"], c=here["z_um"], s=18, ec="0.3", lw=0.4, **colour
            )
    _fractions(axes["fractions"], recent, level, seconds)
    _latencies(axes["late"], recent, seconds)
    axes["words"].axis("off")
    axes["words"].text(0, 1, _words(status), va="top", transform=axes["words"].transAxes, **FONT)
    return figure


def _span(recent: pd.DataFrame, seconds: float) -> tuple[float, float]:
    """Give the limits of the time axis: the last `seconds` before the newest decision."""
    end = recent["decision_s"].max() if len(recent) else 0.0
    return max(end - seconds, 0), max(end, 1.0)


def _fractions(axes: Axes, recent: pd.DataFrame, level: float, seconds: float) -> None:
    """Draw the two fractions against time, thick while their trigger is on."""
    axes.axhline(level, color="black", lw=0.8, ls=":")
    for name, colour in TRIGGER_COLOURS.items():
        if f"fraction_{name}" in recent:
            axes.plot(recent["t_s"], recent[f"fraction_{name}"], color=colour, lw=1.2, label=f"{name}/3")
            on = recent[f"fraction_{name}"].where(recent[f"on_{name}"])
            axes.plot(recent["t_s"], on, color=colour, lw=4, solid_capstyle="butt")
            axes.legend(loc="lower right", fontsize="small")
    axes.set(xlabel="t (s)", ylabel="fraction (thick: on)", ylim=(0, 1.05), xlim=_span(recent, seconds))


def _latencies(axes: Axes, recent: pd.DataFrame, seconds: float) -> None:
    """Draw the latency of each evaluated frame against time."""
    if len(recent):
        axes.plot(recent["t_s"], recent["latency_ms"], ".", color=COLOURS[2], ms=4)
        axes.set_ylim(0, 1.15 * recent["latency_ms"].max())
    axes.set(xlabel="t (s)", ylabel="latency (ms)", xlim=_span(recent, seconds))


def _words(status: Status) -> str:
    """Write the monitor's state and its counts, a line for each."""
    lines = [
        f"{status.state}, {status.grabbed} frames",
        f"camera  {status.camera_hz:5.1f} /s",
        f"looks   {status.rate_hz:5.1f} /s",
        f"dropped {status.dropped:5d}",
        f"failed  {status.failed:5d}",
        f"latency {status.latency_median_ms:5.1f} ms, 99 %: {status.latency_p99_ms:.0f}",
        f"log     {status.log_written:5d} lines" + (" !" if status.log_problem else ""),
    ]
    if status.waiting_s > 1 and status.state == "running":
        lines.append(f"no frame for {status.waiting_s:.0f} s")
    if status.error:
        lines.append(status.error[:34])
    return "\n".join(lines)


def watch_live(monitor: Monitor, *, period_s: float = 1.0, **settings: Any) -> None:
    """Draw `live_panel` in a notebook, again and again, until the monitor's source has ended.

    Parameters
    ----------
    monitor : Monitor
    period_s : float
        Pause between two pictures.
    **settings
        Of `live_panel`.
    """
    from IPython.display import display

    shown, ended, patience_s = None, False, sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        while not ended:
            ended = monitor.wait(period_s)
            picture = live_panel(monitor.latest, monitor.recent(), monitor.status(), **settings)
            if shown is None:
                shown = display(picture, display_id=True)
            else:
                shown.update(picture)
    finally:
        sys.setswitchinterval(patience_s)


@styled
def latencies(runs: Mapping[str, pd.DataFrame], limits_ms: Mapping[str, float]) -> Figure:
    """Plot how long after its delivery each frame was decided on, for several runs of a monitor.

    Parameters
    ----------
    runs : dict of DataFrame
        From `Monitor.recent`, by name.
    limits_ms : dict of float
        Horizontal lines, by name.

    Returns
    -------
    Figure
        On the left in time, on the right the fraction of frames that took longer.
    """
    figure, [[line, tail]] = panels(2, 10, 3.2, width_ratios=[1.7, 1], sharey=True)
    for i, (name, recent) in enumerate(runs.items()):
        late = np.sort(recent["latency_ms"])[::-1]
        line.plot(
            recent["t_s"], recent["latency_ms"], MARKERS[i], color=COLOURS[i], ms=3, mfc="none", mew=0.7, label=name
        )
        tail.step((np.arange(len(late)) + 1) / len(late), late, color=COLOURS[i], ls=LINES[i % 4], where="pre")
    for name, limit in limits_ms.items():
        for panel in (line, tail):
            panel.axhline(limit, color="0.45", lw=1, ls=":")
        tail.annotate(name, (1, limit), (-2, 2), xycoords=("axes fraction", "data"), textcoords="offset points",
                      ha="right", fontsize="small", color="0.3")  # fmt: skip
    tail.set(xscale="log", xlabel="fraction of frames that took longer")
    line.set(xlabel="the frame came at t (s)", ylabel="decided after (ms)", ylim=(0, None))
    figure.legend(*line.get_legend_handles_labels(), loc="outside upper center", ncols=len(runs))
    return figure


@styled
def loop_and_timer(loop: pd.DataFrame, timers: pd.DataFrame, level: float, chosen_s: Mapping[str, float]) -> Figure:
    """Plot when the sound went off against when it could have, and what each setting of a timer would have meant.

    Parameters
    ----------
    loop : DataFrame
        Rows from `device.closed_loop`.
    timers : DataFrame
        From `device.timed`, of the same films.
    level : float
        Fraction that counts as focused.
    chosen_s : dict of float
        Settings of the timer to be marked, by name.

    Returns
    -------
    Figure
        Left: one point for each experiment, by its energy density; squares are when the true fraction reached the
        level, circles when the monitor switched. Right: against the timer's setting, the fraction of experiments
        that it stops too early, beside the monitor's.
    """
    figure, [[left, right]] = panels(2, 10, 3.6)
    left.plot(
        loop["energy_density_J_m3"], loop["needed_s"], "s", color="0.4", mfc="none", ms=6, label="focused, in truth"
    )
    left.plot(loop["energy_density_J_m3"], loop["off_s"], "o", color=COLOURS[0], ms=4, label="monitor: off")
    ends = loop["energy_density_J_m3"].agg(["min", "max"])
    for i, (name, t) in enumerate(chosen_s.items()):
        left.plot(ends, [t, t], color=COLOURS[1 + i], ls=LINES[1 + i], label=f"timer, {name}: {t:.2f} s")
    left.set(xlabel="energy density (J/m³)", ylabel="sound off at t (s)", ylim=(0, None))
    left.legend(fontsize="small", loc="lower left")
    early = (timers["true_fraction"] < level).groupby(timers["off_s"]).mean()
    right.plot(early.index, 100 * early, color=COLOURS[1], label="timer")
    right.axhline(100 * (loop["true_fraction"] < level).mean(), color=COLOURS[0], ls=LINES[1], label="monitor")
    for i, (name, t) in enumerate(chosen_s.items()):
        right.axvline(t, color=COLOURS[1 + i], ls=LINES[1 + i], lw=1)
        right.annotate(name, (t, 111), (2, 0), textcoords="offset points", rotation=90, va="top", fontsize="small")
    right.set(xlabel="setting of the timer (s)", ylabel=f"below {level:.0%} when it goes off (%)", ylim=(-3, 114))
    right.set_yticks(range(0, 101, 25))
    right.legend(fontsize="small", loc="center right")
    return figure


@styled
def one_loop(recent: pd.DataFrame, true: pd.DataFrame, off_s: float, level: float, of: str = "w") -> Figure:
    """Plot one experiment in which the monitor switched the sound off.

    Parameters
    ----------
    recent : DataFrame
        Frames looked at: `t_s` since the sound was switched on, and `fraction`.
    true : DataFrame
        From `device.true_fractions`.
    off_s : float
        When the sound went off.
    level : float
        Fraction that triggers.
    of : str
        'h' or 'w'.

    Returns
    -------
    Figure
    """
    figure, [[axes]] = panels(1, 8, 3.2)
    axes.axvspan(0, off_s, color=TRIGGER_COLOURS[of], alpha=0.1, lw=0)
    axes.axhline(level, color="black", lw=0.8, ls=":")
    axes.plot(true["t_s"], true[f"fraction_{of}"], color=TRIGGER_COLOURS[of], lw=1, ls=LINES[1], label="true")
    axes.plot(recent["t_s"], recent["fraction"], "o", color=TRIGGER_COLOURS[of], ms=3, label="measured")
    axes.annotate(f"sound off at {off_s:.2f} s", (off_s, 0.32), (4, 0), textcoords="offset points")
    axes.set(xlabel="t (s)", ylabel=f"fraction of particles in {of}/3", ylim=(0.2, 1.05), xlim=(0, true["t_s"].max()))
    axes.legend(loc="lower right")
    return figure
