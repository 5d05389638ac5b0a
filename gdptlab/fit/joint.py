"""A frame explained: particles found, bright ones first, and fitted all at once with the background."""

from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gdptlab.fit.background import Background
from gdptlab.fit.depths import Alone
from gdptlab.fit.model import PatternModel, field_terms
from gdptlab.fit.noise import Pixels, Variance, learned_variance, usable_pixels
from gdptlab.fit.renderer import Renderer, draw_error, energy_beside_errors
from gdptlab.fit.search import MatchedFilter
from gdptlab.fit.solver import Fit, Population, fitted

LEAST_GAIN = 20.0
LOSSLESS = 0.98
DEBUG = None
ODD = 1.5
SHARP_GAIN = 2.0
CYCLES = 4
MOVE = [True, False]
WH = [True,True]
APART = 3.0
STEPS = 5


@dataclass(frozen=True, eq=False)
class Explained:
    fit: Fit
    stays: NDArray[np.bool_]
    places: NDArray[np.float64]
    velocity: NDArray[np.float64]
    population: Population
    variance: Variance
    pixels: Pixels
    gain: NDArray[np.float64]


class Joint:
    def __init__(self, model: PatternModel, shape: tuple[int, int], threads: int = 1) -> None:
        self.model, self.shape, self.threads = model, shape, threads
        self._peak = np.float32(model.peak.max())
        patterns, error = model.patterns / self._peak, model.pattern_error / self._peak
        modes = None if model.modes is None else model.modes / self._peak
        fine = model.nodes_per_px
        self._error = error
        self._renderer = Renderer(
            patterns, fine, noise=1.0, surface=model.surface, modes=modes, error=error, threads=threads
        )
        self._surface = Background(shape, 2 * model.size)
        scale = self._scale = 2
        small = tuple(-(-n // scale) for n in shape)
        reduced = _reduced(patterns, fine) if scale == 2 else patterns
        blur = self._blur = model.size / 20 / scale
        sharp = _high_passed(reduced, blur * fine)
        trim = error.shape[-1] // 2 % 2
        small_error = np.ascontiguousarray(error[:, trim : error.shape[1] - trim, trim : error.shape[2] - trim][:, ::scale, ::scale]) / scale
        self._small_error = small_error
        self._sharp = Renderer(sharp, fine, noise=1 / scale, surface=model.surface, error=small_error, threads=threads)
        self._small = Renderer(reduced, fine, noise=1 / scale, surface=model.surface, error=small_error, threads=threads)
        self._filter = MatchedFilter(np.ascontiguousarray(reduced[0][:, ::fine, ::fine]), small)
        self._small_surface = Background(small, 2 * model.size / scale)
        self._small_shape = small

    def first(self, frame):
        pixels = usable_pixels(frame)
        frame = (pixels.filled - np.median(pixels.filled[::4, ::4])) / np.float32(pixels.noise)
        places, population, variance, background = np.zeros((0, 4)), None, Variance(), None
        weight = variance.weight(frame, pixels.valid)
        for cycle in range(CYCLES):
            places, population = self._search(frame, pixels, places, population)
            fit = self._fitted(frame, places, weight, population, background, STEPS)
            keep, _ = self._stays(self._renderer, fit, weight, self._error)
            if MOVE[1]:
                places, moved = self._moved(self._renderer, fit, keep, variance, pixels.valid)
            else:
                places = fit.places[keep]
            background = fit.background
            population = _population(fit, keep, population)
            variance = learned_variance(fit.image, fit.residual, 1.0)
            weight = variance.weight(fit.image, pixels.valid)
            odd = (fit.chi2 > 1.5)[keep]
            self._report(f"full {cycle} odd {odd.sum()}", places, [])
            if cycle == CYCLES - 1 or not odd.any():
                break
            places = places[~odd]
        fit = self._fitted(frame, places, weight, population, background, 3)
        while True:
            keep, gain = self._stays(self._renderer, fit, weight, self._error)
            if keep.all():
                break
            fit = self._fitted(frame, fit.places[keep], weight, population, fit.background, 2)
        self._report("end", fit.places[keep], [])
        return Explained(fit, keep, fit.places[keep], np.zeros((keep.sum(), 3)), population, variance, pixels, gain)

    def _report(self, name, places, new):
        if DEBUG is not None:
            DEBUG(self, name, places, new)

    def _fitted(self, frame, places, weight, population, background, steps, near=False):
        return fitted(self._renderer, frame, places, weight, population, steps=steps, surface=self._surface,
                      background=background, near=near)

    def _errors(self, renderer, places, error, shape):
        slices = places[:, 2] - field_terms(places[:, 1], places[:, 0], shape) @ renderer.surface
        boxes = renderer.boxes(places, slices, shape)
        return draw_error(error, self.model.nodes_per_px, places, boxes, slices, shape)

    def _stays(self, renderer, fit, weight, error):
        places, shape = fit.places[fit.order], fit.frame.shape
        if not len(places):
            return np.zeros(0, bool), np.zeros(0)
        slices = places[:, 2] - field_terms(places[:, 1], places[:, 0], shape) @ renderer.surface
        total = draw_error(error, self.model.nodes_per_px, places, fit.columns.boxes, slices, shape)
        sure = energy_beside_errors(fit.columns, error, self.model.nodes_per_px, places, slices, weight, total)
        ratio = np.empty(len(places))
        ratio[fit.order] = sure / np.maximum(fit.energy[fit.order], 1e-12)
        gain = fit.gain * np.minimum(ratio, 1) - fit.population.penalty(fit.places[:, 3])
        bad = gain < (SHARP_GAIN if renderer is self._sharp else LEAST_GAIN)
        # Of two that explain the same, each explains nothing beside the other: the worse one goes first.
        drop = np.zeros(len(bad), bool)
        for i in np.argsort(gain)[: bad.sum()]:
            near = np.hypot(*(fit.places[i, :2] - fit.places[drop, :2]).T) < self.model.size / 6 / (1 if shape == self.shape else self._scale)
            drop[i] = not near.any()
        return ~drop, gain

    def _moved(self, renderer, fit, keep, variance, valid):
        """Places of the particles that stay, the odd ones at another depth where that is likelier."""
        chi2 = fit.chi2
        odd = np.flatnonzero(keep & (chi2 > ODD * max(np.median(chi2[keep]), 1e-9 if renderer is self._sharp else 1)))
        places = fit.places.copy()
        moved = 0
        if len(odd):
            alone = Alone(renderer, fit, variance, valid)
            own, other = alone.climbed(places[odd], odd, 2), alone.best_elsewhere(odd, APART)
            better = other.gain > own.gain + 10
            places[odd[better]] = other.places[better]
            moved = better.sum()
        return places[keep], moved

    def _unexplained(self, fit, pixels, population, weight):
        total = self._errors(self._renderer, fit.places, self._error, self.shape)
        left = fit.residual * np.sqrt(weight / (1 + weight * total))
        small = cv2.pyrDown(left)
        new = self._new(small, population, whiten=WH[1], outside_px=self.model.size / 4)
        return new * (self._scale, self._scale, 1, 1)

    def _new(self, left, population, *, whiten, outside_px=0.0):
        narrow = population is not None and population.sigma < 0.5
        kwargs = dict(brightness=population.centre, spread=max(population.sigma, 0.05) * population.centre) if narrow else {}
        new, gain = self._filter(left, 1 / self._scale, whiten=whiten, least=LEAST_GAIN, share=0.1 if narrow else 0,
                                 apart_px=self.model.size / 6 / self._scale, outside_px=outside_px / self._scale, **kwargs)
        if narrow:
            new[:, 3] = np.clip(new[:, 3], population.centre * np.exp(-2*population.sigma), population.centre*np.exp(2*population.sigma))
        order = np.argsort(-gain, kind="stable")
        new, gain = new[order], gain[order]
        keep = np.ones(len(new), bool)
        if not narrow:
            radius = self.model.size / 2 / self._scale
            for i in range(len(new)):
                near = np.hypot(*(new[i, :2] - new[:i, :2][keep[:i]]).T) < radius
                keep[i] = not (near & (gain[:i][keep[:i]] > 3 * gain[i])).any()
        return new[keep]

    def _search(self, frame, pixels, places, population):
        scale = self._scale
        small = cv2.pyrDown(frame)
        valid = cv2.pyrDown(pixels.valid.astype(np.float32)) > 0.9
        weight = valid * np.float32(scale**2)
        sharp = _high_passed(small[None], self._blur)[0]
        places, background = places / (scale, scale, 1, 1), np.float32(0)
        image = self._small.image(places, small.shape)
        for stage, rounds in (("sharp", 5), ("plain", 3)):
            renderer = self._sharp if stage == "sharp" else self._small
            for r in range(rounds):
                if stage == "plain":
                    background = self._small_surface.fit(small - image, weight)
                total = self._errors(self._small, places, self._small_error, small.shape)
                left = (small - image - background) / np.sqrt(1 + scale**2 * total)
                new = self._new(left, population, whiten=stage == "sharp" or WH[0])
                self._report(f"{stage}{r}", places * (scale, scale, 1, 1), new * (scale, scale, 1, 1))
                if not len(new):
                    break
                if population is None:
                    population = Population(float(np.median(new[:, 3])), 2.0)
                fit = fitted(renderer, sharp if stage == "sharp" else small - background, np.concatenate([places, new]),
                             weight, population, steps=STEPS)
                keep, _ = self._stays(renderer, fit, weight, self._small_error)
                places = self._moved(renderer, fit, keep, Variance(1 / scale**2), valid)[0] if MOVE[0] else fit.places[keep]
                population = _population(fit, keep, population)
                image = self._small.image(places, small.shape)
                if len(new) < 0.05 * len(places):
                    break
        places = places * (scale, scale, 1, 1)
        return places, population or Population(1.0, 2.0)

    def table(self, e: Explained) -> pd.DataFrame:
        fit, model = e.fit, self.model
        y, x, step, amplitude = fit.places[:, :4].T
        z_um, steps = model.z_um, np.arange(model.count)
        y_std, x_std, step_std = fit.std.T
        misfit = np.sqrt(1 + 5.0 * np.maximum(fit.chi2 - 1, 0))
        own = [np.interp(step, steps, o) for o in model.own_error.T]
        table = pd.DataFrame({
            "x_px": x, "y_px": y,
            "z_um": np.interp(step, steps, np.clip(z_um - model.own_bias_um, z_um[0], z_um[-1])),
            "cm": fit.cm, "at_end": (step <= 0) | (step >= model.count - 1),
            "x_std_px": misfit * np.hypot(x_std, own[0]), "y_std_px": misfit * np.hypot(y_std, own[1]),
            "z_std_um": misfit * np.hypot(step_std * np.interp(step, steps, np.gradient(z_um)), own[2]),
            "amplitude": amplitude * e.pixels.noise / self._peak, "chi2": fit.chi2, "gain": e.gain, "gain_fraction": fit.gain/np.maximum(fit.energy*amplitude**2/2,1e-9),
        })
        rows, columns = self.shape
        inside = e.stays & (y >= -0.5) & (y < rows - 0.5) & (x >= -0.5) & (x < columns - 0.5)
        return table[inside].sort_values("cm", ascending=False, ignore_index=True)


def _reduced(patterns: NDArray, fine: int) -> NDArray[np.float32]:
    """Patterns (M, N, m, m) at half the resolution, as `cv2.pyrDown` makes of frames, with as many nodes per pixel."""
    kernel = np.zeros(4 * fine + 1, np.float32)
    kernel[::fine] = np.array([1, 4, 6, 4, 1]) / 16
    half = patterns.shape[-1] // 2
    trim = half % 2
    flat = patterns.reshape(-1, *patterns.shape[-2:])
    out = [cv2.sepFilter2D(np.ascontiguousarray(p), -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)[trim : 2 * half + 1 - trim, trim : 2 * half + 1 - trim][::2, ::2] for p in flat.astype(np.float32)]
    out = np.stack(out)
    return out.reshape(*patterns.shape[:2], *out.shape[-2:])


def _high_passed(images: NDArray, blur: float) -> NDArray[np.float32]:
    """Images (..., rows, columns) less what remains of them when blurred."""
    flat = images.reshape(-1, *images.shape[-2:]).astype(np.float32)
    return np.stack([i - cv2.GaussianBlur(i, (0, 0), blur, borderType=cv2.BORDER_REFLECT) for i in flat]).reshape(images.shape)


def _population(fit: Fit, keep: NDArray, before: Population) -> Population:
    if not keep.any():
        return before
    a = fit.places[keep, 3]
    log = np.log(a)
    centre = float(np.median(log))
    mad = np.median(np.abs(log - centre)) * 1.4826
    known = np.median((fit.amplitude_std[keep] / a) ** 2)
    scatter = np.sqrt(max(mad**2 - known, 0))
    return Population(float(np.exp(centre)), float(np.hypot(max(scatter, 0.02), 0.1 / np.sqrt(len(a)))))
