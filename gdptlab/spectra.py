"""Spectra of real images, as `cv2.dft` packs them into as many numbers as there are pixels.

Rows and columns are even in number. Real and imaginary parts stand side by side, from the second column on; those
of the first and of the last column, where the frequencies along the rows are 0 and highest, one above the other.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from gdptlab.cores import compiled


def good_shape(shape: Iterable[int]) -> tuple[int, ...]:
    """Least numbers of rows and columns, none below those of `shape`, that are even and fast to transform."""
    return tuple(2 * cv2.getOptimalDFTSize((n + 1) // 2) for n in shape)


def smooth_power(spectrum: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Power of a spectrum, (rows, columns / 2 + 1), smoothed over `sigma` frequency steps."""
    squares = spectrum**2
    inner = squares[:, 1:-1:2] + squares[:, 2:-1:2]
    # The outermost columns are packed in another way; their neighbours stand in for them.
    return gaussian_filter(np.pad(inner, ((0, 0), (1, 1)), mode="edge"), sigma, mode=("wrap", "nearest"))


def packed(half: NDArray[np.float32]) -> NDArray[np.float32]:
    """Factors (rows, columns / 2 + 1) of a spectrum in OpenCV's order."""
    out = np.repeat(half[:, 1:], 2, axis=1)
    rows = (np.arange(len(half)) + 1) // 2
    return np.column_stack([half[rows, 0], out[:, :-2], half[rows, -1]])


@compiled
def times_conjugate(image, template, product):  # pragma: no cover
    """Fill `product` with one spectrum times the conjugate of another, several times faster than `cv2.mulSpectrums`."""
    rows, columns = image.shape
    for r in range(rows):
        a, b, c = image[r, 1:], template[r, 1:], product[r, 1:]
        for j in range((columns - 2) // 2):
            re, im = a[2 * j], a[2 * j + 1]
            c[2 * j], c[2 * j + 1] = re * b[2 * j] + im * b[2 * j + 1], im * b[2 * j] - re * b[2 * j + 1]
    for q in (0, columns - 1):  # of their frequencies, each other's conjugates are packed in pairs of rows
        product[0, q] = image[0, q] * template[0, q]
        for r in range(1, rows - 1, 2):
            re, im = image[r, q], image[r + 1, q]
            product[r, q] = re * template[r, q] + im * template[r + 1, q]
            product[r + 1, q] = im * template[r, q] - re * template[r + 1, q]
        product[rows - 1, q] = image[rows - 1, q] * template[rows - 1, q]
