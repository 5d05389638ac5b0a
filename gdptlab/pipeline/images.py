"""Images in files, read when they are asked for: a film of any length in the memory of a frame."""

import logging
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, Self, overload
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import tifffile
from numpy.typing import ArrayLike, DTypeLike, NDArray

from gdptlab._checks import number, real_array

SUFFIXES = (".tif", ".tiff")
"""Of the files that are looked for in a folder, in lower or upper case."""

UM = {"m": 1e6, "cm": 1e4, "mm": 1e3, "µm": 1.0, "μm": 1.0, "um": 1.0, "micron": 1.0, r"\u00B5m": 1.0, "nm": 1e-3}
"""Units of length that image files use, in µm. (There are two letters µ.)"""

COLOUR = "for a colour image choose the channel with the particles, or the mean of all, and save it as grey"
"""Advice."""


class Images(Sequence):
    """Frames in files, made by `open_images`. What `np.asarray` makes of them is an array (n, rows, columns).

    `images[3]` reads a frame; `images[100:200]` and `images[[5, 2]]` read nothing, and are `Images` again.
    They hold no file open and go to other processes as names of files, which must be found there too.

    Attributes
    ----------
    shape : tuple
        (n, rows, columns).
    dtype : numpy.dtype
        Of the pixels, as in the files.
    um_per_px : float or None
        Size of a pixel in the plane of the particles, if the files (OME-TIFF, ImageJ) say so.
    """

    def __init__(
        self,
        files: Sequence[tuple[Path, bool]],
        places: NDArray[np.int64],
        frame: tuple[tuple[int, int], np.dtype],
        um_per_px: float | None,
    ) -> None:
        # A place is the number of a file, and where in it the image is described or, if the file is raw, begins.
        used, number_of_file = np.unique(places[:, 0], return_inverse=True)
        self._files = [files[i] for i in used]
        self._places = np.stack([number_of_file, places[:, 1]], axis=1)
        self._frame = frame
        self.um_per_px = um_per_px

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self), *self._frame[0]

    @property
    def dtype(self) -> np.dtype:
        return self._frame[1]

    @property
    def names(self) -> list[str]:
        """Name of the file that each image is in."""
        return [self._files[i][0].name for i in self._places[:, 0]]

    def __repr__(self) -> str:
        n, rows, columns = self.shape
        return f"<{n} images of {rows} by {columns} px, {self.dtype}, in {len(self._files)} files>"

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> NDArray: ...

    @overload
    def __getitem__(self, index: slice | ArrayLike) -> Self: ...

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, tuple):
            raise TypeError(f"index: got {index!r}, allowed is one along the images; what is in them is not read yet")
        places = self._places[index]
        if places.ndim == 1:
            return next(iter(type(self)(self._files, places[None], self._frame, self.um_per_px)))
        return type(self)(self._files, places, self._frame, self.um_per_px)

    def __iter__(self) -> Iterator[NDArray]:
        (rows, columns), dtype = self._frame
        for file, places in groupby(self._places.tolist(), lambda place: place[0]):
            path, raw = self._files[file]
            with _opened(path) as tif:
                for _, offset in places:
                    if raw:
                        tif.filehandle.seek(offset)
                        image = tif.filehandle.read_array(tif.byteorder + dtype.char, rows * columns)
                        image = image.reshape(rows, columns).astype(dtype, copy=False)
                    elif offset:
                        tif.filehandle.seek(offset)
                        image = tifffile.TiffPage(tif, index=0).asarray()
                    else:
                        image = _only_image(tif)
                    if (image.shape, image.dtype) != self._frame:
                        raise _refused(path, f"an image of {_described(image)}", f"as in the others {_described(self)}")
                    yield image

    def __array__(self, dtype: DTypeLike = None, copy: bool | None = None) -> NDArray:
        if copy is False:
            raise ValueError("copy: got False, allowed are True and None for images that are still to be read")
        images = np.empty(self.shape, self.dtype if dtype is None else dtype)
        for i, image in enumerate(self):
            images[i] = image
        return images


