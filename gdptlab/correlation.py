"""Normalised cross-correlation of a frame with many templates, and the peaks of the maps (the paper's Figure 2b to d).

With a window W of the frame and a template T, both n by n pixels and less their means,

    C = sum(W T) / sqrt(sum(W^2) sum(T^2))

(J. P. Lewis, Vision Interface (1995) 120). `Correlator` computes C for every window that lies in the frame: entry
[r, c] of a map belongs to the window whose first pixel is (r, c), so that its centre is (r + n // 2, c + n // 2).
`peaks` then finds the maxima of the maps, between pixels too, and the profile of C_m over the maps at each.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from gdptlab._compiled import compiled, inlined

FLAT = 1e-4
"""Standard deviation of a window, as a fraction of the frame's, below which the window counts as flat and C is 0.
Chosen: rounding in the float32 transform changes C by about 1e-8 over this fraction, which is 1e-4 at the limit."""

BETWEEN = 0.95
"""Fraction of the threshold that a pixel must reach for a peak between pixels to be looked for there. Derived: half a
pixel off in x and y, the templates of the sample stacks keep a correlation of 0.96 or more with themselves at the
resolution of the search. A lower fraction costs time only; a higher one loses peaks at the threshold."""

APART_PX = 2
"""Half-width, px, of the square in which a peak must be the highest pixel. Chosen: the maps are smooth over about two
pixels; with 1 the ripples of noise on one peak count as several, with 3 and more neighbouring particles are lost."""


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


def good_shape(shape: Iterable[int]) -> tuple[int, ...]:
    """Smallest even numbers of rows and columns that are quick to transform and not below those of `shape`."""
    return tuple(2 * cv2.getOptimalDFTSize((n + 1) // 2) for n in shape)


class Correlator:
    """Plan for correlating frames of one shape with a set of templates.

    One Fourier transform of the frame, and one set of local sums, serve all templates. The transforms of the templates
    are kept, and so is the working memory, so that a plan serves one thread at a time.

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
    """Fill `product` (rows, columns) with the upper left part of `image` times `per_norm` (rows, columns)."""
    for r in range(per_norm.shape[0]):
        for c in range(per_norm.shape[1]):
            product[r, c] = image[r, c] * per_norm[r, c]


