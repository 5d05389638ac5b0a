"""Measure particles whose images change over the field, differ in brightness, and look alike on both sides of focus.

Particles are found one after the other by a matched filter in what the others leave and fitted all at once, as in
`overlap`, but nothing is known of their brightness, and each is drawn with the pattern of its place. The joint fit
climbs to the nearest depth only. Without astigmatism there are two, one on either side of focus, so that each
particle is also fitted from the mirror image of its depth, with the others as they are, and goes where the
likelihood is higher. The lower of the two is reported as well. In these fits of single particles each may also differ
from the pattern as those of the scan do; the joint fits in between keep what was found.
"""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls
from scipy.spatial import KDTree

from gdptlab._checks import real_array
from gdptlab._compiled import compiled, on_one_core
from gdptlab._plans import planned
from gdptlab.denoising import noise_level
from gdptlab.fit.background import Background
from gdptlab.fit.field_calibration import MISFIT, PHOTONS, FieldCalibration
from gdptlab.fit.field_images import FINE, field_terms
from gdptlab.fit.joint_fit import JointFit, fitted
from gdptlab.fit.matched_filter import MatchedFilter

LEAST_GAIN = 30.0
"""In log-likelihood, of a particle (see `overlap.LEAST_GAIN`); more, as its brightness is free."""

EXPLAINS, FAINTEST = 0.3, 0.05
"""Share of what it would explain alone that a particle must explain beside the others; its least brightness."""

FREE = 1e3
"""Spread of brightness of which nothing is known."""

ROUNDS = 4
"""Of searching for more particles."""

CLIMB = 4
"""Steps of the fits of single particles."""

ASTRAY = np.array([-8.0, -4.0, 0.0, 4.0, 8.0])
"""Steps by which the mirror image of a depth may be off, when it is not known well yet."""

APART_UM = 1.0
"""Depths nearer than this are one."""

PLANE_UM = 1.0
"""Scatter of depths about a plane, for `decided_by_plane`."""

AMBIGUOUS = 20.0
"""Log-likelihood by which one depth must be better than the other to be believed. The patterns' own errors are
alike in neighbouring pixels, which the likelihood does not know: it would ask for 3."""


@on_one_core
def locate_over_field(image: ArrayLike, calibration: FieldCalibration) -> pd.DataFrame:
    """Measure x, y and z of every particle in a frame, with a calibration over the field.

    Parameters
    ----------
    image : array (rows, columns)
        From the camera and the optics of the scan, and of the same shape.
    calibration : FieldCalibration

    Returns
    -------
    DataFrame
        A row for each particle, brightest first. `x_px`, `y_px`, `z_um` as from `locate`, z in the depths of the
        stage; `at_end`; `x_std_px`, `y_std_px`, `z_std_um`, the last with what a particle differs from the
        scan's; `brightness`, 1 for the scan's median; `chi2`; `z_other_um`, the best depth on the other side of focus
        and `log_ratio`, the logarithm of the likelihood of the first over that of the second; `ambiguous`, whether that
        is below `AMBIGUOUS`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or the image holds NaN or infinity.
    """
    if not isinstance(calibration, FieldCalibration):
        raise TypeError(f"calibration: got a {type(calibration).__name__}, allowed is a FieldCalibration")
    image = real_array("image", image, 2)
    if min(image.shape) <= 2 * calibration.reach_px:
        raise ValueError(f"image: got shape {image.shape}, allowed is larger than a pattern")
    search = _Search(image, calibration)
    search.find()
    return search.table()


