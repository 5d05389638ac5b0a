"""Mismatch of the patterns: what the residuals of all particles of a film have in common.

Optics that changed since the scan change the images of all particles alike. In the residual of one particle noise hides
it; the mean of some hundred shows it. A part of it is the calibration's own noise, which is taken off.

A focus that moved since the scan shifts all z alike, and no image shows it: each image is still that of some depth of
the scan. A bead that sticks to a wall does: its z must be that of the wall.
"""

from collections.abc import Iterable
from itertools import pairwise

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from gdptlab._checks import image_array, iterable, numbers, table
from gdptlab.calibration import Calibration, checked
from gdptlab.fit.frames import explained
from gdptlab.fit.model import ERROR_SCALE_PX, PatternModel, field_terms

BINS = 6
"""Number of bins of depth, if the calibration has three slices or more for each. Chosen: some hundred particles then
put 30 or more into a bin."""

CELLS = 4
"""Number of cells along x and along y into which a frame is divided. Only residuals of different cells are multiplied:
a particle that hardly moves is in several frames, and what is peculiar to it is not common."""

FEWEST = 8
"""Fewest cells with particles, in a bin. Convention: half of them. With three, the last bin of 50 particles that rested
in six frames was taken for a mismatch."""

OWN = 0.33, 0.12
"""Fraction of the energy of the patterns' own error that remains in the mean over the slices of a bin and after a fit,
and its standard deviation. Chosen on calibrations made again (`recalibration_errors`) of one noisy exposure of 51
slices: 0.28 to 0.42."""

MODEL = 0.004
"""Mismatch, as a fraction of the norm of a pattern, that the calibration's model makes with unchanged optics: it
interpolates between slices, and a template cuts faint skirts off. Chosen on films of the sample's scan and of two scans
of Gaussian spots, particles unequal by 0.3: of 60 with unchanged optics 18 are flagged at 0, 1 at 0.003 and none at
0.004; of 36 with 1 % more magnification 36, 29 and 25; of 72 with 2 % or a lens changed by 5 % all. On two noisier
calibrations, not chosen on, 0.004 flags 0 of 40, 9 of 24 and 24 of 24."""

SURE = 2.5
"""Significance, standard deviations, from which on a mismatch is more than noise. Chosen on frames of three
calibrations, before `MODEL` was subtracted: it was at most 0.6 in any bin with unchanged optics, and 3.3 or more in one
with 1 % more magnification."""

ABSORBED = 2.0
"""Error of z that the fit has absorbed, over what the residual would be if it were all along z. Chosen on the same: it
is 1.3 to 2.1 with a magnification changed by 2 %, and 0.6 to 0.8 with a cylindrical lens changed by 5 %."""


