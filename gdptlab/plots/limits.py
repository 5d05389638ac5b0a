"""Pictures of how accurate a measurement can be, is, and whether it leans to one side.

Each function takes data and returns a matplotlib Figure.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gdptlab.plots.style import COLOURS, MARKERS, panels, styled

AXES = {
    "x (px)": ("x_std_px", "sigma_x_px"),
    "y (px)": ("y_std_px", "sigma_y_px"),
    "z (µm)": ("z_std_um", "sigma_z_um"),
}
"""Panel, with the columns of `fit.expected_error` and of `assessment.scores` in it."""


def _points(i: int, label: str) -> dict[str, object]:
    """How the points of the i-th curve look."""
    return {"color": COLOURS[i], "marker": MARKERS[i], "mfc": "none", "capsize": 2, "lw": 1, "label": label}


@styled
def expected_errors(expected: Mapping[str, pd.DataFrame]) -> Figure:
    """Plot the least error of x, y and z against depth.

    Parameters
    ----------
    expected : dict of DataFrame
        By name, from `fit.expected_error`.

    Returns
    -------
    Figure
    """
    figure, [axes] = panels(3, 10.5, 3.3)
    for panel, (name, (column, _)) in zip(axes, AXES.items(), strict=True):
        for i, (label, table) in enumerate(expected.items()):
            panel.plot(table["z_um"], table[column], color=COLOURS[i], ls=("-", "--", ":", "-.")[i % 4], label=label)
        panel.set(xlabel="z (µm)", ylabel=f"least error of {name}")
        panel.set_ylim(bottom=0)
    axes[0].legend()
    return figure


@styled
def errors_against_bound(expected: pd.DataFrame, measured: Mapping[str, pd.DataFrame]) -> Figure:
    """Plot measured errors against depth beside the least that is possible.

    Parameters
    ----------
    expected : DataFrame
        From `fit.expected_error`.
    measured : dict of DataFrame
        By the method's name, from `assessment.standard_assessment` with bins of z.

    Returns
    -------
    Figure
        Bars are the confidence intervals.
    """
    figure, [axes] = panels(3, 10.5, 3.6)
    for panel, (name, (bound, column)) in zip(axes, AXES.items(), strict=True):
        lowest = expected[bound].min() / 2
        panel.fill_between(expected["z_um"], lowest, expected[bound], color="0.85", label="impossible", lw=0)
        for i, (label, table) in enumerate(measured.items()):
            ends = table[column] - table[f"{column}_low"], table[f"{column}_high"] - table[column]
            shift = (i - (len(measured) - 1) / 2) * 1.2  # µm, so that bars do not hide each other
            panel.errorbar(table.index + shift, table[column], np.maximum(ends, 0), **_points(i, label))
        panel.set(xlabel="z (µm)", ylabel=f"RMS error of {name}", yscale="log", ylim=(lowest, None))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@styled
def biases(tables: Mapping[str, Mapping[str, pd.DataFrame]]) -> Figure:
    """Plot mean errors against what they might depend on.

    Parameters
    ----------
    tables : dict of dict of DataFrame
        By panel, "dz (µm) against z (µm)", and method: the index is drawn along x; columns `mean`, its standard
        error `sem`, and `std` of the errors, a third of which, the first method's, is shaded.

    Returns
    -------
    Figure
    """
    figure, axes = panels(-(-len(tables) // 2), 10.5, 6.2, rows=2)
    for panel, (title, methods) in zip(axes.flat, tables.items(), strict=False):
        ylabel, xlabel = title.split(" against ")
        third = next(iter(methods.values()))["std"].mean() / 3
        panel.axhspan(-third, third, color="0.9", label="a third of σ")
        panel.axhline(0, color="black", lw=0.8)
        for i, (label, table) in enumerate(methods.items()):
            panel.errorbar(table.index, table["mean"], table["sem"], **_points(i, label))
        end = max(2 * third, *(1.2 * (table["mean"].abs() + table["sem"]).max() for table in methods.values()))
        panel.set(xlabel=xlabel, ylabel=f"mean {ylabel}", ylim=(-end, end))
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure
