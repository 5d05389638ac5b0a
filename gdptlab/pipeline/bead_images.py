"""The images of one bead, cut out of a scan: where its centre is, how large they are, whether it stands alone."""

from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import shift as shift_image
from skimage.registration import phase_cross_correlation

from gdptlab._checks import depths, positive, real_array
from gdptlab._compiled import on_one_core
from gdptlab.calibration import levelled
from gdptlab.denoising import denoised, noise_level
from gdptlab.fit.pattern import image_size, largest_size

RECENTRED = 4
"""Largest number of times that a particle is cut out anew about the centre that was found. Derived: each time the first
guess may be off by half an image's width, and hardly any particle needs a second."""

STANDS_OUT = 4.0
"""Height of a particle, in standard deviations of a pixel's noise, from which on it is one. Derived: the highest of the
thousand pixels of a window without a particle, denoised, stays below 4."""

MARGIN = 8
"""Margin about a window that is moved, px, for the spline and for a particle that drifts. Derived: a cubic spline's
response falls by 0.27 from pixel to pixel, to 3e-5 over 8."""


@on_one_core
def stack_of_bead(
    scan: ArrayLike, z_um: ArrayLike, x_px: float, y_px: float, size: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Cut one bead out of a scan, its centre on the middle pixel of every slice.

    Parameters
    ----------
    scan, z_um, x_px, y_px, size
        As in `Calibration.from_bead`.

    Returns
    -------
    stack : float32 array (N, size, size)
    z_um : float64 array (N,)
    """
    scan, z_um = real_array("scan", scan, 3), depths("z_um", z_um)
    if len(z_um) != len(scan):
        raise ValueError(f"z_um: got {len(z_um)} depths, needed is one for each of {len(scan)} frames")
    rows, columns = scan.shape[1:]
    x_px, y_px = positive("x_px", x_px, zero=True), positive("y_px", y_px, zero=True)
    if size is not None and (not isinstance(size, Integral) or isinstance(size, bool)):
        raise TypeError(f"size: got {size!r}, allowed are odd whole numbers")
    given = size
    for _ in range(RECENTRED):
        room = int(min(x_px, y_px, columns - 1 - x_px, rows - 1 - y_px)) - 2
        where = f"a particle at x_px = {x_px:g}, y_px = {y_px:g} in frames of {columns} by {rows} px"
        if room < 1:
            raise ValueError(f"x_px, y_px: got {where}, allowed is one 3 px or more inside")
        if given is None:
            half = min(room, largest_size((rows, columns)) // 2)
            size = image_size(cut_out(scan, x_px, y_px, half))
            if size >= 2 * half - 1 and half == room:
                raise ValueError(f"x_px, y_px: got {where}, whose images reach the border: allowed is one inside")
        if not 3 <= size <= 2 * room + 1 or size % 2 == 0:
            raise ValueError(f"size: got {size} px, allowed are odd sizes from 3 to {2 * room + 1} for {where}")
        stack, centres = centred(scan, z_um, x_px, y_px, size, room)
        middle = centres.mean(axis=0)
        if np.abs(middle - (x_px, y_px)).max() <= 1:
            break
        x_px, y_px = np.clip(middle, 0, (columns - 1, rows - 1)).tolist()
    _must_stand_out(stack, where)
    return stack, z_um


def _must_stand_out(stack: NDArray[np.float32], where: str) -> None:
    """Refuse a stack in whose middle is no particle, or with a brighter one beside it."""
    noise, size = max(noise_level(stack), 1e-9), stack.shape[1]
    edge = size // 4
    smooth = denoised(stack)
    height = np.abs(smooth - np.median(smooth, axis=(1, 2), keepdims=True)).max(axis=0) / noise
    inside = height[edge : size - edge, edge : size - edge].max()
    if inside < max(STANDS_OUT, height.max() / 2):
        raise ValueError(
            f"x_px, y_px: got {where}, where nothing stands out by more than {inside:.1f} times the noise (beside "
            f"it, by {height.max():.1f}); needed is a particle, alone, that does so by {STANDS_OUT:g}"
        )


def cut_out(scan: NDArray, x_px: float, y_px: float, half: int) -> NDArray:
    """Part (N, 2 half + 1, 2 half + 1) of a scan about a position."""
    x, y = round(x_px), round(y_px)
    return scan[:, y - half : y + half + 1, x - half : x + half + 1]


def centred(
    scan: NDArray, z_um: NDArray, x_px: float, y_px: float, size: int, room: int
) -> tuple[NDArray, NDArray[np.float64]]:
    """Images (N, size, size) with the particle on the middle pixel, and its positions (x, y) before, (N, 2)."""
    centres = _centres(scan, z_um, x_px, y_px, size)
    margin = min(room + 2 - size // 2, 2 * MARGIN)
    stack = [
        shift_image(image, (round(y_px) - y, round(x_px) - x), order=3, mode="nearest")
        for image, (x, y) in zip(cut_out(scan, x_px, y_px, size // 2 + margin), centres, strict=True)
    ]
    return np.stack(stack)[:, margin:-margin, margin:-margin], centres


def _centres(scan: NDArray, z_um: NDArray, x_px: float, y_px: float, size: int) -> NDArray[np.float64]:
    """Centre (x, y) of the particle in every slice, (N, 2), px."""
    cut = levelled(cut_out(scan, x_px, y_px, size // 2).astype(np.float32))
    smooth = denoised(cut)
    weight = np.einsum("kij,kij->k", smooth, smooth)  # of the particle, not of the noise
    blank = np.flatnonzero((weight == 0) | ~cut.any(axis=(1, 2))).tolist()
    if blank:
        raise ValueError(f"scan: got frames without contrast around x_px, y_px at {blank}, allowed are frames with it")
    shifts = [
        # Half a turn about the middle moves an image that is symmetric about c by -2 c.
        phase_cross_correlation(image, image[::-1, ::-1], upsample_factor=100, normalization=None)[0] / 2
        for image in cut
    ]
    order = np.argsort(z_um)
    weight = weight[order]
    offsets = np.empty((len(scan), 2))
    for axis, values in enumerate(np.asarray(shifts).T):
        if len(scan) >= 5:
            values[order] = make_smoothing_spline(z_um[order], values[order], w=weight / weight.max())(z_um[order])
        offsets[:, axis] = values
    return offsets[:, ::-1] + (round(x_px), round(y_px))
