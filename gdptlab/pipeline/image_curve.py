"""The curve on which images of one kind of particle lie, as they differ by depth alone, and mean images along it."""

from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from gdptlab.pipeline.lone_images import BLUR_PX

SLICES = 41
"""Number of images of the calibration, evenly spread along the curve."""

BEYOND = 2
"""Slices that are added at either end, extrapolated: of the outermost particles none may have stood alone."""

COMPONENTS = 16
"""Number of principal components in which images are compared. Measured on three of the channel's films: they hold 99 %
of the squared norm of the images that stand alone. Noise is spread over some 1500."""

NEAR, SUPPORT = 2.5, 2
"""Radius of a neighbourhood on the curve, in median distances of an image to the nearest of another particle; and the
least number of particles in one. A neighbour spoils an image in a way of its own, so that spoilt images are alone."""

SAME = (10, 0.1)
"""Frames that were looked at, and distance of images on the sphere, within which images in near places may be of one
particle. One that flows slowly is there for long, and its images say nothing new."""

LEAST_NODES = 8
"""Least number of neighbourhoods that make a curve."""

REACH = 5.0
"""Width of the diffusion map's kernel, in radii of a neighbourhood."""

ROUNDS = 6
"""Number of times that images are put on the curve, and the curve through the images."""

OFF_CURVE = 3.0
"""Distance from the curve, in medians, from which on an image is not used."""

IMAGES_EACH = 12
"""Least number of images that are averaged in a slice, about."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Lone images along their curve.

    Attributes
    ----------
    along : float array (n,)
        Place of each image on the curve, 0 to 1: length along it.
    used : bool array (n,)
        Which are near the curve.
    weights : float array (SLICES + 2 BEYOND, used)
        Of the used images in the average at each slice.
    gap : float
        Largest step between neighbours in the order, in radii of a neighbourhood.
    """

    along: NDArray[np.float64]
    used: NDArray[np.bool_]
    weights: NDArray[np.float64]
    gap: float


