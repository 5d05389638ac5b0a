"""A calibration from beads on a slide that is tilted by a known angle: their depths are a plane over the field.

Beads that stand alone give positions, the plane their depths, but for the offset of each frame, by which images of
equal depth lie elsewhere in the field. Two beads that look like one are told by their image, which is unlike those of
equal depth. Means of the images along z, without their neighbours, are the first calibration. With it all beads are
measured (joint fit) and put on the plane: labels for the next calibration, in which no bead's light is left over.
"""

import warnings

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import choice, number, positive, real_array
from gdptlab._compiled import on_one_core
from gdptlab.calibration import Calibration
from gdptlab.locate import batch
from gdptlab.pipeline.image_curve import BEYOND, SLICES, features, first_stack, line_weights
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

OFF_LINE, LOOKS = 4.0, 4
"""Distance of an image from the mean of those of about equal depth, in medians, from which on it shows two beads that
look like one; number of times that the means are taken, each without such images of the last. Chosen on slides of 60
beads in three frames: where all images are kept, 39 % of the beads of seed 2 are first measured off the plane, and
5 % with 4; the last calibration is as good."""

ROUNDS = 2
"""Number of times that all beads are measured and the calibration is made anew. Convention: the first brings the beads
that do not stand alone, and better offsets; the second what follows from these."""

OFF_PLANE, MOST_OFF = 0.05, 0.05
"""Distance of a bead from its frame's plane, as a fraction of the depth, from which on it is off the plane, and the
fraction of such beads above which a warning says that the calibration is in doubt. Chosen on slides of 60 beads in
three frames, seeds 0 to 4, where the error of z is at most 2.1 times that of a scan: 0, 0, 0, 2 and 0 % are off in the
last round. A calibration that is worse by less than this is not noticed."""


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
    points, table = features(lone.images), lone.table
    plane_um = _plane(table, axis, slope, frames.shape[1:])
    one = _single(points, plane_um + _offsets(points, table["frame"].to_numpy(), plane_um))
    z_um = plane_um[one] + _offsets(points[one], table["frame"].to_numpy()[one], plane_um[one])
    calibration = _first(lone.images[one], z_um)
    for _ in range(ROUNDS):
        found = batch(frames, calibration, method="joint", progress=False, n_jobs=1)
        labels, off_um = _on_plane(found, _plane(found, axis, slope, frames.shape[1:]), calibration.z_um)
        calibration = _calibrated(frames, labels, size, n_sub)
    off = off_um > OFF_PLANE * np.ptp(labels["z_um"])
    if off.mean() > MOST_OFF:
        where_um = labels["z_um"][off]
        warnings.warn(
            f"frames: got {off.sum()} of {len(off)} beads off the plane of this tilt, at depths from "
            f"{where_um.min():.3g} to {where_um.max():.3g} um, where z is in doubt; allowed are {100 * MOST_OFF:g} %: "
            "use more frames, or a slide on which beads lie farther apart, and check the axis",
            stacklevel=4,
        )
    return calibration


def _first(images: NDArray[np.float32], z_um: NDArray[np.float64]) -> Calibration:
    """Calibration from the mean images along z, of images (n, s, s) without their neighbours, at depths (n,)."""
    beyond_um = BEYOND * np.ptp(z_um) / (SLICES - 1)
    grid = np.linspace(z_um.min() - beyond_um, z_um.max() + beyond_um, SLICES + 2 * BEYOND)
    return Calibration.from_stack(first_stack(images, line_weights(z_um, grid)), grid)


def _calibrated(frames: NDArray[np.float32], table: pd.DataFrame, size: int | None, n_sub: int | None) -> Calibration:
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


def _offsets(points: NDArray, frame: NDArray, plane_um: NDArray) -> NDArray[np.float64]:
    """Offset (n,) of each image's frame from the first, um, at which images of equal depth are most alike.

    Images are `points` (n, m), in frames (n,); their heights in these are `plane_um` (n,).
    """
    depth, offsets = np.ptp(plane_um), np.zeros(len(frame))
    for k in np.unique(frame)[1:]:
        here, before = frame == k, np.flatnonzero(frame < k)
        z_um = (plane_um + offsets)[before]
        before, z_um = before[np.argsort(z_um)], np.sort(z_um)
        tried = np.linspace(-1, 1, 2 * TRIED + 1) * depth
        apart = [_apart(points[here], plane_um[here] + d, points[before], z_um) for d in tried]
        offsets[here] = tried[int(np.argmin(apart))]
    return offsets


def _single(points: NDArray[np.float64], z_um: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which images (n,) show one bead: `points` (n, m) that are near the mean of those of about equal depth."""
    one, grid = np.ones(len(z_um), bool), np.linspace(z_um.min(), z_um.max(), SLICES)
    for _ in range(LOOKS):
        line = line_weights(z_um[one], grid) @ points[one]
        off = np.linalg.norm(points - np.column_stack([np.interp(z_um, grid, along) for along in line.T]), axis=1)
        one = off < OFF_LINE * np.median(off)
    return one


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


def _on_plane(
    found: pd.DataFrame, plane_um: NDArray[np.float64], slices_um: NDArray[np.float64]
) -> tuple[pd.DataFrame, NDArray[np.float64]]:
    """Labels from what was measured, each frame's on its plane, the first frame's through 0; how far off it they were.

    All beads are labels, as their light would spoil the images of their neighbours. A bead beyond the calibration's
    slices is measured at the outermost: it is on the plane if the plane is beyond, too.
    """
    off = found["z_um"] - plane_um
    offset = off.groupby(found["frame"]).median()
    if 0 not in offset:
        raise ValueError("frames: got a first frame in which no bead is like those that stand alone, needed are some")
    z_um = plane_um + found["frame"].map(offset)
    off_um = np.abs(found["z_um"] - np.clip(z_um, slices_um[0], slices_um[-1])).to_numpy()
    return found[["frame", "x_px", "y_px"]].assign(z_um=z_um - offset[0]), off_um
