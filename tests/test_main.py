"""The runner of the notebooks, on tiny ones."""

import os
from pathlib import Path

import nbformat
import pytest

from gdptlab.__main__ import main, run, select


def write(path: Path, *cells: str) -> Path:
    """Write a notebook of these code cells, after one of text."""
    v4 = nbformat.v4
    nbformat.write(v4.new_notebook(cells=[v4.new_markdown_cell("text"), *map(v4.new_code_cell, cells)]), path)
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Give a checkout with three notebooks, the middle one broken."""
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "old.png").touch()
    figure = "open('../figures/{0}.png', 'w').close()"
    write(tmp_path / "notebooks" / "10_last.ipynb", "1 / 3", figure.format("fig2"))
    write(tmp_path / "notebooks" / "02_broken.ipynb", "print('fine')", "1 / 0")
    write(tmp_path / "notebooks" / "01_first.ipynb", "print('a'); print('b')", figure.format("fig1"), "1 + 1")
    return tmp_path


def outputs(notebook: Path) -> list:
    """Give the outputs of the code cells."""
    cells = nbformat.read(notebook, as_version=4).cells
    return [cell.outputs for cell in cells if cell.cell_type == "code"]


def test_runs_all_in_order_and_reports(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, broken, last = sorted((root / "notebooks").iterdir())
    untouched = broken.read_bytes()

    assert main([], root=root) == 1

    assert outputs(first)[0][0].text == "a\nb\n"
    assert outputs(first)[2][0].data["text/plain"] == "2"
    assert len(outputs(last)[0]) == 1
    assert broken.read_bytes() == untouched
    assert sorted((root / "notebooks").iterdir()) == [first, broken, last]
    out, err = capsys.readouterr()
    words = [line.split() for line in out.splitlines()]
    assert words[0] == ["notebook", "seconds", "figures"]
    assert [line[0] for line in words[1:]] == ["01_first", "02_broken", "10_last"]
    assert words[1][2:] == ["fig1.png"]
    assert words[2][1:] == ["FAILED"]
    assert words[3][2:] == ["fig2.png"]
    assert "02_broken, cell 3: ZeroDivisionError: division by zero" in err


def test_running_again_changes_no_byte(root: Path) -> None:
    notebook = root / "notebooks" / "01_first.ipynb"
    assert run([notebook], root / "figures")["error"].item() == ""
    once = notebook.read_bytes()
    assert b"iopub" not in once
    assert b"language_info" not in once
    run([notebook], root / "figures")
    assert notebook.read_bytes() == once


def test_a_dead_kernel_is_reported(root: Path) -> None:
    notebook = write(root / "notebooks" / "03_dead.ipynb", "import os; os._exit(1)")
    table = run([notebook], root / "figures")
    assert table["error"].item().startswith("cell 2: DeadKernelError")


def test_a_file_that_is_no_notebook_is_reported(root: Path) -> None:
    notebook = root / "notebooks" / "03_text.ipynb"
    notebook.write_text("not a notebook")
    assert "cell 0: NotJSONError" in run([notebook], root / "figures")["error"].item()


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["01_first"], ["01_first"]),
        (["01_first.ipynb"], ["01_first"]),
        ([os.path.join("notebooks", "01_first.ipynb")], ["01_first"]),
        (["10", "01"], ["10_last", "01_first"]),
        (["1", "01_first"], ["01_first"]),
        ([], ["01_first", "02_broken", "10_last"]),
    ],
)
def test_names(root: Path, capsys: pytest.CaptureFixture[str], names: list[str], stems: list[str]) -> None:
    assert main(["--list", *names], root=root) == 0
    assert capsys.readouterr().out.split() == stems


@pytest.mark.parametrize("name", ["7", "0", "first", "", "."])
def test_unknown_name(root: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    with pytest.raises(ValueError, match=r"^notebook"):
        select([name], sorted((root / "notebooks").iterdir()))
    with pytest.raises(SystemExit) as leaving:
        main(["01", name], root=root)
    assert leaving.value.code == 2
    assert f"01_first, 02_broken, 10_last, or its leading number; got {name!r}" in capsys.readouterr().err


def test_no_notebooks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        main([], root=tmp_path)
    assert leaving.value.code == 2
    assert f"no notebooks in {tmp_path / 'notebooks'}" in capsys.readouterr().err


def test_progress_bars_are_not_kept(root: Path) -> None:
    notebook = root / "notebooks" / "01_first.ipynb"
    view = "{'application/vnd.jupyter.widget-view+json': {'model_id': 'a'}, 'text/plain': '0%'}"
    write(notebook, f"from IPython.display import display\ndisplay({view}, raw=True)\nprint('done')")
    run([notebook], root / "figures")
    (kept,) = outputs(notebook)
    assert [output.output_type for output in kept] == ["stream"]
