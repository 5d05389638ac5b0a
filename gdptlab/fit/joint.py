"""A frame, or a film, explained: particles found, bright ones first, and fitted all at once with the background.

Particles are found, some at a time, by a matched filter in what the others leave, and after each time all are fitted
together. While much is unexplained, frame and patterns are high-pass filtered: neighbours not found yet are smooth
there, and do not pull. What is too bright for one particle may be two: what its amplitude has above the population's
stays in the residual that is searched. A particle stays while it adds to the likelihood beside the others; where the
residual is more than noise, particles are taken out and sought once more, two that are too near are made one, or one
is made two (`pairs`). Where particles line up many are made two, again and again. What then is left may be debris:
pixels that it covers are left out, and all is fitted again (`debris`). In a film the particles of one frame, moved on,
are where the next begins.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gdptlab.fit.background import Background, suitable
from gdptlab.fit.debris import covered_pixels
from gdptlab.fit.depths import Alone, Trials
from gdptlab.fit.judgement import LEAST_GAIN, Level, learned_population
from gdptlab.fit.model import PatternModel, field_terms
from gdptlab.fit.noise import Pixels, Variance, learned_variance, usable_pixels
from gdptlab.fit.pairs import split
from gdptlab.fit.renderer import Renderer
from gdptlab.fit.search import MatchedFilter
from gdptlab.fit.solver import Fit, Population, fitted

BLUR = 1 / 20
"""Width of the Gaussian, as a fraction of a template, beyond which the high-pass filter of the search lets nothing."""

SHARP_GAIN = 2.0
"""Log-likelihood that a particle must add in high-passed frames: little, as wide images have little to show there."""

CYCLES = 2
"""Largest number of searches, each without what was odd after the one before."""

ROUNDS = 8
"""Largest number of times that further particles are sought in one search."""

FEW = 0.02
"""Fraction by which particles must become more in a round for another one to follow."""

SEARCH_STEPS, STEPS = 2, 5
"""Largest numbers of Gauss-Newton steps after each round of the search, and at full resolution."""

REFITS = 6
"""Largest number of fits at full resolution, each without the particles that added too little in the one before."""

CROWDED, EXPLAINED, UNEXPLAINED = 3, 0.5, 2.0
"""Largest number of times that a frame is fitted again as a crowd; the factor by which that must lower the mean squared
residual, less that of noise; and what is so much that it is tried even where no row looks like debris. Chosen on films
whose particles line up, 25 to 100 in view: there 0 to 0.5 is reached at first, on frames with debris, with dust or with
diameters that differ 0.7 to 1.1."""

SPLITS = 4
"""Largest number of times that particles of a crowd are tried as two. Chosen between 2 and 4 on thirteen frames of the
films of `CROWDED`: 4 finds 30 particles more in three of them, and 15 fewer in one."""

KNOTS = (8.0, 2.0, 1.0, 0.5)
"""Distances between the knots of the background that are tried, in templates."""

FINER, CLEARLY_FINER = 15.0, 2.0
"""Factors by which the finest knots must lower the smoothed residual for coarser ones to be given up: during the
search, where particles that are not found yet make it up to 5 and a background that changes over two templates 48 to
110; and once particles are fitted."""

ASTRAY = np.array([-4.0, 0.0, 4.0])
"""Slices by which the depth on the other side of focus may be off the one that looks most alike."""

AMBIGUOUS = 20.0
"""Log-likelihood by which one depth must be better than the other to be believed. The patterns' own errors are
alike in neighbouring pixels, which the likelihood does not know: it would ask for 3."""

CORRELATED = 5.0
"""Pixels over which what neighbours leave of a particle is alike, about, where it is more than noise: an excess of
chi-square by 0.1 adds 0.5 times the variance. Found as what makes errors of particles in a crowd agree with their
standard deviation."""

WAYS = 8.0
"""Ways in which a particle may differ from the pattern, of which z is one: of the energy of a residual that is
certainly more than noise the share 1 / WAYS may have moved z. Chosen between 8 and 64 on particles whose diameters
differ by 10 %, whose errors are 1.3 times the standard deviation with 8, and 3 times with 64."""

LEAST_RETAINED = 1e-4
"""Least fraction of what the frame tells of a particle that the errors of its neighbours' patterns leave: its standard
deviations grow a hundredfold at most. Convention."""

UNUSUAL = 3.0
"""Standard deviations by which a particle's amplitude differs from the others' where its variance is twice the usual:
it may not be alone."""

FOREIGN = 6.0
"""Chi-square over that of noise and patterns' errors from which on a row is no particle of this kind."""

FOREIGN_UNUSUAL = 1.5, 4.0
"""Lower chi-square from which on a row is none if its amplitude is, by so many standard deviations, unusual as well.
Chosen on frames with debris and dust: nearly all false rows are beyond, and 1 % of the true ones."""

LEAST_SIGMA = 0.06
"""Least standard deviation of the logarithm of amplitudes for that."""

LOST = 0.2
"""Fraction of a frame's particles that may be gone in the next (or two of them); if more are, all are sought anew."""

COVERS = 3
"""Largest number of times that pixels are left out because debris covers them. Chosen: after the first the rim of what
was taken for a particle shows, the second hardly finds more."""

SEEN = 0.5
"""Least fraction of a particle's image that is seen beside debris. Convention."""

UNKNOWN = Population(1.0, 2.0)
"""Distribution of the amplitudes where nothing was found."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A frame explained, and all that the next one begins with.

    Attributes
    ----------
    fit : Fit
        In units of the noise of a pixel.
    stays : bool array
        Which of the fit's particles are believed.
    places : float64 array (P, 4 + K)
        Of those, and of others that may be there: y, x (px), slice, amplitude, coefficients of the modes.
    velocity : float64 array (P, 3)
        Of y, x and slice, per frame.
    population : Population
    surface : int
        Which of the backgrounds in `KNOTS` suits the frame.
    variance : Variance
    pixels : Pixels
    gain, excess : float64 arrays
        Log-likelihood that each particle of the fit adds; its chi-square over that of noise and patterns' errors.
    covered : bool array (rows, columns)
        Pixels that are left out, as debris covers them.
    debris : DataFrame, optional
        Rows that no pattern explained before these pixels were left out.
    """

    fit: Fit
    stays: NDArray[np.bool_]
    places: NDArray[np.float64]
    velocity: NDArray[np.float64]
    population: Population
    surface: int
    variance: Variance
    pixels: Pixels
    gain: NDArray[np.float64]
    excess: NDArray[np.float64]
    covered: NDArray[np.bool_]
    debris: pd.DataFrame | None = None


