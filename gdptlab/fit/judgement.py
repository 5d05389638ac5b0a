"""Which particles stay: what each explains beside the others, and whether its residual is noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from gdptlab.fit.background import Background
from gdptlab.fit.model import field_terms
from gdptlab.fit.renderer import Renderer, draw_error, energy_beside_errors
from gdptlab.fit.solver import Fit, Population

LEAST_GAIN = 20.0
"""Log-likelihood that a particle must add, its prior and the errors of all other patterns considered."""

FRACTION = 0.3
"""Fraction of the white-noise density of a pattern's error (`PatternModel.pattern_error`) that is its variance in a
pixel: the error is smooth. Chosen on frames of lognormal amplitudes so that chi-square does not grow with amplitude."""

ODD = 2.0
"""Chi-square over the median of all particles, both less what noise and the patterns' errors explain, from which on a
particle is odd: it, or one that is not found yet, lies elsewhere."""

WORST = 0.5
"""Fraction of the largest chi-square within half a template below which a particle is but a neighbour of an odd one."""

NEAR = 1 / 12
"""Distance, as a fraction of a template and of the stack, within which two particles may stand for one."""

NARROWEST = 0.02
"""Least standard deviation of the logarithm of amplitudes that is believed."""


@dataclass(frozen=True, eq=False)
class Level:
    """What draws particles at one resolution.

    Attributes
    ----------
    renderer : Renderer
    error : float32 array (N, m, m)
        Standard deviation of the patterns' error there.
    nodes_per_px : int
    size : float
        Rows and columns of a template, px.
    surface : Background, optional
    """

    renderer: Renderer
    error: NDArray[np.float32]
    nodes_per_px: int
    size: float
    surface: Background | None

    def error_variance(self, places: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Variance (rows, columns) of the errors of the patterns of all particles."""
        slices = self._slices(places, shape)
        boxes = self.renderer.boxes(places, slices, shape)
        return draw_error(self.error, self.nodes_per_px, places, boxes, slices, shape)

    def retained(self, fit: Fit, weight: NDArray[np.float32], total: NDArray[np.float32]) -> NDArray[np.float64]:
        """Fraction (P,) of each particle's energy that the errors of the others' patterns leave.

        They add to the noise; `total` is the variance of the errors of all patterns, its own as well.
        """
        places, shape = fit.places[fit.order], fit.frame.shape
        slices = self._slices(places, shape)
        sure = np.empty(len(places))
        sure[fit.order] = energy_beside_errors(
            fit.columns, self.error, self.nodes_per_px, places, slices, weight, total
        )
        return np.minimum(sure / np.maximum(fit.energy, 1e-12), 1)

    def gain(self, fit: Fit, weight: NDArray[np.float32], total: NDArray[np.float32]) -> NDArray[np.float64]:
        """Log-likelihood (P,) that each particle adds beside the others, their patterns' errors considered."""
        return fit.gain * self.retained(fit, weight, total) - fit.population.penalty(fit.places[:, 3])

    def staying(self, gain: NDArray[np.float64], places: NDArray[np.float64], least: float) -> NDArray[np.bool_]:
        """Which particles stay (P,): all but those that add too little; of neighbours the worst goes first.

        Of two that explain the same, each explains nothing beside the other.
        """
        drop = np.zeros(len(gain), bool)
        for i in np.argsort(gain, kind="stable")[: np.count_nonzero(gain < least)]:
            drop[i] = not (np.hypot(*(places[i, :2] - places[drop, :2]).T) < self.size / 6).any()
        return ~drop

    def excess(self, fit: Fit, weight: NDArray[np.float32], total: NDArray[np.float32]) -> NDArray[np.float64]:
        """Chi-square (P,) over what noise and the patterns' errors of variance `total` explain."""
        return fit.chi2 / (1 + FRACTION * fit.chi2_of(np.sqrt(total), weight))

    def odd(self, places: NDArray[np.float64], excess: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which particles (P,) have a residual that is more than noise, and more than their neighbours'."""
        return (excess > ODD * max(np.median(excess), 1e-12)) & self.worst(places, excess)

    def worst(self, places: NDArray[np.float64], excess: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which particles (P,) are no mere neighbours of one whose residual is far worse."""
        distance = np.hypot(*(places[:, None, :2] - places[:, :2]).T)
        return excess > WORST * np.where(distance < self.size / 2, excess, 0).max(axis=1, initial=0)

    def merged(self, places: NDArray[np.float64], excess: NDArray[np.float64]) -> NDArray[np.float64]:
        """Particles (P, 4 + K), those merged that stand for one: too near to converge, their residual more than noise.

        If they are two, one will not do, and the other is found again in the residual.
        """
        places, gone = places.copy(), np.zeros(len(places), bool)
        near = self.size * NEAR, self.renderer.count * NEAR
        for i in np.argsort(places[:, 3], kind="stable"):
            distance, apart = np.hypot(*(places[:, :2] - places[i, :2]).T), np.abs(places[:, 2] - places[i, 2])
            partner = (distance < near[0]) & (apart < near[1]) & ~gone
            partner[i] = False
            if excess[i] < ODD or not partner.any():
                continue
            j = np.flatnonzero(partner)[distance[partner].argmin()]
            amplitude = places[[i, j], 3]
            places[j] = amplitude @ places[[i, j]] / amplitude.sum()
            places[j, 3] = amplitude.sum()
            gone[i] = True
        return places[~gone]

    def _slices(self, places: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
        """Slices of the patterns (P,) at places in the field."""
        return places[:, 2] - field_terms(places[:, 1], places[:, 0], shape) @ self.renderer.surface


def learned_population(fit: Fit, keep: NDArray[np.bool_], before: Population | None) -> Population | None:
    """Distribution of the amplitudes of the particles that are kept, less what is uncertain of each.

    Centre and width are medians; the width is never less than so few particles can tell.
    """
    amplitude = fit.places[keep, 3]
    if not len(amplitude):
        return before
    logarithm = np.log(amplitude)
    unsure = np.median((fit.amplitude_std[keep] / amplitude) ** 2)
    sigma = np.sqrt(max(median_abs_deviation(logarithm, scale="normal") ** 2 - unsure, NARROWEST**2))
    return Population(float(np.exp(np.median(logarithm))), float(np.hypot(sigma, 0.1 / np.sqrt(len(amplitude)))))
