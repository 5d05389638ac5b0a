"""The paper's Figure 5: how wrong a trigger is, against the time that an evaluation takes."""

from collections.abc import Mapping, Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from gdptlab.plots.experiment import TRIGGER_COLOURS, TRIGGER_TITLES, TRIGGERS
from gdptlab.plots.style import COLOURS, MARKERS, panels, styled

BAND = "0.86"
"""Grey of the delay that the clock alone explains."""

PAPER_S = 1.0
"""Evaluation time on the paper's laptop, s (paper, section 4.1: about 1 s)."""

NESTED = (4.5, 2.6, 1.1)
"""Widths of the first line and of those drawn upon it, points: where lines coincide, all of them are seen."""


def _band(axes: Axes, band: pd.DataFrame) -> None:
    """Draw the delay that is expected by chance, and where the paper's laptop was."""
    axes.fill_between(band["tau_s"], band["low_s"], band["high_s"], color=BAND, lw=0)
    axes.plot(band["tau_s"], band["mean_s"], color="0.6", lw=2)
    axes.axhline(0, color="black", lw=0.8)
    axes.axvline(PAPER_S, color="0.4", lw=1, ls=":")
    axes.set(xscale="log", ylabel="error (s)")
    ticks = (0.01, 0.03, 0.1, 0.3, 1, 3)
    axes.set_xticks(ticks, labels=[f"{t:g}" for t in ticks])
    axes.minorticks_off()


def _point(axes: Axes, x: float, row: pd.Series, vertical: bool = True, **look: object) -> None:
    """Draw a median and its quartiles."""
    ends = [[row["median"] - row["q25"]], [row["q75"] - row["median"]]]
    bars = {"yerr": ends} if vertical else {"xerr": ends}
    at = (x, row["median"]) if vertical else (row["median"], x)
    axes.errorbar(*at, **bars, lw=1, ms=6, ls="", **look)


@styled
def fig5_times(points: pd.DataFrame, band: pd.DataFrame, colour: str, letters: str = "ab") -> Figure:
    """Draw the error of both triggers against the measured evaluation time (the paper's Figure 5 a, b, d and e).

    Parameters
    ----------
    points : DataFrame
        From `figure5.verdicts`, by `trigger`, `tau_s`, `refine`, `evaluator` and the column `colour`.
    band : DataFrame
        From `replay.expected_delay`: grey. Its mean is the grey line.
    colour : str
        Column of `points` that is told apart by colour. Markers tell the evaluators apart; open: not refined.
    letters : str
        Letters of the panels.

    Returns
    -------
    Figure
        Medians and quartiles of the films that did not fail; the strip on top counts those that did, in per cent.
    """
    figure, axes = panels(2, 10, 5.2, rows=2, height_ratios=[1, 3.4], sharex=True)
    colours = dict(zip(points[colour].drop_duplicates(), COLOURS, strict=False))
    markers = dict(zip(points["evaluator"].drop_duplicates(), MARKERS, strict=False))
    for k, (trigger, title) in enumerate(TRIGGER_TITLES.items()):
        strip, panel = axes[:, k]
        _band(panel, band)
        panel.sharey(axes[1, 0])
        for _, row in points[points["trigger"] == trigger].iterrows():
            c, m = colours[row[colour]], markers[row["evaluator"]]
            look = {"color": c, "marker": m, "mfc": c if row["refine"] else "white"}
            _point(panel, row["tau_s"], row, **look)
            strip.plot(row["tau_s"], 100 * row["failed"], ls="", ms=5, **look)
        strip.axvline(PAPER_S, color="0.4", lw=1, ls=":")
        strip.set(ylim=(-8, 108), yticks=(0, 50, 100), title=f"({letters[k]})  {title}")
        strip.grid(axis="y", color="0.9")
        panel.set(xlabel="measured evaluation time τ (s)")
    axes[0, 0].set_ylabel("failed (%)")
    axes[0, 1].annotate(" 1 s: the\n paper's laptop", (PAPER_S, 95), va="top", fontsize="small", color="0.3")
    handles = [Line2D([], [], color=c, lw=4, label=str(name)) for name, c in colours.items()]
    handles += [Line2D([], [], color="0.3", marker=m, ls="", label=name) for name, m in markers.items()]
    handles += [
        Line2D([], [], color="0.3", marker="o", ls="", label="refined"),
        Line2D([], [], color="0.3", marker="o", ls="", mfc="white", label="not refined"),
        Rectangle((0, 0), 1, 1, color=BAND, label="delay of a perfect monitor (line: mean)"),
    ]
    films = points.groupby("evaluator", sort=False)["films"].max()
    title = ", ".join(f"{name}: {number} films" for name, number in films.items())
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small", title=title)
    return figure


