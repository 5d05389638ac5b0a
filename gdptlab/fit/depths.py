"""Other depths at which a particle might be: each tried alone, all other particles as they are.

The joint fit climbs to the nearest depth only. Here each particle is taken out of the model and climbs from
other depths, its modes free; the likelihoods are compared.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gdptlab._compiled import compiled
from gdptlab.fit.noise import Variance
from gdptlab.fit.renderer import Renderer
from gdptlab.fit.solver import FAINTEST, Fit

LONGEST = np.array([1.0, 1.0, 3.0, 0.5])
"""Longest step of y, x (px), slice and amplitude (as a fraction) of a particle fitted alone."""

CLIMB = 4
"""Steps from another depth before the modes are free."""

FREE = 2
"""Steps with the modes free, in which the image is linear. Chosen on four frames of the planar beads about focus: 0.952
of the beads are found with two, 0.940 with one."""

APART = 3.0
"""Slices: depths nearer than this are one."""


@dataclass(frozen=True, eq=False)
class Trials:
    """Particles fitted alone.

    Attributes
    ----------
    places : float64 array (n, 4 + K)
    gain : float64 array (n,)
        Log-likelihood, with the priors of amplitude and modes, over that of the frame without the particle.
    matrix : float64 array (n, 4 + K, 4 + K)
        Of least squares, with the priors of the modes.
    """

    places: NDArray[np.float64]
    gain: NDArray[np.float64]
    matrix: NDArray[np.float64]

    def variance_of_modes(self) -> NDArray[np.float64]:
        """What the modes' being unknown adds to the variance of y, x and slice, (n, 3)."""
        with_modes, without = (np.linalg.inv(m) for m in (self.matrix, self.matrix[:, :4, :4]))
        added = np.diagonal(with_modes, axis1=1, axis2=2)[:, :3] - np.diagonal(without, axis1=1, axis2=2)[:, :3]
        return np.maximum(added, 0)


