"""Execute the notebooks in place: ``python -m gdptlab [NOTEBOOK ...]``."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import nbformat
import pandas as pd
from nbclient import NotebookClient
from tqdm import tqdm

from gdptlab._files import written_whole

ROOT = Path(__file__).resolve().parents[1]

WIDGET = "application/vnd.jupyter.widget-view+json"


def select(names: Sequence[str], notebooks: Sequence[Path]) -> list[Path]:
    """Find the `notebooks` of these `names` (stem, file name or leading number), in that order, each once."""
    chosen: dict[Path, None] = {}
    for name in names:
        wanted = Path(name).name  # so that a path completed by the shell is fine, too
        fits = [path for path in notebooks if wanted in (path.name, path.stem)]
        if wanted.isdecimal():
            fits += [path for path in notebooks if re.match(rf"0*{int(wanted)}(?!\d)", path.stem)]
        if not fits:
            stems = ", ".join(path.stem for path in notebooks)
            raise ValueError(f"notebook must be one of {stems}, or its leading number; got {name!r}")
        chosen |= dict.fromkeys(fits)
    return list(chosen)


def execute(notebook: Path) -> str:
    """Execute one notebook in its own folder, and write it back if every cell ran.

    Returns
    -------
    str
        Empty, or which cell failed (the notebook's first is 1) and how; then the file is as it was.
    """
    cell = 0

    def count(cell_index: int, **_: object) -> None:
        nonlocal cell
        cell = cell_index + 1

    try:
        document = nbformat.read(notebook, as_version=4)
        metadata = document.metadata.copy()
        # No times, no kernel version and whole streams: running again changes nothing but results.
        NotebookClient(
            document,
            kernel_name="python3",
            extra_arguments=["--log-level=ERROR"],  # not a warning, for each kernel, about local sockets
            on_cell_start=count,
            record_timing=False,
            store_widget_state=False,
            coalesce_streams=True,
        ).execute(cwd=str(notebook.parent))
        document.metadata = metadata
        for part in document.cells:  # a progress bar is no result, and comes back from the file at 0 %
            if part.cell_type == "code":
                part.outputs = [o for o in part.outputs if WIDGET not in o.get("data", {})]
        with written_whole(notebook) as temporary:
            nbformat.write(document, temporary)
    except Exception as error:  # whatever it is, the other notebooks still get their turn
        kind, text = getattr(error, "ename", type(error).__name__), getattr(error, "evalue", error)
        return f"cell {cell}: {kind}: {text}"
    return ""


def run(notebooks: Sequence[Path], figures: Path) -> pd.DataFrame:
    """Execute notebooks in place, one after the other, and watch the folder `figures`.

    Returns
    -------
    pandas.DataFrame
        One row per notebook: ``notebook`` (its stem), ``seconds``, ``figures`` (the files written
        meanwhile, separated by commas), ``error`` (empty, or which cell failed and how).
    """

    def files() -> set[tuple[str, int]]:
        return {(file.name, file.stat().st_mtime_ns) for file in figures.glob("[!.]*")}

    rows = []
    for notebook in (bar := tqdm(notebooks, unit="notebook")):
        bar.set_description(notebook.stem)
        before, start = files(), perf_counter()
        error, seconds = execute(notebook), round(perf_counter() - start, 1)
        rows.append((notebook.stem, seconds, ", ".join(sorted(name for name, _ in files() - before)), error))
    return pd.DataFrame(rows, columns=["notebook", "seconds", "figures", "error"])


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Run the command line; give its exit code: 0, or 1 if a notebook failed."""
    parser = argparse.ArgumentParser(prog="python -m gdptlab", description="Execute the notebooks in place.")
    parser.add_argument("notebook", nargs="*", help="stem, file name or leading number; all if none is named")
    parser.add_argument("--list", action="store_true", help="list the notebooks and leave")
    options = parser.parse_args(arguments)
    notebooks = sorted((root / "notebooks").glob("[!.]*.ipynb"))
    if not notebooks:
        parser.error(f"no notebooks in {root / 'notebooks'}; install from a checkout: pip install -e .")
    try:
        chosen = select(options.notebook, notebooks) or notebooks
    except ValueError as error:
        parser.error(str(error))
    if options.list:
        print("\n".join(path.stem for path in chosen))
        return 0
    table = run(chosen, root / "figures")
    failed = table["error"] != ""
    table["seconds"] = table["seconds"].astype(str).mask(failed, "FAILED")
    print(table.drop(columns="error").to_string(index=False))
    for row in table[failed].itertuples():
        print(f"{row.notebook}, {row.error}", file=sys.stderr)
    return int(failed.any())


if __name__ == "__main__":
    sys.exit(main())
