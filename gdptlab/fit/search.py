"""The search: where a further particle would explain most of a residual, by a matched filter for all depths at once.

What hides a particle in a crowd is not the camera's noise but the light of its neighbours, which is strong and
smooth. The filter therefore takes all that is left of the frame for noise with the spectrum that it has
(D. O. North's matched filter for coloured noise): where neighbours abound, edges and rings speak; once they
are explained, all of an image does.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from gdptlab._compiled import compiled
from gdptlab.correlation import good_shape, times_conjugate
from gdptlab.fit.solver import LEAST_SPREAD, Population

DEPTHS = 13
"""About as many depths are searched; the fit finds those between."""

RANK = 10
"""Singular images that stand for all depths."""

SMOOTHING = 4.0
"""Standard deviation, in frequency steps, over which the power of the residual's spectrum is smoothed."""

LEAST_GAIN = 20.0
"""Log-likelihood that a particle must add: chi-square of 40 with 4 degrees of freedom, which noise reaches at one place
in ten million, and a frame has some ten thousand places to be at."""

WIDE = 0.5
"""Standard deviation of the logarithm of amplitudes from which on the search takes them for free."""

SHARE = 0.1
"""Fraction of the gain of a lone particle that a further one must bring, where amplitudes are known."""

SIDE_LOBE = 3.0
"""A peak may be a side-lobe of one within half a template whose gain is so many times its own: it waits."""


class MatchedFilter:
    """Plan for searching frames of one shape, in one thread at a time: it keeps its working memory.

    Parameters
    ----------
    images : array (N, n, n)
        A particle of amplitude 1 at N depths, on no background; n is odd.
    shape : (rows, columns)
        Of the frames.
    """

    def __init__(self, images: NDArray, shape: tuple[int, int]) -> None:
        self._shape, self._steps = shape, np.arange(0, len(images), max(len(images) // DEPTHS, 1))
        images = images[self._steps].astype(np.float32)
        n = images.shape[-1]
        self._half = n // 2
        self._padded = good_shape(side + n for side in shape)
        left, values, right = np.linalg.svd(images.reshape(len(images), -1), full_matrices=False)
        self._mix = np.ascontiguousarray(left[:, :RANK] * values[:RANK], dtype=np.float32)
        singular = right[:RANK].reshape(-1, n, n).astype(np.float32)
        rows, columns = (side - n for side in self._padded)
        self._spectra = [cv2.dft(cv2.copyMakeBorder(b, 0, rows, 0, columns, cv2.BORDER_CONSTANT)) for b in singular]
        images = (self._mix @ right[:RANK]).reshape(images.shape)
        self._energy = np.pad((images**2).cumsum(axis=1).cumsum(axis=2), ((0, 0), (1, 0), (1, 0)))
        spectra = np.fft.rfft2(images, self._padded)
        twice = np.r_[1, np.full(spectra.shape[-1] - 2, 2), 1]  # half of the spectrum is its mirror image
        power = np.abs(spectra) ** 2 * (twice / np.prod(self._padded))
        self._power = power.reshape(len(power), -1).astype(np.float32)
        self._maps = np.empty((len(self._spectra), *self._padded), dtype=np.float32)
        self._product = np.empty(self._padded, dtype=np.float32)

    def __call__(
        self,
        residual: NDArray[np.float32],
        noise: float,
        population: Population | None,
        *,
        whiten: bool,
        size: float,
        outside_px: float = 0.0,
    ) -> NDArray[np.float64]:
        """Find the best places for further particles, bright ones first.

        Parameters
        ----------
        residual : float32 array (rows, columns)
            The frame without background and without the particles found so far.
        noise : float
            Standard deviation of a pixel.
        population : Population, optional
            What is known of the particles' amplitudes.
        whiten : bool
            Take all of the residual for noise, rather than the camera's alone.
        size : float
            Rows and columns of a template, px. Of places nearer than a sixth of it only the best is given.
        outside_px : float
            How far beyond the frame's edge to look.

        Returns
        -------
        float64 array (P, 4)
            y, x (px), slice, amplitude.
        """
        if population is None or population.sigma > WIDE:
            found, gain = self._peaks(residual, noise, 1.0, np.inf, 0.0, whiten, size / 6, outside_px)
            return found[_in_the_open(found, gain, size / 2)]
        centre, sigma = population.centre, population.sigma
        spread = max(sigma, LEAST_SPREAD) * centre
        found, _ = self._peaks(residual, noise, centre, spread, SHARE, whiten, size / 6, outside_px)
        found[:, 3] = np.clip(found[:, 3], centre * np.exp(-2 * sigma), centre * np.exp(2 * sigma))
        return found

    def _peaks(
        self,
        residual: NDArray[np.float32],
        noise: float,
        centre: float,
        spread: float,
        fraction: float,
        whiten: bool,
        apart_px: float,
        outside_px: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Peaks (P, 4) of the gain in log-likelihood, best first, and the gain (P,).

        The prior of the amplitude is normal; a peak brings at least `fraction` of what a lone particle would.
        """
        (rows, columns), pad = self._shape, self._half
        canvas = np.zeros(self._padded, dtype=np.float32)
        # So that index 0 of a map is the centre that lies `pad` outside the frame.
        canvas[2 * pad : 2 * pad + rows, 2 * pad : 2 * pad + columns] = residual
        spectrum = cv2.dft(canvas)
        if whiten:
            noise_power = np.maximum(smooth_power(spectrum, SMOOTHING) / residual.size, np.float32(noise**2))
            spectrum /= packed(noise_power)
            energy = self._power @ (1 / noise_power).ravel()
        else:
            spectrum /= np.float32(noise**2)
            energy = self._energy[:, -1, -1] / noise**2
        for map_, image in zip(self._maps, self._spectra, strict=True):
            times_conjugate(spectrum, image, self._product)
            cv2.idft(self._product, map_, flags=cv2.DFT_REAL_OUTPUT | cv2.DFT_SCALE)
        cut = self._energy * (energy / self._energy[:, -1, -1])[:, None, None]
        known = spread**-2
        gain, bright = (np.zeros((rows + 2 * pad, columns + 2 * pad), np.float32) for _ in range(2))
        best = np.zeros(gain.shape, np.int32)
        margin = int(np.clip(round(pad - outside_px), 0, pad))
        cut = cut.astype(np.float32)
        _gain(self._maps, self._mix, cut, rows, columns, margin, centre, known, fraction, gain, best, bright)

        width = 2 * max(round(apart_px), 1) + 1
        near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        i, j = np.nonzero((gain > LEAST_GAIN) & (gain == cv2.dilate(gain, near)))
        found = np.stack([i - pad, j - pad, self._steps[best[i, j]], bright[i, j]], axis=1).astype(float)
        order = np.argsort(-gain[i, j], kind="stable")
        return found[order], gain[i, j][order]


def _in_the_open(found: NDArray[np.float64], gain: NDArray[np.float64], distance: float) -> NDArray[np.bool_]:
    """Which of the peaks (P, 4), best first, are not beside a far better one, whose side-lobes they may be."""
    keep = np.ones(len(found), bool)
    for i in range(len(found)):
        better = keep[:i] & (gain[:i] > SIDE_LOBE * gain[i])
        keep[i] = not (np.hypot(*(found[:i, :2][better] - found[i, :2]).T) < distance).any()
    return keep


@compiled
def _gain(maps, mix, cut, rows, columns, margin, centre, known, fraction, gain, best, bright):  # pragma: no cover
    """Highest gain over the depths at each place, with the amplitude that brings it.

    A particle of amplitude a changes minus the log-likelihood by a**2 e / 2 - a c + known (a - centre)**2 / 2;
    c is its product with the residual, mixed from those of the singular images, and e its energy, less where the
    frame's edge cuts it.
    """
    depths, (height, width) = len(mix), gain.shape
    n = cut.shape[1] - 1
    half = n // 2
    aim, known = np.float32(centre * known), np.float32(known)
    base, least = np.float32(centre**2) * known, np.float32(fraction * centre**2)
    zero, half_of = np.float32(0), np.float32(0.5)
    inverse = np.empty((depths, width), np.float32)
    between, product = np.empty(n + 1, np.float32), np.empty(width, np.float32)
    highest, argument = np.empty(width - 2 * margin, np.float32), np.empty(width - 2 * margin, np.int32)
    before = (-1, -1)
    for i in range(margin, height - margin):
        top, bottom = max(0, 2 * half - i), min(n, rows - i + 2 * half)
        if (top, bottom) != before:
            before = (top, bottom)
            for z in range(depths):
                for j in range(n + 1):
                    between[j] = cut[z, bottom, j] - cut[z, top, j]
                inverse[z, :] = 1 / max(between[n] + known, np.float32(1e-9))
                for j in range(width):
                    if 2 * half <= j <= columns - n + 2 * half:
                        continue  # it is not cut at the left or right
                    left, right = max(0, 2 * half - j), min(n, columns - j + 2 * half)
                    inverse[z, j] = 1 / max(between[right] - between[left] + known, np.float32(1e-9))
        highest[:] = 0
        argument[:] = 0
        for z in range(depths):
            product[:] = aim
            for k in range(len(maps)):
                factor, map_ = mix[z, k], maps[k, i]
                for j in range(width):
                    product[j] += factor * map_[j]
            inner, per = product[margin:], inverse[z, margin:]
            for j in range(len(highest)):  # from 0: an index that cannot be negative is far faster
                c = max(inner[j], zero)
                g = c * c * per[j]
                better = g > highest[j]
                highest[j] = g if better else highest[j]
                argument[j] = z if better else argument[j]
        for j in range(len(highest)):
            per = inverse[argument[j], margin + j]
            value = half_of * (highest[j] - base)
            gain[i, margin + j] = value if value > half_of * least * (1 / per - known) else zero
            best[i, margin + j] = argument[j]
            bright[i, margin + j] = np.sqrt(highest[j] * per)  # c / (e + known)


def smooth_power(spectrum: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Power of a spectrum, (rows, columns / 2 + 1), smoothed over `sigma` frequency steps."""
    squares = spectrum**2
    inner = squares[:, 1:-1:2] + squares[:, 2:-1:2]
    rim = int(np.ceil(3 * sigma))  # rows go around; the outermost columns are packed in another way, and left out
    inner = cv2.copyMakeBorder(inner, rim, rim, 0, 0, cv2.BORDER_WRAP)
    inner = cv2.copyMakeBorder(inner, 0, 0, 1, 1, cv2.BORDER_REPLICATE)
    return cv2.GaussianBlur(inner, (2 * rim + 1, 2 * rim + 1), sigma, borderType=cv2.BORDER_REPLICATE)[rim:-rim]


def packed(half: NDArray[np.float32]) -> NDArray[np.float32]:
    """Factors (rows, columns / 2 + 1) of a spectrum in OpenCV's order."""
    out = np.repeat(half[:, 1:], 2, axis=1)
    rows = (np.arange(len(half)) + 1) // 2
    return np.column_stack([half[rows, 0], out[:, :-2], half[rows, -1]])
