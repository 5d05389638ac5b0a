"""The pattern model learned from all particles of a scan at once.

The scan's particles may overlap, differ in amplitude, and be in focus at different slices. Each slice is taken for a
smooth background and the sum of their images. What is unknown is solved for in turns, each by least squares over the
whole scan: positions, amplitudes and heights of the particles, all at once, with the patterns as they are; then the
patterns, from the residual of the slices.

Particles are not quite alike: some are larger, some are two that stick together. The ways in which they differ most
from the mean pattern (`modes`) are learned as well, with each particle's coefficients, so that a particle that is
measured may differ, too, as far as those of the scan do. Else its size would be taken for its depth, near focus.
"""

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve
from scipy.ndimage import gaussian_filter, shift, uniform_filter1d
from scipy.spatial import KDTree
from scipy.stats import median_abs_deviation
from skimage.registration import phase_cross_correlation

from gdptlab._checks import depths, flag, numbers, real_array, whole
from gdptlab._compiled import compiled, on_one_core
from gdptlab.denoising import noise_level, noise_line
from gdptlab.fit.background import Background
from gdptlab.fit.model import ERROR_SCALE_PX, PatternModel, field_terms
from gdptlab.fit.pattern import LARGEST, continued, image_size
from gdptlab.fit.renderer import Columns, Renderer

ALONE = 0.75
"""Particles with no neighbour nearer than this fraction of an image's size give the first patterns."""

MISFIT = 0.05
"""Standard deviation of a pixel that the patterns' own error adds, as a fraction of the light in it."""

RIDGE = 0.5
"""Regularisation of a pattern's changes over the field, and of the modes, as a fraction of the weight of the mean
pattern. Chosen, between 0.05 and 2, by learning from half of a real scan's particles and measuring the other half in
its slices."""

BELIEVED = 1.0
"""Slices by which a particle's height may differ from the focal surface until modes tell how particles differ."""

SMOOTH = (1.0, 0.08)
"""Slices over which patterns are smoothed along z: at least, and as a fraction of the distance from focus. Where an
image is wide it changes slowly, but noise differs from slice to slice and makes depths stick to some of them."""

SLICES = 35
"""Number of slices, evenly spread, from which positions are learned: neighbouring ones say much the same of them."""

FIRST_STEPS = 2
"""Gauss-Newton steps of the positions in each turn before modes are learned: positions may be off by pixels then."""

SIZE_SLICES = 15
"""Number of slices, evenly spread, in which the size of the images is sought."""

WIDER = 1.5
"""Factor by which patterns are wider than the median image seems: its skirt is lost in the noise of one particle, not
in that of all. Patterns that are the same all over the field always are, once: chosen on a scan of 30 equal beads,
whose depths on the far side of focus are off by 1.5 µm with 1, 0.7 with 1.25 and 0.2 with 1.5. Patterns that change
over the field become so once or twice where they do not hold the light (HELD)."""

HELD = 0.97
"""Least fraction of the particles' light, on average over the slices, that patterns that change over the field hold.
The median image's size holds 0.84 to 0.86 and one wider by WIDER 0.95 to 0.96 in four scans of row `field` of
`tests/benchmark_fit.py` (seeds 7300 and 8300), and more than 0.98 in the scan of row `planar`. With 0.9 patterns of
row `field` are widened once only: RMS z of 50 a frame is 1.0 µm, not 0.47 (8 frames, seed 8300). Patterns with two
nodes per pixel, as those of row `planar`, are not made wider."""

FREE = 0.1
"""Least fraction of the pixels that images leave free for patterns that change over the field to become wider: in a
crowd neighbours' light would be taken for a skirt. Scans of row `field` leave 0.13 to 0.16 free with the widest
patterns. The value itself is a convention."""

KNOTS = 16, 4
"""Distances between the knots of the background of a slice, in halves of a pattern: for patterns that are the same all
over the field or were made wider, and for others. Chosen on the same scan as WIDER: with 4 the background takes the
skirts of the images, and depths are off by 2.6 µm. Of patterns that change over the field a coarse background spoils
the change; for those that were made wider no other value was measured."""

GAPS = 8
"""Power of the distance from the nearest particle, in halves of a pattern that was made wider, by which a pixel counts
for the background: images cover most of such a scan, and the background would take their skirts. Chosen on row `field`
of `tests/benchmark_fit.py`, 50 a frame (8 frames, 2 calibrations, seed 8300): RMS z is 0.83 µm with 0, 1.02 with 2,
0.47 with 8, and 0.50 with 16, where a frame takes twice as long."""

NOISE_SLICES = 6
"""Number of slices, evenly spread, from whose residual the noise is learned: more than a million pixels."""

MODES, PARTICLES_PER_MODE = 8, 8
"""Largest number of modes, and the number of particles that each needs."""

PARTICLES_FOR_FIELD = 40
"""Number of particles from which on the patterns change over the field unasked: ten for each term."""

DIFFER = 0.07
"""Particles may differ in slices whose brightest pixel is above this fraction of the scan's brightest, as far from the
middle as the pattern stays above it. Beyond, a mode would rather explain the light of neighbours. Chosen, between
0.05 and 0.15, like RIDGE."""