@styled
def fig5_settings(points: pd.DataFrame, labels: Mapping[tuple, str], counts: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw the error of both triggers for each setting, and the number of particles against time (Figure 5 c, f).

    Parameters
    ----------
    points : DataFrame
        From `figure5.verdicts`, indexed by setting, by `trigger` and `refine`.
    labels : dict of str
        What is written beside each setting, in order from top to bottom.
    counts : dict of DataFrame
        By name: `count` and `valid` against time in s (index); the one named 'true' has `count` alone.

    Returns
    -------
    Figure
        Medians and quartiles of the films that did not fail, and in words how many failed, with the 95 % interval.
    """
    figure, [axes] = panels(3, 11, 1.6 + 0.42 * len(labels), width_ratios=[1, 1, 0.9])
    for panel, (trigger, title) in zip(axes, TRIGGER_TITLES.items(), strict=False):
        here = points[points["trigger"] == trigger]
        for y, setting in enumerate(labels):
            for refine, up in ((True, -0.16), (False, 0.16)):
                row = here[(here.index == setting) & (here["refine"] == refine)].iloc[0]
                look = {"color": COLOURS[0 if refine else 1], "marker": "o" if refine else "s"}
                _point(panel, y + up, row, vertical=False, **look | {"mfc": look["color"] if refine else "white"})
                text = f"{row['failed']:.0%} ({row['failed_low']:.0%}–{row['failed_high']:.0%})"
                at = {"xycoords": ("axes fraction", "data"), "va": "center", "ha": "right", "fontsize": "x-small"}
                panel.annotate(text, (0.995, y + up), color=look["color"], **at)
        low, high = here["q25"].min(), here["q75"].max()
        panel.axvline(0, color="black", lw=0.8)
        panel.set(xlim=(low - 0.1, high + 0.6 * (high - low) + 0.2), ylim=(len(labels) - 0.5, -0.5))
        panel.set(xlabel="error (s)", title=f"{title}; right: failed", yticks=range(len(labels)))
        panel.set_yticklabels(labels.values() if trigger == "h" else [])
        panel.grid(axis="y", color="0.93")
    last = axes[2]
    for i, (name, table) in enumerate(counts.items()):
        colour = "black" if name == "true" else COLOURS[i]
        last.plot(table.index, table["count"], color=colour, lw=1, ls=":", label=name if name == "true" else None)
        if "valid" in table:
            last.plot(table.index, table["valid"], color=colour, lw=NESTED[i % 3], label=name)
    last.set(xlabel="t (s)", ylabel="particles", ylim=(0, None), title="Valid (line) and all detected (dots)")
    lines, words = last.get_legend_handles_labels()
    handles = [
        Line2D([], [], color=COLOURS[0], marker="o", label="refined"),
        Line2D([], [], color=COLOURS[1], marker="s", mfc="white", label="not refined"),
    ]
    names = [*(handle.get_label() for handle in handles), *words]
    figure.legend([*handles, *lines], names, loc="outside lower right", ncols=3, fontsize="small")
    return figure


@styled
def error_against_tau(points: pd.DataFrame, band: pd.DataFrame, by: str) -> Figure:
    """Plot the error against an imposed evaluation time, over what the clock alone would do.

    Parameters
    ----------
    points : DataFrame
        From `figure5.verdicts`, by `trigger`, `tau_s` and the column `by`.
    band : DataFrame
        From `replay.expected_delay`.
    by : str
        Column of what is compared.

    Returns
    -------
    Figure
        Medians of the replays that did not fail, with the quartiles of the first as a shade; above, how many failed.
    """
    figure, axes = panels(2, 10, 4.8, rows=2, height_ratios=[1.3, 3], sharex=True)
    for k, (trigger, title) in enumerate(TRIGGER_TITLES.items()):
        strip, panel = axes[:, k]
        _band(panel, band)
        panel.sharey(axes[1, 0])
        for i, (name, part) in enumerate(points[points["trigger"] == trigger].groupby(by, sort=False)):
            part = part.sort_values("tau_s")
            look = {"color": COLOURS[i], "lw": NESTED[i % 3], "marker": MARKERS[i], "ms": (8, 6, 3.5)[i % 3]}
            if i == 0:
                panel.fill_between(part["tau_s"], part["q25"], part["q75"], color=COLOURS[0], alpha=0.25, lw=0)
            panel.plot(part["tau_s"], part["median"], **look, label=name)
            strip.plot(part["tau_s"], 100 * part["failed"], **look)
        strip.axvline(PAPER_S, color="0.4", lw=1, ls=":")
        strip.set(ylim=(-8, 108), yticks=(0, 50, 100), title=title)
        strip.grid(axis="y", color="0.9")
        panel.set(
            xlabel="imposed evaluation time τ (s)", xlim=(0.9 * points["tau_s"].min(), 1.1 * points["tau_s"].max())
        )
    axes[0, 0].set_ylabel("failed (%)")
    axes[1, 0].legend(loc="upper left", fontsize="small")
    return figure


@styled
def three_answers(
    slower: pd.DataFrame,
    unrefined: pd.DataFrame,
    in_time: pd.DataFrame,
    level: float,
    tau_s: Mapping[str, float],
    findings: Sequence[str],
) -> Figure:
    """Draw what evaluation time buys, what refinement buys, and where the method fails, each in one panel.

    Parameters
    ----------
    slower : DataFrame
        From `figure5.verdicts`, by `trigger` and `tau_s`.
    unrefined : DataFrame
        For each `setting` and `trigger`: `mean`, `low` and `high` of the change in failed films without refinement.
    in_time : DataFrame
        Against time in s (index), means over films: `fraction_h`, `fraction_w`, `true_fraction_h`,
        `true_fraction_w`, and `valid`, the valid particles as a fraction of the true ones.
    level : float
        Fraction of the particles that triggers.
    tau_s : dict of float
        Evaluation times that are marked in the first panel, by what is written beside them.
    findings : sequence of str, 3
        The answers, written below the questions.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(3, 11, 3.9, width_ratios=[1.15, 1, 1.15])
    first, second, third = axes
    for k, (trigger, symbol) in enumerate(TRIGGERS.items()):
        colour = TRIGGER_COLOURS[trigger]
        rows = slower[slower["trigger"] == trigger].sort_values("tau_s")
        first.fill_between(
            rows["tau_s"],
            100 - 100 * rows["failed_high"],
            100 - 100 * rows["failed_low"],
            color=colour,
            alpha=0.18,
            lw=0,
        )
        first.plot(rows["tau_s"], 100 - 100 * rows["failed"], color=colour, marker=MARKERS[k], label=symbol)
        rows = unrefined[unrefined["trigger"] == trigger]
        y = range(len(rows))
        ends = 100 * (rows["mean"] - rows["low"]), 100 * (rows["high"] - rows["mean"])
        look = {"color": colour, "marker": MARKERS[k], "ls": "", "lw": 1.4}
        second.errorbar(100 * rows["mean"], [v + 0.3 * (k - 0.5) for v in y], xerr=ends, **look)
        second.set_yticks(y, labels=rows["setting"])
        third.plot(in_time.index, 100 * in_time[f"true_fraction_{trigger}"], color=colour, lw=1, ls="--")
        third.plot(in_time.index, 100 * in_time[f"fraction_{trigger}"], color=colour, lw=2)
    third.plot(in_time.index, 100 * in_time["valid"], color="0.5", lw=2)
    for name, tau in tau_s.items():
        first.axvline(tau, color="0.4", lw=1, ls=":")
        first.annotate(f"{name} ", (tau, 3), rotation=90, ha="right", va="bottom", fontsize="small", color="0.3")
    ticks = [t for t in (0.01, 0.03, 0.1, 0.3, 1, 3) if t > 0.8 * slower["tau_s"].min()]
    taus = slower["tau_s"]
    first.set(xlim=(0.8 * taus.min(), 1.25 * taus.max()))
    first.set(xscale="log", ylim=(0, 104), xlabel="evaluation time τ (s)", ylabel="films whose trigger is right (%)")
    first.set_xticks(ticks, labels=[f"{t:g}" for t in ticks])
    first.legend(loc="lower left")
    first.minorticks_off()
    second.axvline(0, color="black", lw=0.8)
    second.invert_yaxis()
    second.grid(axis="x", color="0.93")
    second.set(xlabel="more films fail without it (percentage points)")
    third.axhline(100 * level, color="black", lw=0.8, ls=":")
    third.set(xlabel="t (s)", ylabel="particles (%)", ylim=(0, 104))
    questions = ("What does evaluation time buy?", "What does refinement buy?", "Where does it fail?")
    for panel, question, finding in zip(axes, questions, findings, strict=True):
        panel.set_title(f"{question}\n{finding}")
    handles = [
        *(Line2D([], [], color=TRIGGER_COLOURS[a], lw=2, label=f"measured in {a}/3") for a in TRIGGERS),
        Line2D([], [], color="0.3", lw=1, ls="--", label="true"),
        Line2D([], [], color="0.5", lw=2, label="valid / true"),
    ]
    figure.legend(handles=handles, loc="outside lower right", ncols=4, fontsize="small")
    return figure
