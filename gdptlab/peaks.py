"""Peaks of correlation maps: where they are, between pixels too, and how high each map rises there (its profile).

The kernels are compiled (numba), as they touch every pixel.
"""

import numpy as np
from numpy.typing import NDArray

from gdptlab.cores import compiled, inlined

BETWEEN = 0.95
"""Share of its C_m that a peak between pixels still has at the nearest one, about, at least."""

APART_PX = 2
"""No pixel so near to a peak is higher."""


def peaks(
    maps: NDArray[np.float32], threshold: float, near: int
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Find the peaks of the highest of some maps.

    Parameters
    ----------
    maps : float32 array (k, rows, columns)
    threshold : float
        A peak reaches `BETWEEN` times this.
    near : int
        How far, in px, each map's own peak may be from it. Nearer to a rim there is no peak: it might be the flank
        of one outside, whose place is unknown.

    Returns
    -------
    place : float64 array (n, 2)
        Row and column of the top of the map that is highest.
    cm : float32 array (n,)
        Height of that top.
    profile : float32 array (n, k)
        Height of each map at its own top, between pixels.
    """
    highest = maps.max(axis=0)
    at = _peaks(highest, np.float32(BETWEEN * threshold), max(near, 1))
    profile, tops = np.empty((len(at), len(maps)), np.float32), np.empty((len(at), len(maps), 2))
    _read(maps, at, near, profile, tops)
    return tops[np.arange(len(at)), profile.argmax(axis=1)], profile.max(axis=1), profile


def strongest(place: NDArray[np.float64], cm: NDArray, distance_px: float) -> NDArray[np.int64]:
    """Indices by falling C_m (n,), without those nearer than this to a stronger one, or with none; of places (n, 2)."""
    order = np.argsort(-cm, kind="stable")
    return _apart(place, order[cm[order] > 0], min(distance_px, 1e150) ** 2)  # of more, the square is no number


@compiled
def _apart(place, order, square):  # pragma: no cover
    kept, n = np.empty(len(order), np.int64), 0
    for i in order:
        alone = True
        for k in kept[:n]:
            y, x = place[i, 0] - place[k, 0], place[i, 1] - place[k, 1]
            if y * y + x * x <= square:
                alone = False
                break
        if alone:
            kept[n] = i
            n += 1
    return kept[:n].copy()


@compiled
def _peaks(highest, threshold, rim):  # pragma: no cover
    """Rows and columns (n, 2) of the local maxima."""
    rows, columns = highest.shape
    found = []
    for r in range(rim, rows - rim):
        before, row, after = highest[r, rim - 1 :], highest[r, rim:], highest[r, rim + 1 :]
        for q in range(columns - 2 * rim):
            here = row[q]
            if here < threshold or here < before[q] or here < after[q]:
                continue
            c = rim + q
            for y in range(max(r - APART_PX, 0), min(r + APART_PX + 1, rows)):
                around = highest[y, max(c - APART_PX, 0) : c + APART_PX + 1]
                if around.max() > here:
                    break
            else:
                found.append((r, c))
    at = np.empty((len(found), 2), np.int64)
    for i in range(len(found)):
        at[i, 0], at[i, 1] = found[i]
    return at


@inlined
def _parabola(before, here, after):  # pragma: no cover
    """Where the parabola through three values, at -1, 0 and 1, has its top, and how far that is above the middle."""
    bend = before + after - 2 * here
    slope = (after - before) / 2
    if bend >= 0:
        return np.sign(slope) / 2, 0 * slope
    top = -slope / bend
    part = min(max(top, -1), 1)
    return min(max(top, -0.5), 0.5), slope * part + bend * part * part / 2


@compiled
def _read(maps, at, near, profile, tops):  # pragma: no cover
    last_row, last_column = maps.shape[1] - 1, maps.shape[2] - 1
    for i in range(len(at)):
        for k in range(len(maps)):
            map_ = maps[k]
            r, c = at[i, 0] - near, at[i, 1] - near
            for y in range(at[i, 0] - near, at[i, 0] + near + 1):
                for x in range(at[i, 1] - near, at[i, 1] + near + 1):
                    if map_[y, x] > map_[r, c]:
                        r, c = y, x
            here = map_[r, c]
            down, rise = _parabola(map_[max(r - 1, 0), c], here, map_[min(r + 1, last_row), c])
            right, more = _parabola(map_[r, max(c - 1, 0)], here, map_[r, min(c + 1, last_column)])
            profile[i, k] = here + rise + more
            tops[i, k, 0], tops[i, k, 1] = r + down, c + right
