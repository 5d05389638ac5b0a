"""Images in files, read when they are asked for: a film of any length in the memory of a frame."""

import logging
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, Self, overload
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import tifffile
from numpy.typing import ArrayLike, DTypeLike, NDArray

from gdptlab._checks import number, real_array, whole
from gdptlab._checks import path as check_path
from gdptlab.pipeline import readers

SUFFIXES = (".tif", ".tiff")
"""Ends of the names of files that are looked for in a folder, in lower or upper case."""

UM = {"m": 1e6, "cm": 1e4, "mm": 1e3, "µm": 1.0, "μm": 1.0, "um": 1.0, "micron": 1.0, r"\u00B5m": 1.0, "nm": 1e-3}
"""Units of length that image files and their names use, in µm. (There are two letters µ.)"""

NUMBER = r"[-+]?[0-9]+(?:[.,][0-9]+)?(?:[eE][-+][0-9]+)?"
"""Regular expression of a number in a file name: with a sign, decimals after a point or a comma, and an exponent."""

RESTING = 0.05
"""Largest step, as a fraction of the largest, of a stage that stands still. Chosen: stages are set to a hundredth of a
step or so, and scans are even."""

MOST_CHANNELS = 7
"""Largest number of channels. ImageJ allows no more; a longer axis that says channel is one of time or depth (files
that tifffile writes for ImageJ, without being told axes, call it channel)."""

STRIDE = 2**32
"""Number of a plane of the next position, in a file that a reader of `readers` opens, less that of the same plane.
Derived: no position has as many."""

COLOUR = "for a colour image choose the channel with the particles, or the mean of all, and save it as grey"
"""Advice in the error about a colour image."""


