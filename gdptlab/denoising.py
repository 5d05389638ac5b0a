"""What noise there is in a stack of images, and the same stack with far less of it."""

from itertools import product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import dct, dctn, idctn
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from gdptlab._compiled import on_one_core

WINDOW = 11
"""Images that are filtered together."""

BLOCK = 16
"""Rows and columns that are filtered together; blocks overlap by half."""

SMOOTHED = (1.5, 1.5, 0.7)
"""Frequencies in the block, and orders along z, over which the power of its spectrum is smoothed."""

DOUBT = 2.0
"""Over-subtraction factor of the Wiener filter. The smoothed power still scatters, so that a factor of 1 would leave a
part of the noise where there is nothing else."""

FIRST_BLUR = 1.5
"""Standard deviation, in slices and px, of the Gaussian filter that gives a first estimate of each pixel's value
without noise. It only sorts pixels by their value, so that its width hardly matters."""

LEAST_IN_BIN = 100
"""Fewest pixels from whose scatter a variance is taken; it is then known to 15 %."""

MEDIAN_SIZE = 2 * 0.6745
"""Median size of the mixed second differences of Gaussian noise of standard deviation 1."""


@on_one_core
def denoised(stack: NDArray) -> NDArray[np.float32]:
    """Smooth model of a stack: a Wiener filter along z and in the image, in small blocks.

    From block to block the filter follows how bright and how sharp the images are, and how noisy: the noise of a pixel
    may grow with its value, as that of photons does, and the stack itself tells how (`noise_line`). What is symmetric
    and what is antisymmetric about the middle row and column is filtered each for itself: a particle that is its own
    mirror image has nothing in three of the four parts, and three quarters of the noise go with them.

    Parameters
    ----------
    stack : array (N, n, n)
        The particle in the middle; n is odd.

    Returns
    -------
    float32 array (N, n, n)
    """
    stack = np.asarray(stack, dtype=np.float32)
    blurred = gaussian_filter(stack, FIRST_BLUR, mode="nearest")
    # The first line takes fine structure for noise, the second one only what the first filter took for noise.
    smooth = _smoothed(stack, np.polyval(noise_line(stack, blurred), blurred))
    return _smoothed(stack, np.polyval(noise_line(stack - smooth, smooth), smooth))


