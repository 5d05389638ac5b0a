"""The noise model: which pixels tell anything, and the variance of those that do.

A pixel's variance is that of read noise, plus photons (a line in the model image), plus the patterns' own error (the
square of the amplitude times the variance of the pattern). The last is not independent from pixel to pixel: it
serves to judge candidates and residuals, never to weigh pixels.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import norm

from gdptlab._compiled import compiled
from gdptlab.denoising import noise_level

ALONE = 3.0
"""A pixel is hot (or dead) if it is above the lowest of its neighbours (below the highest) by more than so many times
what its second highest (lowest) neighbour is. In an image 2 px wide at half height the brightest pixel is so by 3."""

HOT = 8.0
"""And by more than so many standard deviations of the noise."""

PLATEAU = 4
"""Fewest pixels at the highest value for it to be the top of the camera's range."""

LEAST_NOISE = 1e-4
"""Least noise of frames that were computed without noise, as a fraction of the range of their values. Convention:
rounding to 16 bits alone makes a tenth of it in frames that fill the range."""

BINS = 12
"""Bins of the model image in which the variance of the residual is estimated."""


@dataclass(frozen=True)
class Pixels:
    """Which pixels of a frame are used.

    Attributes
    ----------
    valid : bool array (rows, columns)
    saturated, defective : int
        Number of pixels left out: at the top of the camera's range, with their neighbours; hot or dead.
    noise : float
        Standard deviation of a pixel without light.
    filled : float32 array (rows, columns)
        The frame, pixels that are left out replaced by the median around them.
    """

    valid: NDArray[np.bool_]
    saturated: int
    defective: int
    noise: float
    filled: NDArray[np.float32]


def usable_pixels(frame: NDArray[np.float32], noise: float | None = None) -> Pixels:
    """Find the pixels of a frame (rows, columns) that tell something; the `noise` of a pixel if it is known."""
    if noise is None:
        inner = np.percentile(frame[::4, ::4], (1, 99))
        noise = max(noise_level(frame), LEAST_NOISE * float(np.ptp(inner)))
        noise = noise if noise > 1e-15 else 1.0  # a blank frame has none, or one whose square is lost in float32
    filled, defective = frame.copy(), np.zeros(frame.shape, np.bool_)
    _mend(frame, np.float32(HOT * noise), np.float32(ALONE), filled, defective)
    top = filled.max()
    near_top = np.count_nonzero(filled > top - 2 * noise)
    at_top = np.count_nonzero(filled == top)
    saturated = np.zeros(frame.shape, np.bool_)
    if at_top >= PLATEAU and 2 * at_top > near_top and filled.min() < top:
        saturated = cv2.dilate((filled == top).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return Pixels(~(defective | saturated), int(saturated.sum()), int(defective.sum()), noise, filled)


@compiled
def _mend(frame, least, alone, filled, defective):  # pragma: no cover
    """Mark pixels that stand alone, and give them the median of their neighbours.

    A pixel stands alone if all but one of its neighbours are far less above the lowest (or below the highest) of them.
    """
    rows, columns = frame.shape
    around = np.empty(8, np.float32)
    for r in range(rows):
        up, down = max(r - 1, 0), min(r + 1, rows - 1)
        for c in range(columns):
            left, right = max(c - 1, 0), min(c + 1, columns - 1)
            value = frame[r, c]
            # Nearly all pixels are done with here.
            if abs(2 * value - frame[r, left] - frame[r, right]) < least:
                continue
            if abs(2 * value - frame[up, c] - frame[down, c]) < least:
                continue
            count = 0
            for i in range(up, down + 1):
                for j in range(left, right + 1):
                    if i != r or j != c:
                        around[count] = frame[i, j]
                        count += 1
            ordered = np.sort(around[:count])
            middle = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
            hot = value - ordered[0] > least + alone * (ordered[count - 2] - ordered[0])
            dead = ordered[count - 1] - value > least + alone * (ordered[count - 1] - ordered[1])
            if hot or dead:
                filled[r, c], defective[r, c] = middle, True


@dataclass(frozen=True)
class Variance:
    """Variance of a pixel as a line in the model image.

    Attributes
    ----------
    level : float
        Of read noise.
    slope : float
        Of photon noise: counts squared per count of light.
    """

    level: float = 1.0
    slope: float = 0.0

    def weight(self, image: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """One over the variance of each pixel; 0 where it is left out."""
        weight = np.empty_like(image)
        _fill_weight(image, np.float32(self.level), np.float32(self.slope), valid, weight)
        return weight


def learned_variance(image: NDArray[np.float32], residual: NDArray[np.float32], noise: float) -> Variance:
    """Variance as a line in the model image, from the residual, robustly.

    The patterns' own errors grow with the square of the image. That term is fitted, too, but left out.
    """
    image, residual = (np.abs(values[::4, ::4]).ravel() for values in (image, residual))  # enough of them
    rank, dark = np.argsort(image), np.count_nonzero(image == 0)
    # Of few particles, light falls on few pixels.
    parts = [part for part in (rank[:dark], *np.array_split(rank[dark:], BINS - 1)) if len(part) > 50]
    values = np.array([(image[part].mean(), (np.median(residual[part]) / norm.ppf(0.75)) ** 2) for part in parts])
    if len(values) < 4:
        return Variance(noise**2)
    light, variance = values.T
    sure, brightest = 1 / np.maximum(variance, 0.25 * noise**2), max(light.max(), 1e-9)
    terms = (light[:, None] / brightest) ** np.arange(3)
    level, linear, _ = nnls(terms * sure[:, None], variance * sure)[0]
    return Variance(max(level, 0.25 * noise**2), linear / brightest)


@compiled
def _fill_weight(image, level, slope, valid, weight):  # pragma: no cover
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            weight[r, c] = valid[r, c] / (slope * abs(image[r, c]) + level)
