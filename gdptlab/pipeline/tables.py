"""Tables of particles in µm, in files that say how they were made, and as points for other programs."""

import hashlib
import json
import os
from inspect import signature

import numpy as np
import pandas as pd

from gdptlab import _checks as check
from gdptlab._files import sources_digest, written_whole
from gdptlab._versions import versions
from gdptlab.calibration import Calibration, checked
from gdptlab.locate import THRESHOLD, locate

POINTS = ("napari", "imagej")
"""Programs that `save_points` can write for."""


def in_um(table: pd.DataFrame, um_per_px: float) -> pd.DataFrame:
    """Add to every column in px one in µm.

    Parameters
    ----------
    table : DataFrame
        With columns whose names end in `_px`, as from `batch`.
    um_per_px : float
        Size of a pixel in the plane of the particles: that of the camera's over the magnification, such as 6.5 / 10.
        `um_per_px` of `Images`, if the files know it.

    Returns
    -------
    DataFrame
        With `x_um`, `y_um` and so on, after the other columns: those in px times `um_per_px`, so that positions count
        from the centre of the first pixel, too. `z_um` is as it was.

    Raises
    ------
    TypeError, ValueError
        If `table` is no table, or `um_per_px` no number above 0.
    """
    um_per_px = check.positive("um_per_px", um_per_px)
    lengths = [name for name in check.table("table", table, ()) if str(name).endswith("_px")]
    check.table("table", table, lengths)
    return table.assign(**{name.removesuffix("_px") + "_um": um_per_px * table[name] for name in lengths})


def fingerprint(calibration: Calibration) -> str:
    """Hexadecimal SHA-256 of all that a calibration measures with."""
    digest = hashlib.sha256()
    parts = [calibration.stack, calibration.z_um, calibration.subset, calibration.templates]
    if calibration.learned is not None:
        parts += [calibration.learned.patterns, calibration.learned.surface]
    for part in parts:
        digest.update(f"{part.dtype.str}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def about(calibration: Calibration, settings: dict[str, object]) -> dict[str, object]:
    """What a table was made with: hashes of calibration and sources, settings of `locate` and others, versions."""
    checked(calibration)
    unsaid = {name: p.default for name, p in signature(locate).parameters.items() if p.kind is p.KEYWORD_ONLY}
    settings = unsaid | settings
    if settings["method"] == "correlation" and settings["threshold"] is None:
        settings["threshold"] = THRESHOLD
    camera = {} if calibration.camera is None else {"camera": calibration.camera.note()}
    return camera | {
        "calibration": fingerprint(calibration),
        "depth_factor": calibration.depth_factor,
        "settings": settings,
        "sources": sources_digest(),
        "versions": versions(),
    }


def as_json(note: dict[str, object]) -> str:
    """What `about` says, as text.

    Raises
    ------
    TypeError, ValueError
        If a setting is not of a kind that JSON has.
    """
    try:
        return json.dumps(note, indent=1, default=np.generic.item)
    except (TypeError, ValueError) as error:
        raise type(error)(
            f"settings: got {note['settings']!r}, allowed are numbers, words, and lists of them"
        ) from error


def save_table(table: pd.DataFrame, path: str | os.PathLike[str], calibration: Calibration, **settings: object) -> None:
    """Write a table, and beside it, in a file of the same name with `.json` added, how it was made.

    Parameters
    ----------
    table : DataFrame
    path : str or path-like
        Ends in `.csv` or `.parquet`. `pandas.read_csv` and `pandas.read_parquet` read it.
    calibration : Calibration
        What the table was measured with; its hash is noted.
    **settings
        Those of `locate`, and whatever else a reader should know: numbers, words, and lists of them.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form.
    FileNotFoundError
        If there is no such folder.
    """
    path = check.path("path", path, ".csv", ".parquet")
    check.table("table", table, ())
    note = as_json(about(calibration, settings))
    write = table.to_csv if path.suffix == ".csv" else table.to_parquet
    with written_whole(path) as temporary:
        try:
            write(temporary, index=False)
        except (TypeError, ValueError, NotImplementedError) as error:
            raise TypeError(f"table: got a column of a kind that {path.suffix} does not hold: {error}") from error
    with written_whole(path.with_name(path.name + ".json")) as temporary:
        temporary.write_text(note)


def save_points(
    table: pd.DataFrame, path: str | os.PathLike[str], program: str, *, um_per_px: float | None = None
) -> None:
    """Write particles as points that napari or ImageJ opens.

    Parameters
    ----------
    table : DataFrame
        Columns `x_px`, `y_px`, `z_um`; `frame`, if there are several.
    path : str or path-like
        Ends in `.csv`.
    program : str
        "napari": drop the file on the window. Without `um_per_px` the axes are frame, row and column, so that the
        points lie on the frames; with it frame, z, y and x in µm. All other columns become features (to colour by).
        "imagej": a table of results, as from Analyze > Measure, for File > Import > Results. X and Y are in px, or
        in µm with `um_per_px`, and count from the corner of the first pixel, as ImageJ does, not from its centre;
        Slice counts from 1; Z is in µm.
    um_per_px : float, optional
        As for `in_um`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or a column is missing.
    FileNotFoundError
        If there is no such folder.
    """
    path = check.path("path", path, ".csv")
    check.choice("program", program, POINTS)
    check.table("table", table, ("x_px", "y_px", "z_um"))
    scale = 1.0 if um_per_px is None else check.positive("um_per_px", um_per_px)
    frame = table["frame"] if "frame" in table else pd.Series(0, table.index)
    if program == "napari":
        position = [scale * table["y_px"], scale * table["x_px"]]
        axes = [frame, *([] if um_per_px is None else [table["z_um"]]), *position]
        points = {f"axis-{i}": axis for i, axis in enumerate(axes)}
        points |= {name: table[name].astype(float) for name in table if table[name].dtype.kind in "buif"}
        name_of_row, first = "index", 0
    else:
        points = {"X": scale * (table["x_px"] + 0.5), "Y": scale * (table["y_px"] + 0.5), "Z": table["z_um"]}
        points |= {"Slice": frame + 1} | ({"Cm": table["cm"]} if "cm" in table else {})
        name_of_row, first = " ", 1
    with written_whole(path) as temporary:
        points = pd.DataFrame(points).set_axis(range(first, first + len(table)))
        points.to_csv(temporary, index_label=name_of_row)