SHARP_PX = 1.5
"""Radius of an image above half its height, in focus, below which a pattern has two nodes per pixel."""

ALIKE = 0.5
"""Least median correlation of the particles' images with the model's. Of a scan it is above 0.8; frames in which
particles move have less than 0.3."""


@on_one_core
def learned(
    scan: ArrayLike,
    z_um: ArrayLike,
    beads_px: ArrayLike,
    *,
    size: int | None = None,
    field: bool | None = None,
    modes: int | None = None,
    turns: int = 3,
    learn_from: ArrayLike | None = None,
) -> tuple[PatternModel, pd.DataFrame]:
    """Learn the pattern model from a scan.

    Parameters
    ----------
    scan : array (N, rows, columns)
        Frames at known depths, through focus, of particles that stay in place.
    z_um : array (N,)
        Depths, increasing, evenly spaced.
    beads_px : array (P, 2)
        About where the particles are: x, y, px, good to a few pixels.
    size : int, optional
        Rows and columns of the widest image, odd; if not given, found in the median of the particles' surroundings, in
        which neighbours do not show, and made wider (`WIDER`, `HELD`).
    field : bool, optional
        Whether the patterns change over the field; if not given, from PARTICLES_FOR_FIELD particles on.
    modes : int, optional
        Number of ways in which particles may differ; if not given, one for each eight particles, at most 8; where
        patterns that change over the field were made wider, none that noise alone may make.
    turns : int
        Of solving for positions and for patterns; as many again with modes.
    learn_from : array of bool (P,), optional
        Which of the particles the patterns are learned from; all, but for those on the border, if not given. The light
        of the others is accounted for, so that they can serve to test the model.

    Returns
    -------
    model : PatternModel
    beads : DataFrame
        A row for each particle: `x_px`, `y_px`, `amplitude`; `height_um`, where it is in focus beside the middle of
        the field; `learned`, whether the patterns were learned from it.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, there are fewer particles than `field` and `modes` need, or the particles
        do not stay in place.
    """
    scan, beads_px = real_array("scan", scan, 3), _beads("beads_px", beads_px, np.shape(scan))
    steps = np.diff(depths("z_um", z_um))
    if len(steps) != len(scan) - 1 or len(scan) < 8:
        raise ValueError(f"z_um: got {len(steps) + 1} depths for {len(scan)} frames, needed are as many, 8 or more")
    if steps.min() <= 0 or np.ptp(steps) > 0.1 * steps.mean():
        raise ValueError(f"z_um: got steps from {steps.min():g} to {steps.max():g} µm, allowed are even ones above 0")
    if np.ptp(scan) == 0:
        raise ValueError("scan: got frames without contrast, allowed are images of particles")
    widened = False
    if size is None:
        alike = not (len(beads_px) >= PARTICLES_FOR_FIELD if field is None else field)
        size, widened = _found_size(scan, beads_px, alike)
    whole("size", size, 5, min(scan.shape[1:]))
    if size % 2 == 0:
        raise ValueError(f"size: got {size}, allowed are odd numbers")
    whole("turns", turns, 1, 100)
    chosen = _chosen(scan, beads_px, size, learn_from)
    learning = _Learning(scan, beads_px[:, ::-1].astype(float), size // 2, chosen, widened=widened)
    count = int(learning.chosen.sum())
    field = count >= PARTICLES_FOR_FIELD if field is None else flag("field", field)
    unasked = modes is None
    modes = min(MODES, count // PARTICLES_PER_MODE) if unasked else whole("modes", modes, 0, 100)
    needed = max(10 if field else 1, 4 * modes)
    if count < needed:
        raise ValueError(
            f"scan: got {count} particles inside it to learn from, needed are {needed} for field = {field} and "
            f"modes = {modes}; scan more particles, or ask for less"
        )
    learning.begin(4 if field else 1)
    for turn in range(turns):
        learning.learn_patterns(first=turn == 0, symmetric=True)
        for _ in range(FIRST_STEPS):
            learning.learn_places()
    learning.centre()
    if modes:
        learning.begin_modes(modes, above_noise=unasked and widened)
    for _ in range(turns):
        learning.learn_patterns()
        learning.learn_coefficients()
        learning.learn_places()
    learning.learn_patterns()
    return learning.model(np.asarray(z_um, dtype=float)), learning.beads(steps.mean())


def _beads(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return `value` as places (P, 2) in frames of a scan of `shape`."""
    places = numbers(name, value)
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise ValueError(f"{name}: got shape {places.shape}, allowed are x and y of one bead or more, (P, 2)")
    if ((places < 0) | (places > np.array(shape[:0:-1]) - 1)).any():
        raise ValueError(f"{name}: got beads outside the frames, allowed are those within {shape[2]} by {shape[1]} px")
    return places


def _chosen(scan: NDArray, beads_px: NDArray, size: int, learn_from: ArrayLike | None) -> NDArray[np.bool_]:
    """Particles to learn from: of one on the border half an image is seen, which would make the halves differ."""
    chosen = np.ones(len(beads_px), bool) if learn_from is None else np.asarray(learn_from)
    if chosen.shape != (len(beads_px),) or chosen.dtype != bool:
        raise ValueError(
            f"learn_from: got shape {chosen.shape}, needed is a bool for each of {len(beads_px)} particles"
        )
    end = np.array(scan.shape[:0:-1]) - 1
    return chosen & (np.minimum(beads_px, end - beads_px).min(axis=1) > size / 4)


def _found_size(scan: NDArray[np.float32], beads_px: NDArray, alike: bool) -> tuple[int, bool]:
    """Size of patterns, and whether those that change over the field must be wider than the median image seems."""
    largest = min(LARGEST // 2, min(scan.shape[1:]) // 4)
    some = scan[:: max(len(scan) // SIZE_SLICES, 1)]
    cuts = np.stack([_window(some, np.rint(place[::-1]).astype(int), largest) for place in beads_px])
    cuts = cuts - np.median(scan)
    size = image_size(np.median(cuts / np.abs(cuts).max(axis=(1, 2, 3), keepdims=True), axis=0))
    halves = [min(max(int(WIDER**n * size) // 2, 2), largest) for n in range(3)]
    if alike:
        return 2 * halves[1] + 1, False
    places = beads_px[:, ::-1].astype(float)
    away = _away(places, scan.shape[1:])
    halves = halves[:1] + [half for half in halves[1:] if (away > half).mean() > FREE]
    rough = _Learning(some, places, halves[-1], np.ones(len(beads_px), bool), widened=True)
    rough.begin(1)
    if rough.fine > 1:  # widened, the sharp beads of tests/test_learning.py are placed to 0.2 px, not to 0.06
        return 2 * halves[0] + 1, False
    for turn in range(3):
        rough.learn_patterns(first=turn == 0, symmetric=True)
        rough.learn_places()
    pattern = rough.patterns[0] * np.sign(rough.patterns[0].sum())
    inside = [slice(halves[-1] - half, halves[-1] + half + 1) for half in halves]
    pattern[:, inside[0], inside[0]] = np.abs(pattern[:, inside[0], inside[0]])  # dark rings are light as well
    light = np.array([pattern[:, part, part].sum(axis=(1, 2)) for part in inside])
    n = int(np.argmax((light / light[-1]).mean(axis=1) >= HELD))
    return 2 * halves[n] + 1, n > 0


def _away(places: NDArray, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Distance of each pixel (rows, columns) from the nearest of `places` (P, 2 or more: y, x), px."""
    clear = np.ones(shape, np.uint8)
    y, x = np.rint(places[:, :2]).astype(int).T.clip(0, np.array(shape)[:, None] - 1)
    clear[y, x] = 0
    return cv2.distanceTransform(clear, cv2.DIST_L2, cv2.DIST_MASK_5)


def _window(images: NDArray, place: NDArray[np.int64], half: int) -> NDArray:
    """Part (N, 2 half + 1, 2 half + 1) of images about the pixel `place` (y, x); the edge is repeated beyond it."""
    rows, columns = (
        np.clip(np.arange(p - half, p + half + 1), 0, n - 1) for p, n in zip(place, images.shape[1:], strict=True)
    )
    return images[:, rows[:, None], columns]


class _Learning:
    """A scan (N, rows, columns) and all that is known of it so far.

    `places` (P, 4 + K) holds y, x (px), a slice, amplitude, and the coefficients of the modes; `heights` (P,) the slice
    at which each is in focus, less `middle`; both sorted by x.
    """

    def __init__(
        self, scan: NDArray[np.float32], places: NDArray, half: int, chosen: NDArray[np.bool_], *, widened: bool
    ) -> None:
        self.scan, self.half, self.shape, self.widened = scan, half, scan.shape[1:], widened
        self._order = np.argsort(places[:, 1], kind="stable")
        self.chosen = chosen[self._order]
        self.places = np.pad(places[self._order], ((0, 0), (0, 2)))
        self.noise = max(noise_level(scan[:: max(len(scan) // 10, 1)]), 1e-4 * float(np.ptp(scan))) or 1.0
        self.line, self.believed = np.array([0, self.noise**2]), BELIEVED
        self.levels = np.median(scan[:, ::4, ::4], axis=(1, 2))
        self._work = np.empty((3, *scan.shape), np.float32)

    def begin(self, terms: int) -> None:
        """First amplitudes and heights, from the particles' small surroundings, and empty patterns."""
        near = max(self.half // 3, 2)
        cuts = np.stack([self._cut(self.scan, i, near) for i in range(len(self.places))])
        cuts -= self.levels[:, None, None]
        typical = np.median(cuts[self.chosen] / np.abs(cuts[self.chosen]).max(axis=(1, 2, 3), keepdims=True), axis=0)
        peak = np.abs(typical).max(axis=(1, 2))
        bright = np.abs(cuts[self.chosen])
        inside = (bright > bright.max(axis=(2, 3), keepdims=True) / 2).sum(axis=(2, 3))
        radius = np.sqrt(np.median(inside, axis=0)[peak > 0.5 * peak.max()].min() / np.pi)
        self.fine = 2 if radius < SHARP_PX else 1
        self.middle = float((peak**4 @ np.arange(len(peak))) / (peak**4).sum())
        amplitude = np.einsum("pkij,kij->p", cuts, typical)
        self.places[:, 3] = np.maximum(amplitude / np.median(amplitude[self.chosen]), 0.02)
        profiles = np.einsum("pkij,kij->pk", cuts, typical / np.maximum(peak, peak.max() / 20)[:, None, None])
        self.heights = _lags(profiles, len(self.scan) // 10)
        self.terms = field_terms(self.places[:, 1], self.places[:, 0], self.shape)[:, :terms]
        self._background = Background(self.shape, KNOTS[terms > 1 and not self.widened] * self.half)
        reached = np.minimum(_away(self.places, self.shape) / self.half, 1)
        self._gaps = np.maximum(reached**GAPS, 1e-4) if self.widened else np.float32(1)
        self._bring_to_surface()
        m = 2 * self.fine * self.half + 1
        self.patterns = np.zeros((terms, len(self.scan), m, m), np.float32)
        self.modes = np.zeros((0, len(self.scan), m, m), np.float32)
        self._prepare()

    def _cut(self, images: NDArray, i: int, half: int) -> NDArray:
        """Part of images (N, rows, columns) about particle i."""
        return _window(images, np.rint(self.places[i, :2]).astype(int), half)

    def _bring_to_surface(self) -> None:
        """Focal surface through the heights, which no outlier pulls; a height far off it is brought back."""
        terms, heights, trust = self.terms[self.chosen], self.heights[self.chosen], np.ones(self.chosen.sum())
        for _ in range(10):
            surface = np.linalg.lstsq(terms * trust[:, None], heights * trust, rcond=None)[0]
            trust = 1 / np.sqrt(np.maximum(1, np.abs(heights - terms @ surface) / 0.3))
        self.surface = np.pad(surface, (0, 4 - len(surface)))
        smooth = self.terms @ surface
        self.heights = np.clip(self.heights, smooth - self.believed, smooth + self.believed)

    def _prepare(self) -> None:
        """Prepare the drawing of the patterns and modes as they are."""
        modes = self.modes if len(self.modes) else None
        self._renderer = Renderer(self.patterns, self.fine, noise=self.noise, modes=modes)

    def _slice(
        self, k: int, *, derivatives: bool = True, by_mode: bool = False
    ) -> tuple[Columns, NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Columns of the particles in a slice, the residual, the pixels' weight, and the model image."""
        places = self.places.copy()
        places[:, 2] = k
        columns = self._renderer.draw(places, self.shape, self.heights, derivatives=derivatives, by_mode=by_mode)
        light = np.zeros(self.shape, np.float32)
        columns.add_to(light, places[:, 3])
        weight = self._weight(light + self.levels[k], light)
        background = self._background.fit(self.scan[k] - light, weight * self._gaps)
        self.levels[k] = background.mean()
        return columns, self.scan[k] - light - background, weight, light + background

    def _weight(self, model: NDArray[np.float32], light: NDArray[np.float32]) -> NDArray[np.float32]:
        """One over the variance of each pixel: of its noise and of the patterns' own error."""
        slope, intercept = self.line.astype(np.float32)
        variance = np.maximum(intercept + slope * model, np.float32(self.noise**2 / 4))
        return 1 / (variance + np.square(np.float32(MISFIT) * light))

    def _residual(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Residual of all slices and its weight, until the next call; photon noise is learned on the way."""
        rest, weight, model = self._work
        for k in range(len(self.scan)):
            _, rest[k], weight[k], model[k] = self._slice(k, derivatives=False)
        if self.patterns.any():
            some = slice(None, None, max(len(rest) // NOISE_SLICES, 1))
            self.line = noise_line(rest[some], model[some])
        return rest, weight

    # ---------------- patterns

    def learn_patterns(self, *, first: bool = False, symmetric: bool = False) -> None:
        """Add to the patterns, and to the modes, the residual around the particles.

        In the `first` turn nobody's neighbours are known yet, and only particles without near ones are used. While
        positions are rough, a mean pattern that is not `symmetric` under half a turn would keep them where they are:
        it has a part for each bright particle that is off.
        """
        rest, weight = self._residual()
        chosen, count = self.chosen, self.terms.shape[1]
        if first and len(self.places) > 1:
            nearest = KDTree(self.places[:, :2]).query(self.places[:, :2], k=2)[0][:, 1]
            alone = chosen & (nearest > ALONE * (2 * self.half + 1))
            chosen = alone if alone.sum() >= 2 * count else chosen
        smoother = _smoother(len(rest), self.middle)
        change = self._regressed(rest, weight, chosen, self.terms, np.arange(len(rest)), self.half)
        if len(self.modes):
            slices, half, zone = self._zone()
            both = np.concatenate([self.terms, self.places[:, 4:]], axis=1)
            both = self._regressed(rest, weight, chosen, both, slices, half)
            change[zone] = both[:count]
            self.modes[zone] = _along(smoother[slices][:, slices], self.modes[zone] + both[count:])
        self.patterns = _along(smoother, self.patterns + change)
        if symmetric:
            self.patterns[0] = (self.patterns[0] + self.patterns[0, :, ::-1, ::-1]) / 2
        self._settle()
        self._prepare()

    def _settle(self) -> None:
        """Give back to positions and heights what the patterns' changes over the field, and the modes, took from them.

        A change in proportion to the mean pattern's slope along x, say, draws particles aside that have another
        position in truth. Heights keep what the modes tell of them: all particles of the scan are on one plane.
        """
        y, x, z = (-np.gradient(self.patterns[0], axis=axis) for axis in (1, 2, 0))
        slopes = self.fine * y, self.fine * x, z
        for slope, of in zip(slopes, (0, 1, None), strict=True):
            power = float(np.vdot(slope, slope)) or 1.0
            moved = np.array([np.vdot(slope, pattern) / power for pattern in self.patterns[1:]])
            self.patterns[1:] -= moved.astype(np.float32)[:, None, None, None] * slope
            shift_ = self.terms[:, 1:] @ moved
            if of is None:
                self.heights += shift_
                continue
            told = np.array([np.vdot(slope, mode) / power for mode in self.modes])
            self.modes -= told.astype(np.float32)[:, None, None, None] * slope
            self.places[:, of] += shift_ + self.places[:, 4:] @ told

    def _regressed(
        self,
        rest: NDArray[np.float32],
        weight: NDArray[np.float32],
        chosen: NDArray[np.bool_],
        coefficients: NDArray[np.float64],
        slices: NDArray[np.int64],
        half: int,
    ) -> NDArray[np.float32]:
        """Residual around the chosen particles, node by node regressed on their `coefficients` (P, M).

        A pixel counts for the four nodes about it, by bilinear weights; what nodes share is left for the next turn.
        Shape is (M, slices, m, m).
        """
        count, m = coefficients.shape[1], 2 * self.fine * half + 1
        square = np.zeros((len(slices), m, m, count * (count + 1) // 2), np.float32)
        right = np.zeros((len(slices), m, m, count), np.float32)
        places = np.concatenate([self.places[:, :2], self.heights[:, None], self.places[:, 3:4]], axis=1)[chosen]
        _accumulate(
            rest, weight, places, coefficients[chosen].astype(np.float32), slices, self.fine, half, square, right
        )
        matrix = np.empty((len(slices), m, m, count, count), np.float32)
        upper = np.triu_indices(count)
        matrix[..., upper[0], upper[1]] = matrix[..., upper[1], upper[0]] = square
        # Of nodes that few meet, by their neighbours; never by all: where light is bright they tell far less.
        held = _blurred(square[..., 0], 5) + 1e-9
        diagonal = np.arange(count)
        matrix[..., diagonal, diagonal] += held[..., None] * np.where(diagonal, RIDGE, 1e-3).astype(np.float32)
        return np.moveaxis(np.linalg.solve(matrix, right[..., None])[..., 0], -1, 0)

    def centre(self) -> None:
        """Move the patterns, and the particles, so that a pattern is symmetric under half a turn about its middle."""
        light = np.abs(self.patterns[0]).max(axis=(1, 2))
        order = np.flatnonzero(light > DIFFER * light.max())
        off = [
            phase_cross_correlation(p, p[::-1, ::-1], upsample_factor=50, normalization=None)[0] / 2
            for p in self.patterns[0, order]
        ]
        # Half a turn about the middle moves an image that is symmetric about c by -2 c.
        off = np.average(off, axis=0, weights=light[order] ** 2)
        flat = self.patterns.reshape(-1, *self.patterns.shape[2:])
        self.patterns = _shifted(flat, -off).reshape(self.patterns.shape)
        self.places[:, :2] += off / self.fine
        self._prepare()

    # ---------------- particles

    def learn_places(self) -> None:
        """A Gauss-Newton step of all particles' y, x, height and amplitude, each the same in all slices."""
        n = 4 * len(self.places)
        matrix, right = np.zeros((n, n)), np.zeros(n)
        for k in range(0, len(self.scan), max(len(self.scan) // SLICES, 1)):
            columns, rest, weight, _ = self._slice(k)
            right += columns.gradient(rest, weight)[0].ravel()
            _add_band(matrix, columns.matrix(weight))
        matrix[np.diag_indices(n)] *= 1.001
        matrix[np.diag_indices(n)] += 1e-9 * np.trace(matrix) / n
        change = solve(matrix, right, lower=True, assume_a="pos").reshape(-1, 4)
        px = max(0.3, self.half / 30)
        longest = np.stack([np.full(len(change), s) for s in (px, px, 0.5)] + [0.2 * self.places[:, 3]], axis=1)
        change = np.clip(change, -longest, longest)
        self.places[:, [0, 1, 3]] += change[:, [0, 1, 3]]
        self.places[:, 3] = np.maximum(self.places[:, 3], 0.02)
        self.heights -= change[:, 2]
        self._bring_to_surface()

    def _zone(self) -> tuple[NDArray[np.int64], int, tuple[slice, ...]]:
        """Slices in which particles may differ, how far from the middle (px), and where in the patterns that is."""
        light = np.abs(self.patterns[0])
        peak = light.max(axis=(1, 2))
        slices = np.flatnonzero(peak > DIFFER * peak.max())
        slices = np.arange(slices[0], slices[-1] + 1)
        bright = gaussian_filter(light[slices], (1, 1, 1)) > DIFFER * peak[slices, None, None]
        away = np.abs(np.arange(light.shape[1]) - light.shape[1] // 2)
        ends = np.maximum(*(np.where(bright.any(axis=axis), away, 0).max(axis=1) for axis in (1, 2)))
        half = int(np.clip(np.percentile(ends, 90) // self.fine + 1, 3, self.half))
        nodes = slice(self.fine * (self.half - half), self.fine * (self.half + half) + 1)
        return slices, half, np.s_[:, slices[0] : slices[-1] + 1, nodes, nodes]

    def begin_modes(self, count: int, *, above_noise: bool) -> None:
        """Coefficients of the modes: the strongest principal components of the residual around the particles.

        With `above_noise` they are only those that are stronger than any of white noise.

        From here on all particles are in focus on the focal surface, as those of a scan lie on a plane: how high one
        seems to be beside it is part of how it differs. A larger one seems to be farther away.
        """
        self.believed = 0.0
        self._bring_to_surface()
        (slices, half, zone), (rest, _), margin, around = self._zone(), self._residual(), 3, []
        for i, (place, height) in enumerate(zip(self.places, self.heights, strict=True)):
            low = np.clip(slices + int(np.floor(height)), 0, len(rest) - 2)
            cut, part = self._cut(rest, i, half + margin), height % 1
            image = ((1 - part) * cut[low] + part * cut[low + 1]) / place[3]
            moved = _shifted(image, np.rint(place[:2]) - place[:2])
            around.append(moved[:, margin:-margin, margin:-margin].ravel())
        light = np.maximum(self.patterns[zone][0, :, :: self.fine, :: self.fine], 0)
        around = np.array(around) / np.sqrt(self.noise**2 + self.line[0] * light).ravel()
        size = np.sqrt((around**2).mean(axis=1))
        around *= np.minimum(1, np.median(size[self.chosen]) / size)[:, None]  # clusters, and what lies beside them
        vectors, strengths, _ = np.linalg.svd(around, full_matrices=False)
        if above_noise:  # white noise has none above the sum of the roots of its numbers of rows and columns
            count = min(count, int((strengths > np.sqrt(around.shape).sum()).sum()))
        if count:
            self._set_coefficients(vectors[:, :count])

    def _set_coefficients(self, values: NDArray[np.float64]) -> None:
        """Coefficients of mean 0 and standard deviation 1, which tell nothing that the place in the field tells."""
        told = np.linalg.lstsq(self.terms[self.chosen], values[self.chosen], rcond=None)[0]
        values = values - self.terms @ told
        spread, vectors = np.linalg.eigh(np.atleast_2d(np.cov(values[self.chosen].T)))
        root = vectors * np.sqrt(np.maximum(spread, 1e-6)) @ vectors.T
        self.places = np.concatenate([self.places[:, :4], values @ np.linalg.inv(root)], axis=1)
        if len(self.modes):
            self.patterns += np.einsum("ak,knij->anij", told.astype(np.float32), self.modes)
            self.modes = np.einsum("kl,lnij->knij", root, self.modes).astype(np.float32)
        else:
            self.modes = np.zeros((values.shape[1], *self.patterns.shape[1:]), np.float32)
        self._prepare()

    def learn_coefficients(self) -> None:
        """Coefficients of the modes that fit best, each particle's for itself, the rest as it is."""
        if not len(self.modes):
            return
        matrix, right = 0, 0
        for k in range(0, len(self.scan), max(len(self.scan) // SLICES, 1)):
            one, other = _each_alone(*self._slice(k, by_mode=True)[:3])
            matrix, right = matrix + one[:, 4:, 4:], right + other[:, 4:]
        right -= self.places[:, 4:]
        matrix += np.eye(len(self.modes))
        self._set_coefficients(self.places[:, 4:] + np.linalg.solve(matrix, right[..., None])[..., 0])

    # ---------------- what is handed over

    def model(self, z_um: NDArray[np.float64]) -> PatternModel:
        """Patterns that go on beyond their cut, with their errors."""
        rest, weight = self._residual()
        self._must_stay_in_place(rest)
        images = self.patterns[0]
        rim = (continued(images).shape[-1] - images.shape[-1]) // 2
        error = np.pad(self._pattern_error(rest, weight), ((0, 0), (rim, rim), (rim, rim)), mode="edge")
        return PatternModel(
            patterns=continued(self.patterns, images).astype(np.float32),
            z_um=z_um,
            nodes_per_px=self.fine,
            noise=float(np.sqrt(max(self.line[1] + self.line[0] * np.median(self.scan), self.noise**2 / 4))),
            size=2 * self.half + 1,
            pattern_error=error,
            own_error=self._own_error() * (1, 1, z_um[1] - z_um[0]),
            own_bias_um=np.zeros(len(z_um)),
            surface=self.surface,
            modes=np.pad(self.modes, ((0, 0), (0, 0), (rim, rim), (rim, rim))) if len(self.modes) else None,
        )

    def beads(self, step_um: float) -> pd.DataFrame:
        """Table of the particles, in the order in which they were given."""
        table = pd.DataFrame(
            {
                "x_px": self.places[:, 1],
                "y_px": self.places[:, 0],
                "amplitude": self.places[:, 3],
                "height_um": self.heights * step_um,
                "learned": self.chosen,
            }
        )
        return table.iloc[np.argsort(self._order)].reset_index(drop=True)

    def _must_stay_in_place(self, rest: NDArray[np.float32]) -> None:
        """Refuse frames whose particles move: what is common to all of them is then no image of one."""
        alike = []
        for i in np.flatnonzero(self.chosen):
            seen = self._cut(rest, i, self.half // 2)
            middle, near = self.fine * self.half, self.fine * (self.half // 2)
            cut = np.s_[middle - near : middle + near + 1 : self.fine]
            drawn = self.places[i, 3] * self.patterns[0][:, cut, cut]
            alike.append(np.corrcoef((seen + drawn).ravel(), drawn.ravel())[0, 1])
        if np.median(alike) < ALIKE:
            raise ValueError(
                f"scan: got frames in which particles are alike (correlation) to {np.median(alike):.2f} only, needed "
                f"is {ALIKE}: a scan, through focus, of particles that stay in place"
            )

    def _pattern_error(self, rest: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of the mean pattern as that of one particle, as in `PatternModel`.

        By how much the particles' residuals, smoothed over `ERROR_SCALE_PX`, exceed noise; and what noise and that
        excess make of the mean of so many.
        """
        density, chosen = 4 * np.pi * ERROR_SCALE_PX**2, np.flatnonzero(self.chosen)
        squares, noise, light = 0, 0, self.places[chosen, 3] ** 2
        for i in chosen:
            cut = gaussian_filter(self._cut(rest, i, self.half), (0, ERROR_SCALE_PX, ERROR_SCALE_PX))
            squares = squares + density * np.square(cut)
            noise = noise + 1 / self._cut(weight, i, self.half)
        fitted = (self.terms.shape[1] + len(self.modes)) / len(chosen)
        squares, noise = squares / light.sum() / max(1 - fitted, 0.5), noise / light.sum()
        differ = np.maximum(gaussian_filter(squares - noise, (2, 2 * ERROR_SCALE_PX, 2 * ERROR_SCALE_PX)), 0)
        error = np.sqrt(differ + (differ + noise) * (light**2).sum() / light.sum() ** 2)
        m = self.patterns.shape[-1]
        return np.stack([cv2.resize(e, (m, m)) for e in error.astype(np.float32)])

    def _own_error(self) -> NDArray[np.float64]:
        """Error of x, y (px) and slice, (N, 3): scatter, beyond noise, of what single slices give for the particles.

        It is that of particles from which the patterns were learned; M terms and modes learned from P particles make it
        smaller than for others by a factor 1 - M / P.
        """
        slices, scatter = np.arange(0, len(self.scan), max(len(self.scan) // 18, 1)), []
        smooth, size = self.terms @ self.surface[: self.terms.shape[1]], 4 + len(self.modes)
        for k in slices:
            matrix, right = _each_alone(*self._slice(k, by_mode=True)[:3])
            matrix[:, np.arange(4, size), np.arange(4, size)] += 1
            right[:, 4:] -= self.places[:, 4:]
            inverse = np.linalg.inv(matrix + 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(size))
            off = np.einsum("pij,pj->pi", inverse, right)[:, [1, 0, 2]]
            off[:, 2] += smooth - self.heights
            std = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))[:, [1, 0, 2]]
            used = (self.terms.shape[1] + len(self.modes) * self.modes[:, k].any()) / self.chosen.sum()
            square = median_abs_deviation(off[self.chosen], axis=0, scale="normal") ** 2 / (1 - min(used, 0.5)) ** 2
            scatter.append(
                np.maximum(square - np.median(std[self.chosen], axis=0) ** 2, 0) + square / self.chosen.sum()
            )
        scatter = np.sqrt(uniform_filter1d(scatter, 5, axis=0, mode="nearest"))
        return np.stack([np.interp(np.arange(len(self.scan)), slices, s) for s in scatter.T], axis=1)


def _lags(profiles: NDArray, most: int) -> NDArray[np.float64]:
    """Slices by which profiles (P, N) along z come later than their median, at most `most`."""
    profiles = profiles - profiles.mean(axis=1, keepdims=True)
    profiles = profiles / np.maximum(np.linalg.norm(profiles, axis=1, keepdims=True), 1e-30)
    lags, tried = np.zeros(len(profiles)), np.arange(-most - 1, most + 2)
    slices = np.arange(profiles.shape[1])
    for _ in range(3):
        typical = np.median([np.interp(slices + lag, slices, p) for lag, p in zip(lags, profiles, strict=True)], axis=0)
        alike = profiles @ np.stack([np.interp(slices - lag, slices, typical) for lag in tried], axis=1)
        best = np.clip(alike.argmax(axis=1), 1, len(tried) - 2)
        before, here, after = (alike[np.arange(len(best)), best + i] for i in (-1, 0, 1))
        bend = np.minimum(before + after - 2 * here, -1e-12)
        lags = tried[best] + np.clip((before - after) / (2 * bend), -0.5, 0.5)
        lags -= np.median(lags)
    return lags


def _along(matrix: NDArray[np.float64], patterns: NDArray) -> NDArray[np.float32]:
    """Matrix (N, N) applied along z to patterns (M, N, m, m)."""
    return np.einsum("kl,mlij->mkij", matrix.astype(np.float32), patterns, optimize=True).astype(np.float32)


def _shifted(images: NDArray, off: NDArray[np.float64]) -> NDArray[np.float32]:
    """Images (N, m, m) shifted by `off` (down, to the right), px."""
    return np.stack([shift(image, off, order=3, mode="nearest") for image in images])


def _blurred(images: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Images (N, m, m), each the mean over squares of that width."""
    return np.stack([cv2.blur(np.ascontiguousarray(image), (width, width)) for image in images])


def _each_alone(
    columns: Columns, rest: NDArray[np.float32], weight: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix (P, C, C) and right-hand side (P, C) of the least-squares problem of each particle for itself."""
    count, unknown = len(columns.boxes), len(columns.values)
    matrix, right = np.zeros((count, unknown, unknown)), np.zeros((count, unknown))
    for i, (y0, y1, x0, x1) in enumerate(columns.boxes):
        own = columns.values[:, columns.starts[i] : columns.starts[i + 1]]
        trusted = own * weight[y0:y1, x0:x1].ravel()
        matrix[i], right[i] = trusted @ own.T, trusted @ rest[y0:y1, x0:x1].ravel()
    return matrix, right


def _smoother(count: int, middle: float) -> NDArray[np.float64]:
    """Matrix (N, N) that replaces each value by that of a parabola through its neighbours along z."""
    slices, matrix = np.arange(count), np.empty((count, count))
    for k in slices:
        away = (slices - k) / max(SMOOTH[0], SMOOTH[1] * abs(k - middle))
        trust = np.exp(-(away**2) / 4)
        matrix[k] = np.linalg.pinv(np.stack([trust, trust * away, trust * away**2], axis=1))[0] * trust
    return matrix


def _add_band(matrix: NDArray, band: NDArray) -> None:
    """Add to the lower half of a square matrix its band, as `Columns.matrix` gives it."""
    n = len(matrix)
    for below, row in enumerate(band):
        i = np.arange(n - below)
        matrix[i + below, i] += row[: n - below]


@compiled
def _accumulate(rest, weight, places, coefficients, slices, fine, half, square, right):  # pragma: no cover
    """Add to `square` (S, m, m, M (M + 1) / 2) and `right` (S, m, m, M) the pixels around each place.

    A place is y, x, height and amplitude; the slice in which a particle is seen is interpolated.
    """
    count, rows, columns = rest.shape
    terms, m = coefficients.shape[1], square.shape[1]
    products = np.empty(square.shape[3], np.float32)
    for i in range(len(places)):
        y, x, height, amplitude = places[i]
        a = np.float32(amplitude)
        q = 0
        for s in range(terms):
            for t in range(s, terms):
                products[q] = a * a * coefficients[i, s] * coefficients[i, t]
                q += 1
        below = int(np.floor(height))
        part = np.float32(height - below)
        y0, y1 = max(int(np.ceil(y - half)), 0), min(int(np.floor(y + half)) + 1, rows)
        x0, x1 = max(int(np.ceil(x - half)), 0), min(int(np.floor(x + half)) + 1, columns)
        for n in range(len(slices)):
            low, high = slices[n] + below, slices[n] + below + 1
            # Beyond the ends of the scan the last slice, repeated, counts for next to nothing.
            known = np.float32(1.0 if low >= 0 and high < count else 1e-3)
            low, high = min(max(low, 0), count - 1), min(max(high, 0), count - 1)
            for r in range(y0, y1):
                v = fine * (r - y) + fine * half
                j = min(int(v), m - 2)
                fv = np.float32(v - j)
                for c in range(x0, x1):
                    u = fine * (c - x) + fine * half
                    k = min(int(u), m - 2)
                    fu = np.float32(u - k)
                    trust = known * ((1 - part) * weight[low, r, c] + part * weight[high, r, c])
                    seen = trust * a * ((1 - part) * rest[low, r, c] + part * rest[high, r, c])
                    for dj in range(2):
                        for dk in range(2):
                            share = (fv if dj else 1 - fv) * (fu if dk else 1 - fu)
                            into, over = square[n, j + dj, k + dk], right[n, j + dj, k + dk]
                            for q in range(len(products)):
                                into[q] += share * trust * products[q]
                            for t in range(terms):
                                over[t] += share * seen * coefficients[i, t]
