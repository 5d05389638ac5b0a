"""What noise there is in a stack of images, and the same stack with far less of it."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter1d

from gdptlab._compiled import on_one_core

WINDOW = 11
"""Images that are filtered together."""

BLOCK = 16
"""Rows and columns that are filtered together; blocks overlap by half."""

SMOOTHED = (1.5, 1.5, 0.7)
"""Frequencies in the block, and orders along z, over which the power of its spectrum is smoothed."""

DOUBT = 2.0
"""Times the power of the noise that is taken from that power. As it still scatters, of noise alone next to nothing is
left."""


@on_one_core
def denoised(stack: NDArray) -> NDArray[np.float32]:
    """Smooth model of a stack: a Wiener filter along z and in the image, in small blocks.

    From block to block it follows how bright and how sharp the images are. What is symmetric and what is antisymmetric
    about the middle row and column is filtered each for itself: a particle that is its own mirror image
    has nothing in three of the four parts, and three quarters of the noise go with them.

    Parameters
    ----------
    stack : array (N, n, n)
        The particle in the middle; n is odd.

    Returns
    -------
    float32 array (N, n, n)
    """
    half = stack.shape[1] // 2
    over = min(BLOCK // 2, half)  # blocks reach beyond the middle
    levels = stack.mean(axis=(1, 2), keepdims=True, dtype=np.float64)
    rest, variance = (stack - levels).astype(np.float32), noise_level(stack) ** 2 / 4
    smooth, away = np.zeros_like(rest), np.arange(-half, half + 1)
    sides = {1: np.ones(len(away), np.float32), -1: np.sign(away).astype(np.float32)}
    for down, y_side in sides.items():
        part = (rest + down * rest[:, ::-1]) / 2
        for across, x_side in sides.items():
            quarter = (part + across * part[:, :, ::-1])[:, half - over :, half - over :] / 2
            quarter = _filtered(quarter, variance)[:, over:, over:]
            smooth += quarter[:, np.abs(away)][:, :, np.abs(away)] * (y_side[:, None] * x_side)
    levels -= smooth.mean(axis=(1, 2), keepdims=True)
    return (smooth + levels).astype(np.float32)


def _filtered(stack: NDArray[np.float32], variance: float) -> NDArray[np.float32]:
    """Images (N, m, m) with noise of that variance, filtered in blocks along z, y and x."""
    count, edge = min(WINDOW, len(stack)), min(BLOCK, stack.shape[1])
    # Polynomials, not cosines, as images still change at the ends of a window.
    along_z = np.linalg.qr(np.vander(np.linspace(-1, 1, count), increasing=True))[0].astype(np.float32)
    trust = (1 - np.abs(np.arange(count) - (count - 1) / 2) / ((count + 1) / 2)).astype(np.float32) ** 2
    sizes = (edge, edge, count)
    blurs = [
        gaussian_filter1d(np.eye(n, dtype=np.float32), sigma, axis=0, mode="nearest")
        for n, sigma in zip(sizes, SMOOTHED, strict=True)
    ]
    taper = np.sin((np.arange(edge) + 0.5) * np.pi / edge).astype(np.float32)
    taper = taper[:, None] * taper
    starts = np.rint(np.linspace(0, stack.shape[1] - edge, -(-2 * (stack.shape[1] - edge) // edge) + 1)).astype(int)
    smooth, weight = np.zeros_like(stack), np.zeros_like(stack)
    for top in starts:
        for left in starts:
            block = np.s_[:, top : top + edge, left : left + edge]
            spectra = sliding_window_view(dctn(stack[block], axes=(1, 2), norm="ortho"), count, axis=0) @ along_z
            power = blurs[0] @ (spectra**2 @ blurs[2].T).reshape(len(spectra), edge, -1)
            power = blurs[1] @ power.reshape(spectra.shape)
            spectra *= 1 - np.minimum(DOUBT * variance / np.where(power > 0, power, 1), 1)
            filtered, together = np.zeros_like(stack[block]), np.zeros((len(stack), 1, 1), np.float32)
            for k, each in enumerate(trust):
                filtered[k : len(stack) - count + 1 + k] += each * (spectra @ along_z[k])
                together[k : len(stack) - count + 1 + k] += each
            smooth[block] += taper * idctn(filtered / together, axes=(1, 2), norm="ortho")
            weight[block] += taper
    return smooth / weight


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
    mixed = np.diff(np.diff(np.asarray(images, dtype=np.float64), axis=-1), axis=-2)
    return float(np.median(np.abs(mixed)) / (2 * 0.6745))


def signal_to_noise(stack: NDArray) -> NDArray[np.float64]:
    """Largest deviation of each denoised image of (N, n, n) from its median, over the noise of a pixel; (N,)."""
    smooth, noise = denoised(stack), noise_level(stack)
    contrast = np.abs(smooth - np.median(smooth, axis=(1, 2), keepdims=True)).max(axis=(1, 2))
    return contrast.astype(np.float64) / noise if noise > 0 else np.full(len(stack), np.inf)
