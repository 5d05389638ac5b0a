"""Two particles that were taken for one: a particle whose residual is more than noise is fitted anew, as two.

The joint fit cannot leave a solution in which one particle stands in the middle of two that are nearer than a pixel or
two. Here such a particle is replaced by two at different depths, which are fitted alone, all else as it is; the
likelihoods are compared.
"""

import numpy as np
from numpy.typing import NDArray

from gdptlab.fit.judgement import Level
from gdptlab.fit.renderer import Columns
from gdptlab.fit.solver import FAINTEST, LONGEST_STEP, Fit

NOTED = 3.0
"""Standard deviations by which a particle's chi-square is above 1 if it is tried as two. Chosen on frames of lognormal
amplitudes: where their spread is 0.6, recall is 0.994 with 5, 0.996 with 3 and with 2."""

CLEARLY = 60.0
"""Log-likelihood by which two particles must explain more than one. Chosen on the same frames between 20 and 80: with
40 and less some bright particles are split by what is not known of their pattern, with 80 a few pairs are missed."""

COMMON, TWICE = 0.05, 2.0
"""Where more than this fraction of a frame's particles, and one, are explained better as two, it is the patterns that
are not known: two must then explain more by this factor than what so many reach. On frames of diameters that differ by
10 %, one pattern known, a tenth of all particles would else be split, nearly all of them wrongly."""

APART = 0.1
"""Depth to either side at which two particles begin, as a fraction of the stack. Between 0.06 and 0.16 the pairs that
are found hardly differ."""

STEPS = 6
"""Steps of the fit of two (Levenberg-Marquardt). With 10 nearly the same pairs are found."""

DAMPING, EASED, RAISED, LEAST_DAMPING = 1e-3, 0.2, 10.0, 1e-9
"""Fraction by which the diagonal of the matrix is raised at first; factors after a step that lowers the misfit and
after one that does not, which is not taken; and what is always added, as a fraction of the trace. Convention."""

ROOM_PX = 2
"""Pixels beyond the support of one particle in which two are fitted: they lie to either side of it."""


