"""Files: written whole or not at all, images read with care, a folder for what can be computed again."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import tifffile
from numpy.typing import NDArray
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
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path must lie in a folder that exists, got {str(path)!r}")
    # Unique, so that two processes filling one cache do not write into each other's file.
    temporary = path.with_name(f".{path.stem}-{uuid4().hex}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Folder for what can be computed again: GDPTLAB_CACHE of the environment, or else the user's cache."""
    folder = Path(os.environ.get("GDPTLAB_CACHE") or user_cache_path("gdptlab", appauthor=False))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def read_images(path: str | os.PathLike[str]) -> NDArray:
    """Read a TIFF file of one or more images.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    array (n, rows, columns)
        In the file's own type; n is 1 for a single image.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a TIFF, is damaged, or does not hold grey images of one size.
    """
    name = Path(path).name
    try:
        with _errors_raised(tifffile.logger()), tifffile.TiffFile(path) as file:
            pages = len(file.pages)
            sizes = {page.shape for page in file.pages}
            images = file.asarray(key=range(pages))
    except FileNotFoundError:
        raise
    except Exception as error:  # of many kinds, for files that are no TIFF or are damaged
        raise ValueError(f"path: got {name!r}, which cannot be read as a TIFF: {error}") from error
    images = images[None] if images.ndim == 2 else images
    if images.ndim != 3 or len(images) != pages or len(sizes) > 1:
        raise ValueError(f"path: got {name!r} of shape {images.shape}, allowed are grey images of one size")
    return images


@contextmanager
def _errors_raised(logger: logging.Logger) -> Iterator[None]:
    """Raise what is logged as an error: tifffile only logs that a file is cut off, and returns what is left."""

    class Raising(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            raise ValueError(record.getMessage())

    handler = Raising(logging.ERROR)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
