"""Pictures of what a monitor did.

Each takes data and returns a matplotlib Figure. What concerns the middle third of the height is
blue, of the width orange, as everywhere.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gdptlab.plots.experiment import LINES, TRIGGER_COLOURS
from gdptlab.plots.style import COLOURS, panels, styled


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
def seen_and_true(seen: pd.DataFrame, level: float) -> Figure:
    """Plot the two fractions of one experiment against time: true, by correlation, and by the joint fit with its band.

    Parameters
    ----------
    seen : DataFrame
        A row for each frame: `t_s`; for each trigger `true_h`, `correlation_h`, `joint_h`, `joint_h_low`, and the same
        with `w`.
    level : float
        Fraction that triggers.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(2, 10, 3.4, sharey=True)
    for panel, (of, colour) in zip(axes, TRIGGER_COLOURS.items(), strict=True):
        panel.axhline(level, color="black", lw=0.8, ls=":")
        panel.plot(seen["t_s"], seen[f"true_{of}"], color="black", lw=1, label="true")
        panel.plot(seen["t_s"], seen[f"correlation_{of}"], "s", color="0.5", ms=4, mfc="none", label="correlation")
        panel.fill_between(seen["t_s"], seen[f"joint_{of}_low"], seen[f"joint_{of}"], color=colour, alpha=0.2, lw=0)
        panel.plot(seen["t_s"], seen[f"joint_{of}"], "o", color=colour, ms=4, label="joint fit, lower bound")
        panel.set(xlabel="t (s)", title=f"{of}/3", ylim=(0.1, 1.05))
        panel.legend(loc="lower right", fontsize="small")
    axes[0].set_ylabel("fraction of the particles in view")
    return figure


@styled
def off_times(decided: pd.DataFrame, near_s: float) -> Figure:
    """Plot the fraction of experiments in which the sound is off, against the time since it should have been.

    Parameters
    ----------
    decided : DataFrame
        A row for each experiment and way: `way`, `of`, `off_s` (NaN: never) and `true_s`.
    near_s : float
        Difference that counts as in time: the grey area.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(2, 10, 3.4, sharey=True)
    for panel, of in zip(axes, "hw", strict=True):
        panel.axvspan(-near_s, near_s, color="0.9", lw=0)
        for i, (way, part) in enumerate(decided[decided["of"] == of].groupby("way", sort=False)):
            late = np.sort((part["off_s"] - part["true_s"]).dropna())
            n = np.arange(len(late) + 1) / len(part)
            panel.step(np.concatenate([[-1], late, [1]]), 100 * np.append(n, n[-1]), where="post",
                       color=COLOURS[i], ls=LINES[i % 4], label=way)  # fmt: skip
        panel.set(xlabel="after the true trigger (s)", title=f"{of}/3", xlim=(-0.6, 0.6), ylim=(-3, 103))
    axes[0].set_ylabel("sound is off (%)")
    axes[0].legend(fontsize="small", loc="upper left")
    return figure
