"""Particles that overlap, found one after the other and fitted all at once.

A frame is taken for a smooth background and the sum of the images of particles, each at its place and depth,
all of nearly the same brightness; the images come from the calibration. Particles are found, some at a time, by a
matched filter in what the others leave, and after each time all are fitted together. While much is
unexplained, frame and images are high-pass filtered: neighbours not found yet are smooth there, and do not
pull. A particle stays while it explains at least half of what it would explain alone.

In a film the particles of one frame, moved on, are where the next begins.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gdptlab.background import Background
from gdptlab.calibration import Calibration
from gdptlab.cores import compiled
from gdptlab.denoising import noise_level
from gdptlab.fit.pattern import continued, particle_light
from gdptlab.joint_fit import JointFit, fitted
from gdptlab.matched_filter import MatchedFilter
from gdptlab.particle_images import ParticleImages

LEAST_GAIN = 20.0
"""In log-likelihood, of a particle: chi-square of 40 with 4 degrees of freedom, which noise reaches at one place
in ten million, and a frame has some ten thousand places to be at."""

SHARE = 0.1
"""Of the gain of a lone particle, that a new one must bring."""

EXPLAINS = 0.5
"""Share of what it would explain alone that a particle must explain beside the others."""

LOST = 0.2
"""Share of a frame's particles that may be gone in the next (or two of them); if more are, the search begins anew."""

KNOWN = 0.02
"""Spread of brightness, its share, while particles are searched for: as if it were known."""


@dataclass(frozen=True)
class Stage:
    """Of the search.

    Attributes
    ----------
    blur : float
        What is subtracted from frame and images, each blurred over so many widths of a template; 0: nothing.
    whiten : bool
        Take all that is unexplained for noise (see `MatchedFilter`).
    rounds : int
        At most.
    """

    blur: float
    whiten: bool
    rounds: int


STAGES = (
    Stage(blur=1 / 20, whiten=True, rounds=4),
    Stage(blur=0, whiten=False, rounds=3),
)


@dataclass(frozen=True, eq=False)
class Explained:
    """A frame explained, and all that the next one begins with.

    Attributes
    ----------
    fit : JointFit
    stays : bool array
        Which of the fit's particles are believed.
    places : float64 array (P, 4)
        Of those, and of others that may be there: y, x (px), step along the stack, brightness.
    velocity : float64 array (P, 3)
        Of y, x and step, per frame.
    brightness, spread : float
        Mean and standard deviation of the particles'.
    variance : float64 array (2,)
        Slope and level of a pixel's variance in the light of the particles.
    """

    fit: JointFit
    stays: NDArray[np.bool_]
    places: NDArray[np.float64]
    velocity: NDArray[np.float64]
    brightness: float
    spread: float
    variance: NDArray[np.float64]


