"""Pictures of the paper's experiment: the channel, the film, and the monitor that watches it.

Bands and lines of the middle third of the height are blue, of the width orange, in every picture.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from gdptlab.experiment.channel import IN_CHANNEL, Channel, Trajectories
from gdptlab.experiment.film import Film
from gdptlab.plots.style import COLOURS, DEPTH, GREY, STYLE, bare, scale_bar, stretched, styled

TRIGGERS = {"h": "$t_{h/3}$", "w": "$t_{w/3}$"}
"""Symbols of the two triggers."""

TRIGGER_TITLES = {"h": "Height: $t_{h/3}$", "w": "Width: $t_{w/3}$"}
"""The same with a word that is legible in a small title."""

TRIGGER_COLOURS = {"h": COLOURS[0], "w": COLOURS[1]}
"""Colours of the two triggers."""

LINES = ("-", (0, (4, 2)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))
"""Styles of lines, in the order of `COLOURS`."""

TIME = "plasma"
"""Scale of colours of time."""


def limit_to_channel(axes: Axes, channel: Channel) -> None:
    """Draw the channel's cross-section, seen along the flow, with the middle thirds."""
    w, h = channel.width_um, channel.height_um
    axes.add_patch(Rectangle((-w / 2, -h / 6), w, h / 3, color=TRIGGER_COLOURS["h"], alpha=0.14, lw=0))
    axes.add_patch(Rectangle((-w / 6, -h / 2), w / 3, h, color=TRIGGER_COLOURS["w"], alpha=0.14, lw=0))
    axes.add_patch(Rectangle((-w / 2, -h / 2), w, h, fill=False, lw=1.4))
    axes.set(xlim=(-0.52 * w, 0.52 * w), ylim=(-0.54 * h, 0.54 * h), aspect="equal")
    axes.spines[:].set_visible(False)


def _device(axes: Axes, channel: Channel) -> None:
    """Draw the channel seen along the flow: the two standing waves, some particles, and the objective below."""
    w, h = channel.width_um, channel.height_um
    limit_to_channel(axes, channel)
    s = np.linspace(-0.5, 0.5, 101)
    pressure = 0.12 * h * np.sin(np.pi * s)  # of a half wave: largest at the walls, none in the middle
    for sign in (-1, 1):
        axes.plot(w * s, sign * pressure, color=TRIGGER_COLOURS["w"], lw=1.2, ls=(0, (4, 2)))
        axes.plot(sign * pressure, h * s, color=TRIGGER_COLOURS["h"], lw=1.2, ls=(0, (4, 2)))
    for y, z in np.array([(-0.38, 0.34), (0.4, 0.3), (0.36, -0.35), (-0.33, -0.3)]) * (w, h):
        arrow = {"arrowstyle": "-|>", "color": "0.3", "shrinkA": 4, "shrinkB": 0}
        axes.annotate("", (0.6 * y, 0.5 * z), (y, z), arrowprops=arrow)
        axes.add_patch(Circle((y, z), 0.03 * h, color="black"))
    low = -h / 2
    cone = [(0, 0), (-0.15 * w, low - 0.4 * h), (0.15 * w, low - 0.4 * h)]
    axes.add_patch(Polygon(cone, color="0.5", alpha=0.2))
    axes.add_patch(Rectangle((-0.15 * w, low - 0.65 * h), 0.3 * w, 0.25 * h, fc="0.75", ec="black"))
    axes.annotate("objective, cylindrical\nlens and camera", (0.19 * w, low - 0.6 * h), fontsize="small")
    both = {"arrowstyle": "<->", "lw": 1}
    axes.annotate("", (-w / 2, 0.6 * h), (w / 2, 0.6 * h), arrowprops=both)
    axes.annotate(f"w = {w:g} µm", (0, 0.65 * h), ha="center")
    axes.annotate("", (-0.56 * w, -h / 2), (-0.56 * w, h / 2), arrowprops=both)
    axes.annotate(f"h = {h:g} µm", (-0.63 * w, 0), rotation=90, va="center", ha="center")
    axes.annotate("h/3", (0.52 * w, 0), color=TRIGGER_COLOURS["h"], va="center", weight="bold")
    axes.annotate("w/3", (0, -0.47 * h), color=TRIGGER_COLOURS["w"], weight="bold", ha="center")
    axes.set(xlim=(-0.7 * w, 0.66 * w), ylim=(low - 0.7 * h, 0.85 * h), xticks=[], yticks=[])


