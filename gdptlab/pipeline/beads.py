"""A calibration made from a scan alone: which beads to use, how large a template, how many images to search with.

The scan is one of a plane of beads (dried on a slide, say) that the stage carries through focus, all together. Near the
slice where they are sharpest each is a small spot, bright or dark, and easy to find. Those that stand alone, are not
clipped and look like the rest are moved to a common centre and depth and averaged: beads are as good as
exposures, so noise falls with their number. What was chosen, and why, is in the result.

Some optics make several spots of one bead, even in focus (astigmatism with spherical aberration: two). Spots of one
bead are told from neighbours by their distance and direction, which are the same all over the scan.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, shift
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.stats import median_abs_deviation

from gdptlab._checks import depths, real_array, whole
from gdptlab._compiled import on_one_core
from gdptlab.assessment import match
from gdptlab.calibration import Calibration, levelled
from gdptlab.correlation import normalised, vertex
from gdptlab.denoising import denoised, noise_level
from gdptlab.fit.pattern import image_size, largest_size
from gdptlab.locate import locate
from gdptlab.pipeline.bead_images import MARGIN, centred

STANDS_OUT = 8.0
"""Height of a spot above its surroundings, in standard deviations of the smoothed image, from which on it is a bead's.
Chosen between 4 and 16 on the planar and the synthetic scan, where the same beads are found; below 4 noise is."""

FAINT = 0.1
"""Height of a spot, as a fraction of that of bright spots (the 90th percentile), below which it is no bead's. Chosen
between 0.03 and 0.3 on the planar scan, where 91, 90 and 88 beads are found at 0.03, 0.1 and 0.3."""

MOST_BEADS = 40
"""Largest number of beads, the brightest of those that stand alone, that are cut out and averaged. Chosen between 10
and 100 on the planar and the synthetic scan: the RMS error of z changes by 2 % or less, and the time to calibrate grows
with the number."""

LEAST_CORRELATION = 0.9
"""Correlation of a bead's images with the average bead's, in the mean over depth, below which it is an outlier. Chosen
between 0.8 and 0.97 on the planar and the synthetic scan, where the same 15 and 14 beads are used."""

ALIKE = 0.85
"""Median correlation of the beads with the average bead below which they do not go through focus together: what was
given as a scan is a film. Chosen on two scans (the planar one 0.99) and on films of the paper's channel and of a vortex
at three speeds each (0.75 or less). Noise lowers it, too: with 300 counts and templates of 35 px the planar scan has
0.42, every other slice of it 0.46, and both are refused."""

WANDERS = 0.25
"""Drift of a bead that is the only one, as a fraction of a template, from which on it is taken for a particle that
flows. Chosen on the same: 0.02 or less in scans, 0.31 or more in films. As `quality.DRIFT`."""

APART = 0.11
"""Median over the beads of how far each wanders from their mean, as a fraction of a template, from which on they do not
stay in place: a stage carries all alike. Chosen on four scans (0.02 or less; the synthetic one with noise of 300 counts
0.09) and nine films with two beads or more of a channel, a vortex and other flows (0.13 or more), with no others to
check it. Every other slice of the planar scan with that noise has 0.18, and is refused, as by `ALIKE`."""

MOST_LAG = 0.1
"""Largest shift of a bead along z, as a fraction of the scan, to the average bead: one that needs more is an outlier.
Convention: its images at a tenth of the depths, at one end, would be made up from the slice at the end."""

COVERED = 0.9
"""Correlation that an image at any depth has, at least, with one of the subset, if the subset is chosen here. Chosen:
the planar and the synthetic scan then get 10 and 6 images; a higher one takes more images, and more time."""

SUBSETS = (5, 25)
"""Least and largest number of images of a subset that is chosen here. The paper's Figure 5 goes from 3 to 25; time
grows with their number, and below 5 a profile has too few values to tell depths apart."""

LEAST = 7
"""Least number of frames of a scan. Derived: smoothing splines along z need 5, and both ends are left out when beads
are moved onto each other."""

FINEST_PX, COARSEST_PX = 1.0, 4.0
"""Standard deviations of the filters, px, between which a spot is counted as sharp: spots of half-widths of about 1 to
5 px. Derived: the spots of the planar beads have 1.4 px, those of the synthetic scan 3.2; below 1 px is a pixel's
noise."""

SHARPEST = 1 / 40
"""Slices to either side of the sharpest, as a fraction of the scan, that are averaged to look for beads. Derived: none
in a scan of fewer than 40 slices; in one of 106, two, over which beads change little."""

MEASURED = 20
"""Number of the brightest spots whose half-width is measured. Convention: their median is known to a fifth of the
scatter of one."""

WIDEST = 30
"""Largest half-width of a spot, px, that is measured. Derived: a spot in focus that is wider would need templates, a
few times as wide in all directions, larger than half a camera's frame."""

