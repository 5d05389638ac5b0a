"""Pixels that debris or dust covers. They are left out, and the particles about it measured by what else is seen."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

CLEARLY = 8.0
"""Standard deviations by which a pixel's smoothed residual is off where debris is. Chosen between 4 and 12 on frames
with debris and dust: with 4 a twentieth of the frame is left out, images of particles with it; with 12 the rims of
specks stay. Residuals of patterns that are not well known reach 6."""

SMALLEST = 0.01
"""Least area of debris, as a fraction of a template's. Chosen between 0.002 and 0.01 on the same: smaller spots are the
middle of particles whose pattern is not well known."""

NEAR = 0.25
"""Distance, as a fraction of a template, from a row that no pattern explains, within which debris lies. With 0.5 as
much is found, and more particles beside it are lost."""

SMOOTH_PX, ROOM_PX = 1.0, 2
"""Width of the Gaussian that smooths the residual, and rim of debris that is left out with it, px. Convention: the
width of the sharpest images."""


def covered_pixels(
    residual: NDArray[np.float32], places: NDArray[np.float64], before: NDArray[np.bool_], size: float
) -> NDArray[np.bool_]:
    """Find what debris covers: regions in which the residual is far beyond noise, at given places.

    Parameters
    ----------
    residual : float32 array (rows, columns)
        In standard deviations of each pixel.
    places : float64 array (n, 2 or more)
        y, x (px) of rows that no pattern explains.
    before : bool array (rows, columns)
        What debris covered before: it still does where the residual is far beyond noise.
    size : float
        Rows and columns of a template, px.

    Returns
    -------
    bool array (rows, columns)
    """
    at = before.copy()
    for y, x in np.rint(places[:, :2]).astype(int):
        top, left = (max(p - round(NEAR * size), 0) for p in (y, x))
        at[top : max(y + round(NEAR * size) + 1, 0), left : max(x + round(NEAR * size) + 1, 0)] = True
    if not at.any():
        return at
    usual = 1 / (2 * np.sqrt(np.pi) * SMOOTH_PX)  # standard deviation of white noise of 1 that is smoothed
    off = np.abs(cv2.GaussianBlur(residual, (0, 0), SMOOTH_PX)) > CLEARLY * usual
    regions, _ = ndimage.label(off, np.ones((3, 3)))
    large = np.bincount(regions.ravel()) >= SMALLEST * size**2
    large[0] = False  # what is in no region
    there = np.zeros(len(large), bool)
    there[np.unique(regions[at])] = True
    width = 2 * ROOM_PX + 1
    return cv2.dilate((large & there)[regions].astype(np.uint8), np.ones((width, width), np.uint8)) > 0
