"""Films too long for memory or for one night: tables on disk, in parts, and runs that go on where they stopped."""

import hashlib
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path

from numpy.typing import ArrayLike
from tqdm.auto import tqdm

from gdptlab._checks import real_array
from gdptlab._files import written_whole
from gdptlab.calibration import Calibration
from gdptlab.locate import BLOCK, blank_table, in_blocks
from gdptlab.pipeline.images import open_images
from gdptlab.pipeline.tables import about, as_json

NOTE = "_about.json"
"""Name of the file that says how the table was made. What reads folders of Parquet skips names that begin with _."""


def batch_to_parquet(
    frames: str | os.PathLike[str] | Sequence[ArrayLike],
    calibration: Calibration,
    folder: str | os.PathLike[str],
    *,
    n_jobs: int = 1,
    progress: bool = True,
    **settings: object,
) -> Path:
    """Measure every particle in every frame, as `batch` does, into a folder of Parquet files.

    A run that was stopped, by whatever, is taken up again by the same call: what is there stays, what is missing is
    measured, and the table is the same row for row as that of a run that was not stopped. The call also
    returns at once if nothing is missing. `pandas.read_parquet(folder)` reads the table, or what there is of it.

    Parameters
    ----------
    frames : path, Images, or sequence of arrays (rows, columns)
        Whatever `open_images` opens, or `batch` takes and has a length.
    calibration : Calibration
        The same in each call; keep it with `Calibration.save`.
    folder : str or path-like
        Made if it does not exist; the folder above it must.
    n_jobs, progress, **settings
        As for `batch`. On a dask cluster too the files are written by the process that calls.

    Returns
    -------
    pathlib.Path
        `folder`. In it are a file for each block of frames, named by the first and the last of them, and
        `_about.json`: settings, versions, hash of the calibration, number of frames and hash of the first.

    Raises
    ------
    TypeError, ValueError, FileNotFoundError
        As `batch` and `open_images`; also if the folder holds a table made with other frames, settings, calibration
        or version of gdptlab (the message says what differs), or other files.
    """
    frames = open_images(frames) if isinstance(frames, str | os.PathLike) else frames
    columns = list(blank_table(calibration, n_jobs, settings))
    folder = _claimed(folder, about(calibration, settings) | _film(frames))
    done = {}
    for path in folder.iterdir():
        found = re.fullmatch(r"([0-9]+)-([0-9]+)\.parquet", path.name)
        if found:
            done[int(found[1])] = int(found[2]) - int(found[1]) + 1
    with tqdm(total=len(frames), initial=sum(done.values()), desc="frames", unit="frame", disable=not progress) as bar:
        for first, n, table in in_blocks(frames, calibration, n_jobs, settings, done):
            with written_whole(folder / f"{first:09d}-{first + n - 1:09d}.parquet") as temporary:
                table[columns].to_parquet(temporary, index=False)
            bar.update(n)
    return folder


def _film(frames: Sequence[ArrayLike]) -> dict[str, object]:
    """What a film is known by: how many frames, in what blocks, and which is the first."""
    try:
        n = len(frames)
        first = frames[0] if n else None
    except (TypeError, LookupError) as error:
        raise TypeError(
            f"frames: got a {type(frames).__name__}, allowed is a path, or a sequence of arrays that has a length"
        ) from error
    if first is None:
        raise ValueError("frames: got none, allowed are one or more")
    image = real_array("frames", first, 2)
    pixels = hashlib.sha256(f"{image.shape}".encode() + image.tobytes()).hexdigest()
    return {"frames": n, "block": BLOCK, "first_frame": pixels}


def _claimed(folder: str | os.PathLike[str], note: dict[str, object]) -> Path:
    """Folder, new or of a table that is made as the note says."""
    if not isinstance(folder, str | os.PathLike):
        raise TypeError(f"folder: got a {type(folder).__name__}, allowed is the path of a folder")
    folder, note = Path(folder), json.loads(as_json(note))
    if not folder.parent.is_dir():
        raise FileNotFoundError(f"folder: got {str(folder)!r}, allowed is one in a folder that exists")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"folder: got {str(folder)!r}, which is a file, allowed is a folder")
    folder.mkdir(exist_ok=True)
    if not (folder / NOTE).exists():
        others = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
        if others:
            raise ValueError(f"folder: got {str(folder)!r}, which holds {others[0]!r}, allowed is an empty folder")
        with written_whole(folder / NOTE) as temporary:
            temporary.write_text(as_json(note))
    try:
        before = json.loads((folder / NOTE).read_text())
        differ = [name for name in note if name != "versions" and before[name] != note[name]]
        pairs = [(name, before[name], note[name]) for name in differ]
        if before["versions"]["gdptlab"] != note["versions"]["gdptlab"]:
            pairs.append(("gdptlab", before["versions"]["gdptlab"], note["versions"]["gdptlab"]))
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"folder: got {str(folder)!r}, whose {NOTE} is damaged") from error
    if pairs:
        said = "; ".join(f"{name} {old}, now {new}" for name, old, new in pairs)
        raise ValueError(f"folder: got {str(folder)!r}, whose table was made with {said}: take another folder")
    return folder