MOST_APART = 20.0
"""Largest distance of spots that may belong to one bead, in half-widths of a spot. Derived: two lobes that defocus
opens lie a few half-widths apart in focus (eight in the tests); templates have about twenty."""

SPOT = 4.0
"""Half-width of the window about a bead in which its brightest spot is looked for, in half-widths of a spot. Derived: a
bead's middle may lie between two lobes, half of eight half-widths from either."""

SAME = 1.0
"""Radius within which steps from spot to spot are the same, in half-widths of a spot. Derived: each centroid is known
to a fraction of one; a larger radius lets more steps be the same by chance."""

FRACTIONS = (1.0, 0.9, 0.8, 0.7)
"""Sizes of a template that are tried, as fractions of the widest image. Below 0.7 little of the widest images is left,
by which depths far from focus are told apart."""

CHECKED = 7
"""Number of slices of the scan, evenly spread, in which beads are looked for to choose that size. Derived: they hold a
few hundred beads, so that `MORE` stands out; the time grows with their number."""

RIGHT = 0.02
"""Largest error of z, as a fraction of the range of depths, of a bead that counts as found. As in `quality.ERROR`."""

MORE = 1.05
"""Ratio of beads found from which on a smaller template is better. Derived: of a few hundred, twenty more."""

NEAR_END = 0.02
"""Part of the camera's range, next to its end, that has fewer pixels than the very end if beads are clipped. Derived:
of images that are not clipped the fewest pixels are the brightest."""