class Joint:
    """Plan for frames of one shape, in one thread at a time.

    Parameters
    ----------
    model : PatternModel
    shape : (rows, columns)
    threads : int
        Threads within a frame; the result does not depend on them.
    """

    def __init__(self, model: PatternModel, shape: tuple[int, int], threads: int = 1) -> None:
        self.model, self.shape = model, shape
        self._peak = np.float32(model.peak.max())
        fine, scale = model.nodes_per_px, 2 if model.half_resolution else 1
        self._scale, self._small_shape = scale, tuple(-(-n // scale) for n in shape)
        patterns, error = model.patterns / self._peak, model.pattern_error / self._peak
        modes = None if model.modes is None else model.modes / self._peak
        self._full = self._level(patterns, error, 1, threads, modes)
        half = patterns
        if scale == 2:
            half, inner = reduced(patterns, fine), slice(_even(error), error.shape[-1] - _even(error), 2)
            error = np.ascontiguousarray(error[:, inner, inner]) / scale
        self._small = self._level(half, error, scale, threads)
        self._blur = BLUR * model.size / scale
        self._sharp = self._level(high_passed(half, self._blur * fine), error, scale, threads)
        self._backgrounds = [Background(shape, model.size * k) for k in KNOTS]
        self._small_backgrounds = [Background(self._small_shape, model.size * k / scale) for k in KNOTS]
        self._filter = MatchedFilter(np.ascontiguousarray(half[0][:, ::fine, ::fine]), self._small_shape)

    def _level(
        self, patterns: NDArray, error: NDArray, scale: int, threads: int, modes: NDArray | None = None
    ) -> Level:
        model = self.model
        renderer = Renderer(
            patterns, model.nodes_per_px, noise=1 / scale, surface=model.surface, modes=modes, error=error,
            threads=threads,
        )  # fmt: skip
        return Level(renderer, error, model.nodes_per_px, model.size / scale, None)

    def first(self, frame: NDArray[np.float32]) -> Explained:
        """Explain a frame (rows, columns) of which nothing is known."""
        pixels = usable_pixels(frame)
        found = self._settled(pixels, *self._search(self._normalised(pixels), pixels))
        found, debris = self._crowded(found), []
        for _ in range(COVERS):
            covered, before = self._covered(found), found
            if (covered <= found.covered).all():
                break
            foreign = self._foreign(found)
            debris.append(self.table(replace(found, stays=found.stays & foreign, debris=None), foreign=True))
            places = found.fit.places[found.stays & ~foreign & ~_at(covered, found.fit.places)]
            covered |= found.covered
            left = replace(pixels, valid=pixels.valid & ~covered)
            found = self._settled(left, places, before.population, before.surface, before)
            seen = found.fit.chi2_of(np.ones_like(frame), left.valid.astype(np.float32))
            stays = found.stays & (seen > SEEN)
            found = replace(found, stays=stays, covered=covered, debris=pd.concat(debris, ignore_index=True))
        return found

    def _crowded(self, found: Explained) -> Explained:
        """Explain a frame again as a crowd, if that explains more.

        Where particles line up many are taken for one, which no pattern explains: it looks like debris.
        """
        for _ in range(CROWDED):
            left = _left(found)
            if left < UNEXPLAINED and not (found.stays & self._foreign(found)).any():
                break
            places = found.fit.places[found.stays]
            again = self._settled(found.pixels, places, found.population, found.surface, crowd=True)
            if _left(again) > EXPLAINED * left:
                break
            found = again
        return found

    def _settled(
        self,
        pixels: Pixels,
        places: NDArray[np.float64],
        population: Population,
        surface: int,
        before: Explained | None = None,
        crowd: bool = False,
    ) -> Explained:
        """Explain a frame from the places of particles that were found, more of which are sought where all is fitted.

        Variance and background begin as they were `before`. In a `crowd` many particles may be two, none are merged.
        """
        frame, splits = self._normalised(pixels), 0
        merged = _as_they_are if crowd else self._full.merged
        variance, background, image = Variance(), None, np.zeros_like(frame)
        if before is not None:
            variance, background, image = before.variance, before.fit.background, before.fit.image
        weight = variance.weight(image, pixels.valid)
        for again in range(2 * REFITS if crowd else REFITS):
            fit = self._fitted(frame, places, weight, population, surface, background, STEPS)
            total = self._full.error_variance(fit.places, self.shape)
            gain = self._full.gain(fit, weight, total)
            stays = self._full.staying(gain, fit.places, LEAST_GAIN)
            excess = self._full.excess(fit, weight, total)
            settled = stays.all() and len(merged(fit.places, excess)) == len(fit.places)
            two, pairs = np.zeros(len(stays), bool), fit.places[:0]
            if splits < (SPLITS if crowd else 1) and again and (settled or again == REFITS - 2):
                two, pairs = split(self._full, fit, stays, weight, total, crowd=crowd)
                splits += 1
            if again and settled and not len(pairs):
                break
            population, background = learned_population(fit, stays, population), fit.background
            new = self._unexplained(fit, weight, total, population) if again < 2 else places[:0]
            variance = learned_variance(fit.image, fit.residual, 1.0)
            weight = variance.weight(fit.image, pixels.valid)
            if again == 0 and (suits := self._suits(frame - fit.image, weight)) != surface:
                surface, background = suits, None
            likelier = self._likelier(fit, variance, pixels)
            kept = stays & ~two
            places = np.concatenate([merged(likelier[kept], excess[kept]), pairs, new])
        velocity = np.zeros((len(fit.places), 3))
        return Explained(
            fit, stays, fit.places, velocity, population, surface, variance, pixels, gain, excess,
            np.zeros(self.shape, bool),
        )  # fmt: skip

    def _covered(self, found: Explained) -> NDArray[np.bool_]:
        """Pixels (rows, columns) that debris covers."""
        fit, foreign = found.fit, found.stays & self._foreign(found)
        if not foreign.any() and not found.covered.any():
            return found.covered
        weight = found.variance.weight(fit.image, found.pixels.valid | found.covered)
        total = self._full.error_variance(fit.places, self.shape)
        residual = fit.residual * np.sqrt(weight / (1 + weight * total))
        return covered_pixels(residual, fit.places[foreign], found.covered, self.model.size)

    def _suits(self, light: NDArray[np.float32], weight: NDArray[np.float32]) -> int:
        """Which of the backgrounds suits a frame from which its particles were taken."""
        return suitable(self._small_backgrounds, self.reduced(light), self.reduced(weight), self._blur, CLEARLY_FINER)

    def following(self, frame: NDArray[np.float32], before: Explained) -> Explained:
        """Explain the frame after one that is explained. A particle that appears in it is in the table of the next.

        Debris is not sought in it; what was covered before may be seen again.
        """
        pixels = usable_pixels(frame, before.pixels.noise)
        pixels = replace(pixels, valid=pixels.valid & ~before.covered)
        frame = self._normalised(pixels)
        places = before.places.copy()
        places[:, :3] += before.velocity
        weight = before.variance.weight(before.fit.image, pixels.valid)
        fit = self._fitted(frame, places, weight, before.population, before.surface, before.fit.background, STEPS)
        total = self._full.error_variance(fit.places, self.shape)
        gain = self._full.gain(fit, weight, total)
        stays = self._full.staying(gain, fit.places, LEAST_GAIN)
        gone = before.stays.sum() - stays.sum()
        if gone > max(LOST * before.stays.sum(), 2) or not stays.any():
            return self.first(pixels.filled)
        moved = (before.velocity + fit.places[:, :3] - before.places[:, :3])[stays] / 2
        population = learned_population(fit, stays, before.population)
        new = self._unexplained(fit, weight, total, population)
        found = Explained(
            fit,
            stays,
            np.concatenate([fit.places[stays], new]),
            np.concatenate([moved, np.zeros((len(new), 3))]),
            population,
            before.surface,
            learned_variance(fit.image, fit.residual, 1.0),
            pixels,
            gain,
            self._full.excess(fit, weight, total),
            before.covered,
        )
        if before.covered.any():
            found = replace(found, covered=before.covered & self._covered(found))
        return found

    @property
    def _open(self) -> bool:
        """Whether the joint fit leaves a question open: how particles differ, or on which side of focus they are."""
        return self.model.modes_count > 0 or bool(np.isfinite(self.model.twin).any())

    def _alone(self, fit: Fit, variance: Variance, pixels: Pixels) -> tuple[Trials, Trials]:
        """Each particle of a fit alone, its modes free: from where it is, and on the other side of focus."""
        alone = Alone(self._full.renderer, fit, variance, pixels.valid)
        own = alone.freed(fit.places, np.arange(len(fit.places)))
        height = field_terms(fit.places[:, 1], fit.places[:, 0], self.shape) @ self.model.surface
        twin = np.interp(fit.places[:, 2] - height, np.arange(self.model.count), self.model.twin) + height
        return own, alone.best(np.clip(twin[:, None] + ASTRAY, 0, self.model.count - 1))

    def _likelier(self, fit: Fit, variance: Variance, pixels: Pixels) -> NDArray[np.float64]:
        """Places of a fit's particles, with their modes, on the side of focus that is likelier."""
        if not self._open or not len(fit.places):
            return fit.places
        own, other = self._alone(fit, variance, pixels)
        return np.where((other.gain > own.gain)[:, None], other.places, own.places)

    def _normalised(self, pixels: Pixels) -> NDArray[np.float32]:
        """The frame in units of its noise, about its median."""
        return (pixels.filled - np.median(pixels.filled[::4, ::4])) / np.float32(pixels.noise)

    def _fitted(
        self,
        frame: NDArray[np.float32],
        places: NDArray[np.float64],
        weight: NDArray[np.float32],
        population: Population,
        surface: int,
        background: NDArray[np.float32] | None,
        steps: int,
    ) -> Fit:
        """All particles and the background at full resolution."""
        return fitted(
            self._full.renderer, frame, places, weight, population, steps=steps, surface=self._backgrounds[surface],
            background=background,
        )  # fmt: skip

    def _unexplained(
        self, fit: Fit, weight: NDArray[np.float32], total: NDArray[np.float32], population: Population
    ) -> NDArray[np.float64]:
        """Places of further particles, at full resolution; some may lie outside the frame."""
        amplitude = fit.places[fit.order, 3]
        left = fit.residual.copy()
        fit.columns.add_to(left, amplitude - population.typical(amplitude))
        left = self.reduced(left * np.sqrt(weight / (1 + weight * total)))
        return self._new(left, population, fit.places.shape[1], whiten=False, outside_px=self.model.size / 4)

    def reduced(self, frame: NDArray[np.float32]) -> NDArray[np.float32]:
        """A frame at the resolution of the search."""
        return cv2.pyrDown(frame) if self._scale == 2 else frame

    def _new(
        self,
        left: NDArray[np.float32],
        population: Population | None,
        width: int = 4,
        *,
        whiten: bool,
        outside_px: float = 0,
    ) -> NDArray[np.float64]:
        """Places (P, width), at full resolution, of further particles in what others leave at the search's."""
        scale = self._scale
        new = self._filter(
            left, 1 / scale, population, whiten=whiten, size=self.model.size / scale, outside_px=outside_px / scale
        )
        return np.pad(new * (scale, scale, 1, 1), ((0, 0), (0, width - 4)))

    def _search(self, frame: NDArray[np.float32], pixels: Pixels) -> tuple[NDArray[np.float64], Population, int]:
        """Places of particles, to a fraction of a pixel, their population, and which background suits."""
        search, before = _Search(self, frame, pixels), np.inf
        for cycle in range(CYCLES):
            search.find(self._sharp, ROUNDS)
            search.find(self._small, ROUNDS)
            odd = search.odd()
            if cycle == CYCLES - 1 or not 0 < odd.sum() < before:
                break
            before = odd.sum()
            search.take_out(odd)
        places = search.places * (self._scale, self._scale, 1, 1)
        return np.pad(places, ((0, 0), (0, self.model.modes_count))), search.population or UNKNOWN, search.surface or 0

    def _foreign(self, explained: Explained) -> NDArray[np.bool_]:
        """Which of a fit's particles no pattern explains: debris, dust."""
        amplitude, population = explained.fit.places[:, 3], explained.population
        unsure = explained.fit.amplitude_std / amplitude
        unusual = np.abs(np.log(amplitude / population.centre)) / np.hypot(max(population.sigma, LEAST_SIGMA), unsure)
        chi2, sigmas = FOREIGN_UNUSUAL
        suspect = (explained.excess > FOREIGN) | (explained.excess > chi2) & (unusual > sigmas)
        return suspect & self._full.worst(explained.fit.places, explained.excess)

    def table(self, explained: Explained, *, foreign: bool = False) -> pd.DataFrame:
        """What is in a frame.

        Parameters
        ----------
        explained : Explained
        foreign : bool
            List what no pattern explains, such as debris and dust, as well.

        Returns
        -------
        DataFrame
            A row for each particle in the frame, highest `cm` first. `x_px`, `y_px`, `z_um`; `cm`, the correlation
            of its image with what the others leave of the frame; `at_end`, whether z may lie beyond the stack;
            `x_std_px`, `y_std_px`, `z_std_um`, standard deviations (noise of the frame, neighbours, errors of the
            patterns, misfit); `amplitude`, 1 for the calibration's particle; `chi2`, the mean square of the residual
            around it, over the variance; `chi2_without`, the same were the particle removed; `z_other_um`, the best
            depth on the other side of focus, NaN where there is none; `log_ratio`, the logarithm of the likelihood of
            the first depth over that of the second, infinity where there is none; `ambiguous`, whether that is below
            `AMBIGUOUS`. `attrs` counts the pixels left out, `saturated_px`, `defective_px`, `covered_px` (by debris),
            and the rows kept out, `foreign`.
        """
        fit, model = explained.fit, self.model
        y, x, slices, amplitude = fit.places[:, :4].T
        at = np.arange(model.count)
        variance, z_other, log_ratio = fit.std**2, np.full(len(y), np.nan), np.full(len(y), np.inf)
        if self._open and len(y):
            own, other = self._alone(fit, explained.variance, explained.pixels)
            log_ratio = own.gain - other.gain
            z_other = np.where(np.isfinite(other.gain), np.interp(other.places[:, 2], at, model.z_um), np.nan)
            variance = variance + own.variance_of_modes()
        unusual = np.log(amplitude / explained.population.centre) / explained.population.sigma
        beyond = explained.excess - 1
        certain = np.maximum(beyond - 2 * np.sqrt(2 / fit.area), 0)
        weight = explained.variance.weight(fit.image, explained.pixels.valid)
        retained = self._full.retained(fit, weight, self._full.error_variance(fit.places, self.shape))
        beyond = CORRELATED * np.maximum(beyond, 0) + certain * fit.area / WAYS
        misfit = np.sqrt(1 / np.maximum(retained, LEAST_RETAINED) + beyond + (unusual / UNUSUAL) ** 2)
        own_error = np.stack([np.interp(slices, at, error) for error in model.own_error.T])
        y_std, x_std, slice_std = np.sqrt(variance).T
        frame_std = x_std, y_std, slice_std * np.interp(slices, at, np.gradient(model.z_um))
        x_std, y_std, z_std = misfit * np.hypot(frame_std, own_error)
        z_um = np.clip(model.z_um - model.own_bias_um, model.z_um[0], model.z_um[-1])
        table = pd.DataFrame(
            {
                "x_px": x,
                "y_px": y,
                "z_um": np.interp(slices, at, z_um),
                "cm": fit.cm,
                "at_end": (slices <= 0) | (slices >= model.count - 1),
                "x_std_px": x_std,
                "y_std_px": y_std,
                "z_std_um": z_std,
                "amplitude": amplitude * explained.pixels.noise / self._peak,
                "chi2": fit.chi2,
                "chi2_without": fit.chi2 + 2 * explained.gain / fit.area,
                "z_other_um": z_other,
                "log_ratio": log_ratio,
                "ambiguous": log_ratio < AMBIGUOUS,
            }
        )
        rows, columns = self.shape
        kept = explained.stays & (foreign | ~self._foreign(explained))
        inside = kept & (y >= -0.5) & (y < rows - 0.5) & (x >= -0.5) & (x < columns - 0.5)
        table = table[inside].sort_values("cm", ascending=False, ignore_index=True)
        table.attrs |= {"saturated_px": explained.pixels.saturated, "defective_px": explained.pixels.defective}
        table.attrs["covered_px"] = int(explained.covered.sum())
        table.attrs["foreign"] = int((explained.stays & self._foreign(explained)).sum())
        if explained.debris is not None:
            table.attrs["foreign"] += len(explained.debris)
            if foreign:
                table = pd.concat([table, explained.debris], ignore_index=True)
        return table


class _Search:
    """A frame at the resolution of the search, and the particles found so far."""

    def __init__(self, joint: Joint, frame: NDArray[np.float32], pixels: Pixels) -> None:
        self._joint, scale = joint, joint._scale
        self._frame = joint.reduced(frame)
        self._sharp_frame = high_passed(self._frame[None], joint._blur)[0]
        valid = True if pixels.valid.all() else joint.reduced(pixels.valid.astype(np.float32)) > 0.9
        self._weight = np.full(self._frame.shape, scale**2, np.float32) * valid
        self._scale = scale
        self.places, self.population = np.zeros((0, 4)), None
        self._fit, self.surface = None, None
        self._image, self._background = np.zeros_like(self._frame), np.float32(0)

    def find(self, level: Level, rounds: int) -> None:
        """Find further particles until there are no more."""
        joint = self._joint
        plain = level is joint._small
        least = LEAST_GAIN if plain else SHARP_GAIN
        for _ in range(rounds):
            if plain:
                unexplained = self._frame - self._image
                if self.surface is None:
                    self.surface = suitable(joint._small_backgrounds, unexplained, self._weight, joint._blur, FINER)
                self._background = joint._small_backgrounds[self.surface].fit(unexplained, self._weight)
            total = joint._small.error_variance(self.places, self._frame.shape)
            left = (self._frame - self._image - self._background) / np.sqrt(1 + self._scale**2 * total)
            new = joint._new(left, self.population, whiten=True) / (self._scale, self._scale, 1, 1)
            if not len(new):
                break
            before = len(self.places)
            self._add(level, new, least, self._frame - self._background if plain else self._sharp_frame)
            if len(self.places) - before < FEW * len(self.places):
                break

    def _add(self, level: Level, new: NDArray[np.float64], least: float, frame: NDArray[np.float32]) -> None:
        """Fit further particles with the others, and drop those that add too little."""
        population = self.population or Population(float(np.median(new[:, 3])), UNKNOWN.sigma)
        places = np.concatenate([self.places, new])
        fit = fitted(level.renderer, frame, places, self._weight, population, steps=SEARCH_STEPS)
        total = level.error_variance(fit.places, frame.shape)
        stays = level.staying(level.gain(fit, self._weight, total), fit.places, least)
        self._fit, self._stays, self._total = fit, stays, total
        self.places = fit.places[stays]
        self.population = learned_population(fit, stays, population)
        self._image = self._typical_image()

    def _typical_image(self) -> NDArray[np.float32]:
        """Model image, its amplitudes typical: what is too bright for one particle may be two."""
        places = self.places.copy()
        places[:, 3] = self.population.typical(places[:, 3])
        return self._joint._small.renderer.image(places, self._frame.shape)

    def odd(self) -> NDArray[np.bool_]:
        """Which particles have a residual that is more than noise."""
        if not len(self.places):
            return np.zeros(0, bool)
        excess = self._joint._small.excess(self._fit, self._weight, self._total)
        return self._joint._small.odd(self.places, excess[self._stays])

    def take_out(self, which: NDArray[np.bool_]) -> None:
        """Go on without those."""
        self.places = self.places[~which]
        self._stays = self._stays.copy()
        self._stays[np.flatnonzero(self._stays)[which]] = False
        self._image = self._typical_image()


def _left(found: Explained) -> float:
    """Mean over a frame of its squared residual, in units of read noise, less 1; pixels that are left out count 0."""
    return float(np.mean((np.square(found.fit.residual) - 1) * found.pixels.valid))


def _as_they_are(places: NDArray[np.float64], _: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (P, 4 + K) of which none are merged, in the stead of `Level.merged`."""
    return places


def _at(mask: NDArray[np.bool_], places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """What a mask (rows, columns) says of the pixels of places (P, 2 or more): y, x."""
    y, x = np.clip(np.rint(places[:, :2]).astype(int), 0, np.array(mask.shape) - 1).T
    return mask[y, x]


def _even(patterns: NDArray) -> int:
    """Nodes to leave out at the border, so that the middle one has an even index."""
    return patterns.shape[-1] // 2 % 2


def reduced(patterns: NDArray[np.float32], nodes_per_px: int) -> NDArray[np.float32]:
    """Patterns (M, N, m, m) at half the resolution, as `cv2.pyrDown` makes it of frames; as many nodes a pixel."""
    kernel, trim = np.zeros(4 * nodes_per_px + 1, np.float32), _even(patterns)
    kernel[::nodes_per_px] = np.array([1, 4, 6, 4, 1]) / 16
    flat = patterns.reshape(-1, *patterns.shape[-2:])
    out = np.stack([cv2.sepFilter2D(p, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101) for p in flat])
    end = patterns.shape[-1] - trim
    out = out[:, trim:end:2, trim:end:2]
    return np.ascontiguousarray(out.reshape(*patterns.shape[:2], *out.shape[-2:]))


def high_passed(images: NDArray[np.float32], blur: float) -> NDArray[np.float32]:
    """Images (..., rows, columns) less what remains of them when blurred."""
    flat = images.reshape(-1, *images.shape[-2:])
    out = [image - cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REFLECT) for image in flat]
    return np.stack(out).reshape(images.shape)
