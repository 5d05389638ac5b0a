"""Refinement: walk along the stack to the best template, then least squares between pixels and between slices.

Near the pixel and the depth of a template T a window shows

    W = a T(y - dy, x - dx; z + dz) + background of some level and slope.

The model is expanded about the template, to first order in dz and to third order in dy and dx. The products that least
squares needs are prepared for each template, so that a solution costs four products of the window and a few small
numbers. `Displacement.refine` first finds the template, and the pixel, that fits best: by a walk along the stack (the
paper's walking procedure), which ends at the nearest maximum of C_m. Plain defocus and rings have several, so that
there, where the stack resembles itself at distant depths (`RISE`), a window is compared with all templates instead. The
kernels are compiled (numba).
"""

from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
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

RISE = 0.3
"""Rise of the correlation of one template with the others, after its fall, above which a window is compared with all
templates instead of walking (`largest_rise`). Chosen: our astigmatic stacks rise by 0.22 at most, and a walk ends where
a comparison does; without a cylindrical lens by 0.32, a measured astigmatic bead by 0.41 to 0.44, rings by up to 1.1,
beads without astigmatism (planar) by 0.82 to 0.87, where a walk ends at a wrong slice in four of ten windows. By
comparison a frame takes some four times as long."""

AROUND_PX = 2
"""Half-width, px, of the square of windows that are compared with all templates. Chosen: with 1, slices of rings
scatter by up to 1.9 times those of a full comparison; with 3, as with 2."""

PARTS = 10
"""Number of points in a pixel at which C_m is interpolated. Derived: the maximum is then off by a twentieth of a pixel,
which least squares mends."""

RANK_ERROR = 1e-4
"""Largest part of a template's square that is not in the singular images with which windows are compared. Chosen on 936
windows of the planar beads: 7 end at a wrong slice, 10 with 1e-3, 58 with 1e-2."""


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
        self._singular = _singular(self._templates) if largest_rise(self._templates) > RISE else None

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

    def refine(
        self, image: NDArray[np.float32], first: NDArray, k: NDArray
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Find the template and the pixel with the highest C_m, then solve.

        That is the nearest maximum along the templates, and across the pixels, or of all templates, if the stack
        resembles itself at distant depths.

        Parameters
        ----------
        image, first, k
            As for a call: where the search begins.

        Returns
        -------
        first : int array (m, 2)
        k : int array (m,)
        cm : float64 array (m,)
            Correlation of that window with that template; 0 where the search leads out of the image.
        shift : float64 array (m, 3)
            As from a call.
        """
        if self._singular is not None:
            first, k = self._best(image, first)
        first, k = first.astype(np.int64), k.astype(np.int64)
        cm, shift = np.zeros(len(first)), np.zeros((len(first), 3))
        if self._singular is None:
            _walk(image, first, k, self._templates, self._rows, self._curved, ROUNDS, cm, shift)
        else:
            _measure(image, first, k, self._templates, self._rows, self._curved, ROUNDS, cm, shift)
        return first, k, cm, shift

    def _best(self, image: NDArray[np.float32], first: NDArray) -> tuple[NDArray, NDArray]:
        """Windows (m, 2) and templates (m,) of the highest C_m, between pixels, about windows at `first` (m, 2)."""
        n, k, best = int(np.sqrt(self._templates.shape[1])), np.zeros(len(first), np.int64), first.astype(np.int64)
        last = np.array(image.shape) - n
        for i in range(len(first)):
            for _ in range(MOST_WINDOWS // AROUND_PX):
                at = best[i].copy()
                low, high = np.maximum(at - AROUND_PX, 0), np.minimum(at + AROUND_PX, last)
                height, top = _highest(self._compared(image[low[0] : high[0] + n, low[1] : high[1] + n], n))
                k[i] = height.argmax()
                best[i] = np.clip(low + np.rint(top[k[i]]).astype(np.int64), 0, last)
                if (np.abs(best[i] - at) < AROUND_PX).all():
                    break
        return best, k

    def _compared(self, part: NDArray[np.float32], n: int) -> NDArray[np.float32]:
        """C_m of all templates (N, rows - n + 1, columns - n + 1) in a small part of an image (rows, columns)."""
        windows = sliding_window_view(part - part.mean(), (n, n))
        shape, windows = windows.shape[:2], windows.reshape(-1, n * n)
        square = np.einsum("wi,wi->w", windows, windows) - windows.sum(axis=1) ** 2 / (n * n)
        images, coefficients = self._singular
        products = coefficients @ (windows @ images).T
        return (products / np.sqrt(np.where(square > 0, square, np.inf))).reshape(-1, *shape)


def largest_rise(templates: NDArray) -> float:
    """Largest rise of the correlation of one template (N, n * n) with the others, going away from it, after its fall.

    0 if the correlation falls from each template on to both ends of the stack.
    """
    similarity, rise = templates @ templates.T, 0.0
    for k, row in enumerate(similarity):
        for along in (row[k:], row[k::-1]):
            rise = max(rise, float((along - np.minimum.accumulate(along)).max()))
    return rise


def _highest(maps: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Largest value (N,) and its row and column (N, 2), between pixels, of each of some small maps."""
    (down, rows), (across, columns) = (_spline(n) for n in maps.shape[1:])
    fine = (down @ maps @ across.T).reshape(len(maps), -1)
    top = fine.argmax(axis=1)
    y, x = np.unravel_index(top, (len(rows), len(columns)))
    return fine[np.arange(len(fine)), top], np.stack([rows[y], columns[x]], axis=1)


@lru_cache
def _spline(n: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Matrix (m, n) from n values to their spline, cubic if there are enough, at m points; the points (m,)."""
    points = np.linspace(0, n - 1, PARTS * (n - 1) + 1)
    return make_interp_spline(np.arange(n), np.eye(n), k=min(3, n - 1))(points).astype(np.float32), points


def _singular(templates: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Leading singular images (n * n, K) of templates (N, n * n), and the templates' coefficients (N, K)."""
    u, s, images = np.linalg.svd(templates, full_matrices=False)
    coefficients = u * s
    left = 1 - np.cumsum(coefficients**2, axis=1).min(axis=0)
    rank = 1 + int(np.argmax(left < RANK_ERROR))
    return np.ascontiguousarray(images[:rank].T), np.ascontiguousarray(coefficients[:, :rank])


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


@compiled
def _measure(image, first, k, templates, rows, curved, rounds, cm, shift):  # pragma: no cover
    """Fill `cm` (m,) and `shift` (m, 3) for the windows at `first` (m, 2), each against its template k."""
    n = int(np.sqrt(templates.shape[1]))
    seen = np.empty(n * n, np.float32)
    for i in range(len(first)):
        norm = _look(image, first[i, 0], first[i, 1], seen)
        cm[i] = _dot(templates[k[i]], seen) / norm if norm > 0 else 0
        _displaced(seen, rows[k[i]], curved[k[i]], rounds, shift[i])
        for axis in range(2):
            moved = first[i, axis] + np.sign(shift[i, axis])
            if abs(shift[i, axis]) > AWAY_PX and (moved < 0 or moved + n > image.shape[axis]):
                cm[i] = 0