@dataclass(frozen=True, eq=False)
class ScanReport:
    """How `Calibration.from_scan` came to its calibration.

    Attributes
    ----------
    beads : DataFrame
        A row for each bead of the scan: `x_px`, `y_px`; `amplitude`, the height of its spot (counts);
        `room_px`, the distance to its nearest neighbour or, doubled, to the border; for those looked at closely
        also `clipped`, in how many slices it is cut off at the top or bottom of the camera's range, `correlation`, that
        with the average bead, and `offset_um`, how much higher (in z of the scan) than the others it comes into focus;
        `verdict`: "used", or why it is not.
    drift_px : float64 array (N, 2)
        Position (x, y) of the average bead in each slice, from its mean position.
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

    def scaled(self, ratio: float) -> Self:
        """Return the report with depths times a ratio."""
        return replace(self, beads=self.beads.assign(offset_um=self.beads["offset_um"] * ratio))

    def part(self, part: slice) -> Self:
        """Return the report on some of the slices."""
        return replace(self, drift_px=self.drift_px[part], clipped=self.clipped[part])


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
    smaller: bool = True,
) -> Calibration:
    """Calibrate with the average of a scan's beads; see `Calibration.from_scan`.

    With `smaller` the size that is found may be less than that of the widest image.
    """
    scan, z_um = _checked(scan, z_um)
    if size is not None and whole("size", size, 3, 10_001) % 2 == 0:
        raise ValueError(f"size: got {size} px, allowed are odd sizes")
    if n_sub is not None:
        whole("n_sub", n_sub, 2, len(scan))
    overview, given = _sharpest(scan), beads_px is not None
    beads = _table(overview, _given(beads_px)) if given else _found(overview)
    widest = size or _size(scan, beads)
    beads, stack, drift, clipped = _averaged(scan, z_um, beads, widest, given=given)
    if size is None and smaller and not given:
        stack = _fitting(stack, scan, z_um, beads)
    calibration = Calibration.from_stack(stack, z_um, n_sub=n_sub or min(9, len(scan)))
    if n_sub is None:
        calibration = calibration.with_subset(subset_size(calibration))
    settings = _choices(
        calibration, beads, widest, {"beads": given, "size": size is not None, "n_sub": n_sub is not None}
    )
    noise = max(noise_level(scan[:: max(len(scan) // 5, 1)]), 1e-9)
    return replace(calibration, report=ScanReport(beads, drift, clipped, settings, overview, noise))


def _given(beads_px: ArrayLike) -> NDArray[np.float64]:
    """Positions (n, 2) of beads, x and y in px, if they are that."""
    positions = real_array("beads_px", beads_px, 2).astype(float)
    if positions.shape[1] != 2:
        raise ValueError(f"beads_px: got shape {positions.shape}, allowed is (n, 2): x and y of each bead")
    return positions


def _choices(calibration: Calibration, beads: pd.DataFrame, widest: int, given: dict[str, bool]) -> pd.DataFrame:
    """Table of what was chosen, and why, by the name of the choice; or `given`."""
    used = (beads["verdict"] == "used").sum()
    averaged = "whatever they are like" if given["beads"] else "alone, not clipped and no outliers"
    size = "just holds the widest image of a bead"
    if calibration.size < widest:
        size = f"the widest image has {widest} px, but with this more of the scan's beads are found at their depth"
    table = {
        "beads": (f"{used} of {len(beads)}", f"averaged: {averaged}"),
        "size": (f"{calibration.size} px", "" if given["size"] else size),
        "n_sub": (
            f"{len(calibration.subset)} of {len(calibration)}",
            f"each depth then correlates with one of them by {COVERED} or more, or it is the most that is tried",
        ),
    }
    rows = [(value, "given" if given[name] else "by itself", why) for name, (value, why) in table.items()]
    return pd.DataFrame(rows, columns=["value", "how", "why"], index=pd.Index(table, name="setting"))


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
    """Sharpest slices of (N, rows, columns) less what rests: bright beads are above 0, dark ones below.

    What rests is the least light of each pixel over z if beads are bright, the most if they are dark. Less the mean a
    bead could be hollow: where astigmatism makes a line of it, its middle is no brighter than in the mean over z. They
    are bright if images are more skewed upwards where they are sharp than at most depths.
    """
    mean = np.zeros(scan.shape[1:])
    least, most = np.full((2, *scan.shape[1:]), np.inf, dtype=np.float32)
    most = -most
    levels = np.empty(len(scan), dtype=np.float32)
    for k, image in enumerate(scan):
        image = real_array("scan", image, 2)
        levels[k] = np.median(image)
        above = (image - levels[k]).astype(np.float32)
        mean += above
        np.minimum(least, above, out=least)
        np.maximum(most, above, out=most)
    mean = (mean / len(scan)).astype(np.float32)
    contrast, skew, resting = np.empty(len(scan)), np.empty(len(scan)), _spots(mean)
    for k, image in enumerate(scan):
        spots = _spots((image - levels[k]).astype(np.float32))
        # The fourth power is large for spots that are small and strong, not for those that are large and weak.
        contrast[k], skew[k] = ((spots - resting) ** 4).mean(), (spots**3).mean()
    if not contrast.max() > 0:
        raise ValueError("scan: got frames that are all the same, needed are beads that change with z")
    best, half = int(contrast.argmax()), int(SHARPEST * len(scan))
    near = slice(max(best - half, 0), best + half + 1)
    sharp = np.mean(scan[near] - levels[near, None, None], axis=0, dtype=np.float32)
    return sharp - (least if skew[best] > np.median(skew) else most)


def _spots(image: NDArray) -> NDArray:
    """What is as fine as a spot in an image, in which coarse and finer things are left out."""
    smooth = gaussian_filter(image, FINEST_PX)
    return smooth - gaussian_filter(smooth, COARSEST_PX)


def _found(overview: NDArray[np.float32]) -> pd.DataFrame:
    """Table of the beads in `overview` (rows, columns)."""
    sign = 1 if overview.max() > -overview.min() else -1
    spots, width = gaussian_filter(sign * overview, 1), 1.0
    for _ in range(2):  # with a first guess of how wide spots are, then with their width
        half = 2 * int(np.ceil(width)) + 3
        highest = spots == maximum_filter(spots, 2 * half + 1)
        level = np.median(spots)
        noise = median_abs_deviation(spots, axis=None, scale="normal")
        y, x = np.nonzero(highest & (spots > level + STANDS_OUT * noise))
        if not len(x):
            raise ValueError(
                "scan: got one in which nothing stands out of the noise, needed are beads that stay in "
                "place (a film of particles that flow is no scan)"
            )
        height = spots[y, x] - level
        bright = height > FAINT * np.percentile(height, 90)
        x, y = x[bright], y[bright]
        width = _half_width(sign * overview, np.stack([x, y], axis=1)[np.argsort(-spots[y, x])])
        spots = gaussian_filter(sign * overview, max(1, width / 2))
    spot = np.array([_centroid(sign * overview, *at, 1 + int(width)) for at in zip(x, y, strict=True)])
    bead = _bead_of(spot, width)
    weight = spots[y, x] - level
    total = np.bincount(bead, weight)
    return _table(overview, np.stack([np.bincount(bead, weight * p) / total for p in spot.T], axis=1), width)


def _bead_of(spots: NDArray, width: float) -> NDArray[np.int64]:
    """Number of the bead that each of the spots at (n, 2), of this half-width, belongs to; (n,).

    A step from spot to spot that a fifth of them or more share, far more often than by chance, leads from one spot of
    a bead to another. In a regular array of beads a step leads on to a third one, and is not taken.
    """
    pairs = KDTree(spots).query_pairs(MOST_APART * width, output_type="ndarray")
    steps = spots[pairs[:, 1]] - spots[pairs[:, 0]]
    by_chance = 2 * len(steps) * (SAME / MOST_APART) ** 2
    joined = np.zeros(len(pairs), dtype=bool)
    either_way = KDTree(np.concatenate([steps, -steps])) if len(steps) else None
    for step in steps:
        same = np.unique(np.array(either_way.query_ball_point(step, SAME * width)) % len(steps))
        ends = np.unique(pairs[same])
        if len(same) >= max(3, len(spots) / 5, 10 * by_chance) and len(ends) > 1.8 * len(same):
            joined[same] = True
    links = coo_array((np.ones(joined.sum()), pairs[joined].T), shape=(len(spots), len(spots)))
    return connected_components(links, directed=False)[1]


def _half_width(image: NDArray, spots: NDArray) -> float:
    """Median radius (px) of the first `MEASURED` spots at (n, 2), x and y: of a disc that has as many pixels as one
    has above half its height."""
    widths = []
    for x, y in np.rint(spots[:MEASURED]).astype(int):
        cut = image[max(y - WIDEST, 0) : y + WIDEST + 1, max(x - WIDEST, 0) : x + WIDEST + 1]
        widths.append(np.sqrt((cut > image[y, x] / 2).sum() / np.pi))
    return float(np.median(widths))


def _centroid(image: NDArray, x: int, y: int, half: int) -> tuple[float, float]:
    """Centroid (x, y) of what is above 0 in a window of an image, `half` px to all sides of a pixel."""
    top, left = max(y - half, 0), max(x - half, 0)
    cut = np.clip(image[top : y + half + 1, left : x + half + 1], 0, None)
    rows, columns = np.indices(cut.shape)
    return left + (cut * columns).sum() / cut.sum(), top + (cut * rows).sum() / cut.sum()


def _highest_near(image: NDArray, positions: NDArray) -> NDArray[np.int64]:
    """Highest pixels (n, 2), x and y, of an image within `WIDEST` px of positions (n, 2)."""
    highest = []
    for x, y in np.rint(positions).astype(int):
        top, left = max(y - WIDEST, 0), max(x - WIDEST, 0)
        cut = image[top : y + WIDEST + 1, left : x + WIDEST + 1]
        row, column = np.unravel_index(cut.argmax(), cut.shape)
        highest.append((left + column, top + row))
    return np.array(highest)


def _table(overview: NDArray[np.float32], positions: NDArray, width: float | None = None) -> pd.DataFrame:
    """Table of beads at `positions` (n, 2), x and y, brightest first; their spots have this half-width, px."""
    y_end, x_end = np.array(overview.shape) - 1
    x, y = positions.T
    border = np.min([x, y, x_end - x, y_end - y], axis=0)
    if (border < 0).any():
        raise ValueError(f"beads_px: got {positions[border.argmin()]}, allowed are positions in the frames")
    nearest = KDTree(positions).query(positions, k=2)[0][:, 1]
    column, row = (np.rint(p).astype(int) for p in (x, y))
    smooth = gaussian_filter(overview, 1)
    if width is None:
        width = _half_width(np.abs(overview), _highest_near(np.abs(overview), positions))
    side = 2 * int(np.ceil(SPOT * width)) + 1
    high, low = (extreme(smooth, side)[row, column] for extreme in (maximum_filter, minimum_filter))
    height = np.where(high > -low, high, low)
    table = pd.DataFrame({"x_px": x, "y_px": y, "amplitude": height, "room_px": np.minimum(nearest, 2 * border)})
    return table.sort_values("amplitude", key=np.abs, ascending=False, ignore_index=True)


def _window(scan: NDArray, x_px: float, y_px: float, half: int) -> tuple[NDArray[np.float32], float, float]:
    """Part of the scan (N, rows, columns) about a position, and the position (x, y) in it."""
    x, y = round(x_px), round(y_px)
    top, left = max(y - half, 0), max(x - half, 0)
    return scan[:, top : y + half + 1, left : x + half + 1].astype(np.float32), x_px - left, y_px - top


def _size(scan: NDArray, beads: pd.DataFrame) -> int:
    """Median of the sizes that hold the widest image of the beads with most room."""
    bright = beads[beads["amplitude"].abs() > beads["amplitude"].abs().median() / 2]
    half = np.minimum(bright["room_px"] // 2 - 1, largest_size(scan.shape[1:]) // 2).nlargest(5).astype(int)
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
    n, within_um = stack.shape[1], RIGHT * (z_um[-1] - z_um[0])
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
        if right > MORE * most:
            best, most = cut, right
    return best


def _averaged(
    scan: NDArray, z_um: NDArray, beads: pd.DataFrame, size: int, *, given: bool
) -> tuple[pd.DataFrame, NDArray, NDArray, NDArray]:
    """Beads with a verdict each, their average stack, its drift (N, 2), and the fraction clipped in each slice."""
    beads = beads.assign(
        clipped=np.nan,
        correlation=np.nan,
        offset_um=np.nan,
        verdict=f"too near to another or the border: not {size} px of room",
    )
    end = np.array(scan.shape[:0:-1]) - 1
    positions = beads[["x_px", "y_px"]].to_numpy()
    inside = 2 * np.minimum(positions, end - positions).min(axis=1)
    alone = (inside >= size + 4) & (given | (beads["room_px"].to_numpy() >= size))
    beads.loc[alone, "verdict"] = "not looked at: others are brighter"
    looked = beads.index[alone] if given else beads.index[alone][:MOST_BEADS]
    if not len(looked):
        raise ValueError(
            f"scan: got {len(beads)} beads, none with {size} px to the next and {size // 2 + 2} to the border, needed "
            "is one; give a smaller size, or the position of one in beads_px (also if one bead's spots are taken "
            "for several), or scan a sparser slide (and a film of particles that flow is no scan)"
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
        window, x, y = _window(scan, bead.x_px, bead.y_px, size // 2 + MARGIN)
        room = int(min(x, y, window.shape[2] - 1 - x, window.shape[1] - 1 - y)) - 2
        stack, centres = centred(window, z_um, x, y, size, room)
        stacks.append(stack)
        drifts.append(centres - (x, y))
    mean, correlation, lags, used = _mean(np.array(stacks), given)
    beads.loc[kept, "correlation"], beads.loc[kept, "offset_um"] = correlation, -lags * np.median(np.diff(z_um))
    beads.loc[kept, "verdict"] = np.where(used, "used", "an outlier")
    drift = np.mean(np.array(drifts)[used], axis=0)
    if not given:
        _must_stay(correlation, np.array(drifts) / size)
    return beads, mean, drift - drift.mean(axis=0), clipped.mean(axis=0)


def _must_stay(correlation: NDArray, drifts: NDArray) -> None:
    """Refuse a film of particles that flow: beads of a scan stay in place, or drift together, and change alike.

    From the correlation of beads with their average (b,), and their drifts (b, N, 2), as fractions of a template.
    """
    said, n = "", len(drifts)
    drifts = drifts - drifts.mean(axis=1, keepdims=True)
    apart = float(np.median(np.ptp(drifts - drifts.mean(axis=0), axis=1).max(axis=1)))
    if n > 1 and np.median(correlation) < ALIKE:
        said = f"{n} beads that do not change alike (median correlation {np.median(correlation):.2f})"
    elif n > 1 and apart > APART:
        said = f"{n} beads that wander by {apart:.2f} of a template against each other"
    elif n == 1 and np.ptp(drifts[0], axis=0).max() > WANDERS:
        said = f"a bead that wanders by {np.ptp(drifts[0], axis=0).max():.2f} of a template"
    if said:
        raise ValueError(
            f"scan: got {said}, as in a film of particles that flow; needed are beads that stay in place while the "
            "stage carries them through focus (if they do, give the positions of good ones in beads_px)"
        )


def _mean(stacks: NDArray, given: bool) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Average (N, n, n) of stacks (b, N, n, n), each moved along z; their correlation with it, lags, and if used, (b,).

    Stacks are weighted by their amplitude, so that the average has the least noise; it has the amplitude of the median.
    """
    smooth = np.array([normalised(levelled(denoised(stack))) for stack in stacks])
    lags, used = np.zeros(len(stacks)), np.ones(len(stacks), dtype=bool)
    mean = stacks[0]
    for _ in range(2):
        model = normalised(levelled(denoised(mean)))
        lags = np.array([_lag(images, model) for images in smooth])
        lags -= np.median(lags[used])
        moved = np.array([shift(stack, (lag, 0, 0), mode="nearest") for stack, lag in zip(stacks, lags, strict=True)])
        images = levelled(mean)
        weight = np.linalg.norm(images, axis=(1, 2)) ** 0.5  # dim slices count less, but count
        each = [
            np.einsum("kij,kij->k", shift(stack, (lag, 0, 0), order=1, mode="nearest"), model)
            for stack, lag in zip(smooth, lags, strict=True)
        ]
        correlation = np.average(each, axis=1, weights=weight)
        typical = correlation >= min(LEAST_CORRELATION, np.median(correlation))
        used = typical & (np.abs(lags) <= MOST_LAG * stacks.shape[1]) | given
        amplitude = np.einsum("bkij,kij->b", moved, images) / (images**2).sum()
        mean = np.einsum("b,bkij->kij", amplitude[used], moved[used])
        mean *= np.median(amplitude[used]) / (amplitude[used] ** 2).sum()
    return mean.astype(np.float32), correlation, lags, used


