"""The light of a calibration's particle: images without background, on beyond their frame."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import median, median_filter

from gdptlab.calibration import Calibration, checked, levelled
from gdptlab.denoising import denoised, noise_level

RIM = 0.06
"""Brightness of a ring, as a fraction of the brightest, below which an image has ended. Chosen on the planar and the
synthetic scan between 0.03 and 0.12, where templates have 37, 35, 33 and 79, 71, 45 px: the larger lose particles in a
crowd and at the border, the smaller cut off faint rings that tell depths apart."""

LARGEST = 121
"""Largest size of a template, px, that is chosen unasked in frames of 500 px; see `largest_size`. Chosen: twice that of
the paper's, and four times that of the planar beads; time to calibrate grows with its square."""


def particle_light(calibration: Calibration) -> NDArray[np.float32]:
    """Light of a calibration's particle: the stack, denoised, less its background, in the stack's counts.

    Templates have no level and no slope; here both are put back, smooth in z as the light itself, but for the
    background, which is that of the images whose outermost pixels are faintest (most bright, for dark particles):
    there the particle is smallest.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    float32 array (N, n, n)
        Below 0 for dark particles.

    Raises
    ------
    TypeError
        If it is no calibration.
    """
    stack, z_um = checked(calibration).stack, calibration.z_um
    strength = np.einsum("kij,kij->k", levelled(stack), calibration.templates)
    smooth = _smooth_in_z(z_um, strength[:, None])[:, 0, None, None] * calibration.templates
    tilt = _smooth_planes(z_um, stack - levelled(stack))
    rim = np.ones(stack.shape[1:], dtype=bool)
    rim[1:-1, 1:-1] = False
    middle = calibration.size // 2
    level = (smooth + tilt)[:, rim].mean(axis=1)
    bright = np.sign((smooth[:, middle, middle] - smooth[:, rim].mean(axis=1)).sum()) or 1
    above = bright * level - (bright * level).min()
    small = above < max(noise_level(stack) / 4, np.median(above) / 50)
    y, x = np.nonzero(rim) - np.array(middle)
    fit = np.linalg.lstsq(_bilinear(y, x), stack[small][:, rim].mean(axis=0), rcond=None)[0]
    y, x = np.indices(rim.shape) - middle
    return (smooth + tilt - _bilinear(y, x) @ fit).astype(np.float32)


def _smooth_in_z(z_um: NDArray, values: NDArray) -> NDArray:
    """Values (N, k), each column smoothed along z; as they are if there are fewer than five."""
    if len(values) < 5:
        return values
    columns = [make_smoothing_spline(z_um, column)(z_um) for column in values.T.astype(float)]
    return np.stack(columns, axis=1).astype(np.float32)


def _smooth_planes(z_um: NDArray, planes: NDArray) -> NDArray:
    """Plane images (N, n, n), smoothed along z."""
    corners = _smooth_in_z(z_um, planes[:, [0, 0, -1], [0, -1, 0]])
    origin, right, down = corners.T[:, :, None, None]
    ramp = np.linspace(0, 1, planes.shape[1])
    return origin + (right - origin) * ramp + (down - origin) * ramp[:, None]


def _bilinear(y: NDArray, x: NDArray) -> NDArray[np.float64]:
    """Terms 1, x, y, x y of a background, (..., 4)."""
    return np.stack([np.ones(x.shape), x, y, x * y], axis=-1)


def continued(images: NDArray[np.float32], mean: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Images that go on beyond their frame: the light along each side falls on as a parabola about the middle does.

    Parameters
    ----------
    images : array (..., N, n, n)
        The particle in the middle, without background.
    mean : array (N, n, n), optional
        Images whose light says how that of all falls; `images` themselves, (N, n, n) then, if not given.

    Returns
    -------
    float32 array (..., N, m, m)
        m is about 5 n / 3.
    """
    mean = images if mean is None else mean
    half = mean.shape[1] // 2
    more, depth = 2 * (half // 3), max(half // 4, 2)
    away = np.arange(-half - more, half + more + 1)
    rim, fall = np.abs(away) > half, []
    for axis in (1, 2):
        light, factor = mean.mean(axis=3 - axis), np.ones((len(mean), len(away)), np.float32)
        for side in (away[more : more + depth], away[-more - depth : -more]):
            bend, middle = np.polyfit(side**2, light[:, side + half].T, 1)
            end = np.where(bend * middle < 0, -middle / np.where(bend == 0, 1, bend), 0)
            end = np.clip(median_filter(end, 5, mode="nearest")[:, None], (half + 1) ** 2, (half + more) ** 2)
            beyond = rim & (away * side[0] > 0)
            factor[:, beyond] = np.clip((end - away[beyond] ** 2) / (end - half**2), 0, 1)
        fall.append(factor)
    down, across = fall
    around = [(0, 0)] * (images.ndim - 2) + [(more, more)] * 2
    return np.pad(images, around, mode="edge") * (down[:, :, None] * across[:, None, :])


def largest_size(shape: tuple[int, int]) -> int:
    """Largest size of a template that is chosen unasked: `LARGEST`, or in large frames a quarter of a side, odd."""
    return max(LARGEST, min(shape) // 8 * 2 + 1)


def image_size(cut: NDArray) -> int:
    """Smallest odd size that holds the particle in nearly every slice of (N, 2 r + 1, 2 r + 1).

    An image ends where the median over a ring about the centre, which a neighbour does not move, first falls
    below the fraction `RIM` of the brightest ring's.
    """
    half = cut.shape[-1] // 2
    y, x = np.indices(cut.shape[1:]) - half
    ring = np.rint(np.hypot(x, y)).astype(int)
    radius = []
    for image in denoised(cut):
        above = image - np.median(np.concatenate([image[[0, -1]].ravel(), image[:, [0, -1]].ravel()]))
        profile = np.abs(median(above, ring, np.arange(half + 1)))
        brightest = int(profile.argmax())
        faint = np.flatnonzero(profile[brightest:] < RIM * profile[brightest])
        radius.append(brightest + int(faint[0]) if len(faint) else half)
    return 2 * int(np.percentile(radius, 95)) + 1
