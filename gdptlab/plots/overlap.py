"""Pictures of particles that overlap: which are found, what they leave of a frame, how far errors are known.

Each function takes data and returns a matplotlib Figure.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from gdptlab.plots.experiment import TRIGGERS
from gdptlab.plots.style import COLOURS, GREY, bare, grey, panels, scale_bar, styled

RESIDUAL_END = 6.0
"""Residual at which its scale of colours ends, in units of the noise of a pixel: beyond it noise hardly ever is."""

RESIDUAL = plt.get_cmap("PuOr", 13)
"""Scale of few colours for a residual, with white in the middle."""

MARKS = {
    "found": {"marker": "o", "color": COLOURS[5], "s": 70, "lw": 1.4},
    "missed": {"marker": "s", "color": COLOURS[1], "s": 80, "lw": 1.8},
    "false": {"marker": "x", "color": COLOURS[4], "s": 50, "lw": 2.2},
}
"""Marks of true particles that are found, of those that are missed, and of measured ones that are false."""


@styled
def found_and_left(
    image: NDArray,
    true: pd.DataFrame,
    measured: Mapping[str, pd.DataFrame],
    pairs: Mapping[str, pd.DataFrame],
    residuals: Mapping[str, NDArray],
) -> Figure:
    """Show what methods find in a frame, and below the residual.

    Parameters
    ----------
    image : array (rows, columns)
    true : DataFrame
        Columns `x_px`, `y_px`.
    measured : dict of DataFrame
        The same, by the method's name.
    pairs : dict of DataFrame
        From `assessment.match`.
    residuals : dict of arrays (rows, columns)
        The frame less the model image of what was measured, in units of the noise of a pixel.

    Returns
    -------
    Figure
        A column for each method.
    """
    figure, axes = panels(len(measured), 5 * len(measured), 9.6, rows=2, sharex=True, sharey=True)
    for name, upper, lower in zip(measured, *axes, strict=True):
        table, pair = measured[name], pairs[name]
        groups = {
            "found": true.loc[pair["true"]],
            "missed": true.drop(index=pair["true"]),
            "false": table.drop(index=pair["measured"]),
        }
        upper.imshow(image, **grey(image) | {"cmap": GREY})
        for kind, here in groups.items():
            look = dict(MARKS[kind])
            colour = look.pop("color")
            look |= {"color": colour} if kind == "false" else {"facecolor": "none", "edgecolor": colour}
            upper.scatter(here["x_px"], here["y_px"], **look)
        counts = ", ".join(f"{len(here)} {kind}" for kind, here in groups.items())
        upper.set_title(f"{name}: {counts}")
        shown = lower.imshow(residuals[name], vmin=-RESIDUAL_END, vmax=RESIDUAL_END, cmap=RESIDUAL)
        lower.set_title("residual")
        lower.set(xlabel="x (px)")
        lower.spines[:].set_visible(True)
    for panel in axes[:, 0]:
        panel.set_ylabel("y (px)")
    # Circles and squares of the legend are as open as those of the picture.
    handles = [
        Line2D([], [], ls="", marker=m["marker"], mec=m["color"], mfc="none", mew=m["lw"], ms=8, label=kind)
        for kind, m in MARKS.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    figure.colorbar(shown, ax=axes[1], label="residual (noise of a pixel)", extend="both", shrink=0.9)
    return figure


@styled
def laid_bare(rows: Mapping[str, Sequence[NDArray]], titles: Sequence[str], um_per_px: float) -> Figure:
    """Show particles that others hide, once the model images of those others are subtracted.

    Parameters
    ----------
    rows : dict of sequences of arrays (n, n)
        By the particle's name: the frame less its background, the others' model image, the difference, and the
        particle's image alone. The first two have one scale of grey, and so have the last two.
    titles : sequence of str
        Of the four columns.
    um_per_px : float
        Size of a pixel in the object.

    Returns
    -------
    Figure
    """
    figure, axes = panels(len(titles), 2.35 * len(titles), 2.35 * len(rows) + 0.3, rows=len(rows))
    for line, (name, images) in zip(axes, rows.items(), strict=True):
        half = len(titles) // 2
        for k, (panel, image) in enumerate(zip(line, images, strict=True)):
            like = images[0] if k < half else images[half]
            panel.imshow(image, **grey(like, 0.4))
            bare(panel)
        line[0].set_ylabel(name)
        scale_bar(line[0], um_per_px, 10)
    for panel, title in zip(axes[0], titles, strict=True):
        panel.set_title(title)
    return figure


@styled
def error_ratios(ratios: Mapping[str, pd.DataFrame], limit: float = 6.0) -> Figure:
    """Plot how errors, each over its own standard deviation, are distributed, beside the normal distribution.

    Parameters
    ----------
    ratios : dict of DataFrame
        By name: a column for each axis, its name that of the panel.
    limit : float
        Ends of the scale; what is beyond is counted in the outermost bins.

    Returns
    -------
    Figure
        The scale of density is logarithmic, to show the tails. Standard deviations are written above.
    """
    columns = list(next(iter(ratios.values())))
    figure, [axes] = panels(len(columns), 10, 3.9, sharey=True)
    edges = np.linspace(-limit, limit, 25)
    s = np.linspace(-limit, limit, 201)
    for panel, column in zip(axes, columns, strict=True):
        panel.plot(s, np.exp(-(s**2) / 2) / np.sqrt(2 * np.pi), color="black", lw=1.2, ls="--", label="normal")
        lines = []
        for i, (name, table) in enumerate(ratios.items()):
            values = np.clip(table[column], -limit, limit)
            density = np.histogram(values, edges)[0] / len(values) / (edges[1] - edges[0])
            panel.stairs(density, edges, color=COLOURS[i], lw=1.8, label=f"{name}, n = {len(values)}")
            plain, robust = np.sqrt(np.mean(table[column] ** 2)), np.median(np.abs(table[column])) / 0.6745
            lines.append(f"{name}: {robust:.1f} robust, {plain:.1f} plain")
        panel.set_title(f"{column}\n" + "\n".join(lines))
        panel.set(yscale="log", ylim=(2e-4, 0.8), xlabel="error / its standard deviation")
    axes[0].set_ylabel("density")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@styled
def film_followed(
    seen: Mapping[str, pd.DataFrame], true: pd.DataFrame, triggers_s: Mapping[str, float], level: float
) -> Figure:
    """Plot how many particles of a film methods find, and the fractions that trigger, against time.

    Parameters
    ----------
    seen : dict of DataFrame
        By the method's name: `t_s`; `valid`, found particles over true ones; `fraction_h` and `fraction_w`.
    true : DataFrame
        `t_s`, `fraction_h`, `fraction_w`.
    triggers_s : {'h': float, 'w': float}
        True trigger times.
    level : float
        Fraction that triggers.

    Returns
    -------
    Figure
        A triangle is where a measured fraction first reaches the level.
    """
    figure, [axes] = panels(3, 11, 3.7, sharey=True)
    for a, symbol in TRIGGERS.items():
        axes[0].axvline(triggers_s[a], color="0.45", lw=1.2, ls=":")
        axes[0].annotate(
            symbol,
            (triggers_s[a], 1),
            (3, 4),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            color="0.3",
            ha="center",
        )
    for i, (name, table) in enumerate(seen.items()):
        look = {"color": COLOURS[i], "label": name}
        axes[0].plot(table["t_s"], table["valid"], **look)
        for panel, a in zip(axes[1:], TRIGGERS, strict=True):
            panel.plot(table["t_s"], table[f"fraction_{a}"], **look)
            fired = table[table[f"fraction_{a}"] >= level]
            if len(fired):
                first = fired.iloc[0]
                panel.plot(first["t_s"], first[f"fraction_{a}"], "v", color=look["color"], mec="black", ms=9, zorder=4)
    for panel, (a, symbol) in zip(axes[1:], TRIGGERS.items(), strict=True):
        panel.plot(true["t_s"], true[f"fraction_{a}"], color="black", lw=1.1, ls=(0, (4, 2)), label="true")
        panel.axhline(level, color="black", lw=0.8, ls=":")
        panel.axvline(triggers_s[a], color="0.45", lw=1.2, ls=":")
        panel.set(title=f"In the middle third: {symbol}", xlabel="t (s)")
        panel.tick_params(labelleft=True)
    axes[0].set(xlabel="t (s)", ylabel="fraction of particles", ylim=(0, 1.05))
    axes[0].set_title("Found and right", pad=18)
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure
