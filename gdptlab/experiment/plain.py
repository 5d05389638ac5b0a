"""The paper's method written with the normalised correlation of a library: the reference of `locate`.

One call correlates each template of the subset with the whole frame at full resolution; candidates are refined one
after the other. `locate` must agree with this. It differs in two more points: here, profiles are read at the pixel of
the peak only, and positions between pixels and between slices come from parabolas through three correlations, there
from least squares.
"""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from skimage.feature import match_template

from gdptlab._checks import choice, flag
from gdptlab.calibration import Calibration
from gdptlab.correlation import standardised, strongest, vertex
from gdptlab.locate import as_table, checked_frame

HALF_WIDTH_PX = 2
"""Half-width, px, of the window around a candidate's pixel in which the refinement searches. Chosen: the peaks of
neighbouring slices are less than a pixel apart. With 0, the refinement could not leave the pixel; with half a template,
it would climb to another particle."""

Correlate = Callable[[NDArray, NDArray], NDArray]

CORRELATE: dict[str, Correlate] = {
    "opencv": lambda image, template: cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED),
    "scikit-image": match_template,
}
"""Normalised correlation of an image (rows, columns) with a template (n, n): (rows - n + 1, columns - n + 1)."""


def locate_plainly(
    image: ArrayLike,
    calibration: Calibration,
    *,
    correlate: str = "opencv",
    threshold: float = 0.5,
    refine: bool = True,
    min_distance_px: float | None = None,
) -> pd.DataFrame:
    """Measure x, y and z of every particle in a frame, as `locate` does, slowly.

    Parameters
    ----------
    image : array (rows, columns)
        As in `locate`.
    calibration : Calibration
    correlate : {"opencv", "scikit-image"}
        Library that correlates: with `cv2.matchTemplate` or `skimage.feature.match_template`.
    threshold, refine, min_distance_px
        As in `locate`.

    Returns
    -------
    DataFrame
        As from `locate`: `x_px`, `y_px`, `z_um`, `cm`, `at_end`.

    Raises
    ------
    TypeError, ValueError
        As `locate`; also if `correlate` is another word.
    """
    image, distance = checked_frame(image, calibration, threshold, min_distance_px)
    correlated, templates = CORRELATE[choice("correlate", correlate, CORRELATE)], calibration.templates
    half, last = calibration.size // 2, len(calibration) - 1
    maps = np.stack([correlated(image, templates[k]) for k in calibration.subset])
    highest = maps.max(axis=0)
    peak = (highest >= threshold) & (highest == cv2.dilate(highest, np.ones((5, 5), np.uint8)))
    peak[[0, -1]] = peak[:, [0, -1]] = False
    row, column = np.nonzero(peak)

    # At full resolution and without the stack's noise, which would enlarge the correlation of a slice with itself.
    expected = calibration.self_similarity()[:, calibration.subset]
    correlation = standardised(maps[:, row, column].T) @ standardised(expected).T
    k = np.clip(correlation.argmax(axis=1), 1, last - 1)
    slice_ = k + vertex(correlation[np.arange(len(k))[:, None], k[:, None] + (-1, 0, 1)])
    if flag("refine", refine):
        starts = zip(row, column, np.rint(slice_).astype(int), strict=True)
        found = [_climbed(image, templates, *start, correlated) for start in starts]
    else:
        best = maps[:, row, column].argmax(axis=0)
        found = [(*_top(maps[b], r, c), s) for b, r, c, s in zip(best, row, column, slice_, strict=True)]
    y, x, cm, slice_ = np.array(found).reshape(-1, 4).T
    position = np.stack([y, x], axis=1) + half
    kept = strongest(position, np.where(cm >= threshold, cm, 0), distance)
    return as_table(position[kept], slice_[kept], cm[kept], calibration.z_um)


def _climbed(
    image: NDArray[np.float32], templates: NDArray[np.float32], row: int, column: int, k: int, correlated: Correlate
) -> tuple[float, float, float, float]:
    """Walk from template k to the best C_m near a pixel: row and column in the maps, C_m (0: not a peak), slice."""
    n = templates.shape[-1]
    first = max(row - HALF_WIDTH_PX, 0), max(column - HALF_WIDTH_PX, 0)
    window = image[first[0] : row + HALF_WIDTH_PX + n, first[1] : column + HALF_WIDTH_PX + n]
    map_ = cache(lambda k: correlated(window, templates[k]))
    while True:
        around = [i for i in (k, k - 1, k + 1) if 0 <= i < len(templates)]
        higher = max(around, key=lambda i: map_(i).max())
        if higher == k:
            break
        k = higher
    r, c = np.unravel_index(map_(k).argmax(), map_(k).shape)
    if not (0 < r < map_(k).shape[0] - 1 and 0 < c < map_(k).shape[1] - 1):
        return row, column, 0, k  # on the flank of another peak, or on its way out of the frame
    y, x, cm = _top(map_(k), r, c)
    part = vertex(np.array([[map_(i).max() for i in (k - 1, k, k + 1)]]))[0] if len(around) == 3 else 0
    return y + first[0], x + first[1], cm, k + part


def _top(map_: NDArray, r: int, c: int) -> tuple[float, float, float]:
    """Return row and column, between pixels, of the peak of a map at pixel (r, c), and the map's value there."""
    part = vertex(np.stack([map_[r - 1 : r + 2, c], map_[r, c - 1 : c + 2]]))
    return r + part[0], c + part[1], map_[r, c]
