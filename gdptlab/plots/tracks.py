"""Pictures of tracks, of the velocities along them, and of the energy density that follows.

Each function takes data and returns a matplotlib Figure.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gdptlab.experiment.channel import IN_CHANNEL, Focusing
from gdptlab.experiment.film import Film
from gdptlab.plots.experiment import limit_to_channel
from gdptlab.plots.style import COLOURS, DEPTH, MARK, grey, panels, scale_bar, styled

BINS = 15
"""Number of bins of a velocity profile."""


@styled
def tracks_in_space(film: Film, tracks: pd.DataFrame, frame: int) -> Figure:
    """Show tracks up to a frame: over that frame, and as they cross the channel.

    Parameters
    ----------
    film : Film
    tracks : DataFrame
        From `tracks.link`, with `x_px`, `y_px` as well.
    frame : int

    Returns
    -------
    Figure
        Colours: depth at which a track begins. Dots: on the left where it is now, on the right where it begins.
    """
    channel, image = film.trajectories.focusing.channel, film[frame]
    limits = {"cmap": DEPTH, "vmin": -channel.height_um / 2, "vmax": channel.height_um / 2}
    past = tracks[tracks["frame"] <= frame]
    begin = past.groupby("particle").first()
    figure, axes = plt.subplot_mosaic(
        [["frame", "section"]], figsize=(11, 4.4), layout="constrained", width_ratios=[1, 1.5]
    )
    limit_to_channel(axes["section"], channel)
    dots = axes["section"].scatter(begin["y_channel_um"], begin["z_um"], c=begin["z_um"], s=16, zorder=2, **limits)
    axes["frame"].imshow(image, **grey(image))
    for particle, track in past.groupby("particle"):
        colour = dots.to_rgba(begin["z_um"][particle])
        axes["frame"].plot(track["x_px"], track["y_px"], color=colour, lw=1.3)
        axes["section"].plot(track["y_channel_um"], track["z_um"], color="0.6", lw=0.8, zorder=1)
    now = past[past["frame"] == frame]
    colours = begin["z_um"][now["particle"]]
    axes["frame"].scatter(now["x_px"], now["y_px"], c=colours, s=16, ec="white", lw=0.6, zorder=3, **limits)
    rows, columns = image.shape
    axes["frame"].set(xlabel="x (px)", ylabel="y (px)", title=f"t = {frame / film.frame_rate_hz:g} s")
    axes["frame"].set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    scale_bar(axes["frame"], film.microscope.um_per_px, 50)
    figure.colorbar(dots, ax=axes["section"], label="z at the start (µm)", shrink=0.8)
    axes["section"].set(
        xlabel="y (µm)", ylabel="z (µm)", title=f"{past['particle'].nunique()} tracks, from their dots on"
    )
    return figure


@styled
def one_track(track: pd.DataFrame, path: pd.DataFrame, frame_rate_hz: float) -> Figure:
    """Show one track in time: positions and velocities, with two standard deviations, beside the true path.

    Parameters
    ----------
    track : DataFrame
        One particle of `tracks.velocities`.
    path : DataFrame
        The true one: `frame`, `x_channel_um`, `y_channel_um`, `z_um`, `vx_um_s`, `vy_um_s`, `vz_um_s`.
    frame_rate_hz : float

    Returns
    -------
    Figure
        A column for each axis.
    """
    figure, axes = panels(3, 10, 4.8, rows=2, sharex=True)
    t, true_t = (table["frame"] / frame_rate_hz for table in (track, path))
    for k, axis in enumerate("xyz"):
        for panel, name, std in (
            (axes[0, k], IN_CHANNEL[axis], f"{axis}_std_um"),
            (axes[1, k], f"v{axis}_um_s", f"v{axis}_std_um_s"),
        ):
            panel.plot(true_t, path[name], color="black", lw=1, label="true", zorder=3)
            low, high = track[name] - 2 * track[std], track[name] + 2 * track[std]
            panel.fill_between(t, low, high, color=COLOURS[k], alpha=0.35, lw=0, label="measured, ± 2 std")
            panel.plot(t, track[name], ".", color=COLOURS[k], ms=2.5)
        axes[0, k].set(ylabel=f"{axis} (µm)")
        axes[1, k].set(xlabel="t (s)", ylabel=f"$v_{axis}$ (µm/s)")
    axes[0, 0].legend(fontsize="small")
    return figure


def _binned(axes: Axes, at: NDArray, value: NDArray, edges: NDArray, colour: str, marker: str, label: str) -> None:
    """Median and quartiles of a velocity in bins of position."""
    groups = pd.Series(value).groupby(pd.cut(pd.Series(at), edges), observed=False)
    low, middle, high = (groups.quantile(q).to_numpy() for q in (0.25, 0.5, 0.75))
    bars = np.stack([middle - low, high - middle])
    middles = (edges[1:] + edges[:-1]) / 2
    axes.errorbar(
        middles, middle, yerr=bars, color=colour, marker=marker, ls="", lw=1, capsize=2, ms=5, label=label, zorder=3
    )


@styled
def velocity_profiles(table: pd.DataFrame, focusing: Focusing) -> Figure:
    """Compare measured velocities with the flow's profile and with eqs (1a, 1b).

    Parameters
    ----------
    table : DataFrame
        From `tracks.velocities`.
    focusing : Focusing
        What is expected.

    Returns
    -------
    Figure
        Flow across the width, in two layers of the height, and sound along y and z. Medians and quartiles in bins.
    """
    channel = focusing.channel
    w, h = channel.width_um, channel.height_um
    figure, axes = panels(3, 12, 4)
    table = table.dropna(subset=["vx_um_s", "vy_um_s", "vz_um_s"])
    y, z = np.linspace(-w / 2, w / 2, 201), np.linspace(-h / 2, h / 2, 201)
    layers = {f"|z| < {h / 10:g} µm": (0.0, h / 10), f"{0.2 * h:g} < |z| < {0.3 * h:g} µm": (0.2 * h, 0.3 * h)}
    for k, (label, (low, high)) in enumerate(layers.items()):
        part = table[table["z_um"].abs().between(low, high)]
        inside = np.linspace(low, high, 9)
        speed = channel.velocity(y, inside[:, None])
        axes[0, 0].fill_between(y, speed.min(axis=0), speed.max(axis=0), color=COLOURS[k], alpha=0.25, lw=0)
        edges = np.linspace(-w / 2, w / 2, BINS + 1)
        _binned(axes[0, 0], part["y_channel_um"], part["vx_um_s"], edges, COLOURS[k], "os"[k], label)
    axes[0, 0].set(xlabel="y (µm)", ylabel="$v_x$ (µm/s)", title="flow: bands, Poiseuille", ylim=(0, None))
    axes[0, 0].legend(fontsize="small", loc="lower center")
    for panel, axis, position in zip(axes[0, 1:], "yz", (y, z), strict=True):
        seen = table[f"v{axis}_um_s"]
        panel.plot(table[IN_CHANNEL[axis]], seen, ".", color="0.7", ms=1, rasterized=True)
        panel.plot(
            position,
            focusing.radiation_velocity(axis, position),
            color="black",
            label="eq. (1a)" if axis == "y" else "eq. (1b)",
        )
        edges = np.linspace(position[0], position[-1], BINS + 1)
        _binned(panel, table[IN_CHANNEL[axis]], seen, edges, COLOURS[1], "o", "measured")
        top = 1.6 * focusing.amplitude_um_s(axis)
        panel.set(xlabel=f"{axis} (µm)", ylabel=f"$v_{axis}$ (µm/s)", title=f"sound along {axis}", ylim=(-top, top))
        panel.legend(fontsize="small", loc="upper right")
    return figure


@styled
def links_in_time(scores: Mapping[str, pd.DataFrame]) -> Figure:
    """Plot how good links are as the film goes on.

    Parameters
    ----------
    scores : dict of DataFrame
        By name; `t_s` as index, and the columns `right` and `found` of `tracks.link_scores`.

    Returns
    -------
    Figure
    """
    figure, axes = panels(2, 9, 3.4)
    titles = {"right": "right, of the links made", "found": "right, of those of the truth"}
    for panel, (column, title) in zip(axes[0], titles.items(), strict=True):
        for k, (name, table) in enumerate(scores.items()):
            panel.plot(table.index, table[column], color=COLOURS[k], marker="os^D"[k], label=name)
        panel.set(xlabel="t (s)", ylabel="fraction", title=title)
    axes[0, 0].legend(fontsize="small", loc="lower left")
    return figure


@styled
def collapsed_paths(
    tracks: pd.DataFrame, focusing: Focusing, amplitudes_um_s: Sequence[float], frame_rate_hz: float
) -> Figure:
    """Plot all paths so that they fall on one straight line, whose slope is the rate of focusing.

    Parameters
    ----------
    tracks : DataFrame
        From `tracks.link`.
    focusing : Focusing
    amplitudes_um_s : (U_y, U_z)
        As fitted: slopes of the lines.
    frame_rate_hz : float

    Returns
    -------
    Figure
        ln |tan(πy/w)| in time, likewise for z, each track moved up or down to the line, away from axis and walls.
    """
    figure, axes = panels(2, 9.5, 3.8)
    t_s = tracks["frame"] / frame_rate_hz
    for panel, axis, amplitude in zip(axes[0], "yz", amplitudes_um_s, strict=True):
        extent = focusing.extent_um(axis)
        position = tracks[IN_CHANNEL[axis]].abs()
        seen = position.between(0.05 * extent, 0.45 * extent)  # elsewhere noise is all there is
        table = pd.DataFrame({"t": t_s, "v": np.log(np.tan(np.pi * position / extent)), "p": tracks["particle"]})[seen]
        slope = -2 * np.pi * amplitude / extent
        table["v"] -= (table["v"] - slope * table["t"]).groupby(table["p"]).transform("median")
        panel.plot(table["t"], table["v"], ".", color=COLOURS[0], ms=1.2, alpha=0.5, rasterized=True, label="tracks")
        t = np.array([0, table["t"].max()])
        panel.plot(t, slope * t, color="black", lw=1.2, label=f"slope of $U_{axis}$ = {amplitude:.2f} µm/s")
        label = "w" if axis == "y" else "h"
        panel.set(xlabel="t (s)", ylabel=rf"ln tan(π|{axis}|/{label}), moved")
        panel.legend(fontsize="small", loc="lower left", markerscale=8)
    return figure


@styled
def energy_intervals(tables: Mapping[str, pd.DataFrame], true: float, names: Mapping[str, str]) -> Figure:
    """Plot intervals of many films, those that miss the truth marked.

    Parameters
    ----------
    tables : dict of DataFrame
        For each quantity a row for each film, with `value`, `low` and `high`.
    true : float
        Of all quantities.
    names : dict of str
        What their panels are called.

    Returns
    -------
    Figure
        Deviations from the truth in %, films sorted by them.
    """
    figure, axes = panels(len(tables), 4.8 * len(tables), 3.6)
    for panel, (key, table) in zip(axes[0], tables.items(), strict=True):
        table = 100 * (table[["value", "low", "high"]].sort_values("value") / true - 1)
        misses = ((table["low"] > 0) | (table["high"] < 0)).to_numpy()
        at = np.arange(len(table))
        for some, colour, style, label in ((~misses, COLOURS[0], "-", "covers"), (misses, MARK, (0, (2, 1)), "misses")):
            part = table[some]
            panel.vlines(at[some], part["low"], part["high"], color=colour, ls=style, lw=1.3)
            panel.plot(
                at[some],
                part["value"],
                "o" if label == "covers" else "s",
                color=colour,
                ms=3,
                label=f"{label}: {some.sum()}",
            )
        panel.axhline(0, color="black", lw=0.8)
        panel.set(xlabel="film, sorted", ylabel="deviation (%)", title=names[key])
        panel.legend(fontsize="small", loc="lower right", bbox_to_anchor=(1, 1), ncols=2)  # above: no interval is there
    return figure
