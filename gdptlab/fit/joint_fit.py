"""Gauss-Newton fit of all particles of a frame, and of the background, at once.

Unknown are y, x, step along the stack and brightness of each particle, and the coefficients of the background.
Particles whose images do not meet have nothing to do with each other, so that, sorted by x, the matrix is a
narrow band with the few rows of the background as a border. Brightness is drawn to that of the others.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from gdptlab._compiled import compiled
from gdptlab.fit.background import Background
from gdptlab.fit.renderer import Columns, ParticleImages

LONGEST_STEP = np.array([1.5, 1.5, 1.5, 0.2])
"""Of y, x (px), step along the stack and brightness, its share."""

DAMPING = 1e-3
"""Share by which the diagonal is raised (Levenberg)."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of `fitted`.

    Attributes
    ----------
    places : float64 array (P, 4 or more)
        y, x (px), step along the stack, brightness; what else they were given with.
    residual, light, behind : float32 arrays (rows, columns)
        What is not explained; what the particles explain; the background.
    explains : float64 array (P,)
        By how much each particle lowers the squares of the residual beside the others, in units of what it
        would alone: 1 for a particle, 0 or less for one that should not be.
    chi2 : float64 array (P,)
        Mean square of the residual around each particle, over its variance.
    std : float64 array (P, 3)
        Standard deviations of y, x and step from the inverse of the matrix (the Cramér-Rao bound).
    cm : float64 array (P,)
        Correlation of each particle's image with what the others leave of the frame.
    """

    places: NDArray[np.float64]
    residual: NDArray[np.float32]
    light: NDArray[np.float32]
    behind: NDArray[np.float32] | np.float32
    explains: NDArray[np.float64]
    _order: NDArray[np.int64]
    _columns: Columns
    _system: "_System"
    _chi2: NDArray[np.float64]

    @property
    def chi2(self) -> NDArray[np.float64]:
        return self._in_order(self._chi2 / np.maximum(np.diff(self._columns.starts), 1))

    @property
    def std(self) -> NDArray[np.float64]:
        return self._in_order(np.sqrt(self._system.variances().reshape(-1, 4)[:, :3]))

    @property
    def cm(self) -> NDArray[np.float64]:
        c = self._columns
        return self._in_order(_correlations(self.residual, self.places[self._order, 3], c.boxes, c.starts, c.values))

    def _in_order(self, values: NDArray) -> NDArray:
        out = np.empty_like(values)
        out[self._order] = values
        return out


def fitted(
    shapes: ParticleImages,
    frame: NDArray[np.float32],
    places: NDArray[np.float64],
    weight: NDArray[np.float32],
    *,
    brightness: float,
    spread: float,
    steps: int,
    surface: Background | None = None,
    behind: NDArray[np.float32] | None = None,
    near: bool = False,
) -> JointFit:
    """Fit particles from where they are about.

    Parameters
    ----------
    shapes : ParticleImages
    frame : float32 array (rows, columns)
    places : float64 array (P, 4 or more)
        y, x (px), step along the stack, brightness; what else `shapes` draws with, which stays as it is.
    weight : float32 array (rows, columns)
        One over the variance of each pixel.
    brightness, spread : float
        Mean and standard deviation of what brightness is known to be.
    steps : int
        Gauss-Newton steps.
    surface : Background, optional
        Fit it as well. Without it the frame has no background.
    behind : float32 array (rows, columns), optional
        Background to begin with; without it, the one that fits what the particles leave.
    near : bool
        The places are good to a fraction of a pixel already, so that one matrix serves all steps.
    """
    places, system, residual = places.copy(), None, np.empty_like(frame)
    if surface is None:
        behind = np.float32(0)
    for step in range(steps + 1):
        if system is None:
            order = np.argsort(places[:, 1], kind="stable")
        columns = shapes.draw(places[order], frame.shape)
        light = np.zeros_like(frame)
        columns.add_to(light, places[order, 3])
        if behind is None:
            behind = surface.fit(frame - light, weight)
        residual = np.subtract(frame, light, out=residual)
        residual -= behind
        if system is None:
            system = _System(columns, weight, spread, surface)
        gradient, chi2 = columns.gradient(residual, weight)
        if step == steps:
            break
        pull = gradient.copy()
        pull[:, 3] += (brightness - places[order, 3]) / spread**2
        change, shift = system.solve(pull.ravel(), surface.gradient(residual, weight) if surface else None)
        share = np.abs(change.reshape(-1, 4)) / (LONGEST_STEP * (1, 1, 1, brightness))
        if surface is not None and share.max(initial=0) <= 1:  # it belongs to the whole step, not to one cut short
            behind = behind + surface.surface(shift)
        change = change.reshape(-1, 4) / np.maximum(share.max(axis=1, keepdims=True), 1)
        places[order, :4] += change
        places[:, 2] = np.clip(places[:, 2], 0, shapes.count - 1)
        places[:, 3] = np.clip(places[:, 3], 0.05 * brightness, 20 * brightness)
        if not near:
            system = None
    alone = system.alone * places[order, 3]
    explains = np.zeros(len(places))
    explains[order] = np.where(alone > 0, 1 + 2 * gradient[:, 3] / np.where(alone > 0, alone, 1), 0)
    return JointFit(places, residual, light, behind, explains, order, columns, system, chi2)


class _System:
    """The matrix, factorised: a band for the particles, bordered by the background."""

    def __init__(
        self, columns: Columns, weight: NDArray[np.float32], spread: float, surface: Background | None
    ) -> None:
        band = columns.matrix(weight)
        self.alone = band[0, 3::4].copy()
        band[0, 3::4] += spread**-2
        band[0, band[0] <= 0] = 1  # of particles without a pixel
        band[0] *= 1 + DAMPING
        self._factor = cholesky_banded(band, lower=True, check_finite=False) if band.size else band
        self._mixed = None
        if surface is not None:
            self._border = surface.matrix(weight)
            # The products are good to a few per cent: the background is damped by as much.
            self._border[np.diag_indices_from(self._border)] *= 1.03
        if surface is not None and band.size:
            self._mixed = surface.products(columns, weight)
            self._solved = self._without(self._mixed)
            self._border -= self._mixed.T @ self._solved

    def _without(self, right: NDArray) -> NDArray:
        """Solve as if there were no background."""
        return cho_solve_banded((self._factor, True), right, check_finite=False) if right.size else right

    def solve(self, pull: NDArray, rest: NDArray | None) -> tuple[NDArray, NDArray | None]:
        """Change of the particles (4 P,) and of the background's coefficients."""
        change = self._without(pull)
        if rest is None:
            return change, None
        if self._mixed is None:
            return change, np.linalg.solve(self._border, rest)
        shift = np.linalg.solve(self._border, rest - self._mixed.T @ change)
        return change - self._solved @ shift, shift

    def variances(self) -> NDArray[np.float64]:
        """Diagonal of the inverse, (4 P,)."""
        if not self._factor.size:
            return np.zeros(0)
        particles = _inverse_diagonal(self._factor)
        if self._mixed is None:
            return particles
        background = np.einsum("ib,bi->i", self._solved, np.linalg.solve(self._border, self._solved.T))
        return particles + np.maximum(background, 0)


