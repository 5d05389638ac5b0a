"""Files: written whole or not at all, and a folder for what can be computed again."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from platformdirs import user_cache_path


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file so that nobody, ever, finds half of it.

    The block writes to the temporary path it is given. When it ends well that file takes the place of
    `path` in one step; when it raises, the temporary file is removed and `path` is as it was.

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
    path = Path(path)
    if path.is_symlink():  # the file it leads to is written, and the link stays
        path = path.resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path must lie in a folder that exists, got {str(path)!r}")
    # Unique, so that two processes filling one cache do not write into each other's file; short, for names have limits.
    temporary = path.with_name(f".{uuid4().hex}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Folder for what can be computed again: GDPTLAB_CACHE of the environment, or else the user's cache."""
    folder = Path(os.environ.get("GDPTLAB_CACHE") or user_cache_path("gdptlab", appauthor=False)).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    return folder