def draw_paths(figure: Figure, paths: Trajectories) -> None:
    """Draw the particles' paths through the field of view, coloured by time."""
    channel, duration = paths.focusing.channel, paths.duration_s
    w, h, length = channel.width_um, channel.height_um, paths.view_length_um
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    times = np.linspace(0, duration, 61)
    table = paths.table(times, border_um=np.inf)
    points = table[list(IN_CHANNEL.values())].to_numpy().reshape(len(times), -1, 3)
    parts = np.stack([points[:-1], points[1:]], axis=2)  # (times - 1, particles, 2 ends, 3)
    seen = ((parts[..., 0] >= 0) & (parts[..., 0] <= length)).all(axis=-1)
    when = np.broadcast_to(times[:-1, None], seen.shape)[seen]
    norm = PowerNorm(0.5, 0, duration)  # most of it happens early
    lines = Line3DCollection(parts[seen], cmap=TIME, norm=norm, lw=0.9, array=when)
    axes.add_collection3d(lines)
    ends = np.array([(-w, -h), (w, -h), (w, h), (-w, h), (-w, -h)]) / 2
    for x in (0, length):
        axes.plot(np.full(5, x), *ends.T, color="black", lw=0.8)
    for y, z in ends[:-1]:
        axes.plot([0, length], [y, y], [z, z], color="black", lw=0.8)
    axes.set_xlabel("x (µm), downstream", labelpad=14)
    axes.set(ylabel="y (µm)", zlabel="z (µm)", xlim=(0, length), zticks=(-h / 2, 0, h / 2))
    axes.set(yticks=(-w / 2, 0, w / 2), ylim=(-w / 2, w / 2), zlim=(-h / 2, h / 2))
    axes.set_box_aspect((length, w, h), zoom=0.9)
    axes.view_init(elev=22, azim=-58)
    figure.colorbar(lines, ax=axes, label="t (s)", shrink=0.6, pad=0.1)


@styled
def fig4_acoustophoresis(paths: Trajectories, seen: Trajectories, times_s: Mapping[str, float]) -> Figure:
    """Draw the paper's Figure 4: the device (a), paths (b), cross-sections of the field of view (c).

    Parameters
    ----------
    paths : Trajectories
        Drawn in (b), coloured by time.
    seen : Trajectories
        Drawn in (c).
    times_s : dict of float
        Instants of (c), by what is written above them besides the time.

    Returns
    -------
    Figure
    """
    channel = seen.focusing.channel
    w, h = channel.width_um, channel.height_um
    figure = plt.figure(figsize=(10, 6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[3.9, 2])
    left, right = upper.subfigures(1, 2, width_ratios=[1, 1.3])
    number = len(paths.start)
    for part, title in (
        (left, "(a)  The device, seen along the flow"),
        (right, f"(b)  {number} paths over {paths.duration_s:g} s"),
        (lower, "(c)  Cross-sections of the field of view"),
    ):
        part.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=11)
    _device(left.subplots(), channel)
    draw_paths(right, paths)
    panels = lower.subplots(1, len(times_s), sharey=True, squeeze=False)[0]
    for panel, (name, t) in zip(panels, times_s.items(), strict=True):
        here = seen.positions(t)
        limit_to_channel(panel, channel)
        panel.plot(here["y_channel_um"], here["z_um"], "o", color="black", ms=2.5)
        inside = {"h": np.abs(here["z_um"]) <= h / 6, "w": np.abs(here["y_channel_um"]) <= w / 6}
        panel.set_title(f"{name}: {t:.2g} s", loc="center")
        fractions = ",  ".join(f"{fraction.mean():.0%} in {a}/3" for a, fraction in inside.items())
        panel.set(xlabel=f"y (µm)\n{fractions}", xticks=(-w / 2, 0, w / 2), yticks=(-h / 2, 0, h / 2))
        panel.xaxis.label.set_size("small")
    panels[0].set_ylabel("z (µm)")
    return figure


