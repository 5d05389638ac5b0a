"""Errors to come, before anything is measured: the Cramér-Rao bound, and what the calibration's own noise adds."""

from functools import lru_cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.ndimage import spline_filter1d, uniform_filter1d

from gdptlab._checks import numbers, positive
from gdptlab.calibration import Calibration
from gdptlab.denoising import denoised, noise_line
from gdptlab.fit.pattern import particle_light

REPEATS = 4
"""Number of Monte-Carlo recalibrations. With smoothing over five slices, they give a standard deviation to some
15 %; each takes as long as a calibration."""

SMOOTHED = 5
"""Slices over which errors of neighbouring slices, which are of one size, are averaged."""

MOST_NOISE = 0.8
"""Largest fraction of the Fisher matrix that is believed to be noise. The last slices, dim and with neighbours on one
side only, reach 0.8 in a stack with 0.05 photo-electrons a count; there the fraction itself is known to a tenth."""

LEAST_NOISE = 1e-9
"""Least standard deviation of a pixel, counts: a stack may have been computed without noise."""


@lru_cache(maxsize=4)
def recalibration_errors(calibration: Calibration) -> NDArray[np.float32]:
    """Errors (REPEATS, N, n, n) of the light of calibrations made of this one's light with fresh noise.

    The noise is like that of the stack, photon noise included (`denoising.noise_line`).
    """
    truth, smooth = particle_light(calibration), denoised(calibration.stack)
    noise = np.sqrt(np.polyval(noise_line(calibration.stack - smooth, smooth), smooth))
    errors = []
    for seed in range(REPEATS):
        stack = truth + np.random.default_rng(seed).normal(0, noise)
        made = Calibration.from_stack(stack, calibration.z_um, n_sub=len(calibration.subset))
        errors.append(particle_light(made) - truth)
    return np.array(errors)


def own_error(calibration: Calibration) -> NDArray[np.float64]:
    """What the noise of the stack does to positions measured with it.

    The error is that of every particle at that depth, so it does not average out.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    float64 array (N, 3)
        RMS error of x, y (px) and z (µm).
    """
    light = particle_light(calibration)
    rows = np.linalg.pinv(derivatives(light, calibration.z_um))[:, :3]
    errors = recalibration_errors(calibration).reshape(REPEATS, *light.shape[:1], -1, 1)
    mean_square = np.mean(np.square(rows @ errors), axis=0)[..., 0]
    return np.sqrt(uniform_filter1d(mean_square, SMOOTHED, axis=0, mode="nearest"))


def own_bias_um(calibration: Calibration) -> NDArray[np.float64]:
    """Error of z (N,) that is common to calibrations made again: what is to be taken from a measured z.

    Denoising leaves out what is faint and fine, and at the ends of the stack it leaves the most noise, from which
    measured depths keep away.

    Parameters
    ----------
    calibration : Calibration
    """
    light, off = particle_light(calibration), []
    for error in recalibration_errors(calibration):
        rows = np.linalg.pinv(derivatives(light + error, calibration.z_um))[:, 2:3]
        off.append(-rows @ error.reshape(len(light), -1, 1))
    return uniform_filter1d(np.mean(off, axis=0)[:, 0, 0], SMOOTHED, mode="nearest")


def expected_error(
    calibration: Calibration,
    *,
    noise: float | None = None,
    electrons_per_count: float | None = None,
    amplitude: float = 1.0,
) -> pd.DataFrame:
    """Least error with which a lone particle can be measured: the Cramér-Rao bound.

    Amplitude and level of the background are unknown, too. The bound is for the frame's noise alone; what the noise of
    the calibration adds is `own_error`. Noise that is left in the calibration's images makes them look sharper than
    they are: what it adds to the Fisher matrix is found with calibrations made again, and taken off.

    Parameters
    ----------
    calibration : Calibration
    noise : float, optional
        Standard deviation of a pixel of the frame without light. If not given, the frame is as noisy as the stack,
        photon noise included.
    electrons_per_count : float, optional
        Photo-electrons behind a count of light, which then has Poisson noise; none if not given and `noise` is.
    amplitude : float
        Of the particle, 1 for the calibration's.

    Returns
    -------
    DataFrame
        A row for each image: `z_um`, and standard deviations `x_std_px`, `y_std_px`, `z_std_um`.

    Raises
    ------
    TypeError, ValueError
        If an argument is no number above 0.
    """
    amplitude, light = _usual("amplitude", amplitude), particle_light(calibration)
    smooth = denoised(calibration.stack)
    slope, level = noise_line(calibration.stack - smooth, smooth)
    if noise is None:
        variance = level + slope * (smooth - light)
    else:
        variance, slope = np.full(light.shape, _usual("noise", noise) ** 2), 0.0
    if electrons_per_count is None:
        variance += slope * amplitude * light
    else:
        variance += amplitude * np.abs(light) / _usual("electrons_per_count", electrons_per_count)
    weight = (amplitude**2 / np.maximum(variance, LEAST_NOISE**2)).reshape(len(light), -1, 1)
    columns = derivatives(light, calibration.z_um)
    fisher = columns.transpose(0, 2, 1) @ (weight * columns)
    noisy = np.zeros_like(fisher)
    for error in recalibration_errors(calibration):
        off = derivatives(light + error, calibration.z_um) - columns
        noisy += off.transpose(0, 2, 1) @ (weight * off) / REPEATS
    variances = map(_without_noise, fisher, uniform_filter1d(noisy, 3, axis=0, mode="nearest"))
    names = ("x_std_px", "y_std_px", "z_std_um")
    return pd.DataFrame(np.sqrt([v[:3] for v in variances]), columns=names).assign(z_um=calibration.z_um)[
        ["z_um", *names]
    ]


def _usual(name: str, value: float) -> float:
    """Return a number above 0 whose square a computer can hold."""
    return float(numbers(name, positive(name, value), 1e-12, 1e12))


def _without_noise(fisher: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Diagonal of the inverse of a Fisher matrix (5, 5) less the part of it that noise makes, at most MOST_NOISE.

    In the basis in which the Fisher matrix is the unit matrix and that of the noise is diagonal.
    """
    fractions, basis = eigh(noise, fisher)
    return basis**2 @ (1 / (1 - np.minimum(fractions, MOST_NOISE)))


def derivatives(images: NDArray, z_um: NDArray) -> NDArray[np.float64]:
    """How each image changes with x, y, z, amplitude and background: (N, n * n, 5).

    Slopes in the image are those of the cubic spline through its pixels: differences of pixels would make them smaller
    where the particle is in focus, and the bound up to 1.3 times too high.
    """
    images = images.astype(np.float64)
    down, across = (np.gradient(spline_filter1d(images, axis=axis), axis=axis) for axis in (1, 2))
    along_z = np.gradient(images, z_um, axis=0)
    columns = np.stack([-across, -down, along_z, images, np.ones_like(images)], axis=-1)
    return columns.reshape(len(images), -1, 5)
