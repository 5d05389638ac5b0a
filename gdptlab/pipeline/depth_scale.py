"""From places on the curve of a film's images to depths, by what is known of the film."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline
from scipy.optimize import least_squares, lsq_linear
from scipy.spatial import KDTree
from scipy.stats import rankdata

from gdptlab._checks import numbers

Speed = Callable[[NDArray, NDArray, NDArray], ArrayLike]
"""Speed along x, in any unit, of the flow at x_px, y_px, z_um (n,)."""

KNOTS = 6
"""Number of inner knots of the cubic spline from places to depths. Measured on two of the channel's films, on true
depths over the middle 90 % of the height: the spline differs from one with 20 knots by 0.10 and 0.14 um (RMS)."""

LEAST_STEP = 1e-3
"""Least difference of neighbouring coefficients of the spline, as a fraction of the height: depths increase."""

OUTLIER = 0.05
"""Difference of a particle's move from the flow's, as a fraction of a fast one's move, from which on it counts less."""

PRIOR = 2.0
"""Weight of the depths by ranks beside the speed: a coefficient off by the height counts as a particle whose move is
off by so many times a fast one's. It decides at the walls, where hardly anything moves: with 0.4, one film of
two got an end 13 um beyond the wall."""

GROUPS = 10
"""Number of groups of consecutive frames, each of which is left out once to tell the error of the depths."""

SCALE_OF_ONE = 0.447
"""Standard deviation of the scale by the ranks of n evenly spread particles, times the root of n. Derived: half the
root of the kurtosis, 1.8, less 1."""

MOVED = (30.0, 2.0, 1.5)
"""Largest move of a particle from a frame to the next: along x, px; along y, px; along the
curve, slices. Beyond, nobody is followed."""

LEAST_PAIRS = 50
"""Least number of particles that are followed from a frame to the next: eight for each coefficient of the spline."""


@dataclass(frozen=True, eq=False)
class Scale:
    """Depths of places on the curve.

    Attributes
    ----------
    z_um, z_std_um : float arrays (N,)
        Depths of the slices, in the order of the curve, and their standard deviations.
    std : float
        Standard deviation of the factor common to all depths.
    """

    z_um: NDArray[np.float64]
    z_std_um: NDArray[np.float64]
    std: float


def depth_scale(table: pd.DataFrame, slices: NDArray, extent_um: tuple[float, float], speed: Speed | None) -> Scale:
    """Find the depths of slices from particles that were measured in some frames.

    Parameters
    ----------
    table : DataFrame
        `frame`, `x_px`, `y_px` and `slice` of all particles in them; with `speed`, frames come in pairs (k, k + 1).
    slices : array (N,)
        Whose depths are asked for.
    extent_um : (float, float)
        Least and largest depth of the particles' centres, which are evenly spread between.
    speed : callable, optional
        Then the depths agree with the speed from frame to frame, and need not be evenly spread.
    """
    knots = np.concatenate([[slices[0]] * 3, np.linspace(slices[0], slices[-1], KNOTS + 2), [slices[-1]] * 3])
    basis = _basis(table["slice"].to_numpy(), knots)
    pairs = None if speed is None else _followed(table)
    frames = np.unique(table["frame"])
    group = np.searchsorted(frames, table["frame"]) * GROUPS // len(frames)
    at = _basis(slices, knots)
    z_um, *others = (
        at @ _coefficients(table, basis, group != left_out, pairs, extent_um, speed) for left_out in range(-1, GROUPS)
    )
    away = np.sqrt(GROUPS - 1) * (np.array(others) - np.mean(others, axis=0))
    slope = away @ (z_um - z_um.mean()) / ((z_um - z_um.mean()) ** 2).sum()
    spread, std = np.sqrt((away**2).mean(axis=0)), float(np.sqrt((slope**2).mean()))
    if speed is None:  # no less than that of ranks, and of their scale, if all particles are new in each frame
        below = np.clip((z_um - extent_um[0]) / (extent_um[1] - extent_um[0]), 0, 1)
        spread = np.maximum(spread, (extent_um[1] - extent_um[0]) * np.sqrt(below * (1 - below) / len(table)))
        std = max(std, SCALE_OF_ONE / np.sqrt(len(table)))
    return Scale(z_um, spread, std)


def _basis(slices: NDArray, knots: NDArray) -> NDArray:
    """Values (n, KNOTS + 4) of the cubic B-splines at slices (n,)."""
    return BSpline.design_matrix(np.clip(slices, knots[0], knots[-1]), knots, 3).toarray()


def _coefficients(
    table: pd.DataFrame, basis: NDArray, used: NDArray, pairs: tuple | None, extent_um: tuple, speed: Speed | None
) -> NDArray:
    """Coefficients of the spline from places to depths, from some of the particles."""
    low, high = extent_um
    rank = (rankdata(table["slice"][used]) - 0.5) / used.sum()
    steps = np.tril(np.ones((basis.shape[1],) * 2))  # from increments to coefficients
    least = [-np.inf] + [LEAST_STEP * (high - low)] * (len(steps) - 1)
    start = lsq_linear(basis[used] @ steps, low + (high - low) * rank, (least, np.inf)).x
    if speed is None:
        return steps @ start
    first, second = (side[used[pairs[0]]] for side in pairs)
    x, y = (table[name].to_numpy() for name in ("x_px", "y_px"))
    moved, middle = x[second] - x[first], (x[first] + x[second]) / 2

    def shape(increments: NDArray) -> NDArray:
        return _speeds(speed, middle, y[first], basis[first] @ steps @ increments)

    usual = np.percentile(np.abs(moved), 90)

    def residual(unknown: NDArray) -> NDArray:
        away = steps @ (unknown[:-1] - start) / (high - low)
        return np.concatenate([moved - unknown[-1] * shape(unknown[:-1]), PRIOR * usual * away])

    expected = shape(start)
    factor = (expected @ moved) / (expected @ expected)
    found = least_squares(
        residual,
        [*start, factor],
        bounds=([*least, -np.inf], np.inf),
        x_scale=[high - low] * len(start) + [abs(factor)],
        loss="soft_l1",
        f_scale=OUTLIER * usual,
    )
    return steps @ found.x[:-1]


def _speeds(speed: Speed, x_px: NDArray, y_px: NDArray, z_um: NDArray) -> NDArray[np.float64]:
    """What `speed` returns (n,), if it is a number for each place."""
    values = numbers("speed", speed(x_px, y_px, z_um))
    if values.shape != z_um.shape or not values.any():
        raise ValueError(
            f"speed: got values of shape {values.shape}, allowed is one for each of {len(z_um)} places, not all 0"
        )
    return values


def _followed(table: pd.DataFrame) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (n,) of particles in one frame and in the next: those that are each other's nearest."""
    place = table[["x_px", "y_px", "slice"]].to_numpy() / MOVED
    frame, rows = table["frame"].to_numpy(), []
    for k in np.unique(frame):
        here, there = np.flatnonzero(frame == k), np.flatnonzero(frame == k + 1)
        if len(there):
            distance, j = KDTree(place[there]).query(place[here])
            back = KDTree(place[here]).query(place[there])[1]
            mutual = (distance < 1) & (back[j] == np.arange(len(here)))
            rows.append(np.column_stack([here, there[j]])[mutual])
    rows = np.concatenate(rows) if rows else np.zeros((0, 2), int)
    if len(rows) < LEAST_PAIRS:
        raise ValueError(
            f"speed: got {len(rows)} particles that can be followed from a frame to the next, needed are "
            f"{LEAST_PAIRS}: frames that follow each other sooner, or more of them"
        )
    return rows[:, 0], rows[:, 1]
