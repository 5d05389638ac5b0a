"""Normalised cross-correlation of one image with many small templates (Lewis 1995; the paper's Figure 2d).

`Correlator` is the fast kernel, `correlate_plainly` the formula written out, which it is tested against. Both
return the value for every position at which the whole template lies inside the image: entry [r, c] belongs to
the window whose first pixel is (r, c), so its centre is (r + n // 2, c + n // 2) for templates n pixels wide.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from gdptlab._compiled import compiled, inlined

FLAT = 1e-4
"""A window whose contrast is below this fraction of the image's is taken as flat: its correlation is 0."""

BETWEEN = 0.95
"""Fraction of its C_m that a peak between pixels still has at the nearest one, about, at least."""

APART_PX = 2
"""No pixel so near to a peak is higher."""


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
    """Least numbers of rows and columns, none below those of `shape`, that are even and fast to transform."""
    return tuple(2 * cv2.getOptimalDFTSize((n + 1) // 2) for n in shape)


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


def peaks(
    maps: NDArray[np.float32], threshold: float, near: int
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Find the peaks of the highest of some maps.

    Parameters
    ----------
    maps : float32 array (k, rows, columns)
    threshold : float
        A peak reaches `BETWEEN` times this.
    near : int
        How far, in px, each map's own peak may be from it. Nearer to a rim there is no peak: it might be the flank
        of one outside, whose place is unknown.

    Returns
    -------
    place : float64 array (n, 2)
        Row and column of the top of the map that is highest.
    cm : float32 array (n,)
        Height of that top.
    profile : float32 array (n, k)
        Height of each map at its own top, between pixels.
    """
    highest = maps.max(axis=0)
    at = _peaks(highest, np.float32(BETWEEN * threshold), max(near, 1))
    profile, tops = np.empty((len(at), len(maps)), np.float32), np.empty((len(at), len(maps), 2))
    _read(maps, at, near, profile, tops)
    return tops[np.arange(len(at)), profile.argmax(axis=1)], profile.max(axis=1), profile


def strongest(place: NDArray[np.float64], cm: NDArray, distance_px: float) -> NDArray[np.int64]:
    """Indices by falling C_m (n,), without those nearer than this to a stronger one, or with none; of places (n, 2)."""
    order = np.argsort(-cm, kind="stable")
    return _apart(place, order[cm[order] > 0], min(distance_px, 1e150) ** 2)  # of more, the square is no number


@compiled
def _apart(place, order, square):  # pragma: no cover
    kept, n = np.empty(len(order), np.int64), 0
    for i in order:
        alone = True
        for k in kept[:n]:
            y, x = place[i, 0] - place[k, 0], place[i, 1] - place[k, 1]
            if y * y + x * x <= square:
                alone = False
                break
        if alone:
            kept[n] = i
            n += 1
    return kept[:n].copy()


@compiled
def _peaks(highest, threshold, rim):  # pragma: no cover
    """Rows and columns (n, 2) of the local maxima."""
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
    """Where the parabola through three values, at -1, 0 and 1, has its top, and how far that is above the middle."""
    bend = before + after - 2 * here
    slope = (after - before) / 2
    if bend >= 0:
        return np.sign(slope) / 2, 0 * slope
    top = -slope / bend
    part = min(max(top, -1), 1)
    return min(max(top, -0.5), 0.5), slope * part + bend * part * part / 2


@compiled
def _read(maps, at, near, profile, tops):  # pragma: no cover
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
    """Top, within (-1/2, 1/2), of the parabola through three values (n, 3) at -1, 0 and 1."""
    before, here, after = values.T
    bend = before + after - 2 * here
    slope = (after - before) / 2
    return np.clip(np.divide(-slope, bend, out=np.sign(slope) / 2, where=bend < 0), -0.5, 0.5)


def standardised(profiles: NDArray) -> NDArray:
    """Rows with mean 0 and norm 1."""
    centred = profiles - profiles.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(centred, axis=1, keepdims=True)
    return centred / np.where(norm > 0, norm, 1)