def _lag(images: NDArray, model: NDArray) -> float:
    """Slices by which images (N, n, n) are moved to correlate best with those of the model, both normalised."""
    most = max(int(MOST_LAG * len(images)), 1)
    correlation = np.einsum("kij,lij->kl", images, model)
    inner = np.arange(most + 1, len(images) - most - 1)  # the same for all lags: the ends may be the noisiest
    mean = np.array([correlation[inner, inner + lag].mean() for lag in range(-most - 1, most + 2)])
    best = 1 + int(mean[1:-1].argmax())
    return best - most - 1 + float(vertex(mean[None, best - 1 : best + 2])[0])


def _clipped(scan: NDArray, beads: pd.DataFrame, size: int) -> NDArray[np.bool_]:
    """Whether a bead's image is cut off at the end of the camera's range, (beads, N).

    Then more pixels are at the very end than in the next `NEAR_END` of the range.
    """
    sign = np.sign(beads["amplitude"].median())
    end, other = (scan.max(), scan.min()) if sign > 0 else (scan.min(), scan.max())
    near = np.abs(scan.astype(np.float32) - float(end)) <= NEAR_END * abs(float(end) - float(other))
    at_end = scan == end
    if at_end.sum() < max(4, near.sum() - at_end.sum()):
        return np.zeros((len(beads), len(scan)), dtype=bool)
    return np.array([_window(at_end, b.x_px, b.y_px, size // 2)[0].any(axis=(1, 2)) for b in beads.itertuples()])


def subset_size(calibration: Calibration) -> int:
    """Fewest images of which, at any depth, one correlates by `COVERED` or more; of `SUBSETS`."""
    correlation = calibration.self_similarity()
    least, most = (min(n, len(calibration)) for n in SUBSETS)
    for n_sub in range(least, most):
        if correlation[:, calibration.with_subset(n_sub).subset].max(axis=1).min() >= COVERED:
            return n_sub
    return most
