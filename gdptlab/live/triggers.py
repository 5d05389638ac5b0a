"""Triggers: a fraction of the particles of a frame, what is uncertain of it, and when to act on it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
import pandas as pd
from scipy.special import betaincinv, ndtr, ndtri

from gdptlab._checks import choice, flag, function, instance, positive, whole
from gdptlab.experiment.channel import Channel
from gdptlab.experiment.trigger import in_middle_third

if TYPE_CHECKING:
    from gdptlab.live.monitor import Result


class Fraction(float):
    """A fraction of the particles in view, a number, that knows the band in which the sample's own fraction lies.

    Attributes
    ----------
    low, high : float
        Below `low`, and above `high`, the fraction of the sample lies with the stated rate of false alarms each.
    """

    low: float
    high: float

    def __new__(cls, value: float, low: float, high: float) -> Self:
        self = super().__new__(cls, value)
        self.low, self.high = float(low), float(high)
        return self

    def __getnewargs__(self) -> tuple[float, float, float]:
        return float(self), self.low, self.high


def fraction_of(inside: np.ndarray, chance: np.ndarray, false_alarms: float) -> Fraction:
    """Return the fraction of particles inside, with its band.

    Those in view are a few of the sample: that alone gives the binomial (Clopper-Pearson) interval, whose rate of
    false alarms is never above the stated one. Error bars at the boundary widen it: particle i is inside with
    probability q_i, and adds q_i (1 - q_i) / n² to the variance. The two widths add up as squares.

    Parameters
    ----------
    inside : bool array (n,)
    chance : float array (n,)
        q_i, probability that each is inside, given its position and standard deviation.
    false_alarms : float
    """
    n, k = len(inside), int(np.count_nonzero(inside))
    if n == 0:
        return Fraction(np.nan, np.nan, np.nan)
    value = k / n
    low = betaincinv(k, n - k + 1, false_alarms) if k else 0.0
    high = betaincinv(k + 1, n - k, 1 - false_alarms) if k < n else 1.0
    boundary = ndtri(1 - false_alarms) * np.sqrt(np.sum(chance * (1 - chance))) / n
    low, high = value - np.hypot(value - low, boundary), value + np.hypot(high - value, boundary)
    return Fraction(value, max(low, 0.0), min(high, 1.0))


@dataclass(frozen=True, kw_only=True)
class MiddleThird:
    """Fraction of the particles in the middle third of the channel's height or width: the paper's two triggers.

    Attributes
    ----------
    of : str
        'h' (|z| ≤ h/6) or 'w' (|y| ≤ w/6), as in `experiment.fractions`.
    channel : Channel
    to_channel : callable
        Table of an evaluator -> the same with `y_channel_um` and `z_um`, and, if known, their standard deviations
        `y_std_um` and `z_std_um`; for example `Film.to_channel`.
    false_alarms : float
        Probability, above 0 and below 0.5, that the sample's fraction lies below the band, and that it lies above it.

    Raises
    ------
    TypeError, ValueError
        If a field is not of its kind.
    """

    of: str
    channel: Channel
    to_channel: Callable[[pd.DataFrame], pd.DataFrame]
    false_alarms: float = 0.05

    def __post_init__(self) -> None:
        choice("of", self.of, "hw")
        instance("channel", self.channel, Channel)
        function("to_channel", self.to_channel)
        if not positive("false_alarms", self.false_alarms) < 0.5:
            raise ValueError(f"false_alarms: got {self.false_alarms:g}, allowed is above 0 and below 0.5")

    def __call__(self, table: pd.DataFrame) -> Fraction:
        """Return the fraction and its band; NaN without particles."""
        table = self.to_channel(table)
        inside = in_middle_third(table, self.of, self.channel)
        at, std, size_um = ("z_um", "z_std_um", self.channel.height_um)
        if self.of == "w":
            at, std, size_um = ("y_channel_um", "y_std_um", self.channel.width_um)
        chance = inside.astype(float)
        if std in table:
            x, s = table[at].to_numpy(), np.maximum(table[std].to_numpy(), 1e-9)
            chance = ndtr((size_um / 6 - x) / s) - ndtr((-size_um / 6 - x) / s)
        return fraction_of(inside, chance, self.false_alarms)


def middle_thirds(
    channel: Channel, to_channel: Callable[[pd.DataFrame], pd.DataFrame], false_alarms: float = 0.05
) -> dict[str, MiddleThird]:
    """Return the `MiddleThird` of height, 'h', and of width, 'w', which convert the table of a frame only once.

    Parameters
    ----------
    channel, to_channel, false_alarms
        As of `MiddleThird`.

    Raises
    ------
    TypeError, ValueError
        If one is not of its kind.
    """
    function("to_channel", to_channel)
    last: tuple[pd.DataFrame | None, pd.DataFrame | None] = (None, None)

    def converted(table: pd.DataFrame) -> pd.DataFrame:
        """Convert a table, unless it is the one converted last."""
        nonlocal last
        if table is not last[0]:
            last = table, to_channel(table)
        return last[1]

    return {of: MiddleThird(of=of, channel=channel, to_channel=converted, false_alarms=false_alarms) for of in "hw"}


@dataclass(frozen=True, kw_only=True)
class Trigger:
    """When to act.

    The trigger goes on with the first frame whose fraction is at or above `level`, and off again with the first whose
    fraction is below `release`. Between the two, and in a frame with fewer than `least` particles, it does not change.

    Attributes
    ----------
    name : str
    fraction : callable
        Table of the evaluator -> number or `Fraction`, such as a `MiddleThird`. A NaN changes nothing.
    action : callable
        Called with the `Result` when the trigger goes on, in the evaluating thread: the next frame waits for it.
    released : callable, optional
        Called with the `Result` when the trigger goes off.
    level : float
        Fraction at which the trigger goes on (paper: 0.9).
    release : float
        Fraction below which the trigger goes off; at most `level`.
    least : int
        Smallest number of particles in a frame that may change the trigger.
    sure : bool
        Go on only when the lower end of the fraction's band is at or above `level`: then the sample's fraction is
        below it with no more than the band's rate of false alarms. Without it the fraction itself decides, as in
        the paper; so it does where `fraction` gives a number without a band.

    Raises
    ------
    TypeError, ValueError
        If a field is not of its kind or out of range.
    """

    name: str
    fraction: Callable[[pd.DataFrame], float | Fraction]
    action: Callable[["Result"], object]
    released: Callable[["Result"], object] | None = None
    level: float = 0.9
    release: float = 0.8
    least: int = 5
    sure: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise TypeError(f"name: got {self.name!r}, allowed is a word")
        for part in ("fraction", "action", "released"):
            if part != "released" or self.released is not None:
                function(part, getattr(self, part))
        positive("level", self.level)
        if positive("release", self.release, zero=True) > self.level:
            raise ValueError(f"release: got {self.release:g}, allowed is up to level, {self.level:g}")
        whole("least", self.least, 0, 2**31)
        flag("sure", self.sure)

    def after(self, on: bool, fraction: float | Fraction, count: int) -> bool:
        """Return whether the trigger is on after a frame, given whether it was on before."""
        fraction = as_fraction(fraction)
        if count < self.least:
            return on
        if on:
            return not fraction < self.release
        return bool((fraction.low if self.sure else fraction) >= self.level)


def as_fraction(value: float | Fraction) -> Fraction:
    """Return what a trigger's function gave as a `Fraction`; a number is its own band."""
    return value if isinstance(value, Fraction) else Fraction(value, value, value)
