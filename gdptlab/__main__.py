"""The command line: ``python -m gdptlab`` executes the notebooks, ``python -m gdptlab measure`` one's own images."""

from __future__ import annotations

import argparse
import os
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
from gdptlab.pipeline import command

ROOT = Path(__file__).resolve().parents[1]
"""Folder of the checkout."""

COMMANDS = ("run", "sweep", "measure", "report", "-h", "--help")
"""First words of a command line that does not just name notebooks."""

WIDGET = "application/vnd.jupyter.widget-view+json"
"""Type of the output of a widget, such as a progress bar."""


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


def execute(notebook: Path, save: bool = True) -> str:
    """Execute one notebook in its own folder, and with `save` write it back if every cell ran.

    Returns
    -------
    str
        Empty, or which cell failed (the notebook's first is 1) and how; then the file is as it was.
    """
    cell = 0

    def count(cell_index: int, **_: object) -> None:
        """Note which cell is executed."""
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
        ).execute(cwd=str(notebook.parent), env=os.environ | {"GDPTLAB_SAVE": str(int(save))})
        document.metadata = metadata
        for part in document.cells:  # a progress bar is no result, and comes back from the file at 0 %
            if part.cell_type == "code":
                part.outputs = [o for o in part.outputs if WIDGET not in o.get("data", {})]
        if save:
            with written_whole(notebook) as temporary:
                nbformat.write(document, temporary)
    except Exception as error:  # whatever it is, the other notebooks still get their turn
        kind, text = getattr(error, "ename", type(error).__name__), getattr(error, "evalue", error)
        return f"cell {cell}: {kind}: {text}"
    return ""


def run(notebooks: Sequence[Path], figures: Path, save: bool = True) -> pd.DataFrame:
    """Execute notebooks, one after the other, and watch the folder `figures`; with `save`, write them back.

    Returns
    -------
    pandas.DataFrame
        One row per notebook: ``notebook`` (its stem), ``seconds``, ``figures`` (the files written
        meanwhile, separated by commas), ``error`` (empty, or which cell failed and how).
    """

    def files() -> set[tuple[str, int]]:
        """Names of the figures, and when they were written (ns)."""
        return {(file.name, file.stat().st_mtime_ns) for file in figures.rglob("[!.]*.*")}

    rows = []
    for notebook in (bar := tqdm(notebooks, unit="notebook")):
        bar.set_description(notebook.stem)
        before, start = files(), perf_counter()
        error, seconds = execute(notebook, save), round(perf_counter() - start, 1)
        rows.append((notebook.stem, seconds, ", ".join(sorted(name for name, _ in files() - before)), error))
    return pd.DataFrame(rows, columns=["notebook", "seconds", "figures", "error"])


def run_notebooks(options: argparse.Namespace, root: Path) -> int:
    """Execute or list notebooks; give the exit code: 0, or 1 if one failed."""
    notebooks = sorted((root / "notebooks").glob("[!.]*.ipynb"))
    if not notebooks:
        raise ValueError(f"no notebooks in {root / 'notebooks'}; install from a checkout: pip install -e .")
    chosen = select(options.notebook, notebooks) or notebooks
    if options.list:
        print("\n".join(path.stem for path in chosen))
        return 0
    table = run(chosen, root / "figures", options.save)
    failed = table["error"] != ""
    table["seconds"] = table["seconds"].astype(str).mask(failed, "FAILED")
    print(table.drop(columns="error").to_string(index=False))
    for row in table[failed].itertuples():
        print(f"{row.notebook}, {row.error}", file=sys.stderr)
    return int(failed.any())


def _parser() -> argparse.ArgumentParser:
    """Parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gdptlab", description="x, y and z of particles from one camera. Without a command: run all notebooks."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add = commands.add_parser
    runs = add(
        "run", help="execute notebooks", description="Execute the notebooks; what they show is kept with --save."
    )
    runs.add_argument("notebook", nargs="*", help="stem, file name or leading number; all if none is named")
    runs.add_argument("--list", action="store_true", help="list the notebooks and leave")
    runs.add_argument(
        "--save",
        action="store_true",
        help="write outputs into the notebooks, and figures into figures/ (not figures/mine)",
    )
    add("sweep", help="compute the tables of Figure 5 anew", add_help=False)
    command.add_to(commands)
    return parser


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Run the command line; give its exit code: 0; 1 if a notebook failed; `command.BAD` if a calibration is bad."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] not in COMMANDS:
        arguments.insert(0, "run")  # `python -m gdptlab 02 03` runs notebooks
    if arguments[0] == "sweep":
        from gdptlab.experiment import figure5

        return figure5.main(arguments[1:])
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        return run_notebooks(options, root) if options.command == "run" else options.do(options)
    except (TypeError, ValueError, FileNotFoundError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main())