@compiled
def times_conjugate(image, template, product):  # pragma: no cover
    """Fill `product` with one spectrum times the conjugate of another, several times faster than `cv2.mulSpectrums`."""
    rows, columns = image.shape
    for r in range(rows):
        a, b, c = image[r, 1:], template[r, 1:], product[r, 1:]
        for j in range((columns - 2) // 2):
            re, im = a[2 * j], a[2 * j + 1]
            c[2 * j], c[2 * j + 1] = re * b[2 * j] + im * b[2 * j + 1], im * b[2 * j] - re * b[2 * j + 1]
    for q in (0, columns - 1):  # in these two columns, real and imaginary parts stand in successive rows
        product[0, q] = image[0, q] * template[0, q]
        for r in range(1, rows - 1, 2):
            re, im = image[r, q], image[r + 1, q]
            product[r, q] = re * template[r, q] + im * template[r + 1, q]
            product[r + 1, q] = im * template[r, q] - re * template[r + 1, q]
        product[rows - 1, q] = image[rows - 1, q] * template[rows - 1, q]


def peaks(
    maps: NDArray[np.float32], threshold: float, near: int
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Find the peaks of the highest of some maps.

    Parameters
    ----------
    maps : float32 array (k, rows, columns)
    threshold : float
        The highest pixel of a peak reaches `BETWEEN` times this.
    near : int
        Largest distance, px, of each map's own peak from the peak of the highest. Peaks nearer than this to the rim are
        left out: they might be the flank of a peak outside of the map.

    Returns
    -------
    position : float64 array (n, 2)
        Row and column of the peak, between pixels, of the map that is highest there.
    cm : float32 array (n,)
        Height of that peak.
    profile : float32 array (n, k)
        Height of each map's own peak near it, between pixels.
    """
    highest = maps.max(axis=0)
    at = _peaks(highest, np.float32(BETWEEN * threshold), max(near, 1))
    profile, tops = np.empty((len(at), len(maps)), np.float32), np.empty((len(at), len(maps), 2))
    _read(maps, at, near, profile, tops)
    return tops[np.arange(len(at)), profile.argmax(axis=1)], profile.max(axis=1), profile


def strongest(position: NDArray[np.float64], cm: NDArray, distance_px: float) -> NDArray[np.int64]:
    """Choose the strongest of the candidates that are near to each other.

    Parameters
    ----------
    position : float64 array (n, 2)
        Row and column.
    cm : array (n,)
        Candidates with 0 are left out.
    distance_px : float
        A candidate is left out if a stronger one that stays lies nearer than this.

    Returns
    -------
    int64 array (m,)
        Indices of those that stay, highest C_m first.
    """
    order = np.argsort(-cm, kind="stable")
    return _apart(position, order[cm[order] > 0], min(distance_px, 1e150) ** 2)  # a larger square overflows


@compiled
def _apart(position, order, square):  # pragma: no cover
    """Indices from `order` (n,) without those whose squared distance to an earlier one that stays is below `square`."""
    kept, n = np.empty(len(order), np.int64), 0
    for i in order:
        alone = True
        for k in kept[:n]:
            y, x = position[i, 0] - position[k, 0], position[i, 1] - position[k, 1]
            if y * y + x * x <= square:
                alone = False
                break
        if alone:
            kept[n] = i
            n += 1
    return kept[:n].copy()


@compiled
def _peaks(highest, threshold, rim):  # pragma: no cover
    """Rows and columns (n, 2) of the local maxima of a map at or above `threshold`, `rim` pixels or more inside."""
    rows, columns = highest.shape
    found = []
    for r in range(rim, rows - rim):
        before, row, after = highest[r, rim - 1 :], highest[r, rim:], highest[r, rim + 1 :]
        for q in range(columns - 2 * rim):
            here = row[q]
            if here < threshold or here < before[q] or here < after[q]:
                continue
            c = rim + q
            for y in range(max(r - APART_PX, 0), min(r + APART_PX + 1, rows)):
                around = highest[y, max(c - APART_PX, 0) : c + APART_PX + 1]
                if around.max() > here:
                    break
            else:
                found.append((r, c))
    at = np.empty((len(found), 2), np.int64)
    for i in range(len(found)):
        at[i, 0], at[i, 1] = found[i]
    return at


@inlined
def _parabola(before, here, after):  # pragma: no cover
    """Vertex of the parabola through three values at -1, 0 and 1, and its height above the middle value."""
    bend = before + after - 2 * here
    slope = (after - before) / 2
    if bend >= 0:
        return np.sign(slope) / 2, 0 * slope
    top = -slope / bend
    part = min(max(top, -1), 1)
    return min(max(top, -0.5), 0.5), slope * part + bend * part * part / 2


@compiled
def _read(maps, at, near, profile, tops):  # pragma: no cover
    """Fill `profile` (n, k) and `tops` (n, k, 2) with height and position of each map's peak near `at` (n, 2)."""
    last_row, last_column = maps.shape[1] - 1, maps.shape[2] - 1
    for i in range(len(at)):
        for k in range(len(maps)):
            map_ = maps[k]
            r, c = at[i, 0] - near, at[i, 1] - near
            for y in range(at[i, 0] - near, at[i, 0] + near + 1):
                for x in range(at[i, 1] - near, at[i, 1] + near + 1):
                    if map_[y, x] > map_[r, c]:
                        r, c = y, x
            here = map_[r, c]
            down, rise = _parabola(map_[max(r - 1, 0), c], here, map_[min(r + 1, last_row), c])
            right, more = _parabola(map_[r, max(c - 1, 0)], here, map_[r, min(c + 1, last_column)])
            profile[i, k] = here + rise + more
            tops[i, k, 0], tops[i, k, 1] = r + down, c + right


def vertex(values: NDArray) -> NDArray:
    """Vertex, within -1/2 and 1/2, of the parabolas through three values (n, 3) at -1, 0 and 1; (n,)."""
    before, here, after = values.T
    bend = before + after - 2 * here
    slope = (after - before) / 2
    return np.clip(np.divide(-slope, bend, out=np.sign(slope) / 2, where=bend < 0), -0.5, 0.5)


def standardised(profiles: NDArray) -> NDArray:
    """Rows of (n, k), each less its mean and over its norm: their products are Pearson correlations."""
    centred = profiles - profiles.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(centred, axis=1, keepdims=True)
    return centred / np.where(norm > 0, norm, 1)
