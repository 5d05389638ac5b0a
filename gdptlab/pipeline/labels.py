"""A calibration from particles of known position and depth, without a scan.

Labels are checked first: a table that does not fit the images is refused, with what would fit, if something does.
"""

import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, mean
from skimage.registration import phase_cross_correlation

from gdptlab._checks import positions, real_array, whole
from gdptlab._compiled import on_one_core
from gdptlab.calibration import Calibration
from gdptlab.fit.labelled import Labelled
from gdptlab.fit.learning import SHARP_PX
from gdptlab.fit.pattern import largest_size
from gdptlab.fit.renderer import FAINT
from gdptlab.pipeline.beads import subset_size

LEAST = 40
"""Least number of particles. Derived: five for each of the fewest slices."""

PER_SLICE, SLICES = 15, (8, 61)
"""Particles for each slice of the calibration, and the least and largest number of slices. Chosen on rendered frames
of 400 particles: with 26 slices the RMS error of z is 0.25 um, with 51 it is 0.28."""

PER_FIRST, FIRST = 8, 25
"""Particles for each slice up to that number of slices: between few slices images change too much. Chosen on a tilted
slide with 180 labels in 104 um, seed 2: with 12 slices the RMS error of z is 0.23 um, 1.4 of its standard deviation,
with 22 it is 0.19 um and 0.9."""

COARSE = 9
"""Number of slices of the coarse patterns from which the size is read, and by which tables are compared."""

FIRST_HALF, WIDER = 20, 1.5
"""First support of the coarse patterns to each side, px, and the factor by which it grows until images end in it."""

GAP = 3.0
"""Slices without a particle from which on depths are said to be missing."""

EXPLAINED, SURE = 0.5, 0.95
"""Fraction of the light in the frames, beyond noise, that particles must explain, and from which on labels are not
doubted. Derived: right labels explain all but a few per cent; wrong ones up to 0.9 if there are few for each slice."""

CLEARLY = 0.5
"""Factor by which another reading of the table must lower the fraction that is not explained to be named."""

OFF_PX = 0.35
"""Distance of the patterns' centre of symmetry from the labels, px, from which on labels are taken to be off. Half a
pixel is what corners and centres of pixels differ by."""

SYMMETRIC = 0.9
"""Correlation of the patterns with themselves, turned by half a turn, below which they have no such centre."""


@on_one_core
def calibration_of_labels(
    frames: ArrayLike, table: pd.DataFrame, *, size: int | None = None, n_sub: int | None = None
) -> Calibration:
    """Calibrate with labelled particles; see `Calibration.from_labelled`."""
    frames, table = checked_labels(frames, table)
    check_sizes(size, n_sub, frames.shape[1:])
    z_um = _slices(table["z_um"].to_numpy())
    coarse = _coarse(frames, table)
    _must_fit(coarse, frames, table)
    half = _support(coarse) if size is None else size // 2
    labelled = _labelled(frames, table, len(z_um), half, _fine(coarse), coarse)
    labelled.learn()
    _must_be_centred(labelled)
    return calibration_of(labelled, z_um, n_sub)


def check_sizes(size: int | None, n_sub: int | None, shape: tuple[int, int]) -> None:
    """Check rows and columns of a template, and the number of images of the subset, where they are given."""
    if size is not None and whole("size", size, 5, min(shape)) % 2 == 0:
        raise ValueError(f"size: got {size} px, allowed are odd sizes")
    if n_sub is not None:
        whole("n_sub", n_sub, 2, SLICES[1])


def calibration_of(labelled: Labelled, z_um: NDArray[np.float64], n_sub: int | None) -> Calibration:
    """Calibration (slices at `z_um`) from patterns that were learned."""
    images = labelled.patterns[:, :: labelled.fine, :: labelled.fine]
    calibration = Calibration.from_stack(images, z_um, n_sub=min(n_sub or 9, len(z_um)))
    if n_sub is None:
        calibration = calibration.with_subset(subset_size(calibration))
    return replace(calibration, learned=labelled.model(z_um))


def checked_labels(frames: ArrayLike, table: pd.DataFrame) -> tuple[NDArray[np.float32], pd.DataFrame]:
    """Frames, and labels with the columns `frame`, `x_px`, `y_px` and `z_um`, if they can belong to each other."""
    frames = real_array("frames", frames, 3)
    if "frame" not in positions("table", table, ("x_px", "y_px", "z_um")):
        if len(frames) > 1:
            raise ValueError(f"table: got no column frame, needed is one, as there are {len(frames)} frames")
        table = table.assign(frame=0)
    table = table[["frame", "x_px", "y_px", "z_um"]].astype(float).reset_index(drop=True)
    if len(table) < LEAST:
        raise ValueError(f"table: got {len(table)} particles, needed are {LEAST} or more, better 200, at all depths")
    number = table["frame"]
    if not number.between(0, len(frames) - 1).all() or (number % 1 != 0).any():
        counted = "; it seems to count from 1" if number.min() == 1 and number.max() == len(frames) else ""
        raise ValueError(
            f"table: got frames from {number.min():g} to {number.max():g}, allowed are whole numbers from 0 to "
            f"{len(frames) - 1}{counted}"
        )
    if not np.ptp(table["z_um"]) > 0:
        raise ValueError(f"table: got z_um = {table['z_um'][0]:g} for all particles, needed are many depths")
    rows, columns = frames.shape[1:]
    outside = ~(table["x_px"].between(-0.5, columns - 0.5) & table["y_px"].between(-0.5, rows - 0.5))
    if outside.any():
        swapped = table["y_px"].max() < columns and table["x_px"].max() < rows
        advice = "; x_px and y_px seem to be swapped: x is the column" if swapped else ""
        first = table[outside].iloc[0]
        raise ValueError(
            f"table: got {outside.sum()} particles outside the frames, such as x_px = {first['x_px']:g}, y_px = "
            f"{first['y_px']:g}, allowed are positions in {columns} columns and {rows} rows{advice}"
        )
    return frames, table.astype({"frame": int})


