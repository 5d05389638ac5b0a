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
from gdptlab.fit.renderer import ROOM_PX, Columns, Renderer

LONGEST_STEP = np.array([1.5, 1.5, 1.5, 0.7])
"""Longest Gauss-Newton step of y, x (px), slice, and amplitude (as a fraction of it)."""

CONVERGED = 0.1
"""Step, in standard deviations of a particle whose neighbours are known, below which the particle stays where it is."""

FAR, MANY = 0.2, 0.05
"""The matrix is made again when more than the fraction MANY of the particles are farther than the fraction FAR of the
longest step from where they were when it was made. A step that is cut short for as few is as good as a whole one."""

DAMPING = 1e-5
"""Fraction by which the diagonal is raised (Levenberg)."""

LEAST_SPREAD = 0.05
"""Least relative standard deviation of amplitudes while particles are sought."""

TYPICAL = 3.5
"""Standard deviations of the logarithm within which an amplitude is typical."""

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

    def typical(self, amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
        """The amplitudes, brought to within `TYPICAL` standard deviations of the centre."""
        factor = np.exp(TYPICAL * max(self.sigma, LEAST_SPREAD))
        return np.clip(amplitude, self.centre / factor, self.centre * factor)

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
    _chi2: NDArray[np.float64]

    @property
    def chi2(self) -> NDArray[np.float64]:
        """Mean square of the residual on each particle's support, over its variance, (P,)."""
        return self._in_order(self._chi2) / self.area

    @property
    def area(self) -> NDArray[np.int64]:
        """Pixels of each particle's support in the frame, 1 or more, (P,)."""
        return self._in_order(np.maximum(self._columns.area, 1))

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
    order = np.argsort(places[:, 1], kind="stable")
    sorted_places, residual = places[order], np.empty_like(frame)
    if surface is None:
        background = np.float32(0)
    columns = renderer.draw(sorted_places, frame.shape, room_px=ROOM_PX)
    system = _System(columns, sorted_places, weight, surface)
    for step in range(steps + 1):
        image = np.zeros_like(frame)
        columns.add_to(image, sorted_places[:, 3])
        if background is None:
            background = surface.fit(frame - image, weight)
        residual = np.subtract(frame, image, out=residual)
        residual -= background
        gradient, chi2 = columns.gradient(residual, weight)
        if step == steps:
            break
        system.factorise(columns, sorted_places, population, MANY)
        right = gradient.copy()
        right[:, 3] += population.pull(sorted_places[:, 3])
        change, shift = system.solve(right.ravel(), surface.gradient(residual, weight) if surface else None)
        change = change.reshape(-1, 4)
        fraction = (np.abs(change) / _longest(sorted_places)).max(axis=1, initial=0)
        moved = (np.abs(change) * np.sqrt(system.diagonal)).max(axis=1, initial=0) > CONVERGED
        # The background's step belongs to whole steps of the particles, but for a few.
        if surface is not None and (fraction > 1).sum() <= MANY * len(fraction):
            background = background + surface.surface(shift)
            residual = frame - image - background
        if not moved.any():
            break
        sorted_places[moved, :4] += (change / np.maximum(fraction, 1)[:, None])[moved]
        sorted_places[:, 2] = np.clip(sorted_places[:, 2], 0, renderer.count - 1)
        sorted_places[:, 3] = np.maximum(sorted_places[:, 3], FAINTEST * population.centre)
        if not renderer.redraw(columns, sorted_places, frame.shape, moved):
            columns = renderer.draw(sorted_places, frame.shape, room_px=ROOM_PX)
    system.factorise(columns, sorted_places, population, 0)
    places = places.copy()
    places[order] = sorted_places
    return Fit(places, frame, residual, image, background, population, order, columns, system, chi2)


def _longest(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longest steps (P, 4)."""
    longest = np.tile(LONGEST_STEP, (len(places), 1))
    longest[:, 3] *= places[:, 3]
    return longest


class _System:
    """The matrix, factorised: a band for the particles, bordered by the background.

    Parameters
    ----------
    columns : Columns
        Particles at `places`, sorted by x.
    weight : float32 array (rows, columns)
    surface : Background, optional
    """

    def __init__(
        self, columns: Columns, places: NDArray[np.float64], weight: NDArray[np.float32], surface: Background | None
    ) -> None:
        self._weight, self._surface = weight, surface
        self._places, self._band, self._factor = places.copy(), columns.matrix(weight), None
        self._mixed = None
        if surface is not None:
            self._plain_border = surface.matrix(weight)
            self._plain_border[np.diag_indices_from(self._plain_border)] *= 1 + DAMPING
            self._border = self._plain_border
        if surface is not None and len(places):
            self._mixed = surface.products(columns, weight)

    @property
    def alone(self) -> NDArray[np.float64]:
        """Weighted squares of each particle's pattern, (P,)."""
        return self._band[0, 3::4]

    @property
    def diagonal(self) -> NDArray[np.float64]:
        """Weighted squares of the columns: one over the variance were all else known, (P, 4)."""
        return self._band[0].reshape(-1, 4)

    def factorise(self, columns: Columns, places: NDArray[np.float64], population: Population, many: float) -> None:
        """Factorise the matrix with the prior of the amplitudes.

        Where more than the fraction `many` of the particles are far from where they were, the matrix is made again,
        for all that have moved: made for one of a pair alone, it might not be positive definite.
        """
        change = np.abs(places[:, :4] - self._places[:, :4])
        far = (change > FAR * _longest(places)).any(axis=1).sum() > many * len(places)
        if self._factor is not None and not far:
            return
        if far:
            moved = change.any(axis=1)
            self._places[moved] = places[moved]
            if not columns.renew(self._band, self._weight, moved):
                self._band = columns.matrix(self._weight)
            if self._mixed is not None:
                self._surface.renew(self._mixed, columns, self._weight, moved)
        band = self._band.copy()
        band[0, 3::4] += population.precision(places[:, 3])
        band[0, band[0] <= 0] = 1  # of particles without a pixel
        band[0] *= 1 + DAMPING
        self._factor = cholesky_banded(band, lower=True, check_finite=False) if band.size else band
        if self._mixed is not None:
            self._solved = self._without(self._mixed)
            self._border = self._plain_border - self._mixed.T @ self._solved

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
        area, light = (y1 - y0) * (x1 - x0), np.float32(amplitude[i])
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
