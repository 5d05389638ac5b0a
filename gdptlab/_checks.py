"""Checks of arguments: each names the argument, what came and what is allowed."""

import math
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

LARGEST = 1e12
"""Largest absolute value of a number in an array, in the array's unit. Derived: the square of the sum of 1e7 such
numbers, an image, is 1e38, which float32 still holds; ten times more would be infinity."""

RESOLVED = 1e-4
"""Largest spacing of float32 numbers, as a fraction of the contrast, at which `image_array` leaves the offset in.
Derived: rounding to it adds noise of 0.3 spacings (1 / sqrt(12)), 3e-5 of the contrast."""


def number(name: str, value: Any) -> float:
    """Return `value` as a float if it is a finite number.

    Raises
    ------
    TypeError
        If `value` is not a real number.
    ValueError
        If it is not finite.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name}: got {value!r}, allowed is a finite number")
    if not math.isfinite(value):
        raise ValueError(f"{name}: got {value!r}, allowed is a finite number")
    return float(value)


def positive(name: str, value: Any, *, zero: bool = False) -> float:
    """Return `value` as a float if it is a finite number above zero (or zero, if allowed).

    Raises
    ------
    TypeError
        If `value` is not a real number.
    ValueError
        If it is not finite, negative, or zero where that is not allowed.
    """
    allowed = "a finite number, at least 0" if zero else "a finite number above 0"
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name}: got {value!r}, allowed is {allowed}")
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise ValueError(f"{name}: got {value!r}, allowed is {allowed}")
    return float(value)


def whole(name: str, value: Any, low: int, high: int) -> int:
    """Return `value` as an int if it is a whole number from `low` to `high`.

    Raises
    ------
    TypeError
        If `value` is not a whole number.
    ValueError
        If it is out of range.
    """
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise TypeError(f"{name}: got {value!r}, allowed are whole numbers from {low} to {high}")
    if not low <= value <= high:
        raise ValueError(f"{name}: got {value}, allowed are whole numbers from {low} to {high}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return `value` as a bool if it is True or False.

    Raises
    ------
    TypeError
        If it is neither.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: got {value!r}, allowed are True and False")
    return bool(value)


def choice(name: str, value: Any, allowed: Iterable[str]) -> str:
    """Return `value` if it is one of the `allowed` words.

    Raises
    ------
    ValueError
        If it is not.
    """
    allowed = list(allowed)
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name}: got {value!r}, allowed are {', '.join(map(repr, allowed))}")
    return value


def table(name: str, value: Any, columns: Iterable[str]) -> pd.DataFrame:
    """Return `value` if it is a table with real numbers in these columns, and in `frame` if it has one.

    Raises
    ------
    TypeError
        If it is no table, or a column does not hold real numbers.
    ValueError
        If a column is missing.
    """
    if not isinstance(value, pd.DataFrame):
        raise TypeError(f"{name}: got a {type(value).__name__}, allowed is a DataFrame")
    columns = list(columns)
    missing = sorted(set(columns) - set(value))
    if missing:
        raise ValueError(f"{name}: got no column {missing}, needed are {', '.join(columns)}")
    for column in [*columns, *({"frame"} & set(value))]:
        if value[column].dtype.kind not in "buif":
            raise TypeError(f"{name}: got {column} of type {value[column].dtype}, allowed are real numbers")
    return value


def positions(name: str, value: Any, columns: Iterable[str]) -> pd.DataFrame:
    """Return `value` if it is a table with finite numbers, up to `LARGEST`, in these columns.

    Raises
    ------
    TypeError, ValueError
        If it is not.
    """
    columns = list(columns)
    if not (table(name, value, columns)[columns].astype(float).abs() <= LARGEST).all(axis=None):
        raise ValueError(f"{name}: got NaN, infinity or numbers beyond {LARGEST:g}, allowed are numbers to there")
    return value


def real_array(name: str, value: Any, ndim: int) -> NDArray[np.float32]:
    """Return `value` as a finite float32 array of `ndim` axes, none of them empty.

    Raises
    ------
    TypeError
        If `value` does not hold real numbers.
    ValueError
        If it has another number of axes, is empty, has masked entries, or holds NaN, infinity or numbers beyond
        `LARGEST`.
    """
    _refuse_masked(name, value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name}: got what is no array ({error}), allowed are {ndim} axes of real numbers") from error
    if array.dtype.kind not in "buif":
        raise TypeError(f"{name}: got values of type {array.dtype}, allowed are real numbers")
    if array.ndim != ndim or 0 in array.shape:
        colour = array.shape[ndim:] in ((3,), (4,))
        advice = f"; for a colour image take one channel, as in {name}[..., 1]" if colour else ""
        if array.ndim == ndim + 1 and array.size and not colour:
            advice = f"; of a film or a stack take one image, as in {name}[0]"
        raise ValueError(f"{name}: got shape {array.shape}, allowed are {ndim} axes, none of them empty{advice}")
    small = array.dtype.kind != "f" and array.dtype.itemsize <= 4  # the types of most cameras hold no NaN
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    if small:
        return array
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: got NaN or infinity, allowed are finite numbers that fit into float32")
    if max(array.max(), -array.min()) > LARGEST:
        raise ValueError(f"{name}: got numbers up to {np.abs(array).max():g}, allowed is up to {LARGEST:g}")
    return array


def image_array(name: str, value: Any, ndim: int) -> NDArray[np.float32]:
    """Return `value` as `real_array` does, but subtract an offset, the same everywhere, that would cost digits.

    Nothing that is measured depends on the level of an image. Float32 has 7 digits: without the subtraction, 1e9 counts
    of offset would leave steps of 64 counts.

    Raises
    ------
    TypeError, ValueError
        As `real_array`.
    """
    array = real_array(name, value, ndim)
    given = getattr(value, "dtype", np.dtype(float))
    if given.itemsize < 4 or given == np.float32:
        return array
    low, high = float(array.min()), float(array.max())
    if np.spacing(np.float32(max(abs(low), abs(high)))) <= RESOLVED * (high - low):
        return array
    exact = np.asarray(value)
    offset = exact.flat[0] if exact.dtype.kind in "iu" else exact.mean(dtype=np.float64)
    return np.ascontiguousarray(np.subtract(exact, offset, dtype=np.float64), dtype=np.float32)


def _refuse_masked(name: str, value: Any) -> None:
    """Refuse an array with masked entries, or a list with one in it: numpy would use what is under the mask."""
    parts = [value, *value] if isinstance(value, list | tuple) else [value]
    if any(np.ma.is_masked(part) for part in parts):
        raise ValueError(f"{name}: got masked entries, allowed is an array without (see numpy.ma.filled)")


def depths(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return `value` as depths (N,), which need more digits than images have.

    Raises
    ------
    TypeError
        If `value` does not hold real numbers.
    ValueError
        If it is no list of finite numbers, or they do not strictly increase or decrease.
    """
    real_array(name, value, 1)
    value = np.array(value, dtype=np.float64)
    steps = np.diff(value)
    if not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError(f"{name}: got depths that turn or repeat, allowed are strictly increasing or decreasing")
    return value
