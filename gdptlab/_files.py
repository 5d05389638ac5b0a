"""Files: written whole or not at all, and a folder for what can be computed again."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from uuid import uuid4
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

UNUSED_DAYS = 30.0
"""Age, in days since its last use, at which a cache folder of other sources is removed. Chosen: a folder holds some
10 to 100 MB. 0 would let two versions of the package, used in turn, remove each other's results; without a limit
each edit of the package would leave a folder for ever."""


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file so that nobody, ever, finds half of it.

    The block writes to the temporary path it is given. When the block ends well, the temporary file takes the place
    of `path` in one step; when the block raises, the temporary file is removed and `path` is as it was. If `path` is
    a symbolic link, the file that it points to is replaced, and the link stays.

    Parameters
    ----------
    path : str or path-like
        The file to write. Its folder must exist; none is created.

    Yields
    ------
    pathlib.Path
        A path that does not exist yet, in the same folder and with the same suffix (by which
        many writers choose the format).

    Raises
    ------
    FileNotFoundError
        If the folder of `path` does not exist, or the block wrote nothing.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with written_whole(Path(folder, "z.csv")) as temporary:
    ...         _ = temporary.write_text("z_um")
    ...     [file.name for file in Path(folder).iterdir()]
    ['z.csv']
    """
    path = Path(path).resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path must lie in a folder that exists, got {str(path)!r}")
    # Unique, so that two processes that fill one cache do not write into each other's file; short, since a file
    # system limits a name to some 255 bytes.
    temporary = path.with_name(f".{uuid4().hex}.part{path.suffix[-20:]}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def cache_folder(name: str = "") -> Path | None:
    """Return a folder for what can be computed again, or None where nothing can be written.

    What lies in the folder may be deleted at any time. Its files are this package's own and are trusted as its
    sources are: numba unpickles the machine code that it keeps there.

    Parameters
    ----------
    name : str
        Of a folder inside the cache folder; the cache folder itself if it is empty.

    Returns
    -------
    pathlib.Path or None
        In the folder that the environment variable GDPTLAB_CACHE names, or else in the user's cache folder.
    """
    try:
        named = os.environ.get("GDPTLAB_CACHE")
        folder = (Path(named).expanduser() if named else user_cache_path("gdptlab", appauthor=False)) / name
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return None
    return folder if os.access(folder, os.W_OK) else None


@cache
def sources_digest() -> str:
    """Return 16 hexadecimal digits that change with any source file of the package (10 ms, once for each process)."""
    digest, package = hashlib.sha256(), Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package).as_posix()} {path.stat().st_size} ".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def sources_folder(name: str) -> Path | None:
    """Return a folder in the cache for results of these very sources, or None where nothing can be written.

    Folders of the same name that other sources left are removed once they are unused for `UNUSED_DAYS`.
    """
    folder = cache_folder(f"{name}-{sources_digest()}")
    if folder is None:
        return None
    with suppress(OSError):  # another process may remove the same folders
        os.utime(folder)  # its time tells when it was last used
        for other in folder.parent.glob(f"{name}-*"):
            if other != folder and time.time() - other.stat().st_mtime > UNUSED_DAYS * 86400:
                shutil.rmtree(other, ignore_errors=True)
    return folder


def kept_arrays(path: Path) -> dict[str, NDArray] | None:
    """Return the arrays in an .npz file of the cache by name, or None if the file is missing or damaged."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, BadZipFile, zlib.error):
        return None


def keep_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write arrays to an .npz file of the cache; if that fails, as on a full disk, they are computed again later."""
    with suppress(OSError), written_whole(path) as temporary:
        np.savez_compressed(temporary, **arrays)