def decided_by_plane(table: pd.DataFrame) -> pd.DataFrame:
    """Choose between the two depths of each particle, when it is known that all lie on one level plane.

    The plane is where it makes the depths of all most likely; each particle then takes the one of its two depths that
    is nearer to it. Nothing else is drawn to the plane.

    Parameters
    ----------
    table : DataFrame
        Of one frame, from `locate_over_field`.

    Returns
    -------
    DataFrame
        The same rows; where the other depth was taken, `z_um` and `z_other_um` are exchanged and `log_ratio` has
        the other sign. `ambiguous` stays: it says what the images alone can tell.

    Raises
    ------
    ValueError
        If a column is missing.
    """
    missing = {"z_um", "z_other_um", "log_ratio"} - set(table)
    if missing:
        raise ValueError(f"table: got no column {sorted(missing)}, needed is a table from locate_over_field")
    depths = table[["z_um", "z_other_um"]].to_numpy()
    if not len(depths):
        return table.copy()
    planes = np.arange(depths.min(), depths.max() + 0.1, 0.1)
    off = np.minimum((depths - planes[:, None, None]) ** 2 / PLANE_UM**2, 9) / 2
    off[:, :, 1] += np.clip(table["log_ratio"].to_numpy(), -AMBIGUOUS, AMBIGUOUS)
    plane = planes[off.min(axis=2).sum(axis=1).argmin()]
    swap = np.abs(depths[:, 1] - plane) < np.abs(depths[:, 0] - plane)
    table = table.copy()
    table["z_um"], table["z_other_um"] = np.where(swap, depths.T[::-1], depths.T)
    table["log_ratio"] = np.where(swap, -table["log_ratio"], table["log_ratio"])
    return table


