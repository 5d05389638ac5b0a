"""Calibration with all particles of a scan at once, for images that change over the field.

The scan's particles may overlap, differ in brightness, and be in focus at different slices. Each slice is taken
for a smooth background and the sum of their images (`field_images`); what is unknown is solved for in turns,
each by least squares over the whole scan: places, brightnesses and heights of the particles, all at once, with the
patterns as they are; then the patterns, from what that leaves of the slices. The turns end when nothing is left but
noise. Nobody needs to say where the particles are: in focus they stand out.

Particles are not quite alike: some are larger, some are two that stick together. The ways in which they differ most
from the mean pattern (`modes`) are learned as well, with each particle's share of them, so that a particle that is
measured may differ, too, as far as those of the scan do. Else its size would be taken for its depth, near focus.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve
from scipy.ndimage import shift, uniform_filter, uniform_filter1d
from scipy.spatial import KDTree

from gdptlab.background import Background
from gdptlab.calibration import Calibration, _depths, checked
from gdptlab.check import real_array, whole
from gdptlab.cores import on_one_core
from gdptlab.denoising import noise_level
from gdptlab.field_images import FINE, FieldImages, field_terms
from gdptlab.fit.pattern import particle_light
from gdptlab.particle_images import Columns

STANDS_OUT = 20.0
"""A particle in focus does by so many times the noise of a pixel, once blurred by its neighbours' blur."""

ALONE_PX = 28.0
"""Particles with no neighbour nearer than this give the first patterns."""

PHOTONS, MISFIT = 0.3, 0.05
"""A pixel's variance is the noise's, and this times its light, and the square of that share of its light."""

RIDGE = 0.5
"""Holds a pattern's changes over the field, and the modes, at nothing where few particles tell. Chosen, between 0.05
and 2, by learning from half of a real scan's particles and measuring the other half in its slices."""

BELIEVED = 1.0
"""Steps by which a particle's height may differ from the focal surface."""

SMOOTH = (1.0, 0.08)
"""Steps over which patterns are smoothed along z: at least, and as a share of the distance from focus. Where an
image is wide it changes slowly, but noise differs from step to step and makes depths stick to some of them."""

EVERY = 3
"""Slices from which places are found: neighbouring ones say much the same of them."""

MODES = 8
"""Ways in which particles may differ."""

DIFFER, DIFFER_PX = 0.07, 8
"""Particles may differ where their images are brighter than this share of the brightest, near focus, and so far from
the middle. Beyond, a mode would rather explain the light of neighbours. Chosen, between 0.05 and 0.15, likewise."""


