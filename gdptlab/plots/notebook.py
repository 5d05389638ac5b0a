"""What only a running notebook needs: to end early, and to keep the figures that it measured.

Each of the notebooks 07 to 12 writes its headline figures into a file of its own, `measured-07-speed.csv` and so on,
where the figures go (`folder`). Notebook 15 gathers them in one table, and the README quotes the lines that are
marked. So every number has one source; a test compares the three.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from IPython import get_ipython

from gdptlab._files import written_whole
from gdptlab.plots.style import FIGURES, folder

DIGITS = 3
"""Significant digits of a kept figure. Convention: an interval from a few dozen samples has no more."""

MARKS = ("<!-- measured: written by notebook 15 -->", "<!-- end of measured -->")
"""What stands in the README before and after the quoted lines."""

COLUMNS = ("notebook", "quantity", "value", "low", "high", "unit", "sample", "quoted")
"""Columns of the kept figures: `low` and `high` are the ends of an interval or range, which `sample` explains."""


def end_notebook(reason: str) -> None:
    """Print why a notebook cannot go on, and let its later cells do nothing instead of failing."""
    print(reason)
    shell = get_ipython()
    if shell is not None:
        shell.input_transformers_cleanup.append(lambda lines: [])


def keep_measured(notebook: str, rows: Mapping[str, Sequence], quoted: Sequence[str] = ()) -> pd.DataFrame:
    """Write the headline figures of a notebook, where its pictures go.

    Parameters
    ----------
    notebook : str
        Stem of the notebook, such as '07-speed'.
    rows : dict of (value, low, high, unit, sample)
        By the name of the quantity. `low` and `high` may be NaN; `sample` says what n is, and which seed.
    quoted : sequence of str
        Names of the quantities that the README quotes.

    Returns
    -------
    DataFrame
        What was written: `COLUMNS`.

    Raises
    ------
    ValueError
        If `quoted` names no quantity, or a row has other than five parts.
    """
    unknown = set(quoted) - set(rows)
    if unknown:
        raise ValueError(f"quoted: got {sorted(unknown)}, allowed are names of the rows, {list(rows)}")
    table = []
    for name, row in rows.items():
        if len(row) != 5:
            raise ValueError(f"rows: got {row!r} for {name!r}, allowed are (value, low, high, unit, sample)")
        numbers = [float(f"{value:.{DIGITS}g}") for value in row[:3]]
        table.append((notebook, name, *numbers, *row[3:], name in quoted))
    table = pd.DataFrame(table, columns=COLUMNS)
    with written_whole(folder() / f"measured-{notebook}.csv") as temporary:
        table.to_csv(temporary, index=False, lineterminator="\n")
    return table


def all_measured(where: Path = FIGURES) -> pd.DataFrame:
    """Gather what the notebooks kept.

    Parameters
    ----------
    where : path
        Folder of the files; the repository's figures if not given.

    Returns
    -------
    DataFrame
        `COLUMNS`, in the order of the notebooks.
    """
    tables = [pd.read_csv(file, keep_default_na=True) for file in sorted(Path(where).glob("measured-*.csv"))]
    if not tables:
        raise FileNotFoundError(f"where: got {str(where)!r}, allowed is a folder with files measured-*.csv")
    return pd.concat(tables, ignore_index=True).fillna({"unit": "", "sample": ""})


def measured_lines(table: pd.DataFrame) -> list[str]:
    """Write kept figures as lines of a Markdown table, with a link to each notebook as seen from the README.

    Parameters
    ----------
    table : DataFrame
        From `all_measured`, or some of its rows.

    Returns
    -------
    list of str
        The head, and a line for each figure.
    """
    lines = ["| notebook | measured | value | n |", "|---|---|---|---|"]
    for row in table.itertuples():
        unit = row.unit if row.unit in ("", "%") else f" {row.unit}"
        interval = "" if np.isnan(row.low) else f" ({row.low:g} to {row.high:g})"
        link = f"[{row.notebook.partition('-')[0]}](notebooks/{row.notebook}.ipynb)"
        lines.append(f"| {link} | {row.quantity} | {row.value:g}{unit}{interval} | {row.sample} |")
    return lines


def quote_measured(text: str, table: pd.DataFrame) -> str:
    """Put the quoted lines of kept figures between the `MARKS` in a text.

    Parameters
    ----------
    text : str
        Of the README.
    table : DataFrame
        From `all_measured`.

    Returns
    -------
    str
        The text with those lines in place of what stood there.

    Raises
    ------
    ValueError
        If the marks are not in the text.
    """
    before, first, rest = text.partition(MARKS[0])
    _, last, after = rest.partition(MARKS[1])
    if not (first and last):
        raise ValueError(f"text: got one without the marks, allowed is one with {MARKS[0]!r} and {MARKS[1]!r}")
    lines = measured_lines(table[table["quoted"].astype(bool)])
    return "\n".join([before + first, *lines, last + after])
