"""The commands ``python -m gdptlab measure`` and ``report``: one's own images, from files to a page."""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from gdptlab.preparation import BACKGROUNDS, Preparation

BAD = 3
"""Exit code after measuring with a calibration that is bad: the results are there, but not to be trusted."""


def add_to(commands: argparse._SubParsersAction) -> None:
    """Add both to a parser's commands; of the options that are parsed, `do` carries them out."""
    add = commands.add_parser
    measures = add(
        "measure",
        help="measure your own images",
        description="Calibrate on a scan of beads, measure a film, and write tables and a page that shows whether to "
        "trust them; with --rate also tracks, velocities and a mean velocity field, for ParaView tracks.pvd and "
        f"field.vtr. A run that was stopped goes on where it was. Exit status: 0; {BAD} if the calibration is bad.",
    )
    measures.set_defaults(do=measure_images)
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
        "--window",
        type=int,
        default=11,
        metavar="N",
        help="measured frames, odd, from which each velocity is taken: more for less noise, fewer where paths bend "
        "(%(default)s)",
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
    reports.set_defaults(do=report_folder)
    reports.add_argument("folder", help="folder of the results")


def measure_images(options: argparse.Namespace) -> int:
    """Measure a film; give the exit code: 0, or `BAD` if the calibration is bad."""
    import matplotlib

    from gdptlab.pipeline.measuring import measure

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
        window=options.window,
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
    from gdptlab.pipeline.images import mean_image

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
    for_paraview = [str(folder / name) for name in ("field.vtr", "tracks.pvd") if (folder / name).exists()]
    if for_paraview:
        print("ParaView:", ", ".join(for_paraview))
    return BAD if (quality["verdict"] == "bad").any() else 0
