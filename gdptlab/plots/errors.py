"""Errors, recall and precision against depth or against a setting."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gdptlab.plots.style import COLOURS, MARKERS, panels, styled


@styled
def z_errors(pairs: Mapping[str, pd.DataFrame], edges_um: Sequence[float]) -> Figure:
    """Plot the error in z of every particle against its true depth, with the mean in each bin of depth.

    Parameters
    ----------
    pairs : dict of DataFrame
        As `match` returns: columns `z_um` (true) and `dz_um`; by name.
    edges_um : sequence of float
        Of the bins.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(len(pairs), 9, 3.3, sharey=True)
    edges = np.asarray(edges_um, dtype=float)
    for panel, colour, (name, table) in zip(axes, COLOURS, pairs.items(), strict=False):
        panel.axhline(0, color="black", lw=0.8)
        panel.plot(table["z_um"], table["dz_um"], ".", color=colour, alpha=0.35, mew=0, ms=6, label="a particle")
        mean = table.groupby(pd.cut(table["z_um"], edges), observed=False)["dz_um"].mean()
        panel.plot((edges[1:] + edges[:-1]) / 2, mean, "k-o", mfc="white", label="mean")
        panel.set(title=name, xlabel="true z (µm)")
    axes[0].set_ylabel("error in z (µm)")
    axes[0].legend()
    return figure


SCORES = {"recall": "recall", "precision": "precision", "sigma_z_um": "σ$_z$ (µm)"}
"""Labels of the scores that can be drawn."""


@styled
def score_curves(
    tables: Mapping[str, pd.DataFrame],
    x_label: str,
    *,
    columns: Sequence[str] = tuple(SCORES),
    chosen: float | None = None,
    log: bool = False,
) -> Figure:
    """Plot recall, precision and error in z of several measurements against depth or against a setting.

    Parameters
    ----------
    tables : dict of DataFrame
        By name: the index is drawn along x, columns as in `assessment.scores`; a column `recall_std`, say, is
        drawn as error bars, or `recall_low` and `recall_high` are.
    x_label : str
        Label, with unit, of the index.
    columns : sequence of str
        Panels, of `recall`, `precision`, `sigma_z_um`.
    chosen : float, optional
        Setting in use, marked by a vertical line.
    log : bool
        Logarithmic scale along x.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(len(columns), max(3.4 * len(columns), 6), 3.1)
    for panel, column in zip(axes, columns, strict=True):
        for colour, marker, (name, table) in zip(COLOURS, MARKERS, tables.items(), strict=False):
            bars = table.get(f"{column}_std")
            if f"{column}_low" in table:
                ends = table[column] - table[f"{column}_low"], table[f"{column}_high"] - table[column]
                bars = np.maximum(ends, 0)
            panel.errorbar(
                table.index, table[column], yerr=bars, color=colour, marker=marker, mfc="none", label=name, capsize=2
            )
        ends = (t.get(f"{column}_high", t[column] + t.get(f"{column}_std", 0)) for t in tables.values())
        top = np.nanmax([0.1, *(end.max() for end in ends)])  # a score is NaN where nothing was found
        panel.set(xlabel=x_label, ylabel=SCORES[column], xscale="log" if log else "linear")
        ticks = np.unique(np.concatenate([t.index for t in tables.values()]))
        if log:
            panel.set_xticks(ticks, labels=[f"{t:g}" for t in ticks], fontsize="small")
            panel.minorticks_off()
        elif np.issubdtype(ticks.dtype, np.integer):
            panel.xaxis.get_major_locator().set_params(integer=True)
        panel.set_ylim(0, 1.05 if column != "sigma_z_um" else 1.08 * top)
        if chosen is not None:
            panel.axvline(chosen, color="0.6", lw=1, ls=":", zorder=0)
    if len(tables) > 1 and len(columns) == 1:
        axes[0].legend(loc="center left", bbox_to_anchor=(1, 0.5))
    elif len(tables) > 1:
        axes[0].legend(loc="lower left")
    return figure