def pattern_mismatch(frames: Iterable[ArrayLike], calibration: Calibration) -> pd.DataFrame:
    """Compare the mean image of the particles of a film with the calibration's, depth by depth.

    All particles of each frame are fitted at once. Their residuals, smoothed by `ERROR_SCALE_PX`, are averaged.

    Parameters
    ----------
    frames : iterable of arrays (rows, columns)
        Some frames, spread over the film, with 200 particles or more in all.
    calibration : Calibration

    Returns
    -------
    DataFrame
        A row for each bin of depth: `z_um`, its middle; `n`, the number of particles; `mismatch`, the norm of the mean
        residual over that of the pattern; `own`, what the calibration's own noise makes of it; `significance`, by how
        many standard deviations the square of the one exceeds those of the other and of `MODEL`; `z_error_um`, the
        error of z that the rest may stand for. NaN where there are too few particles.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form.
    """
    model, size = checked(calibration).model, calibration.model.size
    edges = np.linspace(0, model.count, max(min(BINS, model.count // 3), 1) + 1)
    sums, n = np.zeros((len(edges) - 1, CELLS**2, 2, size, size)), np.zeros(len(edges) - 1, int)
    for frame in iterable("frames", frames):
        _add(image_array("frames", frame, 2), calibration, edges, sums, n)
    energy, std = np.transpose([_energy(each) for each in sums])
    bins = [slice(*ends) for ends in pairwise(np.ceil(edges).astype(int))]
    pattern, slope, own = (np.array([values[part].mean() for part in bins]) for values in _energies(model))
    beyond = energy - OWN[0] * own
    return pd.DataFrame(
        {
            "z_um": np.interp((edges[1:] + edges[:-1] - 1) / 2, np.arange(model.count), model.z_um),
            "n": n,
            "mismatch": np.sqrt(np.maximum(energy, 0) / pattern),
            "own": np.sqrt(OWN[0] * own / pattern),
            "significance": (beyond - MODEL**2 * pattern) / np.hypot(std, OWN[1] * own),
            "z_error_um": ABSORBED * np.sqrt(np.maximum(beyond, 0) / slope),
        }
    )


def mismatch_error_um(mismatch: pd.DataFrame) -> float:
    """Error of z (µm) that a mismatch may stand for, at any depth; 0 if the mismatch is no more than noise.

    It is for `Calibration.with_depth_error`. It is the RMS over depth, as what the fit absorbed at one depth does not
    show in the residual there.

    Parameters
    ----------
    mismatch : DataFrame
        As from `pattern_mismatch`.

    Raises
    ------
    TypeError, ValueError
        If it lacks `significance` or `z_error_um`.
    """
    columns = ["significance", "z_error_um"]
    known = table("mismatch", mismatch, columns)[columns].dropna()
    if not (known["significance"] > SURE).any():
        return 0.0
    return float(np.sqrt(np.square(numbers("mismatch", known["z_error_um"])).mean()))


def _add(frame: NDArray[np.float32], calibration: Calibration, edges: NDArray, sums: NDArray, n: NDArray) -> None:
    """Add residuals times amplitudes, and squares of amplitudes, by bin and cell (B, C, 2, size, size); count (B,)."""
    model, size = calibration.model, sums.shape[-1]
    rows, found = explained(frame, calibration)
    rows = rows[~(rows["at_end"] | rows["ambiguous"])]
    valid = found.pixels.valid.astype(np.float32)
    images = found.fit.residual * valid * np.float32(found.pixels.noise), valid
    images = [cv2.copyMakeBorder(image, *[size] * 4, cv2.BORDER_CONSTANT, value=0) for image in images]
    slices = np.interp(rows["z_um"], model.z_um, np.arange(model.count))
    slices -= field_terms(rows["x_px"], rows["y_px"], frame.shape) @ model.surface
    bins = np.clip(np.searchsorted(edges, slices, side="right") - 1, 0, len(n) - 1)
    cells = (rows[["y_px", "x_px"]].to_numpy() / frame.shape * CELLS).clip(0, CELLS - 1).astype(int) @ (CELLS, 1)
    for row, k, cell in zip(rows.itertuples(), bins, cells, strict=True):
        for power, image in enumerate(images, 1):
            patch = cv2.getRectSubPix(image, (size, size), (row.x_px + size, row.y_px + size))
            sums[k, cell, power - 1] += row.amplitude**power * patch
    n += np.bincount(bins, minlength=len(n))


def _energy(sums: NDArray[np.float64]) -> tuple[float, float]:
    """Energy of the mean residual of a bin, free of noise, from sums by cell (C, 2, n, n); its standard deviation.

    Noise is left out of the square of a sum with the squares of its terms; the standard deviation is the jackknife's.
    """
    sums = sums[sums[:, 1].any(axis=(1, 2))]
    if len(sums) < FEWEST:
        return np.nan, np.nan
    sums[:, 0] = gaussian_filter(sums[:, 0], (0, ERROR_SCALE_PX, ERROR_SCALE_PX))
    total, squares = sums.sum(axis=0), np.square(sums).sum(axis=0)

    def energy(total: NDArray, squares: NDArray) -> float:
        residual, weight = np.square(total) - squares
        return float(np.divide(residual, weight, out=np.zeros_like(weight), where=weight > 1e-6 * weight.max()).sum())

    without = [energy(total - each, squares - np.square(each)) for each in sums]
    return energy(total, squares), float(np.sqrt(len(sums) - 1) * np.std(without))


def _energies(model: PatternModel) -> tuple[NDArray, NDArray, NDArray]:
    """Energies (N,), smoothed: of the pattern, its change with z (per µm²) at free amplitude, and its own error."""
    rim = (model.images.shape[-1] - model.size) // 2
    inner = slice(rim, rim + model.size)
    images = model.images[:, inner, inner].astype(float)
    change = np.gradient(images, model.z_um, axis=0)
    along = np.einsum("kij,kij->k", change, images) / np.einsum("kij,kij->k", images, images)
    change -= along[:, None, None] * images
    smoothed = (gaussian_filter(each, (0, ERROR_SCALE_PX, ERROR_SCALE_PX)) for each in (images, change))
    error = model.pattern_error[:, :: model.nodes_per_px, :: model.nodes_per_px][:, inner, inner].astype(float)
    own = np.square(error).sum(axis=(1, 2)) / (4 * np.pi * ERROR_SCALE_PX**2)
    pattern, slope = (np.square(each).sum(axis=(1, 2)) for each in smoothed)
    return pattern, slope, own