class _Search:
    """A frame, and the particles found so far."""

    def __init__(self, frame: NDArray[np.float32], calibration: FieldCalibration) -> None:
        self.frame, self.calibration, self._images = frame, calibration, calibration.images
        self._filter = planned(calibration, _matched_filter, frame.shape)
        self._surface = Background(frame.shape, 4 * calibration.reach_px)
        self.noise = max(noise_level(frame), 1e-4 * float(np.ptp(frame))) or 1.0
        self.noise_and_photons, self.misfit = (self.noise**2, PHOTONS), MISFIT
        self.places = np.zeros((0, 4 + self._images.modes))
        self.fit: JointFit = self._fitted(0)

    def find(self) -> None:
        """Find particles until no more are."""
        for again in range(ROUNDS):
            new = self._new(whiten=again < ROUNDS - 1)
            self.places = np.concatenate([self.places, new])
            self.fit = self._fitted(4)
            self._drop()
            if again:
                self._learn_variance()
                self._other_sides(ASTRAY if again == 1 else ASTRAY[1:-1])
                self.fit = self._fitted(3)
        self._drop()
        self._other_sides(ASTRAY[1:-1])
        self.fit = self._fitted(3)

    def table(self) -> pd.DataFrame:
        """What `locate_over_field` returns."""
        z_um, steps = self.calibration.z_um, np.arange(len(self.calibration))
        _, other, log_ratio, more = self._compare(ASTRAY[1:-1])
        y, x, step, brightness = self.places.T[:4]
        std = np.sqrt(self.fit.std**2 + more) * (1, 1, abs(z_um[1] - z_um[0]))
        table = pd.DataFrame(
            {
                "x_px": x,
                "y_px": y,
                "z_um": np.interp(step, steps, z_um),
                "at_end": (step <= 0) | (step >= len(steps) - 1),
                "x_std_px": std[:, 1],
                "y_std_px": std[:, 0],
                "z_std_um": np.hypot(std[:, 2], np.interp(step, steps, self.calibration.own_error_um)),
                "brightness": brightness,
                "chi2": self.fit.chi2,
                "z_other_um": np.interp(other[:, 2], steps, z_um),
                "log_ratio": log_ratio,
                "ambiguous": log_ratio < AMBIGUOUS,
            }
        )
        rows, columns = self.frame.shape
        inside = (x >= -0.5) & (x < columns - 0.5) & (y >= -0.5) & (y < rows - 0.5)
        return table[inside].sort_values("brightness", ascending=False, ignore_index=True)

    def _fitted(self, steps: int) -> JointFit:
        """All particles and the background."""
        light = np.zeros_like(self.frame)
        self._images.draw(self.places, self.frame.shape).add_to(light, self.places[:, 3])
        fit = fitted(
            self._images,
            self.frame,
            self.places,
            (1 / self._variance(light)).astype(np.float32),
            brightness=1.0,
            spread=FREE,
            steps=steps,
            surface=self._surface,
        )
        self.places = fit.places
        return fit

    def _variance(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of pixels, read noise and photons only (see `overlap._variance`)."""
        level, photons = self.noise_and_photons
        return level + photons * np.maximum(light, 0)

    def _learn_variance(self) -> None:
        """Of a pixel's variance: read noise, photons, and the patterns' own error; none below nothing."""
        light, left = self.fit.light.ravel(), self.fit.residual.ravel()
        parts = np.array_split(np.argsort(light), 100)[20:]  # in most frames most is dark
        mean = np.array([max(light[part].mean(), 0) for part in parts])
        spread = np.array([(np.median(np.abs(left[part])) / 0.6745) ** 2 for part in parts])
        spread = np.maximum(spread, 0.1 * self.noise**2)
        terms = np.stack([np.ones_like(mean), mean, mean**2], axis=1)
        level, photons, square = nnls(terms / spread[:, None], np.ones_like(spread))[0]
        self.noise_and_photons = max(level, 0.5 * self.noise**2), photons
        # What neighbouring pixels share does not show in them one by one: no less than in the scan.
        self.misfit = max(np.sqrt(square), MISFIT)

    def _new(self, whiten: bool) -> NDArray[np.float64]:
        """Places of further particles, of which each stands out from all that is near."""
        # Where there is light, part of what is left is the patterns' own error.
        variance = self._variance(self.fit.light) + (self.misfit * self.fit.light) ** 2
        left = self.fit.residual * (self.noise / np.sqrt(variance)).astype(np.float32)
        new, gain = self._filter(left, self.noise, whiten=whiten, least=LEAST_GAIN, share=0, apart_px=4)
        new, gain = (a[np.argsort(-gain, kind="stable")] for a in (new, gain))
        keep = []
        for i, place in enumerate(new[:, :2]):
            away = np.hypot(*(place - new[keep, :2]).T)
            if not ((away < 5) | ((away < 8) & (gain[keep] > 2 * gain[i]))).any():
                keep.append(i)
        new = new[keep]
        if len(self.places) and len(new):
            new = new[KDTree(self.places[:, :2]).query(new[:, :2])[0] > 2]
        return np.pad(new, ((0, 0), (0, self._images.modes)))

    def _drop(self) -> None:
        """Without those that explain too little, and those far outside."""
        centre = (np.array(self.frame.shape) - 1) / 2
        outside = np.abs(self.places[:, :2] - centre) - centre
        stays = (self.fit.explains > EXPLAINS) & (self.places[:, 3] > FAINTEST) & (outside.max(axis=1, initial=0) < 10)
        self.places = self.places[stays]
        self.fit = self._fitted(1)

    def _compare(
        self, astray: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Each particle fitted alone, from where it is and from the other side of focus.

        Returns
        -------
        own, other : arrays (P, 4 + K)
            Where it gets from where it is; the best place at another depth.
        log_ratio : array (P,)
            Log-likelihood by which the other is worse.
        more : array (P, 3)
            What the modes' being unknown adds to the variance of y, x and step.
        """
        places, count = self.places, len(self.places)
        if not count:
            return places, places, np.zeros(0), np.zeros((0, 3))
        height = field_terms(places[:, 1], places[:, 0], self.frame.shape) @ self.calibration.surface
        mirror = 2 * (self.calibration.middle + height) - places[:, 2]
        start = np.concatenate([places[:, 2:3], mirror[:, None] + astray], axis=1)
        trials = np.repeat(places, start.shape[1], axis=0)
        trials[:, 2] = np.clip(start.ravel(), 0, len(self.calibration) - 1)
        owner = np.repeat(np.arange(count), start.shape[1])
        trials, gain, more = (a.reshape(count, start.shape[1], -1) for a in self._climbed(trials, owner))
        gain = gain[..., 0]
        step_um = abs(self.calibration.z_um[1] - self.calibration.z_um[0])
        same = np.abs(trials[:, :, 2] - trials[:, :1, 2]) * step_um < APART_UM
        same[same.all(axis=1), 1] = False  # one depth only: it is both
        best = np.where(same, -np.inf, gain).argmax(axis=1)
        rows = np.arange(count)
        log_ratio = np.where(same, gain, -np.inf).max(axis=1) - np.where(same, -np.inf, gain)[rows, best]
        return trials[:, 0], trials[rows, best], log_ratio, more[:, 0]

    def _other_sides(self, astray: NDArray[np.float64]) -> None:
        """Move particles to the other side of focus where that is likelier, and find how they differ."""
        own, other, log_ratio, _ = self._compare(astray)
        self.places = np.where(log_ratio[:, None] < 0, other, own)

    def _climbed(
        self, trials: NDArray[np.float64], owner: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Fit particles alone, the others as they are, from `trials` (n, 4 + K), each in the stead of one `owner`.

        Returns
        -------
        trials
        gain : array (n,)
            In log-likelihood, over the frame without the particle.
        more : array (n, 3)
            As from `_compare`.
        """
        fit, count, size = self.fit, len(self._images.reach), trials.shape[1]
        own = self._images.draw(self.places, self.frame.shape)
        upper, diagonal = np.triu_indices(size), np.arange(size)
        for step in range(CLIMB + 1):
            columns = self._images.draw(trials, self.frame.shape, by_mode=True)
            sums = np.zeros((len(trials), len(upper[0]) + size + 1))
            _local(
                fit.residual, fit.light, self.places[:, 3], owner, trials[:, 3], self.noise_and_photons,
                own.boxes, own.starts, own.values, columns.boxes, columns.starts, columns.values, sums,
            )  # fmt: skip
            matrix = np.empty((len(trials), size, size))
            matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = sums[:, : len(upper[0])]
            matrix[:, diagonal, diagonal] = 1.01 * matrix[:, diagonal, diagonal] + 1e-9
            matrix[:, diagonal[4:], diagonal[4:]] += 1
            if step == CLIMB:
                variance = [np.diagonal(np.linalg.inv(m), axis1=1, axis2=2)[:, :3] for m in (matrix, matrix[:, :4, :4])]
                gain = sums[:, -1] - (trials[:, 4:] ** 2).sum(axis=1) / 2
                return trials, gain, np.maximum(variance[0] - variance[1], 0)
            pull = sums[:, len(upper[0]) : -1]
            pull[:, 4:] -= trials[:, 4:]
            change = np.linalg.solve(matrix, pull[..., None])[..., 0]
            longest = np.stack([np.full(len(trials), s) for s in (1, 1, 3)] + [0.5 * trials[:, 3]], axis=1)
            change /= np.maximum((np.abs(change[:, :4]) / longest).max(axis=1, keepdims=True), 1)
            trials = trials + change
            trials[:, 2] = np.clip(trials[:, 2], 0, count - 1)
            trials[:, 3] = np.maximum(trials[:, 3], 0.02)
        raise AssertionError


def _matched_filter(calibration: FieldCalibration, shape: tuple[int, int]) -> MatchedFilter:
    """Filter for the mean pattern, in frames of this shape."""
    return MatchedFilter(np.ascontiguousarray(calibration.patterns[0][:, ::FINE, ::FINE]), shape)


@compiled
def _local(
    left, light, brightness, owner, trial, noise_and_photons, boxes, starts, values, t_boxes, t_starts, t_values, sums
):  # pragma: no cover
    """Sums over the pixels of each trial: upper triangle of its matrix, gradient, gain in log-likelihood.

    A trial stands in the stead of its owner, whose light goes back into what is left. Each pixel's variance is that
    of the light of all others and of the trial.
    """
    level, photons = np.float32(noise_and_photons[0]), np.float32(noise_and_photons[1])
    zero, size = np.float32(0), len(t_values)
    first = size * (size + 1) // 2  # of the gradient in `sums`
    trust, pull, trusted = np.empty((3, left.shape[1]), np.float32)
    for i in range(len(t_boxes)):
        o, total = owner[i], 0.0
        mine, bright = np.float32(brightness[o]), np.float32(trial[i])
        y0, y1, x0, x1 = t_boxes[i]
        a0, a1, b0, b1 = boxes[o]
        used = size if np.any(t_values[4:, t_starts[i] : t_starts[i + 1]]) else 4
        for r in range(y0, y1):
            s, inside = t_starts[i] + (r - y0) * (x1 - x0), a0 <= r < a1
            for c in range(x0, x1):
                seen, others = left[r, c], light[r, c]
                if inside and b0 <= c < b1:
                    back = mine * values[3, starts[o] + (r - a0) * (b1 - b0) + c - b0]
                    seen += back
                    others -= back
                others = max(others, zero)
                before = level + photons * others
                image = bright * t_values[3, s + c - x0]
                others += max(image, zero)
                after = level + photons * others
                rest = seen - image
                total += seen * seen / before - rest * rest / after + np.log(before / after)
                trust[c - x0], pull[c - x0] = 1 / after, rest / after
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