def open_images(path: str | os.PathLike[str]) -> Images:
    """Open grey images in TIFF files, without reading them yet.

    Arrays of any kind (memory maps, dask arrays, sequences of pims) need no opening: `batch` takes them as they are.

    Parameters
    ----------
    path : str or path-like
        A file of one or more images (OME-TIFF and ImageJ included; a set of OME-TIFFs by any one of them), a folder
        of such files, or a folder and a pattern, as in "film/*_green.tif". Files are sorted by name, numbers in
        it by their value: frame2 before frame10. Where the first holds one image, so must all.

    Returns
    -------
    Images
        A sequence of arrays (rows, columns), of 8 or 16 bit or floating point as in the files. Reading raises
        ValueError where a file is damaged, or its images are not like those of the first.

    Raises
    ------
    TypeError, FileNotFoundError
        If `path` is no path, or there is no such file, or none in the folder.
    ValueError
        If a file is no TIFF, is damaged, or does not hold grey images of one size and type.

    Examples
    --------
    >>> from gdptlab.datasets import DATA
    >>> frames = open_images(DATA / "fluorescent-frames.tif")
    >>> frames.shape, frames[1].dtype
    ((3, 512, 512), dtype('uint16'))
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"path: got a {type(path).__name__}, allowed is the path of a file or a folder")
    paths = _paths(Path(path))
    files, places, frame, um_per_px = [], [], None, None
    for path in paths:
        if any(path == known for known, _ in files):  # of a set of OME-TIFFs
            continue
        with _opened(path) as tif:
            here, um = _frame_of(tif, path), _um_per_px(tif)
            found, raw = _found(tif, path)
        frame, um_per_px = frame or here, um_per_px or um
        if here != frame:
            raise _refused(path, f"another size or type than {paths[0].name!r}", "are images of one size and type")
        if len(paths) > 1 and not files and len(found) == 1:
            # One image in each of perhaps 100 000 files: they are looked at when they are read.
            files = [(path, False) for path in paths]
            places = [(i, 0) for i in range(len(paths))]
            break
        for file, offset in found:
            if not files or files[-1][0] != file:
                files.append((file, raw))
            places.append((len(files) - 1, offset))
    return Images(files, np.array(places, dtype=np.int64), frame, um_per_px)


def open_scan(
    path: str | os.PathLike[str],
    *,
    start_um: float | None = None,
    step_um: float | None = None,
    csv: str | os.PathLike[str] | None = None,
    names: str | None = None,
) -> tuple[Images, NDArray[np.float64]]:
    """Open the images of a calibration scan, and find their depths.

    The depths come from where they begin and the step between two images; from a CSV file; or, if neither is given,
    from the file names, which then should differ in one number.

    Parameters
    ----------
    path
        As for `open_images`.
    start_um, step_um : float, optional
        Depth of the first image, and from each to the next (negative if the scan went down).
    csv : str or path-like, optional
        A table with a column `z_um` and a row for each image, in their order.
    names : str, optional
        A regular expression that finds the depth in a file name as its only group, as in r"_z(-?[0-9.]+)um".

    Returns
    -------
    images : Images
        By increasing depth.
    z_um : float array (n,)

    Raises
    ------
    TypeError, FileNotFoundError, ValueError
        As `open_images`; also if the depths cannot be told for certain, are not finite, or not one for each image.

    Examples
    --------
    >>> from gdptlab.datasets import DATA
    >>> scan, z_um = open_scan(DATA / "fluorescent-calibration.tif", start_um=-50, step_um=2)
    >>> len(scan), float(z_um[0]), float(z_um[-1])
    (51, -50.0, 50.0)
    """
    images = open_images(path)
    given = [name for name, value in (("start_um", start_um), ("csv", csv), ("names", names)) if value is not None]
    if len(given) > 1 or (start_um is None) != (step_um is None):
        raise ValueError("start_um, step_um, csv, names: got too many or too few, allowed are the first two or one")
    if start_um is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            z_um = number("start_um", start_um) + number("step_um", step_um) * np.arange(len(images))
        real_array("start_um, step_um", z_um, 1)
    elif csv is not None:
        z_um = _depths_of_table(csv, len(images))
    else:
        z_um = _depths_of_names(images.names, names)
    order = np.argsort(z_um, kind="stable")
    return images[order], z_um[order]


def _depths_of_table(path: str | os.PathLike[str], n: int) -> NDArray[np.float64]:
    """Column z_um of a CSV file, if it has a number for each of `n` images."""
    try:
        table = pd.read_csv(path)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"csv: got {str(path)!r}, where there is no file") from error
    except Exception as error:  # of many kinds
        raise ValueError(f"csv: got {path!r}, which cannot be read: {error}") from error
    if "z_um" not in table or len(table) != n:
        raise ValueError(
            f"csv: got {len(table)} rows with columns {list(table)}, allowed is a column z_um and a row for each of "
            f"{n} images"
        )
    real_array("csv", table["z_um"], 1)
    return table["z_um"].to_numpy(dtype=np.float64)


def _depths_of_names(files: list[str], pattern: str | None) -> NDArray[np.float64]:
    """The number in which file names differ, or that which a pattern finds."""
    stems = [Path(file).stem for file in files]
    advice = "give names=, a pattern that finds the depth, or start_um= and step_um=, or csv="
    if pattern is not None:
        try:
            found = [re.search(pattern, stem) for stem in stems]
        except (re.error, TypeError) as error:
            raise ValueError(f"names: got {pattern!r}, which is no regular expression: {error}") from error
        lost = [stem for stem, match in zip(stems, found, strict=True) if match is None or len(match.groups()) != 1]
        if lost:
            raise ValueError(f"names: got {pattern!r}, which finds no group, or several, in {lost[0]!r}")
        numbers = [[match[1]] for match in found]
    else:
        numbers = [re.findall(r"[-+]?[0-9]+(?:[.,][0-9]+)?", stem) for stem in stems]
        if len({len(each) for each in numbers}) > 1:
            raise ValueError(f"path: got file names with more and with fewer numbers, as {stems[0]!r}; {advice}")
        columns = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
        if len(columns) != 1:
            raise ValueError(f"path: got file names that differ in {len(columns)} numbers, as {stems[0]!r}; {advice}")
        if all(each.startswith("-") for each in columns[0]):
            raise ValueError(f"path: got file names as {stems[0]!r}, where - may be a hyphen or a minus; {advice}")
        numbers = [[each] for each in columns[0]]
    try:
        z_um = np.array([float(each.replace(",", ".")) for (each,) in numbers])
    except ValueError as error:
        raise ValueError(f"names: got {pattern!r}, which finds what is no number: {error}") from error
    if len(set(z_um)) < len(z_um):
        raise ValueError(f"path: got file names in which depths repeat, as {stems[0]!r}; {advice}")
    return z_um


def _paths(path: Path) -> list[Path]:
    """Files that are meant by a path, in the order of their names."""
    try:
        folder, pattern = (path, "*") if path.is_dir() else (path.parent, path.name)
    except OSError as error:  # a name too long, or a folder that is locked
        raise ValueError(f"path: got {str(path)[:200]!r}, which cannot be looked at: {error.strerror}") from error
    if folder is not path and (path.exists() or not re.search(r"[*?\[]", pattern)):
        if not path.exists():
            raise FileNotFoundError(f"path: got {str(path)!r}, where there is no file")
        return [path]
    found = [p for p in folder.glob(pattern) if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    if not found:
        raise FileNotFoundError(f"path: got {str(path)!r}, where there is no file that ends in {' or '.join(SUFFIXES)}")
    return sorted(found, key=_by_number)


def _by_number(path: Path) -> tuple[list[str | int], str]:
    """A key that sorts frame2 before frame10."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def _found(tif: tifffile.TiffFile, path: Path) -> tuple[list[tuple[Path, int]], bool]:
    """File and place of each image, and whether they lie there raw, one after the other."""
    series = tif.series
    raw = series[0].dataoffset
    if any(len(one.axes.replace("Y", "").replace("X", "").replace("S", "")) > 1 for one in series):
        kind = f"images along the axes {series[0].axes} of lengths {series[0].shape}"
        raise _refused(path, kind, "is one axis, time or depth, beside rows and columns: save a film for each channel")
    plain = len(series) == 1 and raw is not None and not series[0].is_multifile
    if plain:
        n, size = int(np.prod(series[0].shape[:-2])), series[0].keyframe.nbytes
        if raw + n * size > tif.filehandle.size:
            raise _refused(path, f"{n} images in a file that is cut off", "are whole files")
        return [(path, raw + k * size) for k in range(n)], True
    pages = [page for one in series for page in one.pages]
    if None in pages:
        raise _refused(path, "a file that lacks some of its images", "are whole files")
    return [(path.with_name(page.parent.filename), page.offset) for page in pages], False


