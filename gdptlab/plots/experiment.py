"""Pictures of the paper's experiment: Figures 4 and 5, and what leads there.

As in `figures`: each takes data and returns a matplotlib Figure. Bands and lines of the middle third of the
height are blue, of the width orange, in every picture.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from numpy.typing import ArrayLike, NDArray

from gdptlab.experiment.channel import Channel, Focusing, Trajectories
from gdptlab.experiment.film import Film
from gdptlab.plots.style import COLOURS, DEPTH, MARKERS, bare, grey, is_dark, panels, scale_bar, styled

TRIGGERS = {"h": "$t_{h/3}$", "w": "$t_{w/3}$"}
"""Symbols of the two triggers."""

TRIGGER_COLOURS = {"h": COLOURS[0], "w": COLOURS[1]}
_BAND = "0.85"  # of what is expected
LINES = ("-", (0, (4, 2)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))


def limit_to_channel(axes: Axes, channel: Channel) -> None:
    """Draw the channel's cross-section, seen along the flow, with the middle thirds."""
    w, h = channel.width_um, channel.height_um
    axes.add_patch(Rectangle((-w / 2, -h / 6), w, h / 3, color=TRIGGER_COLOURS["h"], alpha=0.14, lw=0))
    axes.add_patch(Rectangle((-w / 6, -h / 2), w / 3, h, color=TRIGGER_COLOURS["w"], alpha=0.14, lw=0))
    axes.add_patch(Rectangle((-w / 2, -h / 2), w, h, fill=False, lw=1.4))
    axes.set(xlim=(-0.52 * w, 0.52 * w), ylim=(-0.54 * h, 0.54 * h), aspect="equal")
    axes.spines[:].set_visible(False)


def _schematic(axes: Axes, focusing: Focusing) -> None:
    channel = focusing.channel
    w, h = channel.width_um, channel.height_um
    limit_to_channel(axes, channel)
    s = np.linspace(-0.5, 0.5, 101)
    swing = np.sin(np.pi * s)  # pressure of a half wave: largest at the walls, none in the middle
    for sign in (-1, 1):
        axes.plot(w * s, sign * 0.14 * h * swing, color=TRIGGER_COLOURS["w"], lw=1.2, ls=(0, (4, 2)))
        axes.plot(sign * 0.14 * h * swing, h * s, color=TRIGGER_COLOURS["h"], lw=1.2, ls=(0, (4, 2)))
    for y, z in ((-78, 33), (-58, -30), (70, 27), (82, -35), (-88, 8), (52, -38), (-47, 40)):
        y, z = y * w / 200, z * h / 100
        arrow = FancyArrowPatch(
            (y, z), (0.68 * y, 0.55 * z), arrowstyle="-|>", mutation_scale=9, lw=1, color="0.35", shrinkA=3, shrinkB=0
        )
        axes.add_patch(arrow)
        axes.add_patch(Circle((y, z), max(2.2 * focusing.suspension.radius_um / 2.5, 0.02 * h), color="black"))
    axes.add_patch(Circle((0, 0), 0.035 * h, fill=False, lw=1.2))
    axes.plot(0, 0, "k.", ms=3)
    axes.annotate("flow", (0.03 * w, 0.04 * h), fontsize="small")
    # The microscope below: cone of light, objective, cylindrical lens, camera.
    low = -h / 2
    axes.add_patch(Polygon([(0, 0), (-0.16 * w, low - 0.32 * h), (0.16 * w, low - 0.32 * h)], color="0.5", alpha=0.2))
    axes.add_patch(
        Polygon(
            [
                (-0.16 * w, low - 0.32 * h),
                (0.16 * w, low - 0.32 * h),
                (0.12 * w, low - 0.55 * h),
                (-0.12 * w, low - 0.55 * h),
            ],
            fc="0.75",
            ec="black",
        )
    )
    axes.add_patch(Rectangle((-0.12 * w, low - 0.68 * h), 0.24 * w, 0.06 * h, fc="#56B4E9", ec="black"))
    axes.add_patch(Rectangle((-0.15 * w, low - 0.98 * h), 0.3 * w, 0.2 * h, fc="0.3", ec="black"))
    for text, z in (("objective", -0.45), ("cylindrical lens", -0.66), ("camera", -0.9)):
        axes.annotate(text, (0.19 * w, low + z * h), fontsize="small")
    line = {"arrowstyle": "<->", "lw": 1}
    axes.annotate("", (-w / 2, 0.6 * h), (w / 2, 0.6 * h), arrowprops=line)
    axes.annotate(f"w = {w:g} µm", (0, 0.64 * h), ha="center")
    axes.annotate("", (-0.55 * w, -h / 2), (-0.55 * w, h / 2), arrowprops=line)
    axes.annotate(f"h = {h:g} µm", (-0.6 * w, 0), rotation=90, va="center", ha="center")
    axes.annotate("h/3", (0.51 * w, 0), color=TRIGGER_COLOURS["h"], va="center", weight="bold")
    axes.annotate("w/3", (-0.145 * w, -0.47 * h), color=TRIGGER_COLOURS["w"], weight="bold")
    corner = (-0.47 * w, low - 0.85 * h)
    for text, tip in (("y", (-0.32 * w, corner[1])), ("z", (corner[0], low - 0.55 * h))):
        axes.annotate("", tip, corner, arrowprops={"arrowstyle": "->", "shrinkA": 0, "shrinkB": 0})
        axes.annotate(text, tip, (4, 2), textcoords="offset points")
    axes.set(xlim=(-0.66 * w, 0.66 * w), ylim=(low - 1.02 * h, 0.8 * h), xticks=[], yticks=[])


