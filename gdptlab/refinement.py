"""Refinement: walk along the stack to the best template, then least squares between pixels and between slices.

Near the pixel and the depth of a template T a window shows

    W = a T(y - dy, x - dx; z + dz) + background of some level and slope.

The model is expanded about the template, to first order in dz and to third order in dy and dx. The products that least
squares needs are prepared for each template, so that a solution costs four products of the window and a few small
numbers. `Displacement.walk` first climbs to the template, and to the pixel, that fits best (the paper's walking
procedure). The kernels are compiled (numba).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from gdptlab._compiled import compiled, inlined

DIFFERENCES = ([1.0], [-0.5, 0.0, 0.5], [1.0, -2.0, 1.0], [-0.5, 1.0, 0.0, -1.0, 0.5])
"""Central differences of order 0 to 3 (Stirling's interpolation formula)."""

CURVED = [(i, j) for i in range(4) for j in range(4) if 2 <= i + j <= 3]
"""Orders along (y, x) of the terms that are not linear."""

ROUNDS = 2
"""Number of times the solution is inserted into the terms that are not linear. Derived: each round gains an order, and
the expansion has three."""

MOST_WINDOWS = 8
"""Largest number of windows that a walk looks at. Most particles need one or two, a few in crowded frames more; the
limit ends walks to and fro between two neighbours."""

AWAY_PX = 0.6
"""Displacement, px, beyond which the walk goes to the next pixel. Derived: more than half a pixel, or particles
half-way between two pixels would be sent to and fro."""


class Displacement:
    """Least-squares displacement of a particle from the middle of a window and the depth of a template.

    Parameters
    ----------
    templates : array (N, n, n)
        Normalised.
    z_um : array (N,)
        Their depths, increasing.

    Attributes
    ----------
    covariance : float64 array (N, 3, 3)
        Of dy, dx (px) and dz (µm), for noise of 1 in each pixel and an amplitude of 1.
    unknowns : int
        Number of unknowns of least squares.
    """

    def __init__(self, templates: NDArray, z_um: NDArray) -> None:
        count, n, _ = templates.shape
        along_z = np.gradient(templates, z_um, axis=0)
        linear = [templates, _difference(templates, 1, 0), _difference(templates, 0, 1), along_z]
        background = [np.broadcast_to(b, templates.shape) for b in (np.ones((n, n)), *np.indices((n, n)) - n // 2)]
        columns = np.stack([c.reshape(count, -1) for c in (*linear, *background)], axis=2)
        rows = np.linalg.pinv(columns)[:, :4]
        self.covariance, self.unknowns = rows[:, 1:] @ rows[:, 1:].transpose(0, 2, 1), columns.shape[2]
        curved = np.stack([_difference(templates, i, j).reshape(count, -1) for i, j in CURVED], axis=2)
        self._rows = np.ascontiguousarray(rows, dtype=np.float32)
        self._curved = rows @ curved
        self._templates = np.ascontiguousarray(templates.reshape(count, -1), dtype=np.float32)

    def __call__(self, image: NDArray[np.float32], first: NDArray, k: NDArray) -> NDArray[np.float64]:
        """Solve for each of some windows.

        Parameters
        ----------
        image : float32 array (rows, columns)
            Its mean is near zero, so that products lose no digits.
        first : int array (m, 2)
            First row and column of each window; all of it lies in the image.
        k : int array (m,)
            Template that each window is compared with.

        Returns
        -------
        float64 array (m, 3)
            dy, dx (px) and dz (µm); 0 where the window shows nothing like the template. They hold up to about a pixel,
            and half-way to the next template.
        """
        shift = np.zeros((len(first), 3))
        _solve(image, first.astype(np.int64), k.astype(np.int64), self._rows, self._curved, ROUNDS, shift)
        return shift

    def walk(
        self, image: NDArray[np.float32], first: NDArray, k: NDArray
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Climb along the templates to the nearest maximum of C_m, and across the pixels to the nearest, then solve.

        Parameters
        ----------
        image, first, k
            As for a call: where the walk begins.

        Returns
        -------
        first : int array (m, 2)
        k : int array (m,)
        cm : float64 array (m,)
            Correlation of that window with that template; 0 where the walk leads out of the image.
        shift : float64 array (m, 3)
            As from a call.
        """
        first, k = first.astype(np.int64), k.astype(np.int64)
        cm, shift = np.zeros(len(first)), np.zeros((len(first), 3))
        _walk(image, first, k, self._templates, self._rows, self._curved, ROUNDS, cm, shift)
        return first, k, cm, shift


def _difference(images: NDArray, order_y: int, order_x: int) -> NDArray:
    """Central differences of images (N, n, n), of these orders along y and x."""
    for axis, order in ((1, order_y), (2, order_x)):
        images = correlate1d(images, DIFFERENCES[order], axis=axis, mode="nearest")
    return images


@inlined
def _dot(a, b):  # pragma: no cover
    """Product of two float32 vectors (n,)."""
    total = np.float32(0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@inlined
def _look(image, top, left, seen):  # pragma: no cover
    """Copy a window, less its mean, into `seen` (n * n,), and return its norm."""
    n = int(np.sqrt(len(seen)))
    total = np.float32(0)
    for r in range(n):
        row, copy = image[top + r, left:], seen[r * n :]
        for c in range(n):  # from 0: an index that cannot be negative is far faster
            copy[c] = row[c]
            total += row[c]
    mean = np.float32(total / len(seen))
    for i in range(len(seen)):
        seen[i] -= mean
    return np.sqrt(_dot(seen, seen))


@inlined
def _displaced(seen, rows, curved, rounds, shift):  # pragma: no cover
    """Fill `shift` (3,) with dy, dx, dz of a window against a template of `rows` (4, n * n), `curved` (4, terms)."""
    products, solution = np.empty(4), np.empty(4)
    for i in range(4):
        products[i] = solution[i] = _dot(rows[i], seen)
    shift[:] = 0
    if products[0] <= 0:
        return
    for _ in range(rounds):
        a = solution[0]
        y, x = min(max(-solution[1] / a, -1), 1), min(max(-solution[2] / a, -1), 1)
        along_y, along_x = (1.0, -y, y * y / 2, -y * (y * y - 1) / 6), (1.0, -x, x * x / 2, -x * (x * x - 1) / 6)
        for i in range(4):
            total, term = 0.0, 0
            for order in range(4):
                for other in range(4):
                    if 2 <= order + other <= 3:
                        total += curved[i, term] * along_y[order] * along_x[other]
                        term += 1
            solution[i] = products[i] - a * total
        if solution[0] <= 0:
            return
    shift[0], shift[1], shift[2] = -solution[1] / solution[0], -solution[2] / solution[0], solution[3] / solution[0]


@compiled
def _solve(image, first, k, rows, curved, rounds, shift):  # pragma: no cover
    """Fill `shift` (m, 3) for the windows at `first` (m, 2), each against its template k."""
    seen = np.empty(rows.shape[2], np.float32)
    for i in range(len(first)):
        _look(image, first[i, 0], first[i, 1], seen)
        _displaced(seen, rows[k[i]], curved[k[i]], rounds, shift[i])


@compiled
def _walk(image, first, k, templates, rows, curved, rounds, cm, shift):  # pragma: no cover
    """Move `first` (m, 2) and `k` (m,) to where each walk ends, and fill `cm` (m,) and `shift` (m, 3)."""
    n, last = int(np.sqrt(templates.shape[1])), len(templates) - 1
    seen = np.empty(n * n, np.float32)
    scores, looked = np.empty(last + 1, np.float32), np.empty(last + 1, np.bool_)
    for i in range(len(first)):
        top, left = first[i]
        for _ in range(MOST_WINDOWS):
            first[i, 0], first[i, 1] = top, left
            norm = _look(image, top, left, seen)
            looked[:] = False
            here, best = -1, k[i]
            while here != best:
                here = best
                for near in (here, here - 1, here + 1):
                    if 0 <= near <= last:
                        if not looked[near]:
                            scores[near], looked[near] = _dot(templates[near], seen), True
                        if scores[near] > scores[best]:
                            best = near
            k[i] = here
            cm[i] = scores[here] / norm if norm > 0 else 0
            _displaced(seen, rows[here], curved[here], rounds, shift[i])
            down = int(np.sign(shift[i, 0])) if abs(shift[i, 0]) > AWAY_PX else 0
            right = int(np.sign(shift[i, 1])) if abs(shift[i, 1]) > AWAY_PX else 0
            if down == 0 and right == 0:
                break
            top, left = top + down, left + right
            if top < 0 or left < 0 or top + n > image.shape[0] or left + n > image.shape[1]:
                cm[i] = 0
                break