@dataclass(frozen=True, eq=False)
class FieldCalibration:
    """Patterns over the field, and the focal surface. Made by `from_scan`, or of one particle by `from_one`.

    Attributes
    ----------
    patterns : float32 array (M, N, m, m)
        As in `FieldImages`, in counts, for a particle of brightness 1 (the scan's median).
    z_um : float64 array (N,)
        Depths, increasing.
    surface : float64 array (4,)
        Focal surface, in steps, in `field_terms`.
    middle : float
        Step at which a particle in the middle of the field is in focus.
    noise : float
        Standard deviation of a pixel of the scan.
    modes : float32 array (K, N, m, m)
        As in `FieldImages`; a particle's share of each is 0 on average, with standard deviation 1.
    own_error_um : float64 array (N,)
        How far a particle like those of the scan is off, at each depth, because it is not quite like them.
    beads : DataFrame
        The scan's particles: `x_px`, `y_px`, `brightness`; `height_um`, where each is in focus beside the
        middle of the field; `learned`, whether the patterns were learned from it.
    """

    patterns: NDArray[np.float32]
    z_um: NDArray[np.float64]
    surface: NDArray[np.float64]
    middle: float
    noise: float
    modes: NDArray[np.float32]
    own_error_um: NDArray[np.float64]
    beads: pd.DataFrame
    _plans: dict = field(default_factory=dict, repr=False)

    @classmethod
    @on_one_core
    def from_scan(
        cls,
        scan: ArrayLike,
        z_um: ArrayLike,
        *,
        reach_px: int = 18,
        turns: int = 4,
        learn_from: ArrayLike | None = None,
    ) -> Self:
        """Calibrate with all particles of a scan.

        Parameters
        ----------
        scan : array (N, rows, columns)
            Frames at known depths, through focus; ten or more particles.
        z_um : array (N,)
            Depths, strictly increasing or decreasing, evenly spaced.
        reach_px : int
            How far the widest image reaches from its middle.
        turns : int
            Of solving for places and for patterns; as many again with modes.
        learn_from : array of bool, optional
            Which of the particles, in the order of `find_beads`, the patterns and the focal surface are learned
            from (all, but for those on the border). The others' light is only accounted for, so that they can serve
            to test the calibration.

        Raises
        ------
        TypeError, ValueError
            If the scan or z_um are not of that form, or the scan has fewer than ten particles to learn from.
        """
        scan, z_um = real_array("scan", scan, 3), _depths(z_um)
        if len(z_um) != len(scan) or len(scan) < 8:
            raise ValueError(
                f"z_um: got {len(z_um)} depths for {len(scan)} frames, needed is one for each of 8 or more"
            )
        steps = np.diff(z_um)
        if np.ptp(steps) > 0.1 * abs(steps.mean()):
            raise ValueError(f"z_um: got steps from {steps.min():g} to {steps.max():g} µm, allowed are even ones")
        reach_px, turns = whole("reach_px", reach_px, 4, min(scan.shape[1:]) // 4), whole("turns", turns, 1, 20)
        order = np.argsort(z_um)
        learning = _Learning(scan[order], reach_px, learn_from)
        for turn in range(turns):
            left, weight = learning.left_over()
            learning.learn_patterns(left, weight, first=turn == 0)
            learning.learn_places()
        learning.begin_modes(learning.left_over()[0])
        for _ in range(turns):
            learning.learn_patterns(*learning.left_over())
            learning.learn_shares()
            learning.learn_places()
        learning.learn_patterns(*learning.left_over())
        own = learning.own_error() * abs(steps.mean())
        beads = pd.DataFrame(
            {
                "x_px": learning.places[:, 1],
                "y_px": learning.places[:, 0],
                "brightness": learning.places[:, 3],
                "height_um": learning.heights * abs(steps.mean()),
                "learned": learning.learned,
            }
        )
        return cls(
            learning.patterns,
            z_um[order],
            learning.surface,
            learning.middle,
            learning.noise,
            learning.modes,
            own,
            beads,
        )

    @classmethod
    def from_one(cls, calibration: Calibration) -> Self:
        """Of a calibration with one particle: the same pattern everywhere, a flat focal surface."""
        checked(calibration)
        images = particle_light(calibration)
        m = FINE * (calibration.size - 1) + 1
        fine = np.stack([cv2.resize(image, None, fx=FINE, fy=FINE, interpolation=cv2.INTER_CUBIC) for image in images])
        # `resize` keeps the corners of the pixels, we the centres: half a node.
        shift = np.float32([[1, 0, -0.5], [0, 1, -0.5]])
        fine = np.stack(
            [cv2.warpAffine(f, shift, (m, m), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for f in fine]
        )
        peak = images.reshape(len(images), -1).max(axis=1)
        beads = pd.DataFrame(
            {"x_px": [np.nan], "y_px": [np.nan], "brightness": [1.0], "height_um": [0.0], "learned": [True]}
        )
        return cls(
            fine[None],
            calibration.z_um,
            np.zeros(4),
            float(peak.argmax()),
            noise_level(calibration.stack),
            np.zeros((0, *fine.shape), np.float32),
            calibration.model.own_error[:, 2],
            beads,
        )

    def __len__(self) -> int:
        return len(self.z_um)

    @property
    def reach_px(self) -> int:
        """How far images reach from their middle."""
        return self.patterns.shape[-1] // (2 * FINE)

    @cached_property
    def images(self) -> FieldImages:
        """What draws particles."""
        brightest = float(self.beads["brightness"].quantile(0.9))
        return FieldImages(self.patterns, self.surface, self.noise, brightest, self.modes)

    def pattern(self, x_px: float, y_px: float, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Images (N, n, n) of a particle at a place of frames of `shape`, a pixel apart, in focus at `middle`."""
        terms = field_terms(x_px, y_px, shape)[: len(self.patterns)].astype(np.float32)
        return np.einsum("m,mkij->kij", terms, self.patterns[:, :, ::FINE, ::FINE])

    def __getstate__(self) -> dict[str, object]:
        """Plans stay behind when a calibration is sent to another process."""
        return self.__dict__ | {"_plans": {}}


@on_one_core
def find_beads(scan: ArrayLike) -> pd.DataFrame:
    """Find the particles of a scan where they are in focus.

    Parameters
    ----------
    scan : array (N, rows, columns)
        Frames through focus, along z.

    Returns
    -------
    DataFrame
        A row for each, by increasing x: `x_px`, `y_px`; `slice`, in which it is in focus, with its part of a
        step; `light`, the sum of its pixels there, less its surroundings.
    """
    scan = real_array("scan", scan, 3)
    noise = _noise(scan)
    sharp = np.stack([cv2.GaussianBlur(f, (0, 0), 0.8) - cv2.GaussianBlur(f, (0, 0), 2.5) for f in scan])
    highest = sharp.max(axis=0)
    y, x = np.nonzero((highest == cv2.dilate(highest, np.ones((5, 5), np.uint8))) & (highest > STANDS_OUT * noise))
    profile = sharp[:, y, x]
    away = np.abs(np.arange(len(scan))[:, None] - profile.argmax(axis=0))
    weight = np.where(away <= 6, np.maximum(profile - 0.5 * profile.max(axis=0), 0), 0)
    focus = (np.arange(len(scan))[:, None] * weight).sum(axis=0) / weight.sum(axis=0)
    padded = np.pad(scan, ((0, 0), (4, 4), (4, 4)), mode="edge")
    near = np.clip(np.rint(focus).astype(int) + np.arange(-2, 3)[:, None], 0, len(scan) - 1)
    rim = np.ones((9, 9), dtype=bool)
    rim[1:-1, 1:-1] = False
    rows = []
    for i in range(len(x)):
        spot = padded[near[:, i], y[i] : y[i] + 9, x[i] : x[i] + 9].mean(axis=0)
        spot = spot - np.median(spot[rim])
        core, offset = np.maximum(spot[2:-2, 2:-2], 0), np.arange(-2, 3)
        rows.append(
            (
                x[i] + (core * offset).sum() / core.sum(),
                y[i] + (core * offset[:, None]).sum() / core.sum(),
                focus[i],
                spot[1:-1, 1:-1].sum(),
            )
        )
    table = pd.DataFrame(rows, columns=["x_px", "y_px", "slice", "light"], dtype=float)
    return table.sort_values("x_px", ignore_index=True)


def _noise(scan: NDArray[np.float32]) -> float:
    """Standard deviation of a pixel of the scan; above 0 even if it was computed without noise."""
    return max(noise_level(scan[:: max(len(scan) // 10, 1)]), 1e-4 * float(np.ptp(scan))) or 1.0


class _Learning:
    """A scan (N, rows, columns) and all that is known of it so far."""

    def __init__(self, scan: NDArray[np.float32], reach: int, learn_from: ArrayLike | None) -> None:
        self.scan, self.noise, self._reach = scan, _noise(scan), reach
        found = find_beads(scan)
        self.learned = np.ones(len(found), bool) if learn_from is None else np.asarray(learn_from)
        if self.learned.shape != (len(found),) or self.learned.dtype != bool:
            raise ValueError(
                f"learn_from: got shape {self.learned.shape}, needed is a bool for each of {len(found)} beads"
            )
        # Of a particle on the border half an image is seen, which would make the halves of the patterns differ.
        places = found[["y_px", "x_px"]].to_numpy()
        inside = np.minimum(places, np.array(scan.shape[1:]) - 1 - places).min(axis=1)
        self.learned = self.learned & (inside > reach / 2)
        if self.learned.sum() < 10:
            raise ValueError(f"scan: got {self.learned.sum()} particles to learn from, needed are 10 or more")
        self.places = np.stack([found["y_px"], found["x_px"], 0 * found["x_px"], found["light"]], axis=1)
        self.places[:, 3] = np.maximum(self.places[:, 3] / found["light"].median(), 0.02)
        self._shape = scan.shape[1:]
        self._terms = field_terms(self.places[:, 1], self.places[:, 0], self._shape)
        self.middle = float(found["slice"].median())
        self.heights = found["slice"].to_numpy() - self.middle
        self._fit_surface()
        off = np.abs(self.heights - self._terms @ self.surface) > BELIEVED
        self.heights[off] = (self._terms @ self.surface)[off]
        m = 2 * FINE * reach + 1
        self.patterns = np.zeros((self._terms.shape[1], len(scan), m, m), np.float32)
        self.modes = np.zeros((0, len(scan), m, m), np.float32)
        self._behind = Background(self._shape, 4 * reach)

    def _fit_surface(self) -> None:
        """Focal surface through the heights, which no outlier pulls; a height far off it is brought back."""
        terms, heights = self._terms[self.learned], self.heights[self.learned]
        trust = np.ones(len(heights))
        for _ in range(10):
            self.surface = np.linalg.lstsq(terms * trust[:, None], heights * trust, rcond=None)[0]
            trust = 1 / np.sqrt(np.maximum(1, np.abs(heights - terms @ self.surface) / 0.3))

    def _slice(
        self, images: FieldImages, k: int, *, by_mode: bool = False
    ) -> tuple[Columns, NDArray[np.float32], NDArray[np.float32]]:
        """Columns of the particles in a slice, what they and the background leave of it, and the pixels' weight."""
        places = self.places.copy()
        places[:, 2] = k
        columns = images.draw(places, self._shape, self.heights, by_mode=by_mode)
        light = np.zeros(self._shape, np.float32)
        columns.add_to(light, places[:, 3])
        bright = np.maximum(light, 0)
        weight = (1 / (self.noise**2 + (PHOTONS + MISFIT**2 * bright) * bright)).astype(np.float32)
        left = self.scan[k] - light
        return columns, left - self._behind.fit(left, weight), weight

    def _images(self) -> FieldImages:
        brightest = float(np.quantile(self.places[:, 3], 0.9))
        return FieldImages(self.patterns, self.surface, self.noise, brightest, self.modes)

    def left_over(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What is not explained of all slices, and its weight."""
        images, left, weight = self._images(), np.empty_like(self.scan), np.empty_like(self.scan)
        for k in range(len(self.scan)):
            _, left[k], weight[k] = self._slice(images, k)
        return left, weight

    def learn_places(self) -> None:
        """A Gauss-Newton step of all particles' y, x, height and brightness, each the same in all slices."""
        images, n = self._images(), 4 * len(self.places)
        matrix, right = np.zeros((n, n)), np.zeros(n)
        for k in range(0, len(self.scan), EVERY):
            columns, left, weight = self._slice(images, k)
            right += columns.gradient(left, weight)[0].ravel()
            _add_band(matrix, columns.matrix(weight))
        matrix[np.diag_indices(n)] *= 1.001
        matrix[np.diag_indices(n)] += 1e-9 * np.trace(matrix) / n
        change = solve(matrix, right, lower=True, assume_a="pos").reshape(-1, 4)
        longest = np.stack([np.full(len(change), s) for s in (0.3, 0.3, 0.5)] + [0.2 * self.places[:, 3]], axis=1)
        change = np.clip(change, -longest, longest)
        self.places[:, [0, 1, 3]] += change[:, [0, 1, 3]]
        self.places[:, 3] = np.maximum(self.places[:, 3], 0.02)
        self.heights -= change[:, 2]
        self._fit_surface()
        smooth = self._terms @ self.surface
        self.heights = np.clip(self.heights, smooth - BELIEVED, smooth + BELIEVED)

    def learn_patterns(self, left: NDArray[np.float32], weight: NDArray[np.float32], first: bool = False) -> None:
        """Add to the patterns, and to the modes, what is left around the particles.

        In the `first` turn nobody's neighbours are known yet, and only particles without near ones are used.
        """
        chosen, count = self.learned, len(self._terms.T)
        if first:
            alone = KDTree(self.places[:, :2]).query(self.places[:, :2], k=2)[0][:, 1] > ALONE_PX
            chosen = chosen & alone if (chosen & alone).sum() >= 2 * count else chosen
        change = self._regressed(left, weight, chosen, self._terms, np.arange(len(left)), self._reach)
        if len(self.modes):
            near, zone = self._near()
            shares = np.concatenate([self._terms, self.places[:, 4:]], axis=1)
            both = self._regressed(left, weight, chosen, shares, near, min(DIFFER_PX, self._reach))
            change[zone] = both[:count]
            self.modes[zone] += both[count:]
            self.modes[zone] = np.einsum(
                "kl,mlij->mkij", _smoother(len(left), self.middle)[near][:, near], self.modes[zone]
            )
        self.patterns = np.einsum("kl,mlij->mkij", _smoother(len(left), self.middle), self.patterns + change)

    def _regressed(
        self,
        left: NDArray[np.float32],
        weight: NDArray[np.float32],
        chosen: NDArray[np.bool_],
        shares: NDArray[np.float64],
        steps: NDArray[np.int64],
        reach: int,
    ) -> NDArray[np.float32]:
        """What is left around the chosen particles at those steps, node by node regressed on their shares (P, M).

        A pixel counts for the node that is nearest to it. Shape is (M, steps, m, m).
        """
        shares, count = shares.astype(np.float32), len(self.scan)
        modes, m = shares.shape[1], 2 * FINE * reach + 1
        upper = np.triu_indices(modes)
        square = np.zeros((len(upper[0]), len(steps), m, m), np.float32)
        right = np.zeros((modes, len(steps), m, m), np.float32)
        for i in np.flatnonzero(chosen):
            (y, x, _, light), terms = self.places[i, :4].astype(np.float32), shares[i]
            (y0, y1), (x0, x1) = (
                (max(int(np.ceil(p - reach)), 0), min(int(np.floor(p + reach)) + 1, n))
                for p, n in zip((y, x), self._shape, strict=True)
            )
            below = int(np.floor(self.heights[i]))
            part = np.float32(self.heights[i] - below)
            low, high = (np.clip(steps + below + j, 0, count - 1) for j in (0, 1))
            seen, trust = (
                (1 - part) * stack[low, y0:y1, x0:x1] + part * stack[high, y0:y1, x0:x1] for stack in (left, weight)
            )
            beyond = (steps + below < 0) | (steps + below + 1 > count - 1)  # the ends of the scan, repeated
            trust[beyond] *= 1e-3
            j, k = (round(FINE * (p0 - p)) + FINE * reach for p0, p in ((y0, y), (x0, x)))
            nodes = np.s_[:, j : j + FINE * (y1 - y0) : FINE, k : k + FINE * (x1 - x0) : FINE]
            for q, (a, b) in enumerate(zip(*upper, strict=True)):
                square[q][nodes] += trust * (light**2 * terms[a] * terms[b])
            seen *= trust * light
            for a in range(modes):
                right[a][nodes] += seen * terms[a]
        matrix = np.empty((len(steps), m, m, modes, modes), np.float32)
        for q, (a, b) in enumerate(zip(*upper, strict=True)):
            matrix[..., a, b] = matrix[..., b, a] = square[q]
        # Of nodes that few meet, by their neighbours; never by all: where light is bright they tell far less.
        held = uniform_filter(square[0], (1, 5, 5), mode="nearest") + 1e-9
        for a in range(modes):
            matrix[..., a, a] += (RIDGE if a else 1e-3) * held
        return np.moveaxis(np.linalg.solve(matrix, np.moveaxis(right, 0, -1)[..., None])[..., 0], -1, 0)

    def _near(self) -> tuple[NDArray[np.int64], tuple[slice, ...]]:
        """Steps at which particles may differ, and where in the patterns that is."""
        peak = self.patterns[0].max(axis=(1, 2))
        steps = np.flatnonzero(peak > DIFFER * peak.max())
        n = min(DIFFER_PX, self._reach)
        nodes = slice(FINE * (self._reach - n), FINE * (self._reach + n) + 1)
        return np.arange(steps[0], steps[-1] + 1), np.s_[:, steps[0] : steps[-1] + 1, nodes, nodes]

    def begin_modes(self, left: NDArray[np.float32]) -> None:
        """Shares of the modes, from the principal components of what is left around particles near focus."""
        (near, zone), n, margin = self._near(), min(DIFFER_PX, self._reach), 3
        around = np.pad(left, ((0, 0), (n + margin,) * 2, (n + margin,) * 2))
        rest = []
        for (y, x, _, light), height in zip(self.places[:, :4], self.heights, strict=True):
            low = np.clip(near + int(np.floor(height)), 0, len(left) - 2)
            part = height % 1
            row, column = (int(np.clip(round(p), 0, size - 1)) for p, size in zip((y, x), self._shape, strict=True))
            cut = np.s_[:, row : row + 2 * (n + margin) + 1, column : column + 2 * (n + margin) + 1]
            image = ((1 - part) * around[low] + part * around[low + 1])[cut] / light
            image = shift(image, (0, row - y, column - x), order=3)[:, margin:-margin, margin:-margin]
            rest.append(image.ravel())
        light = np.maximum(self.patterns[zone][0, :, ::FINE, ::FINE], 0)
        rest = np.array(rest) / np.sqrt(self.noise**2 + PHOTONS * light).ravel()
        size = np.sqrt((rest**2).mean(axis=1))
        rest *= np.minimum(1, np.median(size[self.learned]) / size)[:, None]  # clusters, and what lies beside them
        count = min(MODES, self.learned.sum() // 4)
        self._set_shares(np.linalg.svd(rest, full_matrices=False)[0][:, :count])

    def _set_shares(self, shares: NDArray[np.float64]) -> None:
        """Shares of mean 0 and standard deviation 1, which tell nothing that the place in the field tells."""
        told = np.linalg.lstsq(self._terms[self.learned], shares[self.learned], rcond=None)[0]
        shares = shares - self._terms @ told
        values, vectors = np.linalg.eigh(np.cov(shares[self.learned].T))
        root = vectors * np.sqrt(np.maximum(values, 1e-6)) @ vectors.T
        self.places = np.concatenate([self.places[:, :4], shares @ np.linalg.inv(root)], axis=1)
        if len(self.modes):
            self.patterns += np.einsum("ak,knij->anij", told.astype(np.float32), self.modes)
            self.modes = np.einsum("kl,lnij->knij", root, self.modes).astype(np.float32)
        else:
            self.modes = np.zeros((shares.shape[1], *self.patterns.shape[1:]), np.float32)

    def learn_shares(self) -> None:
        """Shares of the modes that fit best, each particle's for itself, the others and the patterns as they are."""
        images, matrix, right = self._images(), 0, 0
        for k in range(0, len(self.scan), EVERY):
            one, other = _each_alone(*self._slice(images, k, by_mode=True))
            matrix, right = matrix + one[:, 4:, 4:], right + other[:, 4:]
        right -= self.places[:, 4:]
        matrix += np.eye(len(self.modes))
        self._set_shares(self.places[:, 4:] + np.linalg.solve(matrix, right[..., None])[..., 0])

    def own_error(self) -> NDArray[np.float64]:
        """Scatter of the depths (steps) that single slices give for their particles, (N,).

        It is that of particles from which the patterns were learned; M terms and modes learned from P particles, a
        quarter of whose pixels meet a node, make it smaller than for others by a factor 1 - 4 M / P.
        """
        images, slices, scatter = self._images(), np.arange(0, len(self.scan), 2 * EVERY), []
        smooth = self._terms @ self.surface
        for k in slices:
            columns, left, weight = self._slice(images, k, by_mode=True)
            n = 4 * len(self.places)
            matrix = np.zeros((n, n))
            _add_band(matrix, columns.matrix(weight))
            matrix[np.diag_indices(n)] += 1e-6 * np.trace(matrix) / n
            change = solve(matrix, columns.gradient(left, weight)[0].ravel(), lower=True, assume_a="pos")
            # Beside others, alike; and alone, but differing, of which nothing is known beforehand.
            matrix, right = _each_alone(columns, left, weight)
            differ = np.arange(4, 4 + len(self.modes))
            matrix[:, differ, differ] += 1
            right[:, 4:] -= self.places[:, 4:]
            alone = np.linalg.solve(matrix + 1e-9 * np.eye(4 + len(self.modes)), right[..., None])[:, 2, 0]
            off = np.abs(np.stack([change.reshape(-1, 4)[:, 2], alone]) + smooth - self.heights)[:, self.learned]
            count = len(self.patterns) + len(self.modes) * self.modes[:, k].any()
            share = min(FINE**2 * count / self.learned.sum(), 0.5)
            scatter.append(np.median(off, axis=1).max() / 0.6745 / (1 - share))
        return np.interp(np.arange(len(self.scan)), slices, uniform_filter1d(scatter, 5, mode="nearest"))


def _each_alone(
    columns: Columns, left: NDArray[np.float32], weight: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix (P, C, C) and right-hand side (P, C) of the least-squares problem of each particle for itself."""
    count, unknown = len(columns.boxes), len(columns.values)
    matrix, right = np.zeros((count, unknown, unknown)), np.zeros((count, unknown))
    for i, (y0, y1, x0, x1) in enumerate(columns.boxes):
        own = columns.values[:, columns.starts[i] : columns.starts[i + 1]]
        trusted = own * weight[y0:y1, x0:x1].ravel()
        matrix[i], right[i] = trusted @ own.T, trusted @ left[y0:y1, x0:x1].ravel()
    return matrix, right


def _smoother(count: int, middle: float) -> NDArray[np.float64]:
    """Matrix (N, N) that replaces each value by that of a parabola through its neighbours along z."""
    steps, matrix = np.arange(count), np.empty((count, count))
    for k in steps:
        away = (steps - k) / max(SMOOTH[0], SMOOTH[1] * abs(k - middle))
        trust = np.exp(-(away**2) / 4)
        matrix[k] = np.linalg.pinv(np.stack([trust, trust * away, trust * away**2], axis=1))[0] * trust
    return matrix


def _add_band(matrix: NDArray, band: NDArray) -> None:
    """Add to the lower half of a square matrix its band, as `Columns.matrix` gives it."""
    n = len(matrix)
    for below, row in enumerate(band):
        i = np.arange(n - below)
        matrix[i + below, i] += row[: n - below]
