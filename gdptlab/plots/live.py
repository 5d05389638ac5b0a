"""Pictures of what a monitor did.

Each takes data and returns a matplotlib Figure. What concerns the middle third of the height is
blue, of the width orange, as everywhere.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gdptlab.plots.experiment import LINES, TRIGGER_COLOURS
from gdptlab.plots.style import COLOURS, MARKERS, panels, styled


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
