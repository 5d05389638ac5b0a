"""Normalised cross-correlation of one image with many small templates (Lewis 1995; the paper's Figure 2d).

`Correlator` is the fast kernel, `correlate_plainly` the formula written out, which it is tested against. Both
return the value for every position at which the whole template lies inside the image: entry [r, c] belongs to
the window whose first pixel is (r, c), so its centre is (r + n // 2, c + n // 2) for templates n pixels wide.
"""

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gdptlab.cores import compiled
from gdptlab.spectra import good_shape, times_conjugate

FLAT = 1e-4
"""A window whose contrast is below this share of the image's is taken as flat: its correlation is 0."""


def normalised(images: NDArray) -> NDArray[np.float32]:
    """Subtract each image's mean and divide by its norm; a flat image becomes zero.

    Parameters
    ----------
    images : array (..., rows, columns)

    Returns
    -------
    float32 array (..., rows, columns)
    """
    centred = images - images.mean(axis=(-2, -1), keepdims=True)
    norm = np.sqrt(np.einsum("...ij,...ij->...", centred, centred))[..., None, None]
    return (centred / np.where(norm > 0, norm, 1)).astype(np.float32)


class Correlator:
    """Plan for correlating frames of one shape with a set of templates.

    One Fourier transform of the frame serves all templates, whose own are kept, and so do its local sums. The
    memory it works in is kept too, so a plan serves one thread at a time.

    Parameters
    ----------
    templates : array (k, n, n)
    shape : (rows, columns)
        Of the frames; no smaller than a template.
    """

    def __init__(self, templates: NDArray, shape: tuple[int, int]) -> None:
        self._n = templates.shape[-1]
        # Wrapping around spoils only positions at which the template would leave the frame.
        self._padded = good_shape(shape)
        self._spectra = [cv2.dft(self._pad(t)) for t in normalised(templates)]
        self._product, self._full = np.empty((2, *self._padded), dtype=np.float32)
        rows, columns = (m - self._n + 1 for m in shape)
        self._maps = np.empty((len(templates), rows, columns), dtype=np.float32)
        self._per_norm = np.empty((rows, columns), dtype=np.float32)

    def _pad(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        rows, columns = (p - n for p, n in zip(self._padded, image.shape, strict=True))
        return cv2.copyMakeBorder(image, 0, rows, 0, columns, cv2.BORDER_CONSTANT, value=0)

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Correlate.

        Parameters
        ----------
        image : float32 array (rows, columns)

        Returns
        -------
        float32 array (k, rows - n + 1, columns - n + 1)
            From -1 to 1; 0 where the image is flat. The next call writes over it.
        """
        image = image - np.float32(cv2.mean(image)[0])
        spectrum = cv2.dft(self._pad(image))
        _fill_per_norm(image, self._n, (FLAT * cv2.meanStdDev(image)[1][0, 0]) ** 2, self._per_norm)
        for map_, template in zip(self._maps, self._spectra, strict=True):
            times_conjugate(spectrum, template, self._product)
            cv2.idft(self._product, self._full, cv2.DFT_REAL_OUTPUT | cv2.DFT_SCALE)
            _multiply(self._full, self._per_norm, map_)
        return self._maps


@compiled
def _fill_per_norm(image, n, flat, per_norm):  # pragma: no cover
    """One over the norm of every n by n window about its own mean; 0 where its variance is at most `flat`.

    Sums over n rows go down the image and sums of those over n columns to the right.
    """
    rows, columns = image.shape
    sums, squares, norms = np.zeros(columns), np.zeros(columns), np.empty(columns - n + 1, np.float32)
    least = np.float32(n * n * flat)
    for r in range(rows):
        row = image[r]
        for c in range(columns):
            sums[c] += row[c]
            squares[c] += np.float64(row[c]) * row[c]
        if r >= n - 1:
            total, square = sums[: n - 1].sum(), squares[: n - 1].sum()
            next_sums, next_squares, out = sums[n - 1 :], squares[n - 1 :], per_norm[r - n + 1]
            for c in range(len(norms)):
                total += next_sums[c]
                square += next_squares[c]
                norms[c] = square - total * total / (n * n)
                total -= sums[c]
                square -= squares[c]
            for c in range(len(norms)):
                out[c] = 1 / np.sqrt(norms[c]) if norms[c] > least else np.float32(0)
            row = image[r - n + 1]
            for c in range(columns):
                sums[c] -= row[c]
                squares[c] -= np.float64(row[c]) * row[c]


@compiled
def _multiply(image, per_norm, product):  # pragma: no cover
    for r in range(per_norm.shape[0]):
        for c in range(per_norm.shape[1]):
            product[r, c] = image[r, c] * per_norm[r, c]


def correlate_plainly(image: NDArray, templates: NDArray) -> NDArray[np.float64]:
    """Normalised cross-correlation by its definition, window by window (slow).

    Parameters
    ----------
    image : array (rows, columns)
    templates : array (k, n, n)

    Returns
    -------
    float64 array (k, rows - n + 1, columns - n + 1)
        From -1 to 1; 0 where image or template is flat.
    """
    windows = sliding_window_view(np.asarray(image, dtype=np.float64), templates.shape[-2:])
    windows = windows - windows.mean(axis=(-2, -1), keepdims=True)
    norm = np.sqrt((windows**2).sum(axis=(-2, -1)))
    templates = templates - templates.mean(axis=(-2, -1), keepdims=True)
    scaled = np.einsum("rcij,kij->krc", windows, templates)
    product = norm * np.sqrt((templates**2).sum(axis=(-2, -1)))[:, None, None]
    return np.divide(scaled, product, out=np.zeros_like(scaled), where=product > 0)