class Alone:
    """Particles of a joint fit, each to be fitted alone.

    Parameters
    ----------
    renderer : Renderer
    fit : Fit
    variance : Variance
    valid : bool array (rows, columns)
    """

    def __init__(self, renderer: Renderer, fit: Fit, variance: Variance, valid: NDArray[np.bool_]) -> None:
        self._renderer, self._fit, self._variance, self._valid = renderer, fit, variance, valid

    def freed(self, trials: NDArray[np.float64], owner: NDArray[np.int64]) -> Trials:
        """Fit from `trials` (n, 4 + K) near the best fit, modes free, each in the stead of the particle `owner` (n,).

        The gain is the one that the quadratic approximation of the last step promises.
        """
        for _ in range(FREE):
            trials, gain, matrix = self._stepped(trials, owner, by_mode=True)
        return Trials(trials, gain, matrix)

    def _stepped(
        self, trials: NDArray[np.float64], owner: NDArray[np.int64], *, by_mode: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Trials after a Gauss-Newton step, the gain (n,) that is expected there, and the matrix (n, C, C) before."""
        population = self._fit.population
        evidence, right, gain = self._evaluated(trials, owner, by_mode=by_mode)
        gain -= population.penalty(trials[:, 3])
        matrix = evidence.copy()
        matrix[:, 3, 3] += population.precision(trials[:, 3])
        right[:, 3] += population.pull(trials[:, 3])
        change = np.linalg.solve(matrix, right[..., None])[..., 0]
        scale = np.ones((len(trials), 4))
        scale[:, 3] = trials[:, 3]
        part = 1 / np.maximum((np.abs(change[:, :4]) / (LONGEST * scale)).max(axis=1), 1)
        gain += (part - part**2 / 2) * (right * change).sum(axis=1)
        trials = trials.copy()
        trials[:, : change.shape[1]] += part[:, None] * change
        trials[:, 2] = np.clip(trials[:, 2], 0, self._renderer.count - 1)
        trials[:, 3] = np.maximum(trials[:, 3], FAINTEST * population.centre)
        return trials, gain, evidence

    def best(self, slices: NDArray[np.float64]) -> Trials:
        """The best fit of each particle at another depth: starts at `slices` (P, S), NaN: none.

        The modes are free from where the best start led. A particle that climbs back to its own depth has no other; its
        gain is minus infinity.
        """
        places = self._fit.places
        out = Trials(places.copy(), np.full(len(places), -np.inf), np.zeros((len(places), *2 * (places.shape[1],))))
        owner, start = np.nonzero(np.isfinite(slices))
        if not len(owner):
            return out
        trials = places[owner]
        trials[:, 2] = slices[owner, start]
        for _ in range(CLIMB):
            trials, gain, _ = self._stepped(trials, owner, by_mode=False)
        order = np.lexsort((-gain, owner))
        first = order[np.unique(owner[order], return_index=True)[1]]
        own = owner[first]
        freed = self.freed(trials[first], own)
        out.places[own], out.matrix[own] = freed.places, freed.matrix
        out.gain[own] = np.where(np.abs(freed.places[:, 2] - places[own, 2]) < APART, -np.inf, freed.gain)
        return out

    def _evaluated(
        self, trials: NDArray[np.float64], owner: NDArray[np.int64], *, by_mode: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Matrix (n, C, C), right-hand side (n, C) and gain in log-likelihood (n,) at `trials`.

        C is the number of unknown: 4, and those of the modes if they are free (`by_mode`).
        """
        fit, size = self._fit, trials.shape[1] if by_mode else 4
        columns = self._renderer.draw(trials, fit.frame.shape, by_mode=size > 4)
        upper, diagonal = np.triu_indices(size), np.arange(size)
        sums = np.zeros((len(trials), len(upper[0]) + size + 1))
        own, rank = fit.columns, np.empty_like(fit.order)
        rank[fit.order] = np.arange(len(rank))
        _sums(
            fit.residual, fit.image, self._valid, fit.places[:, 3], owner, rank, trials[:, 3],
            self._variance.level, self._variance.slope,
            own.boxes, own.starts, own.values, columns.boxes, columns.starts, columns.values, sums,
        )  # fmt: skip
        matrix = np.empty((len(trials), size, size))
        matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = sums[:, : len(upper[0])]
        matrix[:, diagonal, diagonal] = 1.01 * matrix[:, diagonal, diagonal] + 1e-9
        matrix[:, diagonal[4:], diagonal[4:]] += 1
        right = sums[:, len(upper[0]) : -1]
        right[:, 4:] -= trials[:, 4:size]
        return matrix, right, sums[:, -1] - (trials[:, 4:] ** 2).sum(axis=1) / 2


@compiled
def _sums(
    residual, image, valid, amplitude, owner, rank, trial, level, slope,
    boxes, starts, values, t_boxes, t_starts, t_values, sums,
):  # fmt: skip  # pragma: no cover
    """Sums over the pixels of each trial: upper triangle of its matrix, right-hand side, gain in log-likelihood.

    A trial stands in the stead of its owner, whose image goes back into the residual. Each pixel's variance is that
    of the light of all others and of the trial.
    """
    level, slope = np.float32(level), np.float32(slope)
    zero, size = np.float32(0), len(t_values)
    first = size * (size + 1) // 2  # of the right-hand side in `sums`
    trust, pull, trusted = np.empty((3, residual.shape[1]), np.float32)
    for i in range(len(t_boxes)):
        o, total = rank[owner[i]], 0.0
        mine, bright = np.float32(amplitude[owner[i]]), np.float32(trial[i])
        y0, y1, x0, x1 = t_boxes[i]
        a0, a1, b0, b1 = boxes[o]
        pixels = max(y1 - y0, 0) * max(x1 - x0, 0)
        used = size if np.any(t_values[4:, t_starts[i] : t_starts[i] + pixels]) else 4
        for r in range(y0, y1):
            s, inside = t_starts[i] + (r - y0) * (x1 - x0), a0 <= r < a1
            for c in range(x0, x1):
                if not valid[r, c]:
                    trust[c - x0], pull[c - x0] = zero, zero
                    continue
                seen, others = residual[r, c], image[r, c]
                if inside and b0 <= c < b1:
                    back = mine * values[3, starts[o] + (r - a0) * (b1 - b0) + c - b0]
                    seen += back
                    others -= back
                others = abs(others)
                before = level + slope * others
                light = bright * t_values[3, s + c - x0]
                after = level + slope * (others + abs(light))
                left = seen - light
                total += seen * seen / before - left * left / after + np.log(before / after)
                trust[c - x0], pull[c - x0] = 1 / after, left / after
            n = x1 - x0
            for a in range(used):
                column, product = t_values[a, s:], zero
                for c in range(n):
                    trusted[c] = trust[c] * column[c]
                    product += pull[c] * column[c]
                sums[i, first + a] += product
                q = a * (2 * size - a - 1) // 2
                for b in range(a, used):
                    other, product = t_values[b, s:], zero
                    for c in range(n):
                        product += trusted[c] * other[c]
                    sums[i, q + b] += product
        sums[i, -1] = total / 2
