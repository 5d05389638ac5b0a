"""The pattern model: the image of a particle at any depth and anywhere in the field, and how well it is known.

The image of particle i, at x_i, y_i, z_i with amplitude a_i, is

    a_i [ sum_m phi_m(x_i, y_i) P_m(x - x_i, y - y_i; z_i - f(x_i, y_i)) + sum_k c_ik Q_k(...) ],   phi = 1, x, y, r^2

with patterns P_m, focal surface f, and modes Q_k by which one particle differs from the next; the c_ik are 0 on average
with standard deviation 1. A calibration of one particle has M = 1, f = 0 and no modes.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from gdptlab._checks import numbers, pair
from gdptlab.calibration import Calibration
from gdptlab.correlation import normalised
from gdptlab.denoising import noise_level
from gdptlab.fit.bounds import own_bias_um, own_error, recalibration_errors
from gdptlab.fit.pattern import continued, particle_light

ALIKE = 0.85
"""Correlation of the patterns at two depths from which on the one may be taken for the other."""

ERROR_SCALE_PX = 2.0
"""Scale, in px, on which the error of the patterns is compared with white noise; about the width of their finest
details, and on this scale a matched filter sums pixels."""

LOSSLESS = 0.98
"""Patterns that keep this correlation with themselves at half resolution are sought there."""


def field_terms(x_px: ArrayLike, y_px: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Terms 1, x, y, r^2 of smooth functions over frames of `shape`, (..., 4); each about -1 to 1.

    Raises
    ------
    TypeError, ValueError
        If x_px and y_px are not finite numbers, as many of both, or shape is not (rows, columns).
    """
    rows, columns = pair("shape", shape)
    x_px, y_px = numbers("x_px", x_px), numbers("y_px", y_px)
    if x_px.shape != y_px.shape:
        raise ValueError(f"x_px: got shape {x_px.shape}, allowed is that of y_px, {y_px.shape}")
    half = max(shape) / 2
    u, v = (x_px - (columns - 1) / 2) / half, (y_px - (rows - 1) / 2) / half
    square = ((rows / 2 / half) ** 2 + (columns / 2 / half) ** 2) / 3  # the mean of r^2 over the frame
    return np.stack([np.ones_like(u), u, v, u**2 + v**2 - square], axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class PatternModel:
    """Patterns, and what is known of their errors.

    Attributes
    ----------
    patterns : float32 array (M, N, m, m)
        Mean pattern, and what is added to it for each further term of `field_terms`, at N slices, in counts for a
        particle of amplitude 1; the particle is in the middle, m = 2 h nodes_per_px + 1 for a support of h px to
        each side. M is 4, or 1: the same everywhere.
    z_um : float64 array (N,)
        Depths of the slices, increasing.
    nodes_per_px : int
        1 or 2.
    noise : float
        Standard deviation of a pixel of the scan without light, counts.
    size : int
        Rows and columns (px, odd) that were measured; beyond, the patterns are continued.
    pattern_error : float32 array (N, m, m)
        Standard deviation of the mean pattern's error (noise of the scan, difference of its particles that no mode
        tells) in counts at amplitude 1: that of white noise which is as large as the error on the scale of
        `ERROR_SCALE_PX` (`error_density`).
    own_error : float64 array (N, 3)
        Standard deviation of the error in x, y (px) and z (um) that the patterns' own error makes.
    own_bias_um : float64 array (N,)
        Error of z common to all particles at a depth, which is to be taken from a measured z.
    surface : float64 array (4,)
        Focal surface in `field_terms`: the slice at which a particle is in focus, less that in the middle.
    modes : float32 array (K, N, m, m)
        Ways in which particles differ.
    """

    patterns: NDArray[np.float32]
    z_um: NDArray[np.float64]
    nodes_per_px: int
    noise: float
    size: int
    pattern_error: NDArray[np.float32]
    own_error: NDArray[np.float64]
    own_bias_um: NDArray[np.float64]
    surface: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    modes: NDArray[np.float32] | None = None

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """Model of a calibration with one particle: one pattern, a node per pixel, flat focal surface, no modes."""
        images = continued(particle_light(calibration))
        rim = (images.shape[-1] - calibration.size) // 2
        errors = np.pad(recalibration_errors(calibration), ((0, 0), (0, 0), (rim, rim), (rim, rim)), mode="edge")
        return cls(
            patterns=images[None],
            z_um=calibration.z_um,
            nodes_per_px=1,
            noise=noise_level(calibration.stack),
            size=calibration.size,
            pattern_error=error_density(errors, 1),
            own_error=own_error(calibration),
            own_bias_um=own_bias_um(calibration),
        )

    @property
    def count(self) -> int:
        """Number of slices N."""
        return self.patterns.shape[1]

    @property
    def modes_count(self) -> int:
        """Number of modes K."""
        return 0 if self.modes is None else len(self.modes)

    @cached_property
    def half_resolution(self) -> bool:
        """Whether particles can be sought at half resolution: their images are hardly changed by it."""
        trim = self.images.shape[-1] // 2 % 2
        images = np.ascontiguousarray(
            self.images[:, trim : len(self.images[0]) - trim, trim : len(self.images[0]) - trim]
        )
        restored = np.stack([cv2.pyrUp(cv2.pyrDown(image))[: image.shape[0], : image.shape[1]] for image in images])
        return bool(np.einsum("kij,kij->k", normalised(restored), normalised(images)).min() >= LOSSLESS)

    @cached_property
    def images(self) -> NDArray[np.float32]:
        """Mean pattern with a node per pixel, (N, n, n), n odd: the particle in the middle."""
        return np.ascontiguousarray(self.patterns[0, :, :: self.nodes_per_px, :: self.nodes_per_px])

    @cached_property
    def peak(self) -> NDArray[np.float64]:
        """Largest deviation of the mean pattern from the background at each slice, counts at amplitude 1, (N,)."""
        return np.abs(gaussian_filter(self.images, (0, 1, 1))).max(axis=(1, 2)).astype(float)

    @cached_property
    def twin(self) -> NDArray[np.float64]:
        """Slice (N,) on the other side of focus that looks most like each slice; NaN where none looks alike.

        The other side begins where the correlation, going away from a slice, rises again.
        """
        flat = self.images.reshape(self.count, -1)
        flat = flat / np.linalg.norm(flat, axis=1, keepdims=True)
        twin, slices = np.full(self.count, np.nan), np.arange(self.count)
        for k, row in enumerate(flat @ flat.T):
            falling = np.concatenate([np.minimum.accumulate(row[k::-1])[:0:-1], np.minimum.accumulate(row[k:])])
            other = np.where(row > falling + 0.02, row, 0)
            if other.max() > ALIKE:
                twin[k] = slices[other.argmax()]
        return twin


def error_density(errors: NDArray, nodes_per_px: int) -> NDArray[np.float32]:
    """Standard deviation (N, m, m) of white noise as large as errors (R, N, m, m) are on the scale `ERROR_SCALE_PX`.

    White noise of standard deviation s, smoothed by a Gaussian of width w px, has s / (2 sqrt(pi) w).
    """
    width = ERROR_SCALE_PX * nodes_per_px
    smooth = gaussian_filter(errors, (0, 0, width, width), mode="nearest")
    variance = gaussian_filter(np.mean(np.square(smooth), axis=0), (2, 2 * width, 2 * width), mode="nearest")
    return (2 * np.sqrt(np.pi) * ERROR_SCALE_PX * np.sqrt(variance)).astype(np.float32)