def features(images: NDArray[np.float32]) -> NDArray[np.float64]:
    """Images (n, s, s) as points on a sphere, (n, COMPONENTS): without noise, amplitude and one-sided light.

    Of each pixel and the one across the centre the fainter counts: a particle's image has both alike.
    """
    size = images.shape[-1]
    y, x = np.indices((size, size)) - size // 2
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), BLUR_PX) for image in images])
    sign = np.float32(np.sign(smooth[:, size // 2, size // 2].sum()) or 1)
    smooth = np.minimum(sign * smooth, sign * smooth[:, ::-1, ::-1]) * (np.hypot(x, y) <= size // 2)
    flat = _unit(smooth[:, size // 2 % 2 :: 2, size // 2 % 2 :: 2].reshape(len(images), -1).astype(float))
    axes = eigh(flat.T @ flat, subset_by_index=[flat.shape[1] - min(COMPONENTS, flat.shape[1]), flat.shape[1] - 1])[1]
    return _unit(flat @ axes)


def _unit(points: NDArray) -> NDArray:
    """Points (n, m) at distance 1 from the origin."""
    return points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-30)


def particles(table: pd.DataFrame, points: NDArray, size: int) -> NDArray[np.int64]:
    """Number of the particle (n,) of each image: images that are alike, in near frames and near places, are of one."""
    if not len(table):
        return np.zeros(0, int)
    step = table["frame"].rank(method="dense")
    place = np.column_stack([table["x_px"] / (size / 2), table["y_px"] / (size / 4), step / SAME[0], points / SAME[1]])
    a, b = KDTree(place).query_pairs(1.0, output_type="ndarray").T
    return connected_components(coo_array((np.ones(len(a)), (a, b)), (len(table),) * 2))[1]


def ordered(points: NDArray, particle: NDArray) -> Curve:
    """Order points (n, m) of the sphere, each of a particle (n,), along the curve that they lie on."""
    nodes, radius = _nodes(points, particle)
    if len(nodes) < LEAST_NODES:
        raise ValueError(
            f"frames: got {len(points)} images that stand alone with {len(nodes)} places where several are alike, "
            f"needed are {LEAST_NODES}: more images of one kind of particle, at all depths"
        )
    distance = np.sqrt(np.maximum(2 - 2 * nodes @ nodes.T, 0))
    kernel = np.exp(-((distance / (REACH * radius)) ** 2))
    density = kernel.sum(axis=1)  # taken off: places where many images are do not bend the order
    kernel /= density[:, None] * density
    root = np.sqrt(kernel.sum(axis=1))
    vectors = eigh(kernel / (root[:, None] * root), subset_by_index=[len(nodes) - 2, len(nodes) - 1])[1]
    curve = nodes[np.argsort(vectors[:, 0] / vectors[:, 1])]
    gap = float(np.linalg.norm(np.diff(curve, axis=0), axis=1).max() / radius)
    for _ in range(ROUNDS):
        place, off = _projected(points, curve)
        used = off < OFF_CURVE * np.median(off)
        weights = line_weights(place[used], np.linspace(0, 1, SLICES))
        curve = _unit(weights @ points[used])
    place, off = _projected(points, curve)
    used = off < OFF_CURVE * np.median(off)
    more = BEYOND / (SLICES - 1)
    return Curve(place, used, line_weights(place[used], np.linspace(-more, 1 + more, SLICES + 2 * BEYOND)), gap)


def _nodes(points: NDArray, particle: NDArray) -> tuple[NDArray, float]:
    """Means of neighbourhoods with several particles, (k, m), evenly spread over the points; their radius."""
    distance = np.sqrt(np.maximum(2 - 2 * points @ points.T, 0))
    other = np.where(particle[:, None] == particle, np.inf, distance).min(axis=1)
    radius = NEAR * float(np.median(other))
    chosen, farthest = [], np.full(len(points), np.inf)
    while farthest.max() > radius:
        chosen.append(int(farthest.argmax()))
        farthest = np.minimum(farthest, distance[chosen[-1]])
    near = distance[chosen] < radius
    near = near[[len(np.unique(particle[row])) >= SUPPORT for row in near]]
    return _unit(near @ points), radius


def _projected(points: NDArray, curve: NDArray) -> tuple[NDArray, NDArray]:
    """Place (n,) of points along a polyline (k, m), as a fraction of its length, and distance (n,) from it."""
    step = np.diff(curve, axis=0)
    length = np.linalg.norm(step, axis=1)
    fraction = np.clip((points @ step.T - (curve[:-1] * step).sum(axis=1)) / length**2, 0, 1)
    near = curve[:-1] + fraction[..., None] * step
    off = np.linalg.norm(points[:, None] - near, axis=2)
    k, each = off.argmin(axis=1), np.arange(len(points))
    start = np.concatenate([[0], np.cumsum(length)])
    return (start[k] + fraction[each, k] * length[k]) / start[-1], off[each, k]


def line_weights(place: NDArray, grid: NDArray) -> NDArray:
    """Weights (k, n) of values at places (n,) in their local linear regression at the points of a grid (k,)."""
    away = place - grid[:, None]
    count = min(IMAGES_EACH, len(place)) - 1
    width = np.maximum(grid[1] - grid[0], np.partition(np.abs(away), count, axis=1)[:, count] / 2)[:, None]
    kernel = np.exp(-0.5 * (away / width) ** 2)
    total, first, second = (np.einsum("kn,kn->k", kernel, away**p)[:, None] for p in range(3))
    second += 1e-3 * width**2 * total
    return kernel * (second - away * first) / (total * second - first**2)


def first_stack(images: NDArray[np.float32], weights: NDArray[np.float64]) -> NDArray[np.float32]:
    """Averages (k, s, s) of images (n, s, s) by weights (k, n), with the amplitude that they have there on average.

    The first and the last `BEYOND` averages are extrapolated.
    """
    norm = np.stack([np.linalg.norm(cv2.GaussianBlur(image, (0, 0), BLUR_PX)) for image in images])
    amplitude = np.exp(weights @ np.log(norm))
    stack = np.tensordot(weights, images / norm[:, None, None], axes=1) * amplitude[:, None, None]
    for k in (*range(BEYOND), *range(-BEYOND, 0)):
        stack[k] = cv2.GaussianBlur(stack[k], (0, 0), BLUR_PX)  # noise grows where it is extrapolated
    return stack.astype(np.float32)
