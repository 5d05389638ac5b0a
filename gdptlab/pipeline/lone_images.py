"""Images of particles that stand alone in the frames of a film, cut out about their centres; nothing else is known yet.

A particle image is a connected region that stands out of the noise. One that is symmetric under half a turn shows one
particle, or so it seems; its centre is that of the symmetry. What belongs to neighbours is replaced by what the
particle itself shows on the other side of its centre.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from gdptlab._checks import real_array
from gdptlab.denoising import noise_level
from gdptlab.fit.pattern import LARGEST

BLUR_PX = 1.5
"""Standard deviation, px, of the Gaussian filter of the frames in which images are looked for. Chosen: a quarter of the
width of an image in focus, so that it is not lost; it lowers the noise of a pixel by five."""

STANDS_OUT = 6.0
"""Height above the background, in standard deviations of the filtered noise, from which on a pixel belongs to an image.
Derived: of the 7e7 pixels of 250 frames of 512 px
less than one is above 6 by noise alone."""

LEAST_PIXELS = 12
"""Least number of pixels of an image. Derived: the area of the filter itself, 4 pi BLUR_PX^2 / 2."""

SYMMETRIC = 0.97
"""Least correlation of an image with itself, turned by half a turn about its centre. Measured on three of the channel's
films: of regions with one particle's centre 99 to 100 % are above it, with several 9 to 12 %; of those above it, 89 to
92 % have one. The rest is left to the curve."""

WIDE = 99
"""Percentile of the width of lone images that decides how large a piece is cut out. Wide images stand alone less often
than others, and some of the widest are two particles that look symmetric."""

ROOM = 1.25
"""Size of a piece over that width: faint images show less of their width above the noise than bright ones."""

SIZED_FRAMES = 25
"""Number of frames, evenly spread, in which the width is looked for."""

MOST_FRAMES = 250
"""Largest number of frames, evenly spread over a film, in which images are looked for."""

MARGIN_PX = 4
"""Margin, px, about a piece that is moved to its centre: the interpolation reaches 2 px, the move half a pixel."""

THEIRS_PX = 8
"""Distance from a neighbour's region within which light may be the neighbour's, px."""


@dataclass(frozen=True, eq=False)
class LoneImages:
    """Images that stand alone.

    Attributes
    ----------
    images : float32 array (n, size, size)
        Less the background, the particle's centre on the middle pixel.
    table : DataFrame
        A row for each: `frame`, `x_px`, `y_px`.
    noise : float
        Standard deviation of the noise of a pixel of a frame.
    frames : int
        Number of frames that were looked at.
    """

    images: NDArray[np.float32]
    table: pd.DataFrame
    noise: float
    frames: int


def lone_images(frames: Sequence[ArrayLike], size: int | None = None) -> LoneImages:
    """Cut out the images that stand alone.

    Parameters
    ----------
    frames : sequence of arrays (rows, columns)
        With a level background (see `Preparation` if it is not).
    size : int, optional
        Rows and columns of a piece, odd; a little more than the wide images have if not given.
    """
    numbers = np.unique(np.rint(np.linspace(0, len(frames) - 1, MOST_FRAMES)).astype(int))
    some = numbers[:: max(len(numbers) // SIZED_FRAMES, 1)]
    noise = noise_level(np.stack([real_array("frames", frames[k], 2) for k in some]))
    noise = noise or 1e-6 * float(np.ptp(np.asarray(frames[0])))
    if size is None:
        widths = [max(region.extent) for k in some for region in _regions(frames[k], noise)]
        size = min(int(ROOM * np.percentile(widths, WIDE) / 2) * 2 + 3, LARGEST) if widths else 3
    images, rows = [], []
    for k in numbers:
        for region in _regions(frames[k], noise):
            if max(region.extent) <= size:
                images.append(region.cut(size // 2))
                rows.append((k, region.x, region.y))
    table = pd.DataFrame(rows, columns=["frame", "x_px", "y_px"])
    images = np.stack(images) if images else np.zeros((0, size, size), np.float32)
    return LoneImages(images, table, noise, len(numbers))


@dataclass(frozen=True, eq=False)
class _Region:
    """An image in a frame (rows, columns): its number among the labels, its extent (rows, columns) and its centre."""

    frame: NDArray[np.float32]
    labels: NDArray[np.int32]
    number: int
    extent: tuple[int, int]
    y: float
    x: float

    def cut(self, half: int) -> NDArray[np.float32]:
        """Piece (2 half + 1, 2 half + 1) with the centre on its middle pixel."""
        around, (row, column) = half + MARGIN_PX, (round(self.y), round(self.x))
        pieces = [
            _piece(a, row, column, around) for a in (self.frame, self.labels, np.ones(self.frame.shape, np.uint8))
        ]
        image, labels, seen = pieces
        own = labels == self.number
        beside = (
            ndimage.distance_transform_edt(own | (labels == 0))
            if (labels[~own] > 0).any()
            else np.full(own.shape, np.inf)
        )
        theirs = beside < np.minimum(ndimage.distance_transform_edt(~own), THEIRS_PX)
        known = ((seen > 0) & ~theirs).astype(np.float32)
        move = np.array([[1, 0, column - self.x], [0, 1, row - self.y]])
        image, known = (
            cv2.warpAffine(a, move, a.shape, flags=how)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
            for a, how in ((image, cv2.INTER_CUBIC), (known, cv2.INTER_LINEAR))
        )
        known = known > 0.99
        turned = np.where(known[::-1, ::-1], image[::-1, ::-1], 0)
        return np.where(known, image, turned)


def _piece(array: NDArray, row: int, column: int, half: int) -> NDArray:
    """Piece (2 half + 1, 2 half + 1) about a pixel; 0 beyond the frame."""
    padded = np.zeros((2 * half + 1, 2 * half + 1), array.dtype)
    top, left = max(row - half, 0), max(column - half, 0)
    part = array[top : row + half + 1, left : column + half + 1]
    y, x = top - row + half, left - column + half
    padded[y : y + part.shape[0], x : x + part.shape[1]] = part
    return padded


def _regions(frame: ArrayLike, noise: float) -> Iterator[_Region]:
    """Images of a frame that are inside it and symmetric."""
    frame = real_array("frames", frame, 2)
    frame = frame - np.float32(_level(frame))
    smooth = cv2.GaussianBlur(frame, (0, 0), BLUR_PX)
    bright = np.abs(smooth) > STANDS_OUT * noise / (2 * np.sqrt(np.pi) * BLUR_PX)
    labels = cv2.connectedComponents(bright.astype(np.uint8))[1]
    end = np.array(frame.shape)
    for number, box in enumerate(ndimage.find_objects(labels), 1):
        first, last = (np.array([getattr(side, which) for side in box]) for which in ("start", "stop"))
        own = labels[box] == number
        if min(first) == 0 or (last == end).any() or own.sum() < LEAST_PIXELS or max(last - first) > LARGEST:
            continue
        centre, symmetry = _centre(smooth[box] * own)
        if symmetry >= SYMMETRIC:
            yield _Region(frame, labels, number, tuple((last - first).tolist()), *(first + centre).tolist())


def _level(frame: NDArray[np.float32]) -> float:
    """Background, the value that most pixels have: the shortest interval with half, of these half, and so on."""
    values = np.sort(frame[::2, ::2], axis=None)
    while len(values) > 10:
        half = len(values) // 2
        first = int((values[half:] - values[: len(values) - half]).argmin())
        values = values[first : first + half + 1]
    return float(values.mean())


def _centre(image: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
    """Centre (y, x) of the symmetry of an image under half a turn, and the correlation with itself about it."""
    shape = [cv2.getOptimalDFTSize(2 * n + 2) for n in image.shape]
    turned = np.fft.irfft2(np.fft.rfft2(image, shape) ** 2, shape)  # at index 2 c
    row, column = np.unravel_index(turned.argmax(), turned.shape)
    centre = np.array([row, column], float)
    for axis, line in enumerate((turned[:, column], turned[row])):
        k = (row, column)[axis]
        low, middle, high = line[k - 1], line[k], line[(k + 1) % len(line)]
        if low - 2 * middle + high < 0:
            centre[axis] += 0.5 * (low - high) / (low - 2 * middle + high)
    return centre / 2, float(turned.max() / max((image**2).sum(), 1e-30))