def _slices(z_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depths of the slices that these particles support; a warning says where there are none."""
    count = max(len(z_um) // PER_SLICE, min(len(z_um) // PER_FIRST, FIRST))
    slices = np.linspace(z_um.min(), z_um.max(), int(np.clip(count, *SLICES)))
    at = np.sort(z_um)
    gaps = np.flatnonzero(np.diff(at) > GAP * (slices[1] - slices[0]))
    if len(gaps):
        where = ", ".join(f"{at[k]:.4g} to {at[k + 1]:.4g}" for k in gaps)
        warnings.warn(f"table: got no particle at depths of {where} um; there z is a guess", stacklevel=4)
    return slices


def _labelled(
    frames: NDArray[np.float32],
    table: pd.DataFrame,
    count: int,
    half: int,
    fine: int = 1,
    before: Labelled | None = None,
) -> Labelled:
    """Frames and labels; of what was learned `before`, the amplitudes."""
    depth, amplitude = table["z_um"] - table["z_um"].min(), np.ones(len(table))
    if before is not None:
        amplitude[before.order] = before.places[:, 3]
    places = np.column_stack([table["y_px"], table["x_px"], depth / depth.max() * (count - 1), amplitude])
    return Labelled(frames, table["frame"].to_numpy(), places, count, half, fine)


def _coarse(frames: NDArray[np.float32], table: pd.DataFrame) -> Labelled:
    """Coarse patterns, wide enough for the images to end in them."""
    half, most, labelled = FIRST_HALF, largest_size(frames.shape[1:]) // 2, None
    while True:
        half = min(half, most)
        labelled = _labelled(frames, table, COARSE, half, before=labelled)
        labelled.learn()
        if half == most or _support(labelled) < half:
            return labelled
        half = int(WIDER * half)


def _support(labelled: Labelled) -> int:
    """Pixels from the middle to where no image of the median particle is visible any more, as `FAINT` says.

    Visible is the root mean square of a whole ring: of 10 000 pixels noise of the patterns lifts one above any level.
    """
    half = labelled.half
    y, x = np.indices(labelled.patterns.shape[1:]) - half
    ring = np.minimum(np.rint(np.hypot(x, y)).astype(int), half + 1)
    power = np.square(gaussian_filter(labelled.patterns, (0, 2, 2)))
    visible = [mean(image, ring, np.arange(half + 1)) > (FAINT * labelled.noise) ** 2 for image in power]
    return min(int(np.flatnonzero(np.any(visible, axis=0)).max(initial=2)) + 1, half)


def _fine(coarse: Labelled) -> int:
    """Nodes per px: two if images in focus are so sharp that one would not do."""
    images = np.abs(coarse.patterns)
    peak = images.max(axis=(1, 2))
    inside = (images > peak[:, None, None] / 2).sum(axis=(1, 2))
    return 2 if np.sqrt(inside[peak > 0.5 * peak.max()].min() / np.pi) < SHARP_PX else 1


def _must_fit(coarse: Labelled, frames: NDArray[np.float32], table: pd.DataFrame) -> None:
    """Refuse labels that explain little of the frames; name what would explain more."""
    explained = float(np.median(coarse.explained()))
    if explained >= SURE:
        return
    rows, columns = frames.shape[1:]
    x, y = table["x_px"], table["y_px"]
    others = {
        "x_px and y_px are swapped: x is the column": table.assign(x_px=y, y_px=x),
        "y_px is counted from the lower edge": table.assign(y_px=rows - 1 - y),
        "x_px is counted from the right edge": table.assign(x_px=columns - 1 - x),
        "frame counts backwards": table.assign(frame=len(frames) - 1 - table["frame"]),
    }
    said, best = "", 1 - CLEARLY * (1 - explained)
    for name, other in others.items():
        labelled = _labelled(frames, other, COARSE, coarse.half)
        labelled.learn(1)
        if (fraction := float(np.median(labelled.explained()))) > best:
            said, best = f"; {100 * fraction:.0f} % would be, if {name}", fraction
    if said or explained < EXPLAINED:
        needed = said or f", needed are {100 * EXPLAINED:.0f} %"
        raise ValueError(
            f"table: got labels by which {100 * explained:.0f} % of the light in a frame are explained{needed}"
        )


def _must_be_centred(labelled: Labelled) -> None:
    """Refuse labels that are off by the same everywhere: then the patterns are symmetric about another point."""
    patterns = labelled.patterns
    turned = patterns[:, ::-1, ::-1]
    off = [
        phase_cross_correlation(p, q, upsample_factor=20, normalization=None)[0] / 2
        for p, q in zip(patterns, turned, strict=True)
    ]
    y, x = np.median(off, axis=0) / labelled.fine
    if max(abs(x), abs(y)) > OFF_PX:
        raise ValueError(
            f"table: got labels that are off by ({-x:.2f}, {-y:.2f}) px in (x, y) from the middle of the images; the "
            f"first pixel's centre is (0, 0): add ({x:.2f}, {y:.2f}) to x_px and y_px"
        )
