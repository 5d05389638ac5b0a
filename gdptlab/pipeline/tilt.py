"""A calibration from beads on a slide that is tilted by a known angle: their depths are a plane over the field.

Beads that stand alone give positions, the plane their depths, but for the offset of each frame, by which images of
equal depth lie elsewhere in the field. With a first calibration from these labels all beads are measured (joint fit):
they give more labels, and better offsets, for the next.
"""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.stats import median_abs_deviation

from gdptlab._checks import choice, number, positive, real_array
from gdptlab._compiled import on_one_core
from gdptlab.calibration import Calibration
from gdptlab.locate import batch
from gdptlab.pipeline.image_curve import features
from gdptlab.pipeline.labels import LEAST, calibration_of_labels, check_sizes
from gdptlab.pipeline.lone_images import lone_images

FLATTEST_DEG, STEEPEST_DEG = 0.01, 60.0
"""Least and largest tilt, degrees. Convention: a field of 1 mm rises by 0.2 µm, less than what is measured; steeper
slides do not stay in the depth of any lens."""

TRIED = 200
"""Number of offsets of a frame, each to either side, that are tried. Derived: steps of half a percent of the depth."""

SHARED = 0.3
"""Least fraction of a frame's beads that lie within the depths of those before. Derived: of 40 beads a dozen, whose
median distance is known to a third."""

ROUNDS = 2
"""Number of times that all beads are measured and the calibration is made anew. Convention: the first brings the beads
that do not stand alone, and better offsets; the second what follows from these."""

OFF_PLANE, LEAST_OFF = 5.0, 0.02
"""Distance of a bead from its frame's plane from which on it is no bead of the slide: in standard deviations of the
others' distances, and at least this fraction of the depth. Convention: hardly any bead of the slide is beyond."""


@on_one_core
def calibration_of_tilt(
    frames: ArrayLike, tilt_deg: float, axis: str, um_per_px: float, *, size: int | None, n_sub: int | None
) -> Calibration:
    """Calibrate with beads on a tilted slide; see `Calibration.from_tilt`."""
    frames = real_array("frames", frames, 3)
    choice("axis", axis, ("x", "y"))
    if not FLATTEST_DEG <= abs(number("tilt_deg", tilt_deg)) <= STEEPEST_DEG:
        raise ValueError(f"tilt_deg: got {tilt_deg:g}, allowed is {FLATTEST_DEG:g} to {STEEPEST_DEG:g} either way")
    check_sizes(size, n_sub, frames.shape[1:])
    if not 1e-4 <= positive("um_per_px", um_per_px) <= 1e4:
        raise ValueError(f"um_per_px: got {um_per_px:g}, allowed is 1e-4 to 1e4")
    slope = np.tan(np.deg2rad(tilt_deg)) * um_per_px
    lone = lone_images(frames, size)
    if len(lone.table) < LEAST:
        raise ValueError(
            f"frames: got {len(lone.table)} beads that stand alone in {len(frames)} frames, needed are {LEAST}: more "
            "frames, or a slide on which beads lie farther apart"
        )
    table = lone.table.assign(z_um=lambda t: _plane(t, axis, slope, frames.shape[1:]))
    offset = _offsets(features(lone.images), table)
    if size is None:
        size = lone.images.shape[-1]  # their surroundings, which are empty
    table["z_um"] += offset[table["frame"]]
    for _ in range(ROUNDS):
        calibration = _calibrated(frames, table, size, None)
        found = batch(frames, calibration, method="joint", progress=False, n_jobs=1)
        table = _labels(found, _plane(found, axis, slope, frames.shape[1:]))
    return _calibrated(frames, table, size, n_sub)


def _calibrated(frames: NDArray[np.float32], table: pd.DataFrame, size: int, n_sub: int | None) -> Calibration:
    """Calibrate with labels; what is wrong with them is wrong with the frames."""
    try:
        return calibration_of_labels(frames, table, size=size, n_sub=n_sub)
    except ValueError as error:
        raise ValueError(
            f"frames: got {len(table)} beads on the plane of this tilt that do not fit: {error}"
        ) from error


def _plane(table: pd.DataFrame, axis: str, slope: float, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Height (n,) of the slide above that in the middle of the field, um, for a slope in um per px."""
    middle = (shape[1 if axis == "x" else 0] - 1) / 2
    return slope * (table[f"{axis}_px"].to_numpy() - middle)


def _offsets(points: NDArray[np.float64], table: pd.DataFrame) -> NDArray[np.float64]:
    """Offset of each frame from the first, (F,), at which images of equal depth are most alike.

    Images are `points` (n, m); their heights in their frames are the table's `z_um`.
    """
    frame, z_um = table["frame"].to_numpy(), table["z_um"].to_numpy().copy()
    depth, offsets = np.ptp(z_um), np.zeros(frame.max() + 1)
    for k in np.unique(frame)[1:]:
        here, before = frame == k, np.flatnonzero(frame < k)
        before = before[np.argsort(z_um[before])]
        tried = np.linspace(-1, 1, 2 * TRIED + 1) * depth
        apart = [_apart(points[here], z_um[here] + d, points[before], z_um[before]) for d in tried]
        offsets[k] = tried[int(np.argmin(apart))]
        z_um[here] += offsets[k]
    return offsets


def _apart(points: NDArray, z_um: NDArray, others: NDArray, their_z_um: NDArray) -> float:
    """Median distance of points from the line through others, in the order of depth; infinite if they share too few."""
    k = np.searchsorted(their_z_um, z_um)
    inside = (k > 0) & (k < len(their_z_um))
    if inside.mean() < SHARED:
        return np.inf
    k, z_um = k[inside], z_um[inside]
    part = (z_um - their_z_um[k - 1]) / np.maximum(their_z_um[k] - their_z_um[k - 1], 1e-12)
    between = (1 - part)[:, None] * others[k - 1] + part[:, None] * others[k]
    return float(np.median(np.linalg.norm(points[inside] - between, axis=1)))


def _labels(found: pd.DataFrame, plane_um: NDArray[np.float64]) -> pd.DataFrame:
    """Labels from what was measured, each frame's on its plane, the first frame's through 0."""
    off = found["z_um"] - plane_um
    offset = off.groupby(found["frame"]).median()
    if 0 not in offset:
        raise ValueError("frames: got a first frame in which no bead is like those that stand alone, needed are some")
    off -= found["frame"].map(offset)
    most = max(OFF_PLANE * median_abs_deviation(off, scale="normal"), LEAST_OFF * np.ptp(plane_um))
    z_um = plane_um + found["frame"].map(offset - offset.iloc[0])
    return found[["frame", "x_px", "y_px"]].assign(z_um=z_um)[off.abs() <= most].reset_index(drop=True)