class Overlap:
    """Plan for frames of one shape, in one thread at a time.

    Parameters
    ----------
    calibration : Calibration
    shape : (rows, columns)
    """

    def __init__(self, calibration: Calibration, shape: tuple[int, int]) -> None:
        images, noise = continued(particle_light(calibration)), noise_level(calibration.stack)
        self._size, self._scale = calibration.size, 2 if calibration.half_resolution else 1
        self._shapes, self._surface = ParticleImages(images, noise), Background(shape, 2 * self._size)
        searched, small = calibration.at_search_resolution(images), tuple(-(-n // self._scale) for n in shape)
        self._filter = MatchedFilter(searched, small)
        self._small_surface = Background(small, 2 * self._size / self._scale)
        self._blurs = [stage.blur * self._size / self._scale for stage in STAGES]
        self._small_shapes = [ParticleImages(_high_passed(searched, blur), noise) for blur in self._blurs]

    def first(self, frame: NDArray[np.float32]) -> Explained:
        """Explain a frame (rows, columns) of which nothing is known."""
        noise = max(noise_level(frame), 1e-4 * float(np.ptp(frame)))
        noise = noise if noise > 1e-15 else 1.0  # a blank frame has none, or one whose square is lost in float32
        places, brightness = self._search(self._reduced(frame), noise)
        places[:, :2] *= self._scale
        spread, variance, behind = KNOWN * brightness, np.array([0, noise**2]), None
        weight = np.full(frame.shape, noise**-2, dtype=np.float32)
        for again in (True, False):
            fit = self._fitted(frame, places, weight, brightness, spread, behind, 2)
            places, behind = fit.places[self._stays(fit, brightness)], fit.behind
            brightness, spread = _brightness(places, brightness, spread)
            variance = _variance(fit.light, fit.residual, noise)
            new = self._unexplained(fit, noise, brightness) if again else []
            if not len(new):
                break
            places = np.concatenate([places, new])
        fit = self._fitted(frame, places, _weight(fit.light, variance), brightness, spread, behind, 3, near=True)
        stays = self._stays(fit, brightness)
        return Explained(fit, stays, fit.places[stays], np.zeros((stays.sum(), 3)), brightness, spread, variance)

    def following(self, frame: NDArray[np.float32], before: Explained) -> Explained:
        """Explain the frame after one that is explained. A particle that appears in it is in the table of the next."""
        start, velocity = before.places, before.velocity
        places = start + np.pad(velocity, ((0, 0), (0, 1)))
        weight = _weight(before.fit.light, before.variance)
        fit = self._fitted(frame, places, weight, before.brightness, before.spread, before.fit.behind, 2, near=True)
        stays = self._stays(fit, before.brightness)
        gone = before.stays.sum() - stays.sum()
        if gone > max(LOST * before.stays.sum(), 2) or not stays.any():
            return self.first(frame)
        places = fit.places[stays]
        moved = (velocity[stays] + places[:, :3] - start[stays, :3]) / 2
        brightness, spread = _brightness(places, before.brightness, before.spread)
        noise = float(np.sqrt(before.variance[-1]))
        new = self._unexplained(fit, noise, brightness)
        return Explained(
            fit,
            stays,
            np.concatenate([places, new]),
            np.concatenate([moved, np.zeros((len(new), 3))]),
            brightness,
            spread,
            _variance(fit.light, fit.residual, noise),
        )

    def _fitted(
        self,
        frame: NDArray[np.float32],
        places: NDArray[np.float64],
        weight: NDArray[np.float32],
        brightness: float,
        spread: float,
        behind: NDArray[np.float32] | None,
        steps: int,
        near: bool = False,
    ) -> JointFit:
        """All particles and the background at full resolution."""
        return fitted(
            self._shapes,
            frame,
            places,
            weight,
            brightness=brightness,
            spread=spread,
            steps=steps,
            surface=self._surface,
            behind=behind,
            near=near,
        )

    @staticmethod
    def _stays(fit: JointFit, brightness: float) -> NDArray[np.bool_]:
        return (fit.explains > EXPLAINS) & (fit.places[:, 3] > brightness / 2)

    def _unexplained(self, fit: JointFit, noise: float, brightness: float) -> NDArray[np.float64]:
        """Places of further particles, at full resolution; some may lie outside the frame."""
        small = self._reduced(fit.residual)
        new = self._new(small, noise, brightness, whiten=False, outside_px=self._size / 4)
        return new * (self._scale, self._scale, 1, 1)

    def _reduced(self, frame: NDArray[np.float32]) -> NDArray[np.float32]:
        """The frame at the resolution of the search."""
        return cv2.pyrDown(frame) if self._scale == 2 else frame

    def _new(
        self,
        residual: NDArray,
        noise: float,
        brightness: float,
        *,
        whiten: bool,
        outside_px: float = 0,
    ) -> NDArray[np.float64]:
        """Places of further particles in what others leave, at the resolution of the search."""
        new, _ = self._filter(
            residual,
            noise / self._scale,
            brightness=brightness,
            spread=0.05 * brightness,
            whiten=whiten,
            least=LEAST_GAIN,
            share=SHARE,
            apart_px=self._size / 6 / self._scale,
            outside_px=outside_px / self._scale,
        )
        new[:, 3] = brightness
        return new

    def _search(self, small: NDArray[np.float32], noise: float) -> tuple[NDArray[np.float64], float]:
        """Places at the resolution of the search, and the particles' brightness."""
        light, behind = np.zeros_like(small), np.median(small)
        new, brightness = self._first_look(small - behind, noise)
        weight = np.full(small.shape, (noise / self._scale) ** -2, dtype=np.float32)
        places = np.zeros((0, 4))
        for stage, blur, shapes in zip(STAGES, self._blurs, self._small_shapes, strict=True):
            for _ in range(stage.rounds):
                if not stage.whiten:
                    behind = self._small_surface.fit(small - light, weight)
                if new is None:
                    rest = small - behind - light
                    new = self._new(rest, noise, brightness, whiten=stage.whiten)
                found, new = new, None
                if not len(found):
                    break
                fit = fitted(
                    shapes,
                    _high_passed((small - behind)[None], blur)[0],
                    np.concatenate([places, found]),
                    weight,
                    brightness=brightness,
                    spread=KNOWN * brightness,
                    steps=2,
                )
                places = fit.places[fit.explains > EXPLAINS]
                places[:, 3] = brightness
                light = np.zeros_like(small)
                self._small_shapes[-1].draw(places, small.shape).add_to(light, places[:, 3])
                if len(found) < 0.05 * len(places):
                    break
        return places, brightness

    def _first_look(self, small: NDArray[np.float32], noise: float) -> tuple[NDArray[np.float64], float]:
        """Particles that stand out, and the brightness of those that stand out most."""
        places, gain = self._filter(
            small,
            noise / self._scale,
            whiten=True,
            least=LEAST_GAIN,
            share=0,
            apart_px=self._size / 6 / self._scale,
        )
        if not len(places):
            return places, 1.0
        best = np.argsort(-gain)[: -(-len(gain) // 3)]
        brightness = float(np.median(places[best, 3]))
        # Where few particles are most of the spectrum, the filter takes them for noise and for faint.
        weight = np.full(small.shape, (noise / self._scale) ** -2, dtype=np.float32)
        sharp = _high_passed(small[None], self._blurs[0])[0]
        fit = fitted(self._small_shapes[0], sharp, places, weight, brightness=brightness, spread=brightness, steps=4)
        brightness = float(np.median(fit.places[best, 3]))
        places = fit.places[np.abs(np.log(fit.places[:, 3] / brightness)) < np.log(2)]
        places[:, 3] = brightness
        return places, brightness


def _high_passed(images: NDArray, blur: float) -> NDArray[np.float32]:
    """Images (k, rows, columns) less what remains of them when blurred."""
    images = images.astype(np.float32)
    if not blur:
        return images
    return np.stack([image - cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REFLECT) for image in images])


def _brightness(places: NDArray, brightness: float, spread: float) -> tuple[float, float]:
    """Median brightness of the particles, and how far they scatter about it, never less than so few can tell."""
    if not len(places):
        return brightness, spread
    middle = float(np.median(places[:, 3]))
    scatter = float(np.median(np.abs(places[:, 3] - middle))) / 0.6745
    return middle, float(np.hypot(max(scatter, KNOWN * middle), 0.1 * middle / np.sqrt(len(places))))


def _variance(light: NDArray, residual: NDArray, noise: float, bins: int = 12) -> NDArray[np.float64]:
    """A pixel's variance as a line in the particles' light: photon noise over read noise.

    The images' own errors grow with the square of the light. That is found, too, but left out: these errors are
    those of a few patterns, not of single pixels, and to trust bright pixels less for them costs more than they do.
    """
    light, residual = np.abs(light[::3, ::3]).ravel(), np.abs(residual[::3, ::3]).ravel()  # enough of them
    rank, dark = np.argsort(light), np.count_nonzero(light == 0)
    # Of few particles, light falls on few pixels.
    parts = [part for part in (rank[:dark], *np.array_split(rank[dark:], bins - 1)) if len(part) > 50]
    values = np.array([(light[part].mean(), (np.median(residual[part]) / 0.6745) ** 2) for part in parts])
    if len(values) < 4:
        return np.array([0, noise**2])
    light, variance = values.T
    sure, brightest = 1 / np.maximum(variance, 0.25 * noise**2), max(light.max(), 1e-9)
    terms = (light[:, None] / brightest) ** np.arange(3)
    level, linear, _ = nnls(terms * sure[:, None], variance * sure)[0]
    return np.array([linear / brightest, max(level, 0.25 * noise**2)])


def _weight(light: NDArray[np.float32], variance: NDArray[np.float64]) -> NDArray[np.float32]:
    """One over the variance of each pixel."""
    weight = np.empty_like(light)
    _fill_weight(light, *variance.astype(np.float32), weight)
    return weight


@compiled
def _fill_weight(light, linear, level, weight):  # pragma: no cover
    for r in range(light.shape[0]):
        for c in range(light.shape[1]):
            weight[r, c] = 1 / (linear * abs(light[r, c]) + level)