@styled
def fig4_acoustophoresis(trajectories: Trajectories, times_s: Sequence[float]) -> Figure:
    """Draw the paper's Figure 4: the device (a), trajectories (b), cross-sections of the field of view (c).

    Parameters
    ----------
    trajectories : Trajectories
    times_s : sequence of float
        Instants of (c).

    Returns
    -------
    Figure
    """
    focusing = trajectories.focusing
    channel = focusing.channel
    figure = plt.figure(figsize=(10, 6.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[4.6, 2])
    left, right = upper.subfigures(1, 2, width_ratios=[1, 1.25])
    left.suptitle("(a)  The device, seen along the flow", x=0.02, ha="left", weight="bold", fontsize=11)
    _schematic(left.subplots(), focusing)
    duration = trajectories.duration_s
    right.suptitle(f"(b)  Paths over {duration:g} s", x=0.02, ha="left", weight="bold", fontsize=11)
    axes = right.add_subplot(projection="3d", computed_zorder=False)
    paths = trajectories.table(np.linspace(0, duration, 81))
    for _, path in paths.groupby("particle"):
        axes.plot(path["x_um"], path["y_um"], path["z_um"], color="0.6", lw=0.7)
    for t, colour, label in ((0.0, COLOURS[0], "at 0 s"), (duration, COLOURS[1], f"at {duration:g} s")):
        here = trajectories.positions(t)
        axes.scatter(here["x_um"], here["y_um"], here["z_um"], color=colour, s=16, depthshade=False, label=label)
    w, h, length = channel.width_um, channel.height_um, trajectories.view_length_um
    for x in (0, length):
        corners = np.array([(-w, -h), (w, -h), (w, h), (-w, h), (-w, -h)]) / 2
        axes.plot(np.full(5, x), *corners.T, color="black", lw=0.8)
    for y, z in ((-w, -h), (w, -h), (w, h), (-w, h)):
        axes.plot([0, length], [y / 2, y / 2], [z / 2, z / 2], color="black", lw=0.8)
    axes.set_xlabel("x (µm), downstream", labelpad=14)
    axes.set(ylabel="y (µm)", zlabel="z (µm)", xlim=(0, length), zticks=(-h / 2, 0, h / 2))
    axes.set(yticks=(-w / 2, 0, w / 2), ylim=(-w / 2, w / 2), zlim=(-h / 2, h / 2))
    axes.set_box_aspect((length, w, h), zoom=0.9)
    axes.view_init(elev=22, azim=-58)
    axes.legend(loc="upper right")
    lower.suptitle("(c)  Cross-sections of the field of view", x=0.01, ha="left", weight="bold", fontsize=11)
    panels = lower.subplots(1, len(times_s), sharey=True, squeeze=False)[0]
    for panel, t in zip(panels, times_s, strict=True):
        here = trajectories.positions(t)
        limit_to_channel(panel, channel)
        panel.plot(here["y_um"], here["z_um"], "o", color="black", ms=2.5)
        inside = {"h": np.abs(here["z_um"]) <= h / 6, "w": np.abs(here["y_um"]) <= w / 6}
        panel.set_title(f"t = {t:g} s", loc="center")
        fractions = ",  ".join(f"{fraction.mean():.0%} in {a}/3" for a, fraction in inside.items())
        panel.set(xlabel=f"y (µm)\n{fractions}", xticks=(-w / 2, 0, w / 2), yticks=(-h / 2, 0, h / 2))
        panel.xaxis.label.set_size("small")
    panels[0].set_ylabel("z (µm)")
    return figure


@styled
def forces_and_flow(focusing: Focusing) -> Figure:
    """Plot what moves a particle: the radiation velocity along y and z, and the flow over the cross-section.

    Parameters
    ----------
    focusing : Focusing

    Returns
    -------
    Figure
    """
    channel = focusing.channel
    figure, [axes] = panels(3, 10, 2.9, width_ratios=[1, 1, 1.5])
    for panel, axis, name, colour in zip(axes, "yz", "wh", (TRIGGER_COLOURS["w"], TRIGGER_COLOURS["h"]), strict=False):
        half = focusing.extent_um(axis) / 2
        s = np.linspace(-half, half, 201)
        panel.axvspan(-half / 3, half / 3, color=colour, alpha=0.14, lw=0)
        panel.axhline(0, color="black", lw=0.8)
        panel.plot(s, focusing.radiation_velocity(axis, s), color=colour)
        panel.set(xlabel=f"{axis} (µm)", ylabel=f"$u_{axis}$ (µm/s)", title=f"Sound along {axis} (shaded: {name}/3)")
    y = np.linspace(-channel.width_um / 2, channel.width_um / 2, 121)
    z = np.linspace(-channel.height_um / 2, channel.height_um / 2, 61)
    shown = axes[2].contourf(y, z, channel.velocity(y, z[:, None]), levels=12, cmap="cividis")
    axes[2].set(xlabel="y (µm)", ylabel="z (µm)", aspect="equal", title="Flow along x")
    figure.colorbar(shown, ax=axes[2], label="u (µm/s)", shrink=0.8)
    return figure


@styled
def focusing_in_time(
    t_s: ArrayLike,
    expected: Mapping[str, ArrayLike],
    counted: pd.DataFrame,
    triggers_s: Mapping[str, float],
    level: float,
) -> Figure:
    """Plot the fraction of particles in the middle thirds against time, and where it passes the level.

    Parameters
    ----------
    t_s : array (n,)
    expected : {'h': array (n,), 'w': array (n,)}
        Fraction of infinitely many particles.
    counted : DataFrame
        Of a finite population: `t_s`, `fraction_h`, `fraction_w`.
    triggers_s : {'h': float, 'w': float}
        Trigger times of the infinite population.
    level : float
        Fraction that triggers.

    Returns
    -------
    Figure
    """
    figure, [[axes]] = panels(1, 7, 3.2)
    axes.axhline(level, color="black", lw=0.8, ls=":")
    for a, colour in TRIGGER_COLOURS.items():
        axes.plot(t_s, expected[a], color=colour, label=f"in {a}/3, closed form")
        axes.plot(counted["t_s"], counted[f"fraction_{a}"], "o", color=colour, mfc="none", label=f"in {a}/3, counted")
        axes.plot(triggers_s[a], level, "v", color="black", ms=7)
        axes.annotate(
            f"{TRIGGERS[a]} = {triggers_s[a]:.2f} s", (triggers_s[a], level), (4, -16), textcoords="offset points"
        )
    axes.set(xlabel="t (s)", ylabel="fraction of particles", ylim=(0.2, 1.03))
    axes.legend(loc="lower right")
    return figure


@styled
def instants(images: Mapping[str, NDArray], um_per_px: float) -> Figure:
    """Show frames of a film side by side.

    Parameters
    ----------
    images : dict of arrays (rows, columns)
        By what is written above.
    um_per_px : float

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(len(images), 10, 10 / len(images) + 0.4)
    for panel, (name, image) in zip(axes, images.items(), strict=True):
        panel.imshow(image, **grey(image, 1))
        bare(panel)
        panel.set_title(name)
    scale_bar(axes[0], um_per_px, 50)
    return figure


def _monitor(axes: Axes, monitor: pd.DataFrame, marks: bool = True) -> None:
    level = monitor["level"].iloc[0]
    axes.axhline(level, color="black", lw=0.8, ls=":")
    for a, colour in TRIGGER_COLOURS.items():
        axes.plot(monitor["t_s"], monitor[f"true_fraction_{a}"], color=colour, lw=1, ls=LINES[1], label=f"{a}/3, true")
        axes.plot(monitor["t_s"], monitor[f"fraction_{a}"], color=colour, label=f"{a}/3, measured")
        fired = monitor[monitor[f"fraction_{a}"] >= level]
        if marks and len(fired):
            axes.plot(fired["t_s"].iloc[0], fired[f"fraction_{a}"].iloc[0], "v", color=colour, mec="black", ms=8)
    axes.set(xlabel="t (s)", ylabel="fraction of particles", ylim=(0.1, 1.05))


@styled
def monitor_in_time(monitor: pd.DataFrame) -> Figure:
    """Plot what the monitor sees of one film: the two fractions with their level, and how many particles.

    Parameters
    ----------
    monitor : DataFrame
        Rows of one film and one method from `replay.sweep`.

    Returns
    -------
    Figure
        A triangle is where a measured fraction first reaches the level.
    """
    figure, [axes] = panels(2, 10, 3.4, width_ratios=[1.6, 1])
    _monitor(axes[0], monitor)
    axes[0].legend(loc="lower right", ncols=2)
    axes[0].set_title("In the middle thirds (triangle: first at the level)")
    axes[1].plot(monitor["t_s"], monitor["true_count"], color="black", lw=1, ls=LINES[1], label="true")
    axes[1].plot(monitor["t_s"], monitor["count"], color=COLOURS[2], label="measured")
    axes[1].set(xlabel="t (s)", ylabel="particles", ylim=(0, None), title="Particles in the frame")
    axes[1].legend(loc="lower left")
    return figure


def _failed(axes: Axes, films: int) -> None:
    axes.set(ylim=(-0.08 * films, 1.12 * films), yticks=(0, films), ylabel="failed\nfilms")
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.tick_params(labelbottom=False)


def _style_of(table: pd.DataFrame, column: str, styles: Sequence[Any]) -> dict[Any, Any]:
    return dict(zip(table[column].drop_duplicates(), styles, strict=False))


@styled
def fig5(
    points: pd.DataFrame,
    band: pd.DataFrame,
    counts: Mapping[str, pd.Series],
    *,
    colour: str,
    marker: str = "n_sub",
    letters: str = "abc",
    names: Mapping[str, str] | None = None,
) -> Figure:
    """Draw the paper's Figure 5: trigger errors against evaluation time, and particles against time.

    Parameters
    ----------
    points : DataFrame
        From `replay.summary`, by `trigger`, `tau_s`, `refine` and the columns of `colour` and `marker`. Medians
        are drawn with the quartiles; films that failed have a scale of their own on top, with crosses.
    band : DataFrame
        From `replay.expected_delay`, over the times on the x axis.
    counts : dict of Series
        Particles against time in s (index), by name; one that is named 'true' is dashed.
    colour, marker : str
        Columns of `points` told apart by colour and by marker. Filled: refined; open: not.
    letters : str
        Of the panels.
    names : dict of str, optional
        How `colour` and `marker` are called in the legend.

    Returns
    -------
    Figure
    """
    names = {"n": "N", "n_sub": "$N_{sub}$", "image_type": ""} | dict(names or {})
    colours, markers = _style_of(points, colour, COLOURS), _style_of(points, marker, MARKERS)
    figure, axes = panels(3, 11, 4.6, rows=2, height_ratios=[1, 4.2], width_ratios=[1, 1, 0.8])
    films = int(points["films"].max())
    ends = 1e3 * np.array([points["tau_s"].min() / 1.06, points["tau_s"].max() * 1.06])
    low = min(points["error_s_q25"].min(), -0.1)
    for k, (trigger, symbol) in enumerate(TRIGGERS.items()):
        strip, panel = axes[:, k]
        panel.fill_between(1e3 * band["tau_s"], band["low_s"], band["high_s"], color=_BAND, lw=0)
        panel.axhline(0, color="black", lw=0.8)
        for row in points[points["trigger"] == trigger].to_dict("records"):
            c, m, x = colours[row[colour]], markers[row[marker]], 1e3 * row["tau_s"]
            fill = c if row["refine"] else "white"
            if np.isfinite(row["error_s_median"]):
                middle = row["error_s_median"]
                reach = [[middle - row["error_s_q25"]], [row["error_s_q75"] - middle]]
                panel.errorbar(x, middle, yerr=reach, color=c, marker=m, mfc=fill, ms=6, lw=1, capsize=0)
            failed = films * row["failed"] / max(row["replays"], 1)
            if failed:
                strip.plot(x, failed, marker="x", color=c, ms=6, mew=1.6, clip_on=False)
        _failed(strip, films)
        strip.set(xlim=ends, title=f"({letters[k]})  {symbol}", xticks=panel.get_xticks())
        strip.set_xlim(ends)
        panel.set(xlim=ends, xlabel="evaluation time τ (ms)", ylabel="error (s)")
        panel.set_ylim(1.1 * low, None)
    axes[0, 2].set_visible(False)
    last = axes[1, 2]
    _counts(last, counts)
    last.set_title(f"({letters[2]})  Valid particles")
    handles = [Line2D([], [], color=c, lw=4, label=f"{names[colour]} {v}".strip()) for v, c in colours.items()]
    handles += [Line2D([], [], color="0.3", marker=m, ls="", label=f"{names[marker]} {v}") for v, m in markers.items()]
    handles += [
        Line2D([], [], color="0.3", marker="o", ls="", label="refined"),
        Line2D([], [], color="0.3", marker="o", ls="", mfc="white", label="not refined"),
        Line2D([], [], color="0.3", marker="x", ls="", mew=1.6, label=f"failed, of {films}"),
        Rectangle((0, 0), 1, 1, color=_BAND, label="expected delay"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize="small")
    return figure


def _counts(axes: Axes, counts: Mapping[str, pd.Series]) -> None:
    lines = iter(zip(COLOURS, LINES * 2, strict=False))
    for name, series in counts.items():
        colour, style = ("black", ":") if name == "true" else next(lines)
        axes.plot(series.index, series, color=colour, ls=style, label=name)
    axes.set(xlabel="t (s)", ylabel="particles", ylim=(0, None))
    axes.legend(fontsize="small", loc="lower left")


@styled
def error_against_tau(points: pd.DataFrame, band: pd.DataFrame, *, by: str, tau_here_s: float | None = None) -> Figure:
    """Plot the trigger error against an imposed evaluation time, over what the clock alone would do.

    Parameters
    ----------
    points : DataFrame
        From `replay.summary`, by `trigger`, `tau_s` and the column `by`: medians are lines, the quartiles of the
        first are a shade; on top, how many films failed.
    band : DataFrame
        From `replay.expected_delay`.
    by : str
        Column of what is compared.
    tau_here_s : float, optional
        Evaluation time on this machine, marked by a tick at the left end if it is below the scale.

    Returns
    -------
    Figure
    """
    figure, axes = panels(2, 10, 4.4, rows=2, height_ratios=[1, 4.2], sharex="col")
    films = int(points["films"].max())
    for k, (trigger, symbol) in enumerate(TRIGGERS.items()):
        strip, panel = axes[:, k]
        panel.fill_between(band["tau_s"], band["low_s"], band["high_s"], color=_BAND, lw=0, label="expected: range")
        panel.plot(band["tau_s"], band["mean_s"], color="0.55", lw=3, label="expected: mean")
        panel.axhline(0, color="black", lw=0.8)
        for i, (name, part) in enumerate(points[points["trigger"] == trigger].groupby(by, sort=False)):
            part = part.sort_values("tau_s")
            look = {"color": COLOURS[i], "ls": LINES[i % 4], "marker": MARKERS[i], "ms": 4}
            if i == 0:
                panel.fill_between(
                    part["tau_s"], part["error_s_q25"], part["error_s_q75"], color=COLOURS[0], alpha=0.25, lw=0
                )
            panel.plot(part["tau_s"], part["error_s_median"], **look, label=name)
            strip.plot(part["tau_s"], films * part["failed"] / part["replays"], **look)
        _failed(strip, films)
        strip.set_title(symbol)
        panel.set(xscale="log", xlabel="imposed evaluation time τ (s)", ylabel="error (s)")
        ticks = (0.04, 0.1, 0.2, 0.5, 1, 2, 5)
        panel.set_xticks(ticks, labels=[f"{t:g}" for t in ticks])
        panel.minorticks_off()
        if tau_here_s is not None:
            panel.annotate(
                f"here: {1e3 * tau_here_s:.0f} ms",
                (0.01, 0.3),
                (0.09, 0.3),
                xycoords="axes fraction",
                va="center",
                arrowprops={"arrowstyle": "->"},
            )
    axes[1, 0].legend(loc="upper left", fontsize="small")
    return figure


@styled
def templates_and_densities(points: pd.DataFrame, found: pd.DataFrame) -> Figure:
    """Plot trigger errors, and the fraction of particles found in time, for sizes of templates and densities.

    Parameters
    ----------
    points : DataFrame
        From `replay.summary`, by `trigger`, `density` and `size`.
    found : DataFrame
        `density`, `size`, `t_s` and `fraction`, of measured to true particles.

    Returns
    -------
    Figure
        A row for each trigger with a column for each density: median and quartiles, and as crosses the films
        that failed; the last row is the fraction found.
    """
    densities, sizes = points["density"].unique(), points["size"].unique()
    figure, axes = panels(len(densities), 10, 6.6, rows=3, sharey="row")
    low, high = points["own_error_s_q25"].min(), points["own_error_s_q75"].max()
    top = high + 0.14 * (high - low)
    for column, density in zip(axes.T, densities, strict=True):
        for panel, trigger in zip(column, TRIGGERS, strict=False):
            panel.axhline(0, color="black", lw=0.8)
            here = points[(points["density"] == density) & (points["trigger"] == trigger)]
            for i, row in enumerate(here.to_dict("records")):
                middle = row["own_error_s_median"]
                reach = [[middle - row["own_error_s_q25"]], [row["own_error_s_q75"] - middle]]
                look = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 6, "capsize": 3}
                panel.errorbar(i, middle, yerr=reach, **look)
                failed = round(row["films"] * row["failed"] / max(row["replays"], 1))
                mark = "× " if failed else ""
                panel.annotate(f"{mark}{failed}/{row['films']}", (i, top), color=COLOURS[i], ha="center", va="center")
            panel.set(
                xticks=range(len(sizes)), xlim=(-0.5, len(sizes) - 0.5), ylim=(low - 0.1, top + 0.1 * (high - low))
            )
            panel.set_xticklabels([f"{s} px" for s in sizes])
        for i, (size, part) in enumerate(found[found["density"] == density].groupby("size", sort=False)):
            column[2].plot(part["t_s"], part["fraction"], color=COLOURS[i], ls=LINES[i], label=f"{size} px")
        column[2].set(xlabel="t (s)", ylim=(0, 1.02))
        column[0].set_title(f"{density:g} particles in view")
    axes[0, 0].set_ylabel(f"error of {TRIGGERS['h']} (s)\n(on top: failed)")
    axes[1, 0].set_ylabel(f"error of {TRIGGERS['w']} (s)\n(on top: failed)")
    axes[2, 0].set_ylabel("measured / true count")
    axes[2, 0].legend(loc="lower left", fontsize="small")
    return figure


@styled
def replay_view(film: Film, measured: pd.DataFrame, monitor: pd.DataFrame, frame: int) -> Figure:
    """Show one moment of the replay: the frame, the cross-section, and the two fractions up to then.

    Parameters
    ----------
    film : Film
    measured : DataFrame
        Of this film, from `replay.evaluate`.
    monitor : DataFrame
        Of this film and method, from `replay.sweep`.
    frame : int

    Returns
    -------
    Figure
    """
    channel = film.trajectories.focusing.channel
    image, here = film[frame], film.to_channel(measured[measured["frame"] == frame])
    true = film.trajectories.positions(frame / film.frame_rate_hz)
    half = channel.height_um / 2
    figure, axes = plt.subplot_mosaic(
        [["frame", "section"], ["frame", "fractions"]], figsize=(10, 5), layout="constrained", width_ratios=[1, 1.05]
    )
    axes["frame"].imshow(image, **grey(image))
    circles = axes["frame"].scatter(here["x_px"], here["y_px"], s=160, lw=1.8, cmap=DEPTH, c=here["z_um"])
    circles.set(facecolor="none", clim=(-half, half))
    circles.set_edgecolor(circles.to_rgba(here["z_um"]))
    contrast = "white" if is_dark(axes["frame"]) else "black"
    axes["frame"].set(xlabel="x (px)", ylabel="y (px)", title=f"t = {frame / film.frame_rate_hz:.2f} s")
    scale_bar(axes["frame"], film.microscope.um_per_px, 50)
    axes["frame"].texts[-1].set_color(contrast)
    section = axes["section"]
    limit_to_channel(section, channel)
    section.plot(true["y_um"], true["z_um"], "x", color="0.35", ms=5, label="true")
    section.scatter(
        here["y_um"], here["z_um"], c=here["z_um"], cmap=DEPTH, vmin=-half, vmax=half, s=26, label="measured"
    )
    figure.colorbar(circles, ax=section, label="z (µm)")
    section.set(xlabel="y (µm)", ylabel="z (µm)", title=f"{len(here)} measured (dots) of {len(true)} (crosses)")
    _monitor(axes["fractions"], monitor[monitor["frame"] <= frame])
    axes["fractions"].set_xlim(0, monitor["t_s"].max())
    axes["fractions"].legend(loc="lower right", fontsize="small", ncols=2)
    return figure


def scrub(film: Film, measured: pd.DataFrame, monitor: pd.DataFrame) -> Any:
    """Slide through a replay by hand: `replay_view` with a slider (needs ipywidgets).

    Parameters
    ----------
    film, measured, monitor
        As in `replay_view`.

    Returns
    -------
    ipywidgets.VBox

    Raises
    ------
    ImportError
        If ipywidgets is not installed.
    """
    try:
        import ipywidgets
    except ImportError as error:
        raise ImportError("the slider needs ipywidgets: pip install 'gdptlab[widgets]', or ipywidgets") from error
    from IPython.display import display

    frames = monitor["frame"].tolist()
    options = [(f"{frame / film.frame_rate_hz:.2f} s", frame) for frame in frames]
    slider = ipywidgets.SelectionSlider(options=options, description="t", continuous_update=False)

    def show(frame: int) -> None:
        display(replay_view(film, measured, monitor, frame))

    return ipywidgets.VBox([slider, ipywidgets.interactive_output(show, {"frame": slider})])