def draw_monitor(axes: Axes, monitor: pd.DataFrame) -> None:
    """Draw the measured and the true fractions of a film against time, with a triangle where each trigger fires."""
    level = monitor["level"].iloc[0]
    axes.axhline(level, color="black", lw=0.8, ls=":")
    for a, colour in TRIGGER_COLOURS.items():
        axes.plot(monitor["t_s"], monitor[f"true_fraction_{a}"], color=colour, lw=1, ls=LINES[1], label=f"{a}/3, true")
        axes.plot(monitor["t_s"], monitor[f"fraction_{a}"], color=colour, label=f"{a}/3, measured")
        fired = monitor[monitor[f"fraction_{a}"] >= level]
        if len(fired):
            axes.plot(fired["t_s"].iloc[0], fired[f"fraction_{a}"].iloc[0], "v", color=colour, mec="black", ms=8)
    axes.set(xlabel="t (s)", ylabel="fraction of particles", ylim=(0.1, 1.05))


def _draw_moment(figure: Figure, film: Film, measured: pd.DataFrame, monitor: pd.DataFrame, frame: int) -> None:
    """Draw one moment of a replay: the frame, the cross-section, and the fractions up to then."""
    channel, scope = film.trajectories.focusing.channel, film.microscope
    here, half = film.to_channel(measured[measured["frame"] == frame]), channel.height_um / 2
    true = film.trajectories.positions(frame / film.frame_rate_hz)
    picture, section, curves = (
        figure.add_axes(box) for box in ([0.01, 0.06, 0.45, 0.86], [0.55, 0.56, 0.43, 0.36], [0.55, 0.12, 0.43, 0.3])
    )
    picture.imshow(stretched(film[frame]), cmap=GREY, vmin=0, vmax=1)
    circles = picture.scatter(here["x_px"], here["y_px"], s=110, lw=1.6, cmap=DEPTH, c=here["z_um"])
    circles.set(facecolor="none", clim=(-half, half))
    circles.set_edgecolor(circles.to_rgba(here["z_um"]))
    picture.set_title(f"t = {frame / film.frame_rate_hz:.2f} s: circles are measured, coloured by z")
    bare(picture)
    scale_bar(picture, scope.um_per_px, 50)
    limit_to_channel(section, channel)
    section.plot(true["y_channel_um"], true["z_um"], "x", color="0.35", ms=5)
    section.scatter(here["y_channel_um"], here["z_um"], c=here["z_um"], cmap=DEPTH, vmin=-half, vmax=half, s=26)
    section.set(xlabel="y (µm)", ylabel="z (µm)", title=f"{len(here)} measured (dots) of {len(true)} (crosses)")
    draw_monitor(curves, monitor[monitor["frame"] <= frame])
    curves.set_xlim(0, monitor["t_s"].max())
    curves.legend(loc="lower right", fontsize="x-small", ncols=2)


@styled
def replay_view(film: Film, measured: pd.DataFrame, monitor: pd.DataFrame, frame: int) -> Figure:
    """Show one moment of the replay: the frame, the cross-section, and the two fractions up to then.

    Parameters
    ----------
    film : Film
    measured : DataFrame
        Particles of this film, from `replay.evaluate`.
    monitor : DataFrame
        Rows of this film and one method, from `replay.sweep`.
    frame : int

    Returns
    -------
    Figure
    """
    figure = plt.figure(figsize=(10, 5))
    _draw_moment(figure, film, measured, monitor, frame)
    return figure


def replay_animation(film: Film, measured: pd.DataFrame, monitor: pd.DataFrame, frames: Sequence[int]) -> FuncAnimation:
    """Animate the replay: the film focuses, the cross-section fills, the fractions climb until the trigger fires.

    Parameters
    ----------
    film, measured, monitor
        As in `replay_view`.
    frames : sequence of int
        Frames of the film that are shown.

    Returns
    -------
    matplotlib.animation.FuncAnimation
        For `save_animation` and `player`.
    """
    with plt.rc_context(STYLE):
        figure = Figure(figsize=(10, 5), dpi=64)

    def draw(frame: int) -> list:
        with plt.rc_context(STYLE):
            figure.clear()
            _draw_moment(figure, film, measured, monitor, frame)
        return []

    return FuncAnimation(figure, draw, frames=list(frames), init_func=lambda: [], blit=False)


def save_animation(animation: FuncAnimation, path: Path, frames_per_s: float = 8) -> None:
    """Write an animation as a GIF."""
    animation.save(path, writer="pillow", fps=frames_per_s)


def player(animation: FuncAnimation, frames_per_s: float = 8) -> str:
    """Make a player, with buttons and a slider, of an animation: HTML that needs nothing else."""
    with plt.rc_context({"animation.frame_format": "jpeg", "savefig.dpi": 52}):
        return animation.to_jshtml(fps=frames_per_s, default_mode="once")
