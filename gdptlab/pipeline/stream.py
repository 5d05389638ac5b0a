"""Films too long for memory or for one night: tables on disk, in parts, and runs that go on where they stopped."""

import hashlib
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from tqdm.auto import tqdm

from gdptlab._checks import flag, real_array
from gdptlab._checks import path as check_path
from gdptlab._files import written_whole
from gdptlab.calibration import Calibration
from gdptlab.locate import BLOCK, blank_table, in_blocks, prepared
from gdptlab.pipeline.images import open_images
from gdptlab.pipeline.tables import about, as_json
from gdptlab.preparation import Preparation

NOTE = "_about.json"
"""Name of the file that says how the table was made. What reads folders of Parquet skips names that begin with _."""

PARTS = "_parts.csv"
"""Name of the file that lists the parts that are whole: first frame, frames, bytes of each."""

COMPUTING = ("numpy", "scipy", "opencv-python-headless", "numba")
"""Packages whose version a table depends on, in its last digits."""

LOOKED_AT = 32
"""Number of frames, evenly spread from first to last, whose hash a film is known by. Derived: two films of which a
fraction f of the frames differs are taken for one with a probability of (1 - f)**32, 1e-3 for a fifth; each takes a
few milliseconds to read."""


def batch_to_parquet(
    frames: str | os.PathLike[str] | Sequence[ArrayLike],
    calibration: Calibration,
    folder: str | os.PathLike[str],
    *,
    n_jobs: int = 1,
    progress: bool = True,
    prepare: Preparation | None = None,
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
    n_jobs, progress, prepare, **settings
        As for `batch`. On a dask cluster too the files are written by the process that calls.

    Returns
    -------
    pathlib.Path
        `folder`. In it are a file for each block of frames, named by the first and the last of them; `_parts.csv`,
        which lists them; and `_about.json`: settings, versions, hashes of the calibration, of the package's sources
        and of frames from the whole film, and their number.

    Raises
    ------
    TypeError, ValueError, FileNotFoundError
        As `batch` and `open_images`; also if the folder holds a table made with other frames, settings, calibration
        or software (the message says what differs), or other files.
    """
    shown = flag("progress", progress)
    frames = open_images(frames) if isinstance(frames, str | os.PathLike) else frames
    columns = list(blank_table(calibration, n_jobs, settings))
    frames, prepare = prepared(frames, calibration, prepare)
    done_before = {} if prepare is None else {"prepared": prepare.note()}
    folder = _claimed(folder, about(calibration, settings) | _film(frames) | done_before)
    done = _whole_parts(folder)
    with tqdm(total=len(frames), initial=sum(done.values()), desc="frames", unit="frame", disable=not shown) as bar:
        for first, n, table in in_blocks(frames, calibration, n_jobs, settings, done):
            part = _part(folder, first, n)
            table = table if prepare is None else prepare.restored(table)
            with written_whole(part) as temporary:
                table[columns].to_parquet(temporary, index=False)
                _on_disk(temporary)
            with open(folder / PARTS, "a", encoding="utf-8") as file:
                file.write(f"{first},{n},{part.stat().st_size}\n")
                file.flush()
                os.fsync(file.fileno())
            bar.update(n)
    return folder


def _part(folder: Path, first: int, n: int) -> Path:
    """File of the block of `n` frames that begins with frame `first`."""
    return folder / f"{first:09d}-{first + n - 1:09d}.parquet"


def _on_disk(path: Path) -> None:
    """Wait until a file is on the disk, and would be there after a power failure."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def _whole_parts(folder: Path) -> dict[int, int]:
    """First frame, and number of frames, of each part that is listed and has the size that is listed."""
    done, listed = {}, folder / PARTS
    for line in listed.read_text(encoding="utf-8").splitlines() if listed.exists() else []:
        found = re.fullmatch(r"([0-9]+),([0-9]+),([0-9]+)", line)  # the last line of a run that was killed may be half
        if found:
            first, n, size = map(int, found.groups())
            part = _part(folder, first, n)
            if part.is_file() and part.stat().st_size == size:
                done[first] = n
            else:
                done.pop(first, None)
    return done


def _film(frames: Sequence[ArrayLike]) -> dict[str, object]:
    """What a film is known by: how many frames, in what blocks, and the hash of frames from all of it."""
    try:
        n = len(frames)
        looked = np.unique(np.rint(np.linspace(0, n - 1, LOOKED_AT)).astype(int)).tolist() if n else []
        images = [frames[k] for k in looked]
    except (TypeError, LookupError) as error:
        raise TypeError(
            f"frames: got a {type(frames).__name__}, allowed is a path, or a sequence of arrays that has a length"
        ) from error
    if not images:
        raise ValueError("frames: got none, allowed are one or more")
    digest = hashlib.sha256()
    for image in images:
        image = real_array("frames", image, 2)
        digest.update(f"{image.shape}".encode() + image.tobytes())
    return {"frames": n, "block": BLOCK, "film": digest.hexdigest()}


def _comparable(note: dict[str, object]) -> dict[str, object]:
    """What must be the same for two parts of a table to belong together, of a note of how it was made."""
    return {name: value for name, value in note.items() if name != "versions"} | {
        name: note["versions"].get(name) for name in ("gdptlab", *COMPUTING)
    }


def _claimed(folder: str | os.PathLike[str], note: dict[str, object]) -> Path:
    """Path of the folder, which is new or holds a table that was made as the note says."""
    folder, note = check_path("folder", folder), json.loads(as_json(note))
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
        before = _comparable(json.loads((folder / NOTE).read_text()))
        pairs = [(name, before.get(name), now) for name, now in _comparable(note).items() if before.get(name) != now]
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"folder: got {str(folder)!r}, whose {NOTE} is damaged") from error
    if pairs:
        said = "; ".join(f"{name} {old}, now {new}" for name, old, new in pairs)
        raise ValueError(f"folder: got {str(folder)!r}, whose table was made with {said}: take another folder")
    return folder