@compiled
def _inverse_diagonal(factor):  # pragma: no cover
    """Diagonal of the inverse of a band matrix from its Cholesky factor (K. Takahashi et al., 1973).

    Within the band the inverse follows from the factor, last column first.
    """
    width, n = factor.shape
    rows = np.zeros((n, width))  # [j, i]: element (j + i, j) of the inverse
    for j in range(n - 1, -1, -1):
        last = min(width - 1, n - 1 - j)
        pivot = factor[0, j]
        column, product = np.zeros(last + 1), np.zeros(last + 1)
        for k in range(1, last + 1):
            column[k] = factor[k, j] / pivot
        for k in range(1, last + 1):  # product = inverse @ column, of which half is stored
            near, c, across = rows[j + k], column[k], 0.0
            ahead, out = column[k:], product[k:]
            out[0] += c * near[0]
            for d in range(1, last - k + 1):
                out[d] += c * near[d]
                across += ahead[d] * near[d]
            out[0] += across
        total = 0.0
        for k in range(1, last + 1):
            rows[j, k] = -product[k]
            total += column[k] * product[k]
        rows[j, 0] = 1 / pivot**2 + total
    return rows[:, 0].copy()


@compiled
def _correlations(residual, brightness, boxes, starts, values):  # pragma: no cover
    out = np.zeros(len(boxes))
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        area, light = starts[i + 1] - starts[i], np.float32(brightness[i])
        if area <= 0:
            continue
        s = t = ss = tt = st = 0.0
        for r in range(y0, y1):
            images, rest = values[3, starts[i] + (r - y0) * (x1 - x0) :], residual[r, x0:x1]
            for q in range(len(rest)):
                image = images[q]
                seen = rest[q] + light * image
                s += seen
                t += image
                ss += seen * seen
                tt += image * image
                st += seen * image
        power = (ss - s * s / area) * (tt - t * t / area)
        if power > 0:
            out[i] = (st - s * t / area) / np.sqrt(power)
    return out
