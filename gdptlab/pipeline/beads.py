"""A calibration made from a scan alone: which beads to use, how large a template, how many images to search with.

The scan is one of a plane of beads (dried on a slide, say) that the stage carries through focus, all together. Near the
slice where they are sharpest each is a small spot, bright or dark, and easy to find. Those that stand alone, are not
clipped and look like the rest are moved to a common centre and depth and averaged: beads are as good as
exposures, so noise falls with their number. What was chosen, and why, is in the result.

Some optics make several spots of one bead, even in focus (astigmatism with spherical aberration: two). Spots of one
bead are told from neighbours by their distance and direction, which are the same all over the scan.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, shift
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from gdptlab._checks import depths, real_array, whole
from gdptlab._compiled import on_one_core
from gdptlab.assessment import match
from gdptlab.calibration import Calibration, levelled
from gdptlab.correlation import normalised
from gdptlab.denoising import denoised, noise_level
from gdptlab.locate import locate
from gdptlab.pipeline.bead_images import LARGEST, centred, image_size

STANDS_OUT = 8.0
"""Height of a bead's spot above what surrounds it, in standard deviations, from which on it is one."""

FAINT = 0.1
"""Fraction of the amplitude of bright beads below which a spot is not taken for a bead."""

MOST_BEADS = 40
"""Of those that stand alone, the brightest, that are looked at closely."""

ALIKE = 0.9
"""Least correlation of a usable bead's images with the average bead's, in the mean over depth."""

COVERED = 0.9
"""Correlation that an image at any depth has, at least, with one of the subset, if the subset is chosen here."""


LEAST = 7
"""Frames of a scan."""

MOST_APART = 60
"""Of spots that may belong to one bead, px."""

SPOT = 10
"""Rows and columns about a bead's place in which its brightest spot is looked for."""

SAME = 2.0
"""Radius, px, within which the steps from spot to spot are the same."""

FRACTIONS = (1.0, 0.9, 0.8, 0.7)
"""Of the widest image, tried as the size of a template."""

CHECKED = 7
"""Slices of the scan in which beads are looked for, to choose that size."""


@dataclass(frozen=True, eq=False)
class ScanReport:
    """How `Calibration.from_scan` came to its calibration.

    Attributes
    ----------
    beads : DataFrame
        A row for each bead of the scan: `x_px`, `y_px`; `amplitude`, the height of its spot (counts);
        `room_px`, the distance to its nearest neighbour or, doubled, to the border; for those looked at closely
        also `clipped`, in how many slices it is cut off at the top or bottom of the camera's range, `alike`, the
        correlation with the average bead, and `offset_um`, how much higher (in z of the scan) than the others it comes
        into focus; `verdict`: "used", or why it is not.
    drift_px : float64 array (N, 2)
        Where the average bead is in each slice (x, y), from its mean place.
    clipped : float64 array (N,)
        Fraction of the beads looked at that are clipped in each slice.
    settings : DataFrame
        A row for each choice (the index): `value`, `how` ("by itself" or "given") and `why`.
    overview : float32 array (rows, columns)
        The scan where it is sharpest.
    noise : float
        Standard deviation of the noise of a pixel of the scan, counts: what a frame has; the average has less.
    """

    beads: pd.DataFrame
    drift_px: NDArray[np.float64]
    clipped: NDArray[np.float64]
    settings: pd.DataFrame
    overview: NDArray[np.float32]
    noise: float


def find_beads(scan: ArrayLike, z_um: ArrayLike) -> pd.DataFrame:
    """Find the beads of a scan, bright or dark, where it is sharpest.

    Parameters
    ----------
    scan : array (N, rows, columns)
        Frames at known depths, of beads that come into focus together.
    z_um : array (N,)
        Depths, strictly increasing or decreasing.

    Returns
    -------
    DataFrame
        A row for each, brightest first: `x_px`, `y_px`, `amplitude` (height of the spot, counts; below 0 for
        dark beads) and `room_px`, the distance to the nearest other bead or twice that to the border.

    Raises
    ------
    TypeError, ValueError
        If the scan or the depths are not of that form, or nothing in the scan changes with z.
    """
    scan, z_um = _checked(scan, z_um)
    return _found(_sharpest(scan))


