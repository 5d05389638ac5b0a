"""A smooth background: the light of a frame that belongs to no particle."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import solve

from gdptlab._compiled import compiled
from gdptlab.fit.renderer import Columns

BOUNDED = 3.0
"""Residuals beyond so many standard deviations pull no harder than these: light not yet explained is no background."""


class Background:
    """Cubic spline surface for frames of one shape.

    Parameters
    ----------
    shape : (rows, columns)
    knot_px : float
        About the distance of its knots, in both directions.
    """

    def __init__(self, shape: tuple[int, int], knot_px: float) -> None:
        self._along = [_splines(n, max(round(n / knot_px), 1)) for n in shape]
        self._pairs, self._where = zip(*(_products_of(b) for b in self._along), strict=True)

    def fit(self, frame: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
        """Fit a frame from which the particles were taken.

        Parameters
        ----------
        frame : float32 array (rows, columns)
        weight : float32 array (rows, columns)
            One over the variance of each pixel; 0 where it says nothing of the background.

        Returns
        -------
        float32 array (rows, columns)
        """
        level = np.median(frame[::4, ::4])
        frame, surface = frame - level, np.float32(0)
        for _ in range(2):
            off = np.abs(frame - surface) * np.sqrt(weight)
            trust = weight * np.minimum(1, BOUNDED / np.maximum(off, BOUNDED))
            surface = self.surface(solve(self.matrix(trust), self.gradient(frame, trust), assume_a="pos"))
        return level + surface

    def gradient(self, residual: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float64]:
        """Right-hand side (B,) of weighted least squares for B coefficients."""
        down, across = self._along
        return (down.T @ (residual * weight) @ across).ravel().astype(np.float64)

    def matrix(self, weight: NDArray[np.float32]) -> NDArray[np.float64]:
        """Matrix (B, B) of weighted least squares."""
        m, n = (along.shape[1] for along in self._along)
        products = np.pad(self._pairs[0].T @ weight @ self._pairs[1], (0, 1))
        down, across = self._where
        matrix = products[down[:, None, :, None], across[None, :, None, :]].reshape(m * n, m * n).astype(np.float64)
        # Where the frame says nothing the surface stays small (in `fit`, near the median), also if that is everywhere.
        # One pixel alone gives a matrix that the rounding errors of its products (6e-8 of the largest) make indefinite.
        diagonal = np.diagonal(matrix)
        matrix[np.diag_indices(m * n)] += max(1e-6 * diagonal.mean(), 2e-7 * diagonal.max()) or 1.0
        return matrix

    def surface(self, coefficients: NDArray) -> NDArray[np.float32]:
        """Surface (rows, columns) with coefficients (B,)."""
        down, across = self._along
        return down @ coefficients.reshape(down.shape[1], -1).astype(np.float32) @ across.T

    def products(self, columns: Columns, weight: NDArray[np.float32]) -> NDArray[np.float64]:
        """Weighted products (4 P, B) of the particles' columns with the splines of the surface."""
        count, (down, across) = len(columns.boxes), self._along
        out = np.zeros((4 * count, down.shape[1] * across.shape[1]))
        self.renew(out, columns, weight, np.ones(count, bool))
        return out

    def renew(
        self, products: NDArray[np.float64], columns: Columns, weight: NDArray[np.float32], moved: NDArray[np.bool_]
    ) -> None:
        """Compute the rows of `products` anew of the particles that `moved` (P,)."""
        down, across = self._along
        rows = (np.ascontiguousarray(along.T) for along in (down, across))
        out = products.reshape(-1, 4, down.shape[1], across.shape[1])
        out[moved] = 0
        _products(columns.boxes, columns.starts, columns.values, weight, *rows, np.flatnonzero(moved), out)


@compiled
def _products(boxes, starts, values, weight, down, across, which, out):  # pragma: no cover
    """`down` (splines, rows) and `across` (splines, columns) as rows, so that the long loops are over pixels."""
    seen = np.empty(across.shape[1], np.float32)
    for i in which:
        y0, y1, x0, x1 = boxes[i]
        if y1 <= y0 or x1 <= x0:
            continue
        width = x1 - x0
        for c in range(4):
            for r in range(y0, y1):
                k = starts[i] + (r - y0) * width
                column, trust = values[c, k:], weight[r, x0:]
                for q in range(width):
                    seen[q] = column[q] * trust[q]
                for b in range(len(across)):
                    if across[b, x0] == 0 and across[b, x1 - 1] == 0:  # few of the splines reach the box
                        continue
                    total, spline = np.float32(0), across[b, x0:]
                    for q in range(width):
                        total += seen[q] * spline[q]
                    for a in range(len(down)):
                        out[i, c, a, b] += down[a, r] * total


def suitable(
    surfaces: list[Background],
    residual: NDArray[np.float32],
    weight: NDArray[np.float32],
    smooth_px: float,
    finer: float,
) -> int:
    """Index of the coarsest of several surfaces, from coarse to fine, that leaves at most `finer` times the finest's.

    Compared is the median size of what is left (rows, columns), smoothed over `smooth_px`: noise is little there, and
    particles that are not found yet are on few pixels.
    """
    left, seen = [], weight > 0
    if not seen.any():
        return 0
    for surface in surfaces:
        smooth = cv2.GaussianBlur(residual - surface.fit(residual, weight), (0, 0), smooth_px)
        left.append(np.median(np.abs(smooth[seen])))
    return int(np.argmax(np.array(left) <= finer * left[-1]))


def _products_of(splines: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Products (n, Q) of splines (n, B) that overlap, and where each pair's stands among them, (B, B); else Q."""
    count = splines.shape[1]
    first, second = np.nonzero(np.triu(np.ones((count, count))) - np.triu(np.ones((count, count)), 4))
    where = np.full((count, count), len(first))
    where[first, second] = where[second, first] = np.arange(len(first))
    return splines[:, first] * splines[:, second], where


def _splines(n: int, spans: int) -> NDArray[np.float32]:
    """Values (n, spans + 3) of cubic B-splines at n pixels."""
    step = n / spans
    knots = -0.5 + step * np.arange(-3, spans + 4)
    return BSpline.design_matrix(np.arange(n), knots, 3).toarray().astype(np.float32)
