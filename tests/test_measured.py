"""Every number has one source: what notebooks kept, notebook 15 shows, and the README quotes."""

from pathlib import Path

import nbformat
import numpy as np
import pandas as pd
import pytest

from gdptlab import plots
from gdptlab.plots.notebook import MARKS

ROOT = Path(__file__).parents[1]


def test_readme_quotes_what_was_measured() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert plots.quote_measured(readme, plots.all_measured()) == readme, "run: python -m gdptlab --save 15"


def test_the_page_of_evidence_shows_what_was_measured() -> None:
    page = nbformat.read(next((ROOT / "notebooks").glob("15-*.ipynb")), as_version=4)
    outputs = [output for cell in page.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = "\n".join(o.get("text", "") + o.get("data", {}).get("text/markdown", "") for o in outputs)
    for line in plots.measured_lines(plots.all_measured()):
        assert line.replace("](notebooks/", "](") in shown, f"run: python -m gdptlab --save 15 ({line})"


def test_each_figure_says_what_it_rests_on() -> None:
    table = plots.all_measured()
    assert table["sample"].ne("").all() and table["value"].notna().all()
    known = table.dropna(subset=["low"])
    assert ((known["low"] <= known["value"]) & (known["value"] <= known["high"])).all()
    notebooks = {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert set(table["notebook"]) <= notebooks


def test_figures_are_kept_and_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GDPTLAB_SAVE", raising=False)
    monkeypatch.setattr("gdptlab.plots.style.FIGURES", tmp_path)
    rows = {"a time": (1.23456, 1.0, 2.0, "ms", "3 rounds"), "a fraction": (50.0, np.nan, np.nan, "%", "2 films")}
    kept = plots.keep_measured("07-speed", rows, quoted=["a time"])
    assert list((tmp_path / "mine").iterdir()) == [tmp_path / "mine" / "measured-07-speed.csv"]
    back = plots.all_measured(tmp_path / "mine")
    pd.testing.assert_frame_equal(back, kept)
    text = plots.quote_measured(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n", back)
    assert "| [07](notebooks/07-speed.ipynb) | a time | 1.23 ms (1 to 2) | 3 rounds |" in text
    assert "fraction" not in text and "old" not in text and text.startswith("before\n") and text.endswith("after\n")
    assert plots.quote_measured(text, back) == text


def test_what_cannot_be_kept_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="quoted"):
        plots.keep_measured("07-speed", {}, quoted=["nothing"])
    with pytest.raises(ValueError, match="rows"):
        plots.keep_measured("07-speed", {"a": (1, 2)})
    with pytest.raises(ValueError, match="text"):
        plots.quote_measured("no marks", plots.all_measured())
    with pytest.raises(FileNotFoundError, match="where"):
        plots.all_measured(tmp_path)