def split(
    level: Level,
    fit: Fit,
    stays: NDArray[np.bool_],
    weight: NDArray[np.float32],
    total: NDArray[np.float32],
    *,
    crowd: bool = False,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which particles (P,) are two, and the places (2 n, 4 + K) of those in their stead.

    Parameters
    ----------
    level : Level
    fit : Fit
    stays : bool array (P,)
        Particles that are believed.
    weight, total : float32 arrays (rows, columns)
        One over the variance of each pixel, and the variance of the errors of all patterns.
    crowd : bool
        Whether many particles may be two: then `COMMON` does not hold.
    """
    noted = stays & (fit.chi2 - 1 > NOTED * np.sqrt(2 / fit.area)) & level.worst(fit.places, fit.chi2)
    which, is_two = np.flatnonzero(noted), np.zeros(len(noted), bool)
    if not len(which):
        return is_two, fit.places[:0]
    certain = weight / (1 + weight * total)
    fits = [_Two(level, fit, i, certain) for i in which]
    for _ in range(STEPS + 1):
        columns = level.renderer.draw(np.concatenate([two.trial for two in fits]), fit.frame.shape)
        for k, two in enumerate(fits):
            two.judge(columns, 2 * k)
            two.step(level.renderer.count - 1)
    gain = np.zeros(len(noted))
    gain[which] = np.array([two.gain for two in fits]) * level.retained(fit, weight, total)[which]
    common = np.sort(np.append(gain[stays], (0, 0)))[::-1][1 + int(COMMON * stays.sum())]
    clear = gain[which] > max(CLEARLY, 0 if crowd else TWICE * common)
    is_two[which[clear]] = True
    return is_two, np.concatenate([fit.places[:0], *(fits[k].places for k in np.flatnonzero(clear))])


class _Two:
    """Two particles in the stead of one, all else as it is.

    Minimised is half the weighted square of what they leave in a window, minus the logarithm of the prior of their
    amplitudes: the misfit.

    Parameters
    ----------
    level : Level
    fit : Fit
    i : int
        The one particle.
    weight : float32 array (rows, columns)
    """

    def __init__(self, level: Level, fit: Fit, i: int, weight: NDArray[np.float32]) -> None:
        k, place, self._population = int(np.flatnonzero(fit.order == i)[0]), fit.places[i], fit.population
        top, bottom, left, right = fit.columns.boxes[k]
        self._window = (max(top - ROOM_PX, 0), bottom + ROOM_PX, max(left - ROOM_PX, 0), right + ROOM_PX)
        part = slice(*self._window[:2]), slice(*self._window[2:])
        self._weight, residual = weight[part], fit.residual[part]
        self._light = residual + place[3] * self._image(fit.columns, k)[3]
        self._of_one = self._misfit_of(residual, place[3:4])
        self.trial = np.repeat(place[None], 2, axis=0)
        self.trial[:, 3] /= 2
        self.trial[:, 2] += APART * level.renderer.count * np.array([-1, 1])
        self.places, self._misfit, self._damping = self.trial, np.inf, DAMPING

    @property
    def gain(self) -> float:
        """Log-likelihood over that of one particle."""
        return self._of_one - self._misfit

    def judge(self, columns: Columns, first: int) -> None:
        """Keep the trial, drawn as the columns `first` and the next, if it is better than what was best."""
        amplitude, population = self.trial[:, 3], self._population
        drawn = np.stack([self._image(columns, k) for k in (first, first + 1)])
        left = self._light - np.tensordot(amplitude, drawn[:, 3], 1).astype(np.float32)
        misfit = self._misfit_of(left, amplitude)
        if misfit >= self._misfit:
            self._damping *= RAISED
            return
        self._damping *= EASED
        self.places, self._misfit, drawn = self.trial, misfit, drawn.reshape(8, -1)
        weighted = drawn * self._weight.ravel()
        self._matrix, self._right = (weighted @ drawn.T).astype(float), (weighted @ left.ravel()).astype(float)
        self._matrix[[3, 7], [3, 7]] += population.precision(amplitude)
        self._right[[3, 7]] += population.pull(amplitude)

    def step(self, deepest: int) -> None:
        """Step from what was best to another trial; slices are from 0 to `deepest`."""
        diagonal = np.diagonal(self._matrix)
        matrix = self._matrix + np.diag(self._damping * diagonal + LEAST_DAMPING * diagonal.sum())
        change = np.linalg.solve(matrix, self._right).reshape(2, 4)
        longest = np.tile(LONGEST_STEP, (2, 1))
        longest[:, 3] *= self.places[:, 3]
        self.trial = self.places.copy()
        self.trial[:, :4] += change / max(np.abs(change / longest).max(), 1)
        self.trial[:, 2] = np.clip(self.trial[:, 2], 0, deepest)
        self.trial[:, 3] = np.maximum(self.trial[:, 3], FAINTEST * self._population.centre)

    def _misfit_of(self, left: NDArray[np.float32], amplitude: NDArray[np.float64]) -> float:
        return float((self._weight * left**2).sum(dtype=float)) / 2 + float(self._population.penalty(amplitude).sum())

    def _image(self, columns: Columns, k: int) -> NDArray[np.float32]:
        """Derivatives and image (4, rows, columns) of the particle k of `columns` in the window."""
        out = np.zeros((4, *self._weight.shape), np.float32)
        top, bottom, left, right = columns.boxes[k]
        values = columns.values[:4, columns.starts[k] : columns.starts[k] + (bottom - top) * (right - left)]
        values = values.reshape(4, bottom - top, right - left)
        y, x = self._window[0], self._window[2]
        a, b = slice(max(top, y) - y, max(bottom - y, 0)), slice(max(left, x) - x, max(right - x, 0))
        part = out[:, a, b]
        part[:] = values[:, a.start + y - top :, b.start + x - left :][:, : part.shape[1], : part.shape[2]]
        return out