@on_one_core
def averaged_beads(
    scan: ArrayLike,
    z_um: ArrayLike,
    *,
    beads_px: ArrayLike | None = None,
    size: int | None = None,
    n_sub: int | None = None,
) -> Calibration:
    """Calibrate with the average of a scan's beads; see `Calibration.from_scan`."""
    scan, z_um = _checked(scan, z_um)
    if size is not None and whole("size", size, 3, 10_001) % 2 == 0:
        raise ValueError(f"size: got {size} px, allowed are odd sizes")
    if n_sub is not None:
        whole("n_sub", n_sub, 2, len(scan))
    overview = _sharpest(scan)
    if beads_px is None:
        beads = _found(overview)
    else:
        beads_px = real_array("beads_px", beads_px, 2)
        if beads_px.shape[1] != 2:
            raise ValueError(f"beads_px: got shape {beads_px.shape}, allowed is (n, 2): x and y of each bead")
        beads = _table(overview, beads_px.astype(float))
    chosen = size or _size(scan, beads)
    beads, stack, drift, clipped = _averaged(scan, z_um, beads, chosen, given=beads_px is not None)
    if size is None and beads_px is None:
        stack = _fitting(stack, scan, z_um, beads)
    calibration = Calibration.from_stack(stack, z_um, n_sub=n_sub or min(9, len(scan)))
    if n_sub is None:
        calibration = calibration.with_subset(_subset_size(calibration))
    used = (beads["verdict"] == "used").sum()
    how = {False: "by itself", True: "given"}
    settings = pd.DataFrame(
        [
            (
                "beads",
                f"{used} of {len(beads)}",
                how[beads_px is not None],
                "averaged, whatever they are like"
                if beads_px is not None
                else "alone, not clipped and alike; averaged",
            ),
            (
                "size",
                f"{calibration.size} px",
                how[size is not None],
                "" if size else _reason(chosen, calibration.size),
            ),
            (
                "n_sub",
                f"{len(calibration.subset)} of {len(calibration)}",
                how[n_sub is not None],
                f"enough for each depth to be like one of them (C_m {COVERED}), or the most that is tried",
            ),
        ],
        columns=["setting", "value", "how", "why"],
    ).set_index("setting")
    noise = max(noise_level(scan[:: max(len(scan) // 5, 1)]), 1e-9)
    return replace(calibration, report=ScanReport(beads, drift, clipped, settings, overview, noise))


def _checked(scan: ArrayLike, z_um: ArrayLike) -> tuple[NDArray, NDArray[np.float64]]:
    """Scan, as it is recorded, and depths, both in the order of increasing depth."""
    try:
        scan = np.asarray(scan)
    except ValueError as error:
        raise ValueError(f"scan: got what is no array ({error}), allowed are 3 axes of real numbers") from error
    z_um = depths("z_um", z_um)
    real_array("scan", scan[:1] if scan.ndim else scan, 3)
    if len(scan) < LEAST or len(z_um) != len(scan):
        raise ValueError(
            f"scan, z_um: got {len(scan)} frames and {len(z_um)} depths, needed are as many, {LEAST} or more"
        )
    order = np.argsort(z_um)
    return scan[order], z_um[order]


def _sharpest(scan: NDArray) -> NDArray[np.float32]:
    """What stands out of the mean over z in the slices about the sharpest, bright beads above 0, dark ones below."""
    mean = np.zeros(scan.shape[1:])
    levels = np.empty(len(scan), dtype=np.float32)
    for k, image in enumerate(scan):
        image = real_array("scan", image, 2)
        levels[k] = np.median(image)
        mean += image - levels[k]
    mean = (mean / len(scan)).astype(np.float32)
    contrast = np.empty(len(scan))
    for k, image in enumerate(scan):
        smooth = gaussian_filter(image - levels[k] - mean, 1)
        contrast[k] = ((smooth - gaussian_filter(smooth, 4)) ** 4).mean()  # small and strong, not large and weak
    if not contrast.max() > 0:
        raise ValueError("scan: got frames that are all alike, needed are beads that change with z")
    best, reach = int(contrast.argmax()), len(scan) // 40
    near = slice(max(best - reach, 0), best + reach + 1)
    return np.mean(scan[near] - levels[near, None, None], axis=0, dtype=np.float32) - mean


def _found(overview: NDArray[np.float32]) -> pd.DataFrame:
    """Table of the spots in `overview`."""
    sign = 1 if (overview**3).mean() > 0 else -1
    spots, width = gaussian_filter(sign * overview, 1), 1.0
    for _ in range(2):  # with a first guess of how wide spots are, then with their width
        reach = 2 * int(np.ceil(width)) + 3
        highest = spots == maximum_filter(spots, 2 * reach + 1)
        level = np.median(spots)
        noise = 1.4826 * np.median(np.abs(spots - level))
        y, x = np.nonzero(highest & (spots > level + STANDS_OUT * noise))
        if not len(x):
            raise ValueError("scan: got one in which nothing stands out of the noise, needed are beads")
        height = spots[y, x] - level
        bright = height > FAINT * np.percentile(height, 90)
        x, y = x[bright], y[bright]
        top = np.argsort(-spots[y, x])[:20]
        width = float(np.median([_half_width(sign * overview, x[i], y[i]) for i in top]))
        spots = gaussian_filter(sign * overview, max(1, width / 2))
    places = np.array([_centroid(sign * overview, *place, 1 + int(width)) for place in zip(x, y, strict=True)])
    bead = _bead_of(places)
    weight = spots[y, x] - level
    total = np.bincount(bead, weight)
    return _table(overview, np.stack([np.bincount(bead, weight * p) / total for p in places.T], axis=1))


def _bead_of(places: NDArray) -> NDArray[np.int64]:
    """Number of the bead that each spot at `places` (n, 2) belongs to.

    A step from spot to spot that a fifth of them or more share, far more often than by chance, leads from one spot of
    a bead to another. In a regular array of beads a step leads on to a third one, and is not taken.
    """
    pairs = KDTree(places).query_pairs(MOST_APART, output_type="ndarray")
    steps = places[pairs[:, 1]] - places[pairs[:, 0]]
    by_chance = 2 * len(steps) * (SAME / MOST_APART) ** 2
    joined = np.zeros(len(pairs), dtype=bool)
    either_way = KDTree(np.concatenate([steps, -steps])) if len(steps) else None
    for step in steps:
        same = np.unique(np.array(either_way.query_ball_point(step, SAME)) % len(steps))
        spots = np.unique(pairs[same])
        if len(same) >= max(3, len(places) / 5, 10 * by_chance) and len(spots) > 1.8 * len(same):
            joined[same] = True
    links = coo_array((np.ones(joined.sum()), pairs[joined].T), shape=(len(places), len(places)))
    return connected_components(links, directed=False)[1]


def _half_width(spot: NDArray, x: int, y: int, most: int = 30) -> float:
    """Radius (px) of the round spot that has as many pixels above half its height."""
    cut = spot[max(y - most, 0) : y + most + 1, max(x - most, 0) : x + most + 1]
    return float(np.sqrt((cut > spot[y, x] / 2).sum() / np.pi))


def _centroid(spot: NDArray, x: int, y: int, reach: int) -> tuple[float, float]:
    top, left = max(y - reach, 0), max(x - reach, 0)
    cut = np.clip(spot[top : y + reach + 1, left : x + reach + 1], 0, None)
    rows, columns = np.indices(cut.shape)
    return left + (cut * columns).sum() / cut.sum(), top + (cut * rows).sum() / cut.sum()


def _table(overview: NDArray[np.float32], places: NDArray) -> pd.DataFrame:
    """Beads at `places` (n, 2), brightest first."""
    y_end, x_end = np.array(overview.shape) - 1
    x, y = places.T
    border = np.min([x, y, x_end - x, y_end - y], axis=0)
    if (border < 0).any():
        raise ValueError(f"beads_px: got {places[border.argmin()]}, allowed are places in the frames")
    nearest = KDTree(places).query(places, k=2)[0][:, 1]
    column, row = (np.rint(p).astype(int) for p in (x, y))
    smooth = gaussian_filter(overview, 1)
    high, low = (extreme(smooth, 2 * SPOT + 1)[row, column] for extreme in (maximum_filter, minimum_filter))
    height = np.where(high > -low, high, low)
    table = pd.DataFrame({"x_px": x, "y_px": y, "amplitude": height, "room_px": np.minimum(nearest, 2 * border)})
    return table.sort_values("amplitude", key=np.abs, ascending=False, ignore_index=True)


def _window(scan: NDArray, x_px: float, y_px: float, half: int) -> tuple[NDArray[np.float32], float, float]:
    """Part of the scan about a place, and where in it the place is."""
    x, y = round(x_px), round(y_px)
    top, left = max(y - half, 0), max(x - half, 0)
    return scan[:, top : y + half + 1, left : x + half + 1].astype(np.float32), x_px - left, y_px - top


def _size(scan: NDArray, beads: pd.DataFrame) -> int:
    """Median of the sizes that hold the widest image of the beads with most room."""
    bright = beads[beads["amplitude"].abs() > beads["amplitude"].abs().median() / 2]
    half = np.minimum(bright["room_px"] // 2 - 1, LARGEST // 2).nlargest(5).astype(int)
    half = half[half >= max(2, 0.8 * half.max())]  # less would cut a wide image off
    if half.empty:
        raise ValueError("scan: got no bead with room around it, needed is one, wholly in the frame")
    sizes = [image_size(_window(scan, *bright.loc[i, ["x_px", "y_px"]], half=h)[0]) for i, h in half.items()]
    return max(int(np.median(sizes)) // 2 * 2 + 1, 5)


def _fitting(stack: NDArray, scan: NDArray, z_um: NDArray, beads: pd.DataFrame) -> NDArray[np.float32]:
    """The stack, cut smaller if more of the scan's beads are then found at their depth.

    A smaller template leaves out what is faint, but also the neighbours. The joint fit has no such need, and is
    tried with the whole images first.
    """
    n, within_um = stack.shape[1], (z_um[-1] - z_um[0]) / 50
    looked = np.rint(np.linspace(0, len(scan) - 1, CHECKED + 2)[1:-1]).astype(int)
    true = pd.concat([beads[["x_px", "y_px"]].assign(frame=k, z_um=z_um[k]) for k in looked], ignore_index=True)
    best, most = stack, 0.0
    for fraction, method in ((1.0, "joint"), *((fraction, "correlation") for fraction in FRACTIONS)):
        m = round(n * (1 - fraction) / 2)
        cut = stack[:, m : n - m, m : n - m]
        calibration = Calibration.from_stack(cut, z_um, n_sub=min(9, len(scan)))
        found = [locate(scan[k], calibration, method=method).assign(frame=k) for k in looked]
        found = pd.concat(found, ignore_index=True)
        right = len(match(found, true, within_px=max(2, n / 10), within_um=within_um))
        if right > 1.05 * most:  # not for one bead more or less
            best, most = cut, right
    return best


def _reason(widest: int, size: int) -> str:
    if size == widest:
        return "just holds the widest image of a bead"
    return f"the widest image has {widest} px, but with this more of the scan's beads are found at their depth"


def _averaged(
    scan: NDArray, z_um: NDArray, beads: pd.DataFrame, size: int, *, given: bool
) -> tuple[pd.DataFrame, NDArray, NDArray, NDArray]:
    """Beads with a verdict each, their average stack, its drift (N, 2), and the fraction clipped in each slice."""
    beads = beads.assign(
        clipped=np.nan,
        alike=np.nan,
        offset_um=np.nan,
        verdict=f"too near to another or the border: not {size} px of room",
    )
    end = np.array(scan.shape[:0:-1]) - 1
    places = beads[["x_px", "y_px"]].to_numpy()
    inside = 2 * np.minimum(places, end - places).min(axis=1)
    alone = (inside >= size + 4) & (given | (beads["room_px"].to_numpy() >= size))
    beads.loc[alone, "verdict"] = "not looked at: others are brighter"
    looked = beads.index[alone] if given else beads.index[alone][:MOST_BEADS]
    if not len(looked):
        raise ValueError(
            f"scan: got {len(beads)} beads, none with {size} px to the next and {size // 2 + 2} to the border, needed "
            "is one; give a smaller size, or the place of one in beads_px (also if one bead's spots are taken "
            "for several), or scan a sparser slide"
        )
    clipped = _clipped(scan, beads.loc[looked], size)
    beads.loc[looked, "clipped"] = clipped.sum(axis=1)
    sound = ~clipped.any(axis=1)
    if given or not sound.any():
        sound[:] = True  # better a clipped calibration, if there is no other: the slices are named in the result
    beads.loc[looked[~sound], "verdict"] = "clipped"
    kept = looked[sound]
    stacks, drifts = [], []
    for bead in beads.loc[kept].itertuples():
        window, x, y = _window(scan, bead.x_px, bead.y_px, size // 2 + 8)
        room = int(min(x, y, window.shape[2] - 1 - x, window.shape[1] - 1 - y)) - 2
        stack, centres = centred(window, z_um, x, y, size, room)
        stacks.append(stack)
        drifts.append(centres - (x, y))
    mean, alike, lags, used = _mean(np.array(stacks), given)
    beads.loc[kept, "alike"], beads.loc[kept, "offset_um"] = alike, -lags * np.median(np.diff(z_um))
    beads.loc[kept, "verdict"] = np.where(used, "used", "unlike the others")
    drift = np.mean(np.array(drifts)[used], axis=0)
    return beads, mean, drift - drift.mean(axis=0), clipped.mean(axis=0)


def _mean(stacks: NDArray, given: bool) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Average of stacks (b, N, n, n), each moved along z to fit the rest; how alike each is, its lag, and if used.

    Stacks count as they are bright, so that the average has the least noise; it has the amplitude of the median.
    """
    smooth = np.array([normalised(levelled(denoised(stack))) for stack in stacks])
    lags, used = np.zeros(len(stacks)), np.ones(len(stacks), dtype=bool)
    mean = stacks[0]
    for _ in range(2):
        model = normalised(levelled(denoised(mean)))
        lags = np.array([_lag(images, model) for images in smooth])
        lags -= np.median(lags[used])
        moved = np.array([shift(stack, (lag, 0, 0), mode="nearest") for stack, lag in zip(stacks, lags, strict=True)])
        light = levelled(mean)
        weight = np.linalg.norm(light, axis=(1, 2)) ** 0.5  # dim slices count less, but count
        like = [
            np.einsum("kij,kij->k", shift(images, (lag, 0, 0), order=1, mode="nearest"), model)
            for images, lag in zip(smooth, lags, strict=True)
        ]
        alike = np.average(like, axis=1, weights=weight)
        used = (alike >= min(ALIKE, np.median(alike))) & (np.abs(lags) <= stacks.shape[1] / 10) | given
        gain = np.einsum("bkij,kij->b", moved, light) / (light**2).sum()
        mean = np.einsum("b,bkij->kij", gain[used], moved[used]) * np.median(gain[used]) / (gain[used] ** 2).sum()
    return mean.astype(np.float32), alike, lags, used


def _lag(images: NDArray, model: NDArray) -> float:
    """Slices by which images (N, n, n) must be moved to be most like those of the model, both normalised."""
    most = max(len(images) // 10, 1)
    likeness = np.einsum("kij,lij->kl", images, model)
    inner = np.arange(most + 1, len(images) - most - 1)  # the same for all lags: the ends may be the noisiest
    mean = np.array([likeness[inner, inner + lag].mean() for lag in range(-most - 1, most + 2)])
    best = 1 + int(mean[1:-1].argmax())
    before, here, after = mean[best - 1 : best + 2]
    bend = before + after - 2 * here
    return best - most - 1 + (np.clip((before - after) / (2 * bend), -0.5, 0.5) if bend < 0 else 0)


def _clipped(scan: NDArray, beads: pd.DataFrame, size: int) -> NDArray[np.bool_]:
    """Whether a bead's image is cut off at the end of the camera's range, (beads, N).

    Then more pixels are at the very end than in the next fiftieth of the range.
    """
    sign = np.sign(beads["amplitude"].median())
    end, other = (scan.max(), scan.min()) if sign > 0 else (scan.min(), scan.max())
    near = np.abs(scan.astype(np.float32) - float(end)) <= abs(float(end) - float(other)) / 50
    at_end = scan == end
    if at_end.sum() < max(4, near.sum() - at_end.sum()):
        return np.zeros((len(beads), len(scan)), dtype=bool)
    return np.array([_window(at_end, b.x_px, b.y_px, size // 2)[0].any(axis=(1, 2)) for b in beads.itertuples()])


def _subset_size(calibration: Calibration, least: int = 5, most: int = 25) -> int:
    """Fewest images of which, at any depth, one is alike to `COVERED`."""
    alike = calibration.self_similarity()
    most = min(most, len(calibration))
    for n_sub in range(min(least, most), most):
        if alike[:, calibration.with_subset(n_sub).subset].max(axis=1).min() >= COVERED:
            return n_sub
    return most
