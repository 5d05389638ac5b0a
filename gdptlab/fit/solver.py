"""The solver: Gauss-Newton fit of all particles of a frame, and of the background, at once.

Unknown are y, x, slice and amplitude of each particle, and the coefficients of the background. Particles whose
supports do not meet have nothing to do with each other, so that, sorted by x, the matrix is a narrow band with the
few rows of the background as a border. The logarithm of the amplitude has a normal prior.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from gdptlab._compiled import compiled
from gdptlab.fit.background import Background
from gdptlab.fit.renderer import Columns, Renderer

LONGEST_STEP = np.array([1.5, 1.5, 1.5, 0.7])
"""Longest Gauss-Newton step of y, x (px), slice, and amplitude (as a fraction of it)."""

CONVERGED = 0.02
"""Fraction of the longest step below which a step is the last."""

LONG = 0.2
"""Fraction of the longest step from which on a step changes the matrix enough for it to be made again."""

DAMPING = 1e-3
"""Fraction by which the diagonal is raised (Levenberg)."""

FAINTEST = 0.005
"""Least amplitude, as a fraction of the population's median."""


@dataclass(frozen=True)
class Population:
    """Distribution of the particles' amplitudes: normal in the logarithm.

    Attributes
    ----------
    centre : float
        Median amplitude.
    sigma : float
        Standard deviation of the logarithm.
    """

    centre: float
    sigma: float

    def pull(self, amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of the logarithm of the prior by the amplitude."""
        return -np.log(amplitude / self.centre) / (self.sigma**2 * amplitude)

    def precision(self, amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
        """One over the variance that the prior leaves to the amplitude, near it."""
        return (self.sigma * amplitude) ** -2

    def penalty(self, amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the logarithm of the prior, 0 at its centre."""
        return np.log(amplitude / self.centre) ** 2 / (2 * self.sigma**2)


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of `fitted`.

    Attributes
    ----------
    places : float64 array (P, 4 or more)
        y, x (px), slice, amplitude; what else they were given with.
    frame, residual, image, background : float32 arrays (rows, columns)
        What was fitted, what is not explained, what the particles explain, and the background.
    population : Population
    """

    places: NDArray[np.float64]
    frame: NDArray[np.float32]
    residual: NDArray[np.float32]
    image: NDArray[np.float32]
    background: NDArray[np.float32] | np.float32
    population: Population
    _order: NDArray[np.int64]
    _columns: Columns
    _system: "_System"
    _gradient: NDArray[np.float64]
    _chi2: NDArray[np.float64]

    @property
    def chi2(self) -> NDArray[np.float64]:
        """Mean square of the residual on each particle's support, over its variance, (P,)."""
        return self._in_order(self._chi2) / self.area

    @property
    def area(self) -> NDArray[np.int64]:
        """Pixels of each particle's support in the frame, 1 or more, (P,)."""
        return self._in_order(np.maximum(np.diff(self._columns.starts), 1))

    def chi2_of(self, residual: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float64]:
        """The same as `chi2`, of another residual and weight."""
        return self._in_order(self._columns.gradient(residual, weight)[1]) / self.area

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviations of y, x and slice from the inverse of the matrix (the Cramér-Rao bound), (P, 3)."""
        return self._in_order(np.sqrt(self._variances[:, :3]))

    @property
    def energy(self) -> NDArray[np.float64]:
        """Weighted squares of each particle's pattern, (P,): one over the variance of its amplitude were it alone."""
        return self._in_order(self._system.alone)

    @cached_property
    def gain(self) -> NDArray[np.float64]:
        """Log-likelihood that each particle adds, all others and the background refitted without it, (P,).

        Without its own prior the profile likelihood of its amplitude is a parabola about m with variance V; it
        rises by a (2 m - a) / (2 V) from 0 to the amplitude a that was fitted.
        """
        amplitude = self.places[self._order, 3]
        precision = np.maximum(1 / self._variances[:, 3] - self.population.precision(amplitude), 1e-12)
        best = amplitude - self.population.pull(amplitude) / precision  # where likelihood and prior balance
        return self._in_order(amplitude * (2 * best - amplitude) * precision / 2)

    @property
    def amplitude_std(self) -> NDArray[np.float64]:
        """Standard deviation of the amplitude as the frame alone tells it, (P,)."""
        precision = 1 / self._variances[:, 3] - self.population.precision(self.places[self._order, 3])
        return self._in_order(1 / np.sqrt(np.maximum(precision, 1e-12)))

    @property
    def cm(self) -> NDArray[np.float64]:
        """Correlation of each particle's image with what the others leave of the frame, (P,)."""
        c = self._columns
        return self._in_order(_correlations(self.residual, self.places[self._order, 3], c.boxes, c.starts, c.values))

    @property
    def columns(self) -> Columns:
        """The particles as they were drawn, in the order `order`."""
        return self._columns

    @property
    def order(self) -> NDArray[np.int64]:
        """Indices of the particles in `columns`."""
        return self._order

    @cached_property
    def _variances(self) -> NDArray[np.float64]:
        return np.maximum(self._system.variances().reshape(-1, 4), 1e-30)

    def _in_order(self, values: NDArray) -> NDArray:
        out = np.empty_like(values)
        out[self._order] = values
        return out


def fitted(
    renderer: Renderer,
    frame: NDArray[np.float32],
    places: NDArray[np.float64],
    weight: NDArray[np.float32],
    population: Population,
    *,
    steps: int,
    surface: Background | None = None,
    background: NDArray[np.float32] | None = None,
) -> Fit:
    """Fit particles from where they are about.

    Parameters
    ----------
    renderer : Renderer
    frame : float32 array (rows, columns)
    places : float64 array (P, 4 or more)
        y, x (px), slice, amplitude; what else the renderer draws with, which stays as it is.
    weight : float32 array (rows, columns)
        One over the variance of each pixel; 0 where it is left out.
    population : Population
        Prior of the amplitude.
    steps : int
        Largest number of Gauss-Newton steps.
    surface : Background, optional
        Fit it as well. Without it the frame has no background.
    background : float32 array (rows, columns), optional
        Background to begin with; without it, the one that fits what the particles leave.
    """
    places, system, residual = places.copy(), None, np.empty_like(frame)
    if surface is None:
        background = np.float32(0)
    step = -1
    while step < steps:
        step += 1
        if system is None:
            order = np.argsort(places[:, 1], kind="stable")
        columns = renderer.draw(places[order], frame.shape)
        image = np.zeros_like(frame)
        columns.add_to(image, places[order, 3])
        if background is None:
            background = surface.fit(frame - image, weight)
        residual = np.subtract(frame, image, out=residual)
        residual -= background
        if system is None:
            system = _System(columns, weight, population.precision(places[order, 3]), surface)
        gradient, chi2 = columns.gradient(residual, weight)
        if step == steps:
            break
        right = gradient.copy()
        right[:, 3] += population.pull(places[order, 3])
        change, shift = system.solve(right.ravel(), surface.gradient(residual, weight) if surface else None)
        change = change.reshape(-1, 4)
        fraction = np.abs(change) / (LONGEST_STEP * _scale(places[order]))
        if surface is not None and fraction.max(initial=0) <= 1:  # it belongs to the whole step, not to one cut short
            background = background + surface.surface(shift)
        places[order, :4] += change / np.maximum(fraction.max(axis=1, keepdims=True), 1)
        places[:, 2] = np.clip(places[:, 2], 0, renderer.count - 1)
        places[:, 3] = np.maximum(places[:, 3], FAINTEST * population.centre)
        longest = fraction.max(initial=0)
        if longest > LONG:
            system = None
        if longest < CONVERGED:
            steps = step + 1
    return Fit(places, frame, residual, image, background, population, order, columns, system, gradient, chi2)


def _scale(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the longest steps (P, 4) are fractions of."""
    scale = np.ones((len(places), 4))
    scale[:, 3] = places[:, 3]
    return scale


class _System:
    """The matrix, factorised: a band for the particles, bordered by the background."""

    def __init__(
        self,
        columns: Columns,
        weight: NDArray[np.float32],
        precision: NDArray[np.float64],
        surface: Background | None,
    ) -> None:
        band = columns.matrix(weight)
        self.alone = band[0, 3::4].copy()
        band[0, 3::4] += precision
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

    def solve(self, right: NDArray, rest: NDArray | None) -> tuple[NDArray, NDArray | None]:
        """Change of the particles (4 P,) and of the background's coefficients."""
        change = self._without(right)
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
def _correlations(residual, amplitude, boxes, starts, values):  # pragma: no cover
    out = np.zeros(len(boxes))
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        area, light = starts[i + 1] - starts[i], np.float32(amplitude[i])
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