def _smoothed(stack: NDArray[np.float32], variance: NDArray[np.float64]) -> NDArray[np.float32]:
    """Stack (N, n, n) with noise of that variance (N, n, n), filtered in its symmetric and antisymmetric parts."""
    half = stack.shape[1] // 2
    over = min(BLOCK // 2, half)  # blocks reach beyond the middle
    levels = stack.mean(axis=(1, 2), keepdims=True, dtype=np.float64)
    centred = (stack - levels).astype(np.float32)
    variance = (variance + variance[:, ::-1]).astype(np.float32)
    variance = (variance + variance[:, :, ::-1])[:, half - over :, half - over :] / 16
    sides = list(product((1, -1), repeat=2))
    parts = [centred + down * centred[:, ::-1] for down, _ in sides]
    parts = [(part + across * part[:, :, ::-1]) / 4 for part, (_, across) in zip(parts, sides, strict=True)]
    quarters = _filtered(np.stack(parts)[..., half - over :, half - over :], variance)[..., over:, over:]
    smooth, away = np.zeros_like(centred), np.arange(-half, half + 1)
    sign = {1: np.ones(len(away), np.float32), -1: np.sign(away).astype(np.float32)}
    for quarter, (down, across) in zip(quarters, sides, strict=True):
        smooth += quarter[:, np.abs(away)][:, :, np.abs(away)] * (sign[down][:, None] * sign[across])
    levels -= smooth.mean(axis=(1, 2), keepdims=True)
    return (smooth + levels).astype(np.float32)


def _filtered(stacks: NDArray[np.float32], variance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stacks (S, N, m, m) with noise of that variance (N, m, m), filtered in blocks along z, y and x."""
    slices, size = variance.shape[:2]
    count, edge = min(WINDOW, slices), min(BLOCK, size)
    # Polynomials, not cosines, as images still change at the ends of a window.
    along_z = np.linalg.qr(np.vander(np.linspace(-1, 1, count), increasing=True))[0].astype(np.float32)
    trust = (1 - np.abs(np.arange(count) - (count - 1) / 2) / ((count + 1) / 2)).astype(np.float32) ** 2
    sizes = (edge, edge, count)
    blurs = [
        gaussian_filter1d(np.eye(n, dtype=np.float32), sigma, axis=0, mode="nearest")
        for n, sigma in zip(sizes, SMOOTHED, strict=True)
    ]
    squares = dct(np.eye(edge, dtype=np.float32), axis=0, norm="ortho") ** 2
    taper = np.sin((np.arange(edge) + 0.5) * np.pi / edge).astype(np.float32)
    taper = taper[:, None] * taper
    starts = np.rint(np.linspace(0, size - edge, -(-2 * (size - edge) // edge) + 1)).astype(int)
    overlap = np.convolve(trust, np.ones(slices - count + 1, np.float32))  # of the windows at each slice
    smooth, weight = np.zeros_like(stacks), np.zeros_like(variance)
    for top, left in product(starts, starts):
        block = np.s_[:, top : top + edge, left : left + edge]
        # z is the last axis, so that each step is one product of large matrices.
        noise = DOUBT * (_windows(squares @ variance[block] @ squares.T, count) @ along_z**2)
        weight[block] += taper
        for stack, out in zip(stacks, smooth, strict=True):
            spectra = _windows(dctn(stack[block], axes=(1, 2), norm="ortho"), count) @ along_z
            power = blurs[0] @ (spectra**2 @ blurs[2].T).reshape(edge, -1)
            power = (blurs[1] @ power.reshape(edge, edge, -1)).reshape(spectra.shape)
            spectra *= 1 - np.minimum(noise / np.where(power > 0, power, 1), 1)
            parts = (spectra @ (along_z.T * trust)).reshape(edge, edge, -1, count)
            filtered = np.zeros((edge, edge, slices), np.float32)
            for k in range(count):
                filtered[..., k : k + parts.shape[2]] += parts[..., k]
            out[block] += taper * idctn(np.moveaxis(filtered / overlap, 2, 0), axes=(1, 2), norm="ortho")
    return smooth / weight


def _windows(images: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """All `count` consecutive values along z of images (N, m, m), a row each, by row, column and first slice."""
    along = np.ascontiguousarray(np.moveaxis(images, 0, 2))
    return sliding_window_view(along, count, axis=2).reshape(-1, count)


def noise_level(images: NDArray) -> float:
    """Standard deviation of the noise of a pixel, from differences that smooth structure does not reach.

    Parameters
    ----------
    images : array (..., rows, columns)

    Returns
    -------
    float
        From the median size of mixed second differences, which few sharp edges do not move.
    """
    return float(np.median(np.abs(_mixed_differences(images))) / MEDIAN_SIZE)


def noise_line(noise: NDArray, smooth: NDArray) -> NDArray[np.float64]:
    """Variance of the noise of a pixel as a line in the pixel's value: photon noise over read noise.

    Parameters
    ----------
    noise : array (..., rows, columns)
        Images, or their residual less a smooth model.
    smooth : array (..., rows, columns)
        About their values without noise.

    Returns
    -------
    float64 array (2,)
        Slope, 0 or above, and intercept, for `numpy.polyval`; at every value in `smooth` the variance is above 0, but
        of images without noise.
    """
    from scipy.optimize import nnls  # here, as it takes long to import

    size = np.abs(_mixed_differences(noise)).ravel()
    value = (smooth[..., 1:, 1:] + smooth[..., 1:, :-1] + smooth[..., :-1, 1:] + smooth[..., :-1, :-1]).ravel() / 4
    bins = np.array_split(np.argsort(value), max(min(len(value) // LEAST_IN_BIN, 200), 1))
    variance = np.array([(np.median(size[part]) / MEDIAN_SIZE) ** 2 for part in bins])
    darkest, span = float(smooth.min()), float(np.ptp(smooth))
    least = (np.median(size) / MEDIAN_SIZE) ** 2 / 4
    if len(bins) < 4 or span == 0 or least == 0:
        return np.array([0, 4 * least])
    relative = np.array([value[part].mean() - darkest for part in bins]) / span
    terms = np.stack([np.ones(len(bins)), relative], axis=1) / np.maximum(variance, least)[:, None]
    level, slope = nnls(terms, variance / np.maximum(variance, least))[0]
    return np.array([slope / span, max(level, least) - slope / span * darkest])


def _mixed_differences(images: NDArray) -> NDArray[np.float64]:
    """Mixed second differences (..., rows - 1, columns - 1), each of four pixels that meet in a corner."""
    return np.diff(np.diff(np.asarray(images, dtype=np.float64), axis=-1), axis=-2)


def signal_to_noise(stack: NDArray) -> NDArray[np.float64]:
    """Largest deviation of each denoised image of (N, n, n) from its median, over the noise of a pixel; (N,)."""
    smooth, noise = denoised(stack), noise_level(stack)
    contrast = np.abs(smooth - np.median(smooth, axis=(1, 2), keepdims=True)).max(axis=(1, 2))
    return contrast.astype(np.float64) / noise if noise > 0 else np.full(len(stack), np.inf)
