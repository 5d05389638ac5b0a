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
from gdptlab.preparation import BACKGROUNDS, Preparation

ROOT = Path(__file__).resolve().parents[1]
"""Folder of the checkout."""

COMMANDS = ("run", "sweep", "measure", "report", "-h", "--help")
"""First words of a command line that does not just name notebooks."""

BAD = 3
"""Exit code after measuring with a calibration that is bad: the results are there, but not to be trusted."""

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


def measure_images(options: argparse.Namespace) -> int:
    """Measure a film; give the exit code: 0, or `BAD` if the calibration is bad."""
    import matplotlib

    from gdptlab.pipeline import measure

    matplotlib.use("Agg")  # pictures go into the page; there may be no screen
    choices = {name: getattr(options, name) for name in ("method", "threshold", "size", "n_sub")}
    measured = measure(
        options.scan,
        options.frames,
        options.out,
        z_um=options.z,
        um_per_px=options.um_per_px,
        frame_rate_hz=options.rate,
        search_range_um=options.search_range,
        cells=tuple(options.cells),
        depth_factor=options.indices or options.depth_factor,
        side=options.side,
        flat_field=options.flat_field,
        prepare=_preparation(options),
        n_jobs=options.jobs,
        **{name: value for name, value in choices.items() if value is not None},
    )
    print(measured.summary())
    return _say(measured.folder, measured.quality)


def _preparation(options: argparse.Namespace) -> Preparation | None:
    """What is to be done to the frames, if anything is."""
    from gdptlab.pipeline import mean_image

    asked = {name: getattr(options, name) for name in ("dark", "flat", "mask", "background")}
    if asked["background"] in BACKGROUNDS:
        images, rest = ("dark", "flat", "mask"), {"background": asked["background"]}
    else:
        images, rest = ("dark", "flat", "mask", "background"), {}
    rest |= {name: mean_image(asked[name]) for name in images if asked[name] is not None}
    if options.region is not None:
        rest["region"] = tuple(options.region)
    if options.frame_range is not None:
        rest["first"], rest["last"] = options.frame_range
    if options.every != 1:
        rest["every"] = options.every
    return Preparation(**rest) if any(value is not None for value in rest.values()) else None


def report_folder(options: argparse.Namespace) -> int:
    """Say what a folder of results holds; give the exit code as `measure_images` does."""
    path = Path(options.folder) / "quality.csv"
    if not path.is_file():
        raise FileNotFoundError(f"folder: got {str(options.folder)!r}, allowed is one that `measure` has finished")
    print(pd.read_csv(Path(options.folder) / "settings.csv", index_col=0).to_string())
    return _say(Path(options.folder), pd.read_csv(path, index_col=0, keep_default_na=False))


def _say(folder: Path, quality: pd.DataFrame) -> int:
    """Print the verdicts on a calibration, and where the page is; give the exit code."""
    for question, row in quality.iterrows():
        print(f"{row['verdict']:5s} {question}: {row['finding']}. {row['advice']}".rstrip())
    print(f"results: {folder}\npage:    {folder / 'report.html'}")
    return BAD if (quality["verdict"] == "bad").any() else 0


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
    measures = add(
        "measure",
        help="measure your own images",
        description="Calibrate on a scan of beads, measure a film, and write tables and a page that shows whether to "
        f"trust them. A run that was stopped goes on where it was. Exit status: 0; {BAD} if the calibration is bad.",
    )
    measures.add_argument("scan", help="TIFF, or folder of TIFFs: beads on a slide, one image for each depth")
    measures.add_argument("frames", help="TIFF, or folder of TIFFs: the film to be measured")
    measures.add_argument(
        "--z",
        nargs=2,
        type=float,
        metavar=("FIRST", "LAST"),
        help="depths of the scan's first and last image, µm; from the file names if not given",
    )
    measures.add_argument(
        "--um-per-px",
        type=float,
        metavar="S",
        help="size of a pixel in the object, µm: the camera's over the magnification; from the files if not given",
    )
    measures.add_argument("--out", metavar="FOLDER", help="folder of the results; beside the film if not given")
    measures.add_argument("--rate", type=float, metavar="HZ", help="frames in a second: then particles are linked")
    measures.add_argument(
        "--search-range",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="how far from where it is expected a particle is looked for in the next frame, µm",
    )
    measures.add_argument(
        "--cells",
        nargs=3,
        type=int,
        default=(8, 8, 3),
        metavar=("X", "Y", "Z"),
        help="cells of the mean velocity field, if particles are linked",
    )
    measures.add_argument(
        "--depth-factor",
        type=float,
        metavar="F",
        help="depth in the sample over travel of the stage, as measured, if the depths of the scan are travel",
    )
    measures.add_argument(
        "--indices",
        nargs=2,
        type=float,
        metavar=("IMMERSION", "SAMPLE"),
        help="refractive indices from which that factor follows, such as 1 1.33 for a dry lens and water",
    )
    measures.add_argument(
        "--side", help="near or far: only depths on this side of focus, smaller or larger, where both look alike"
    )
    measures.add_argument(
        "--flat-field", action="store_true", help="take tilt and curvature of the focal surface from the depths"
    )
    prepares = measures.add_argument_group("what is done to the frames first")
    prepares.add_argument("--dark", metavar="FILE", help="image without light; of several, the mean")
    prepares.add_argument("--flat", metavar="FILE", help="image of even light, without particles; of several, the mean")
    prepares.add_argument(
        "--background",
        metavar="median|minimum|FILE",
        help="subtracted: median or minimum over the film, or an image; takes resting particles away, too",
    )
    prepares.add_argument("--mask", metavar="FILE", help="image that is not 0 where particles are measured")
    prepares.add_argument("--region", nargs=4, type=int, metavar=("LEFT", "TOP", "RIGHT", "BOTTOM"), help="px, from 0")
    prepares.add_argument(
        "--frames", nargs=2, type=int, dest="frame_range", metavar=("FIRST", "LAST"), help="measured, from 0"
    )
    prepares.add_argument("--every", type=int, default=1, metavar="N", help="measure every N-th frame")
    measures.add_argument("--jobs", type=int, default=1, metavar="N", help="processes; -1: one for each core")
    measures.add_argument("--method", help="correlation, or joint for overlapping particles; chosen if not given")
    measures.add_argument("--threshold", type=float, help="least correlation of a particle; chosen if not given")
    measures.add_argument("--size", type=int, help="size of a template, px, odd; chosen if not given")
    measures.add_argument("--n-sub", type=int, help="images of the scan to search with; chosen if not given")
    reports = add("report", help="say what a folder of results holds", description="Say what `measure` found.")
    reports.add_argument("folder", help="folder of the results")
    return parser


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Run the command line; give its exit code: 0; 1 if a notebook failed; `BAD` if a calibration is bad."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] not in COMMANDS:
        arguments.insert(0, "run")  # `python -m gdptlab 02 03` runs notebooks
    if arguments[0] == "sweep":
        from gdptlab.experiment import figure5

        return figure5.main(arguments[1:])
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        if options.command == "measure":
            return measure_images(options)
        return report_folder(options) if options.command == "report" else run_notebooks(options, root)
    except (TypeError, ValueError, FileNotFoundError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main())
