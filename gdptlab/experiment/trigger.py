"""The paper's triggers: when 90 % of the particles are in the middle third of the channel's height or width."""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import choice, instance, numbers, positive
from gdptlab._checks import table as check_table
from gdptlab.experiment.channel import Channel


def fractions(table: pd.DataFrame, frames: ArrayLike, channel: Channel) -> pd.DataFrame:
    """Return the fraction of particles in the middle third of height and width, frame by frame.

    Parameters
    ----------
    table : DataFrame
        Particles, measured or true, in channel coordinates: `frame`, `y_channel_um`, `z_um` (see `Film.to_channel`).
    frames : array (n,)
        Frames to report, increasing, with or without particles; others are ignored.
    channel : Channel

    Returns
    -------
    DataFrame
        `frame`; `count`, the number of particles; `fraction_h` with |z| ≤ h/6 and `fraction_w` with |y| ≤ w/6.
        A frame without particles has count 0 and NaN fractions, which are not at or above any level.

    Raises
    ------
    ValueError
        If a column is missing or the frames do not increase.
    """
    check_table("table", table, ["frame", "y_channel_um", "z_um"])
    numbers("frames", frames)
    frames = np.asarray(frames)
    if frames.ndim != 1 or (np.diff(frames) <= 0).any():
        raise ValueError(f"frames: got {frames}, allowed are increasing numbers")
    table = table[table["frame"].isin(frames)]
    row = np.searchsorted(frames, table["frame"])
    count = np.bincount(row, minlength=len(frames))
    inside = {f"fraction_{of}": in_middle_third(table, of, channel) for of in "hw"}
    empty = np.where(count > 0, 0.0, np.nan)
    fractions = {
        name: np.bincount(row, weights=yes, minlength=len(frames)) / np.maximum(count, 1) + empty
        for name, yes in inside.items()
    }
    return pd.DataFrame({"frame": frames, "count": count} | fractions)


def in_middle_third(table: pd.DataFrame, of: str, channel: Channel) -> NDArray[np.bool_]:
    """Tell which particles (n,) of a table in channel coordinates have |z| ≤ h/6 (of 'h') or |y| ≤ w/6 (of 'w')."""
    instance("channel", channel, Channel)
    sides = {"h": ("z_um", channel.height_um), "w": ("y_channel_um", channel.width_um)}
    column, size_um = sides[choice("of", of, sides)]
    check_table("table", table, [column])
    return np.abs(table[column].to_numpy()) <= size_um / 6


def trigger_time(times_s: ArrayLike, fraction: ArrayLike, level: float = 0.9) -> float:
    """Return the first time at which `fraction` is at or above `level`; NaN if it never is.

    Parameters
    ----------
    times_s, fraction : arrays (n,)
        NaN fractions do not trigger.
    level : float
        Fraction that triggers, in (0, 1] (paper: 0.9).
    """
    times, fraction = numbers("times_s", times_s), np.asarray(fraction)
    if fraction.dtype.kind not in "buif" or fraction.shape != times.shape or times.ndim != 1:
        raise ValueError(f"fraction: got {fraction!r}, allowed is a number for each of the times")
    hits = np.flatnonzero(fraction >= _level(level))
    return float(times[hits[0]]) if len(hits) else np.nan


def _level(level: float) -> float:
    """Return `level` if it is above 0 and at most 1."""
    if not 0 < positive("level", level) <= 1:
        raise ValueError(f"level: got {level}, allowed is above 0 to 1")
    return level