class File(NamedTuple):
    """A file of images.

    path: absolute. raw: whether its images lie in it one after the other, as numbers. stamp: its size (bytes) and time
    of change (ns) when it was opened; None if it was not looked at then.
    """

    path: Path
    raw: bool
    stamp: tuple[int, int] | None


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
        files: Sequence[File],
        locations: NDArray[np.int64],
        frame: tuple[tuple[int, int], np.dtype],
        um_per_px: float | None,
    ) -> None:
        # A row of locations: number of a file, and where in it an image is described or, if the file is raw, begins.
        used, number_of_file = np.unique(locations[:, 0], return_inverse=True)
        self._files = [files[i] for i in used]
        self._locations = np.stack([number_of_file, locations[:, 1]], axis=1)
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
        return [self._files[i].path.name for i in self._locations[:, 0]]

    @property
    def paths(self) -> list[Path]:
        """Absolute paths of the files, each once."""
        return [file.path for file in self._files]

    def __repr__(self) -> str:
        n, rows, columns = self.shape
        return f"<{n} images of {rows} by {columns} px, {self.dtype}, in {len(self._files)} files>"

    def __len__(self) -> int:
        return len(self._locations)

    @overload
    def __getitem__(self, index: int) -> NDArray: ...

    @overload
    def __getitem__(self, index: slice | ArrayLike) -> Self: ...

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, tuple):
            raise TypeError(f"index: got {index!r}, allowed is one along the images; what is in them is not read yet")
        locations = self._locations[index]
        if locations.ndim == 1:
            return next(iter(type(self)(self._files, locations[None], self._frame, self.um_per_px)))
        return type(self)(self._files, locations, self._frame, self.um_per_px)

    def __iter__(self) -> Iterator[NDArray]:
        (rows, columns), dtype = self._frame
        for file, locations in groupby(self._locations.tolist(), lambda location: location[0]):
            path, raw, stamp = self._files[file]
            if stamp not in (None, _stamp(path)):
                raise ValueError(f"path: got {path.name!r}, which has changed since it was opened: open it again")
            if path.suffix.lower() in readers.PACKAGES:
                numbers = [offset for _, offset in locations]
                with _others_opened(path, numbers[0] // STRIDE) as planes:
                    for image in planes.read(number % STRIDE for number in numbers):
                        if (image.shape, image.dtype) != self._frame:
                            raise _refused(path, f"an image of {_described(image)}", f"are those of {_described(self)}")
                        yield image
                continue
            with _opened(path) as tif:
                for _, offset in locations:
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


def open_images(path: str | os.PathLike[str], *, channel: int | None = None, position: int | None = None) -> Images:
    """Open grey images in TIFF files, or in others that `readers` knows, without reading them yet.

    Arrays of any kind (memory maps, dask arrays, sequences of pims) need no opening: `batch` takes them as they are.

    Parameters
    ----------
    path : str or path-like
        A file of one or more images (OME-TIFF and ImageJ included; a set of OME-TIFFs by any one of them), a folder
        of such files, or a folder and a pattern, as in "film/*_green.tif". Where the first holds one image, so must
        all. Files are sorted by name, numbers in it by their value: frame2 before frame10. Where the names give depths
        (as `open_scan` reads them: z_-50, z_0, z_50) the files are sorted by depth. Or, with ``pip install
        gdptlab[formats]``, one file of Nikon's (.nd2), Zeiss's (.czi) or Leica's (.lif), or a grey video (.avi, .mp4,
        .mov; of one in colour the brightness).
    channel : int, optional
        Number of the channel, from 0, in files that have several.
    position : int, optional
        Number of the position on the slide (scene, image), from 0, in files that have several.

    Returns
    -------
    Images
        A sequence of arrays (rows, columns), of 8 or 16 bit or floating point as in the files. Reading raises
        ValueError where a file is damaged or was changed, or its images are not like those of the first.

    Raises
    ------
    TypeError, FileNotFoundError
        If `path` is no path, or there is no such file, or none in the folder.
    ValueError
        If a file is no TIFF, is damaged, or does not hold grey images of one size and type; if it has several channels
        or positions and none is chosen, or one that it does not have; if an OME-TIFF names files in other folders.

    Examples
    --------
    >>> from gdptlab.datasets import DATA
    >>> frames = open_images(DATA / "fluorescent-frames.tif")
    >>> frames.shape, frames[1].dtype
    ((3, 512, 512), dtype('uint16'))
    """
    path = check_path("path", path)
    chosen = {
        name: None if value is None else whole(name, value, 0, 10_000)
        for name, value in (("channel", channel), ("position", position))
    }
    paths = _paths(path.absolute())
    if paths[0].suffix.lower() in readers.PACKAGES:
        return _others(paths[0], chosen["channel"], chosen["position"])
    number, files, locations, frame, um_per_px = {}, [], [], None, None
    for path in paths:
        if path in number:  # a part of a set of OME-TIFFs
            continue
        with _opened(path) as tif:
            _must_stay_in_folder(tif, path)
            series = _series(tif, path, chosen["position"])
            here, um = _frame_of(series, path), _um_per_px(tif)
            found, raw = _found(tif, series, path, chosen["channel"])
        frame, um_per_px = frame or here, um_per_px or um
        if here != frame:
            raise _refused(path, f"another size or type than {paths[0].name!r}", "are images of one size and type")
        if len(paths) > 1 and not files and len(found) == 1:
            # One image in each of perhaps 100 000 files: they are looked at when they are read.
            files = [File(path, False, None) for path in paths]
            locations = [(i, 0) for i in range(len(paths))]
            break
        for file, offset in found:
            if file not in number:
                number[file] = len(files)
                files.append(File(file, raw, _stamp(file)))
            locations.append((number[file], offset))
    return Images(files, np.array(locations, dtype=np.int64), frame, um_per_px)


def mean_image(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Mean (rows, columns) of all images in a file or a folder, such as those of a dark or a flat exposure.

    Parameters
    ----------
    path
        As for `open_images`.

    Raises
    ------
    TypeError, FileNotFoundError, ValueError
        As `open_images`.
    """
    images = open_images(path)
    total = np.zeros(images.shape[1:])
    for image in images:
        total += image
    return (total / len(images)).astype(np.float32)


def open_scan(
    path: str | os.PathLike[str],
    *,
    start_um: float | None = None,
    step_um: float | None = None,
    csv: str | os.PathLike[str] | None = None,
    names: str | None = None,
    channel: int | None = None,
    position: int | None = None,
) -> tuple[Images | NDArray[np.float32], NDArray[np.float64]]:
    """Open the images of a calibration scan, and find their depths.

    The depths come from where they begin and the step between two images; from a CSV file; or, if neither is given,
    from the file names. These then differ in one number, which is a depth in µm if it follows a z, or has a sign,
    decimals or a unit of length (z_-2.5, z-2,5um, 1500nm, z1e+01).

    Parameters
    ----------
    path
        As for `open_images`.
    start_um, step_um : float, optional
        Depth of the first image, and from each to the next (negative if the scan went down).
    csv : str or path-like, optional
        A table with a column `z_um` and a row for each image, in their order. With semicolons between the columns,
        decimals follow a comma. Images at either end between which the stage stood still are averaged, with a warning.
    names : str, optional
        A regular expression that finds the depth, µm, in a file name as its only group, as in r"_z(-?[0-9.]+)um".
    channel, position : int, optional
        As for `open_images`.

    Returns
    -------
    images : Images
        By increasing depth; an array (n, rows, columns) if some were averaged.
    z_um : float array (n,)

    Raises
    ------
    TypeError, FileNotFoundError, ValueError
        As `open_images`; also if the depths cannot be told for certain, repeat, are not finite, or not one for each
        image.

    Examples
    --------
    >>> from gdptlab.datasets import DATA
    >>> scan, z_um = open_scan(DATA / "fluorescent-calibration.tif", start_um=-50, step_um=2)
    >>> len(scan), float(z_um[0]), float(z_um[-1])
    (51, -50.0, 50.0)
    """
    images = open_images(path, channel=channel, position=position)
    given = [name for name, value in (("start_um", start_um), ("csv", csv), ("names", names)) if value is not None]
    if len(given) > 1 or (start_um is None) != (step_um is None):
        raise ValueError("start_um, step_um, csv, names: got too many or too few, allowed are the first two or one")
    if start_um is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            z_um = number("start_um", start_um) + number("step_um", step_um) * np.arange(len(images))
        real_array("start_um, step_um", z_um, 1)
    elif csv is not None:
        z_um = _depths_of_table(csv, len(images))
        images, z_um = _without_rests(images, z_um)
        _unrepeated("csv", z_um)
    else:
        z_um = _depths_of_names(images.names, names)
    order = np.argsort(z_um, kind="stable")
    return images[order], z_um[order]


def _depths_of_table(path: str | os.PathLike[str], n: int) -> NDArray[np.float64]:
    """Column z_um of a CSV file, if it has a number for each of `n` images: (n,)."""
    path = check_path("csv", path)
    if path.exists() and not path.is_file():  # reading a pipe would wait for ever
        raise ValueError(f"csv: got {path.name!r}, allowed is a file")
    try:
        with open(path, encoding="utf-8-sig") as file:
            european = ";" in file.readline()
        table = pd.read_csv(path, encoding="utf-8-sig", **({"sep": ";", "decimal": ","} if european else {}))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"csv: got {str(path)!r}, where there is no file") from error
    except Exception as error:  # of many kinds
        raise ValueError(f"csv: got {str(path)!r}, which cannot be read: {error}") from error
    if not isinstance(table.index, pd.RangeIndex):
        raise ValueError("csv: got more columns than names of columns, allowed are points as in 1.5, not commas")
    if "z_um" not in table or len(table) != n:
        raise ValueError(
            f"csv: got {len(table)} rows with columns {list(table)}, allowed is a column z_um and a row for each of "
            f"{n} images"
        )
    real_array("csv", table["z_um"], 1)
    return table["z_um"].to_numpy(dtype=np.float64)


def _without_rests(
    images: Images, z_um: NDArray[np.float64]
) -> tuple[Images | NDArray[np.float32], NDArray[np.float64]]:
    """Images and depths (n,); those at which the stage stood still at either end are averaged, with a warning."""
    steps = np.abs(np.diff(z_um))
    moving = np.flatnonzero(steps > RESTING * steps.max(initial=0))
    if not len(moving):
        return images, z_um
    first, last = int(moving[0]), int(moving[-1]) + 1  # the last image before the stage moves, the first after
    if first == 0 and last == len(z_um) - 1:
        return images, z_um
    warnings.warn(
        f"csv: the stage stood still at {z_um[first]:g} µm in {first + 1} images and at {z_um[last]:g} µm in "
        f"{len(z_um) - last}: they are averaged",
        stacklevel=3,
    )
    parts = [slice(0, first + 1), *(slice(k, k + 1) for k in range(first + 1, last)), slice(last, None)]
    mean = np.stack([np.mean(np.asarray(images[part]), axis=0, dtype=np.float64) for part in parts])
    return mean.astype(np.float32), np.array([z_um[part].mean() for part in parts])


def _unrepeated(name: str, z_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return depths (n,) if none of them is there twice."""
    value, count = np.unique(z_um, return_counts=True)
    if (count > 1).any():
        raise ValueError(f"{name}: got the depth {value[count > 1][0]:g} µm {count.max()} times, allowed is once")
    return z_um


def _depths_of_names(files: list[str], pattern: str | None) -> NDArray[np.float64]:
    """Depths (n,) by the number in which file names differ, or by that which a pattern finds."""
    stems = [Path(file).stem for file in files]
    if pattern is None:
        return _unrepeated("path", _depths_of_stems(stems))
    try:
        found = [re.search(pattern, stem) for stem in stems]
    except (re.error, TypeError) as error:
        raise ValueError(f"names: got {pattern!r}, which is no regular expression: {error}") from error
    lost = [stem for stem, match in zip(stems, found, strict=True) if match is None or len(match.groups()) != 1]
    if lost:
        raise ValueError(f"names: got {pattern!r}, which finds no group, or several, in {lost[0]!r}")
    try:
        return _unrepeated("names", np.array([float(match[1].replace(",", ".")) for match in found]))
    except (ValueError, AttributeError) as error:
        if str(error).startswith("names:"):
            raise
        raise ValueError(f"names: got {pattern!r}, which finds what is no number: {error}") from error


def _depths_of_stems(stems: list[str]) -> NDArray[np.float64]:
    """Depths (n,) in µm by the one number in which names differ, if that is certainly a depth."""
    said = f"path: got file names as {stems[0]!r}"
    advice = "give names=, a pattern that finds the depth, or start_um= and step_um=, or csv="
    numbers = [list(re.finditer(NUMBER, stem)) for stem in stems]
    if len({len(each) for each in numbers}) > 1:
        raise ValueError(f"{said}, some with more and some with fewer numbers; {advice}")
    columns = [each for each in zip(*numbers, strict=True) if len({number[0] for number in each}) > 1]
    if len(columns) != 1:
        raise ValueError(f"{said}, which differ in {len(columns)} numbers; {advice}")
    column = columns[0]
    texts = [number[0] for number in column]
    if all(text.startswith("-") for text in texts):
        raise ValueError(f"{said}, where - may be a hyphen or a minus; {advice}")
    units = [_unit_after(number) for number in column]
    signed = any(text[0] in "-+" or not text.isdecimal() for text in texts)
    after_z = all(re.search(r"(?:^|[^a-z])z[ _=]*$", number.string[: number.start()].lower()) for number in column)
    if not (signed or after_z or all(units)):
        raise ValueError(f"{said}, whose numbers may count images or be depths; {advice}")
    if len({bool(unit) for unit in units}) > 1:
        raise ValueError(f"{said}, some with a unit of length and some without; {advice}")
    return np.array([float(text.replace(",", ".")) * (unit or 1) for text, unit in zip(texts, units, strict=True)])


def _unit_after(number: re.Match) -> float | None:
    """Unit of length, in µm, that follows a number in a name; None if none does."""
    letters = re.match(r"[ _]?([a-zµμ]+)(?![a-zµμ])", number.string[number.end() :])
    return UM.get(letters[1]) if letters else None


def _paths(path: Path) -> list[Path]:
    """Files that are meant by an absolute path, in their order."""
    try:
        folder, pattern = (path, "*") if path.is_dir() else (path.parent, path.name)
        if folder is not path and (path.exists() or not re.search(r"[*?\[]", pattern)):
            if not path.exists():
                raise FileNotFoundError(f"path: got {str(path)!r}, where there is no file")
            if not path.is_file():
                raise ValueError(f"path: got {str(path)!r}, which is a device or a pipe, allowed is a file or a folder")
            return [path]
    except OSError as error:  # a name too long, or a folder that is locked
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"path: got {str(path)[:200]!r}, which cannot be looked at: {error.strerror}") from error
    found = [p for p in folder.glob(pattern) if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    found = [p for p in found if p.is_file()]
    if not found:
        raise FileNotFoundError(f"path: got {str(path)!r}, where there is no file that ends in {' or '.join(SUFFIXES)}")
    found.sort(key=_by_number)
    try:
        depths = _depths_of_stems([p.stem for p in found])
    except ValueError:  # the names give no depths, or not for certain
        return found
    return [found[i] for i in np.argsort(depths, kind="stable")]


def _by_number(path: Path) -> tuple[list[str | int], str]:
    """A key that sorts frame2 before frame10."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def _stamp(path: Path) -> tuple[int, int]:
    """Size (bytes) and time of change (ns) of a file."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _must_stay_in_folder(tif: tifffile.TiffFile, path: Path) -> None:
    """Refuse an OME-TIFF that names files in other folders, before they are opened."""
    if tif.is_ome:
        for uuid in ElementTree.fromstring(tif.ome_metadata).iterfind(".//{*}UUID"):
            name = uuid.get("FileName", "")
            if re.search(r"[/\\]", name):
                raise _refused(path, f"images in another folder, {name!r}", "are files of one folder")


def _series(tif: tifffile.TiffFile, path: Path, position: int | None) -> list[tifffile.TiffPageSeries]:
    """Series of images of a file; of an OME-TIFF, where each is a position, the one that was chosen."""
    series = tif.series
    several = len(series) if tif.is_ome else 1
    if position is None and several > 1:
        raise _refused(path, f"{several} positions", f"is one: choose it, position=0 to {several - 1}")
    if position is not None and position >= several:
        raise ValueError(f"position: got {position}, allowed are 0 to {several - 1} in {path.name!r}")
    return series[position or 0 :][:1] if tif.is_ome else series


def _found(
    tif: tifffile.TiffFile, series: list[tifffile.TiffPageSeries], path: Path, channel: int | None
) -> tuple[list[tuple[Path, int]], bool]:
    """File and location of each image of a channel, and whether they lie there raw, one after the other."""
    raw = series[0].dataoffset
    chosen = [_of_channel(one, path, channel) for one in series]
    if len(series) == 1 and raw is not None and not series[0].is_multifile:
        n, size = int(np.prod(series[0].shape[:-2])), series[0].keyframe.nbytes
        if raw + n * size > tif.filehandle.size:
            raise _refused(path, f"{n} images in a file that is cut off", "are whole files")
        return [(path, raw + k * size) for k in chosen[0].tolist()], True
    pages = [one.pages[k] for one, which in zip(series, chosen, strict=True) for k in which.tolist()]
    if None in pages:
        raise _refused(path, "a file that lacks some of its images", "are whole files")
    return [(path.with_name(page.parent.filename), page.offset) for page in pages], False


def _others(path: Path, channel: int | None, position: int | None) -> Images:
    """Images of a file that a reader of `readers` opens."""
    with _others_opened(path, position or 0) as planes:
        if position is None and planes.positions > 1:
            raise _refused(
                path, f"{planes.positions} positions", f"is one: choose it, position=0 to {planes.positions - 1}"
            )
        if position is not None and position >= planes.positions:
            raise ValueError(f"position: got {position}, allowed are 0 to {planes.positions - 1} in {path.name!r}")
        number = _chosen(planes.axes, planes.lengths, path, channel)
        frame = (tuple(planes.shape), planes.dtype)
    if not len(number):
        raise _refused(path, "no images", "are files with some")
    locations = np.stack([np.zeros_like(number), (position or 0) * STRIDE + number], axis=1)
    return Images([File(path, False, _stamp(path))], locations, frame, planes.um_per_px)


@contextmanager
def _others_opened(path: Path, position: int) -> Iterator[readers.Planes]:
    """A file that a reader of `readers` opens; what is wrong with it is a ValueError that names it."""
    try:
        with readers.opened(path, position) as planes:
            yield planes
    except IndexError as error:
        raise ValueError(f"position: got {position}, which is not in {path.name!r}") from error
    except Exception as error:  # of many kinds
        if re.match("(path|channel|position): got", str(error)):
            raise
        raise ValueError(f"path: got {path.name!r}, which cannot be read: {error}") from error


def _of_channel(series: tifffile.TiffPageSeries, path: Path, channel: int | None) -> NDArray[np.int64]:
    """Numbers of the images, in the order of the file, that belong to a channel of a series."""
    axes, shape = series.axes.replace("YX", ""), series.shape[: len(series.axes.replace("YX", ""))]
    if axes == "C" and shape[0] > MOST_CHANNELS:
        axes = "T"
    return _chosen(axes, shape, path, channel)


def _chosen(axes: str, shape: tuple[int, ...], path: Path, channel: int | None) -> NDArray[np.int64]:
    """Numbers of the images of a channel, of all along these axes, if beside it they have one axis."""
    number = np.arange(int(np.prod(shape))).reshape(shape)
    channels = shape[axes.index("C")] if "C" in axes else 1
    if channel is None and channels > 1:
        raise _refused(path, f"{channels} channels", f"is one: choose it, channel=0 to {channels - 1}")
    if channel is not None and channel >= channels:
        raise ValueError(f"channel: got {channel}, allowed are 0 to {channels - 1} in {path.name!r}")
    if "C" in axes:
        number, axes = number.take(channel, axis=axes.index("C")), axes.replace("C", "")
    if sum(n > 1 for n in number.shape) > 1:
        kind = f"images along the axes {axes}YX, of lengths {number.shape}"
        raise _refused(path, kind, "is one axis, time or depth, beside channel, rows and columns")
    return number.ravel()


def _only_image(tif: tifffile.TiffFile) -> NDArray:
    """The image of a file that may hold no other."""
    if len(tif.pages) > 1:
        raise ValueError(f"it holds {len(tif.pages)} images, where the first file holds one")
    return tif.pages[0].asarray()


def _frame_of(series: list[tifffile.TiffPageSeries], path: Path) -> tuple[tuple[int, int], np.dtype]:
    """Shape and type of the images of a file, if all are grey and of one size."""
    kinds = {(one.keyframe.shape, one.keyframe.dtype) for one in series}
    shape, dtype = min(kinds, key=str)
    if len(shape) == 3 and min(shape[0], shape[2]) in (2, 3, 4):
        raise _refused(path, f"images of shape {shape}", f"are grey images: {COLOUR}")
    if len(kinds) > 1 or len(shape) != 2 or dtype is None or dtype.kind not in "buif":
        raise _refused(path, f"images of shape and type {sorted(kinds, key=str)}", "are grey images of one size")
    return shape, dtype


def _um_per_px(tif: tifffile.TiffFile) -> float | None:
    """Size of a pixel in µm, where OME or ImageJ have noted one that is the same along x and y."""
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
    """Shape of an image, and type of its pixels, in words."""
    return f"{images.shape[-2:]} {images.dtype}"


def _refused(path: Path, got: str, allowed: str) -> ValueError:
    """Error that names a file, what it has, and what is allowed."""
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
        if re.match("(path|channel|position): got", str(error)):
            raise
        raise ValueError(f"path: got {path.name!r}, which cannot be read as a TIFF: {error}") from error


@contextmanager
def _errors_raised(logger: logging.Logger) -> Iterator[None]:
    """Raise what is logged as an error: tifffile only logs that a file is cut off, and returns what is left."""

    class Raising(logging.Handler):
        """Handler that raises."""

        def emit(self, record: logging.LogRecord) -> None:
            """Raise ValueError with what is logged."""
            raise ValueError(record.getMessage())

    handler = Raising(logging.ERROR)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
