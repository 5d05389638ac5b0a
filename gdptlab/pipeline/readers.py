"""Files of microscope makers, and videos: a thin layer over one reader for each, imported when a file asks for it.

`pip install gdptlab[formats]` brings them. What a file holds is the same to the rest: planes, numbered in the order of
the axes that the reader names, of one position.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

PACKAGES = {".nd2": "nd2", ".czi": "pylibCZIrw", ".lif": "liffile", ".avi": "av", ".mp4": "av", ".mov": "av"}
"""Package that reads files with names that end so."""

GREY = {"gray": np.uint8, "gray10le": np.uint16, "gray12le": np.uint16, "gray16le": np.uint16}
"""Types of the pixels of videos that are grey, by the name of their format."""


class Planes(NamedTuple):
    """What a file holds.

    positions: how many; the rest is of one. axes, lengths: of the planes, as "TZC", without rows and columns.
    shape: (rows, columns). um_per_px: None if it is not noted. read: yields planes of these numbers.
    """

    positions: int
    axes: str
    lengths: tuple[int, ...]
    shape: tuple[int, int]
    dtype: np.dtype
    um_per_px: float | None
    read: Callable[[Iterable[int]], Iterator[NDArray]]


@contextmanager
def opened(path: Path, position: int) -> Iterator[Planes]:
    """Open a file, of whose positions one is to be read.

    Raises
    ------
    ValueError
        If the package that reads it is not installed, or the position is not there.
    """
    package = PACKAGES[path.suffix.lower()]
    openers = {"nd2": _nd2, "pylibCZIrw": _czi, "liffile": _lif, "av": _video}
    try:
        with openers[package](path, position) as planes:
            yield planes
    except ModuleNotFoundError as error:
        raise ValueError(f"it takes the package {package}: pip install {package}") from error


@contextmanager
def _nd2(path: Path, position: int) -> Iterator[Planes]:
    """A file of Nikon's."""
    import nd2

    with nd2.ND2File(path) as file:
        loops = {axis: n for axis, n in file.sizes.items() if axis not in "CYXS"}
        channels, size = file.sizes.get("C", 1), file.voxel_size()
        if file.is_rgb:
            raise ValueError("it is a colour image, allowed are grey ones")
        number = np.arange(int(np.prod([*loops.values()], dtype=int))).reshape(*loops.values())
        if "P" in loops:
            number = number.take(position, axis=[*loops].index("P"))
        frames = number.ravel()

        def read(planes: Iterable[int]) -> Iterator[NDArray]:
            for plane in planes:
                k, channel = divmod(plane, channels)
                yield file.read_frame(int(frames[k])).reshape(channels, *shape)[channel]

        shape = (file.sizes["Y"], file.sizes["X"])
        axes = "".join(axis for axis in loops if axis != "P") + "C"
        lengths = (*number.shape, channels)
        yield Planes(loops.get("P", 1), axes, lengths, shape, np.dtype(file.dtype), _same(size.x, size.y), read)


@contextmanager
def _lif(path: Path, position: int) -> Iterator[Planes]:
    """A file of Leica's, each of whose images is a position."""
    import liffile

    with liffile.LifFile(path) as file:
        image = file.images[position]
        if "S" in image.dims:
            raise ValueError("it is a colour image, allowed are grey ones")
        sizes = {axis: n for axis, n in image.sizes.items() if axis not in "YX"}
        shape = (image.sizes["Y"], image.sizes["X"])
        steps = [1e6 * float(c[1] - c[0]) if c is not None else None for c in map(image.coords.get, "XY")]  # m

        def read(planes: Iterable[int]) -> Iterator[NDArray]:
            for plane in planes:
                index = np.unravel_index(plane, tuple(sizes.values())) if sizes else ()
                yield image.frame(**{axis: int(i) for axis, i in zip(sizes, index, strict=True)})

        yield Planes(
            len(file.images),
            "".join(sizes),
            tuple(sizes.values()),
            shape,
            np.dtype(image.dtype),
            _same(*steps),
            read,
        )


@contextmanager
def _czi(path: Path, position: int) -> Iterator[Planes]:
    """A file of Zeiss's, each of whose scenes is a position."""
    from pylibCZIrw import czi

    with czi.open_czi(str(path)) as file:
        scenes = sorted(file.scenes_bounding_rectangle)
        scene = scenes[position] if scenes else None
        box = {axis: (first, end) for axis, (first, end) in file.total_bounding_box.items() if axis in "TZC"}
        lengths = tuple(end - first for first, end in box.values())
        sample = file.read(plane={axis: first for axis, (first, _) in box.items()}, scene=scene)
        if sample.shape[2] != 1:
            raise ValueError("it is a colour image, allowed are grey ones")

        def read(planes: Iterable[int]) -> Iterator[NDArray]:
            for plane in planes:
                index = np.unravel_index(plane, lengths)
                at = {axis: int(i) + first for (axis, (first, _)), i in zip(box.items(), index, strict=True)}
                yield file.read(plane=at, scene=scene)[..., 0]

        sizes = [
            1e6 * float(value.text)  # m
            for axis in "XY"
            for value in ElementTree.fromstring(file.raw_metadata).iterfind(f".//Scaling//Distance[@Id='{axis}']/Value")
        ]
        scale = _same(*sizes) if len(sizes) == 2 else None
        yield Planes(max(len(scenes), 1), "".join(box), lengths, sample.shape[:2], sample.dtype, scale, read)


@contextmanager
def _video(path: Path, position: int) -> Iterator[Planes]:
    """A video: grey as it is, of a colour video's usual planes the first, its brightness."""
    import av

    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        times = sorted(packet.pts for packet in file.demux(stream) if packet.pts is not None)
        name = stream.pix_fmt
        luma = name.startswith(("yuv", "nv12")) and not name.endswith(("le", "be"))
        if not (luma or name in GREY):
            raise ValueError(f"its pixels are of the format {name}, allowed are grey ones, and yuv of 8 bit")

        def read(planes: Iterable[int]) -> Iterator[NDArray]:
            frames, last = iter(()), None
            for plane in planes:
                if last is None or plane != last + 1:
                    file.seek(times[plane], stream=stream)
                    frames = file.decode(stream)
                frame = next(f for f in frames if f.pts == times[plane])
                last = plane
                yield _brightness(frame) if luma else frame.to_ndarray()

        shape, dtype = (stream.height, stream.width), np.dtype(np.uint8 if luma else GREY[name])
        yield Planes(1, "T", (len(times),), shape, dtype, None, read)


def _brightness(frame: Any) -> NDArray[np.uint8]:
    """First plane (rows, columns) of a frame, whose lines in memory may be longer than the image."""
    plane = frame.planes[0]
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width].copy()


def _same(x_um: float | None, y_um: float | None) -> float | None:
    """Size of a pixel, if it is noted, and the same along x and y."""
    return float(x_um) if x_um and y_um and x_um > 0 and abs(x_um / y_um - 1) < 1e-3 else None