def _only_image(tif: tifffile.TiffFile) -> NDArray:
    """The image of a file that may hold no other."""
    if len(tif.pages) > 1:
        raise ValueError(f"it holds {len(tif.pages)} images, where the first file holds one")
    return tif.pages[0].asarray()


def _frame_of(tif: tifffile.TiffFile, path: Path) -> tuple[tuple[int, int], np.dtype]:
    """Shape and type of the images of a file, if all are grey and alike."""
    kinds = {(one.keyframe.shape, one.keyframe.dtype) for one in tif.series}
    shape, dtype = min(kinds, key=str)
    if len(shape) == 3 and min(shape[0], shape[2]) in (2, 3, 4):
        raise _refused(path, f"images of shape {shape}", f"are grey images: {COLOUR}")
    if len(kinds) > 1 or len(shape) != 2 or dtype is None or dtype.kind not in "buif":
        raise _refused(path, f"images of shape and type {sorted(kinds, key=str)}", "are grey images of one size")
    return shape, dtype


def _um_per_px(tif: tifffile.TiffFile) -> float | None:
    """Size of a pixel, where OME or ImageJ have noted one that is the same along x and y."""
    sizes = []
    if tif.is_ome:
        pixels = ElementTree.fromstring(tif.ome_metadata).find(".//{*}Pixels")
        for axis in "XY":
            size, unit = pixels.get(f"PhysicalSize{axis}"), UM.get(pixels.get(f"PhysicalSize{axis}Unit", "µm"))
            if size and unit:
                sizes.append(float(size) * unit)
    elif tif.is_imagej:
        unit, tags = UM.get(tif.imagej_metadata.get("unit", "")), tif.pages[0].tags
        for name in ("XResolution", "YResolution"):
            if unit and name in tags and tags[name].value[0]:
                sizes.append(tags[name].value[1] / tags[name].value[0] * unit)
    same = len(sizes) == 2 and sizes[0] > 0 and np.isclose(*sizes, rtol=1e-3)
    return float(sizes[0]) if same else None


def _described(images: NDArray | Images) -> str:
    return f"{images.shape[-2:]} {images.dtype}"


def _refused(path: Path, got: str, allowed: str) -> ValueError:
    return ValueError(f"path: got {path.name!r} with {got}, allowed {allowed}")


@contextmanager
def _opened(path: Path) -> Iterator[tifffile.TiffFile]:
    """A TIFF file; what is wrong with it is a ValueError that names it."""
    try:
        with _errors_raised(tifffile.logger()), tifffile.TiffFile(path) as tif:
            yield tif
    except FileNotFoundError:
        raise
    except Exception as error:  # of many kinds, for files that are no TIFF or are damaged
        if str(error).startswith("path: got"):
            raise
        raise ValueError(f"path: got {path.name!r}, which cannot be read as a TIFF: {error}") from error


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
