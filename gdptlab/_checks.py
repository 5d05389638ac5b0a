"""Checks of arguments. Each returns the value, or raises an error: the argument, what came and what is allowed.

It is a TypeError if the value is of another kind, such as a word for a number, and a ValueError if it is out of range.
"""

import math
import os
from collections.abc import Iterable
from numbers import Integral, Real
from pathlib import Path
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
    """Return `value` as a float if it is a finite number."""
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name}: got {value!r}, allowed is a finite number")
    if not math.isfinite(value):
        raise ValueError(f"{name}: got {value!r}, allowed is a finite number")
    return float(value)


def positive(name: str, value: Any, *, zero: bool = False, infinite: bool = False) -> float:
    """Return `value` as a float if it is a finite number above zero (or zero, or infinity, if allowed)."""
    allowed = "a finite number, at least 0" if zero else "a finite number above 0"
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name}: got {value!r}, allowed is {allowed}")
    if infinite and value == math.inf:
        return math.inf
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise ValueError(f"{name}: got {value!r}, allowed is {allowed}")
    return float(value)


def depth_factor(name: str, value: Any) -> float:
    """Return depth over travel, 0.1 to 10, from it or from the refractive indices (immersion, sample)."""
    if isinstance(value, tuple | list):
        if len(value) != 2:
            raise ValueError(f"{name}: got {value!r}, allowed are two refractive indices: immersion, sample")
        value = positive(name, value[1]) / positive(name, value[0])
    if not 0.1 <= positive(name, value) <= 10:
        raise ValueError(f"{name}: got {value:g}, allowed is 0.1 to 10")
    return float(value)


def rate(name: str, value: Any) -> float:
    """Return `value` as a float if it is a number of frames in a second, 1e-9 to 1e9."""
    if not 1e-9 <= positive(name, value) <= 1e9:
        raise ValueError(f"{name}: got {value!r}, allowed is 1e-9 to 1e9")
    return float(value)


def whole(name: str, value: Any, low: int, high: int) -> int:
    """Return `value` as an int if it is a whole number from `low` to `high`."""
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise TypeError(f"{name}: got {value!r}, allowed are whole numbers from {low} to {high}")
    if not low <= value <= high:
        raise ValueError(f"{name}: got {value}, allowed are whole numbers from {low} to {high}")
    return int(value)


def processes(name: str, value: Any) -> int:
    """Return `value` as an int if it is a number of processes, 1 to 10 000, or -1, one for each core."""
    return -1 if np.ndim(value) == 0 and value == -1 else whole(name, value, 1, 10_000)


def flag(name: str, value: Any) -> bool:
    """Return `value` as a bool if it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: got {value!r}, allowed are True and False")
    return bool(value)


def choice(name: str, value: Any, allowed: Iterable[str]) -> str:
    """Return `value` if it is one of the `allowed` words."""
    allowed = list(allowed)
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name}: got {value!r}, allowed are {', '.join(map(repr, allowed))}")
    return value


def instance(name: str, value: Any, kind: type) -> Any:
    """Return `value` if it is of this class."""
    if not isinstance(value, kind):
        raise TypeError(f"{name}: got {value!r}, allowed is a {kind.__name__}")
    return value


def iterable(name: str, value: Any) -> Any:
    """Return `value` if one can go through it."""
    try:
        iter(value)
    except TypeError as error:
        raise TypeError(f"{name}: got a {type(value).__name__}, allowed is a list or the like") from error
    return value


def instances(name: str, value: Any, kind: type) -> list:
    """Return `value` as a list if it holds nothing but objects of this class."""
    value = list(iterable(name, value))
    for item in value:
        if not isinstance(item, kind):
            raise TypeError(f"{name}: got {item!r} in it, allowed are objects of the class {kind.__name__}")
    return value


def function(name: str, value: Any) -> None:
    """Raise TypeError unless `value` can be called."""
    if not callable(value):
        raise TypeError(f"{name}: got {value!r}, allowed is a function")


def pair(name: str, value: Any) -> tuple[int, int]:
    """Return `value` as (rows, columns) if it is a pair of whole numbers from 1 to 2**20."""
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise TypeError(f"{name}: got {value!r}, allowed is a pair (rows, columns)")
    return whole(f"{name}[0]", value[0], 1, 2**20), whole(f"{name}[1]", value[1], 1, 2**20)


def numbers(name: str, value: ArrayLike, low: float = -LARGEST, high: float = LARGEST) -> NDArray[np.float64]:
    """Return `value` as a float64 array of its shape if all of it are numbers from `low` to `high`."""
    array = _real(name, value).astype(np.float64)
    outside = ~((array >= low) & (array <= high))  # in this form NaN is outside
    if outside.any():
        raise ValueError(f"{name}: got {array[outside].flat[0]}, allowed is {low:g} to {high:g}")
    return array


def generator(name: str, value: Any) -> np.random.Generator:
    """Return numpy's generator of random numbers: `value`, or the one with this seed."""
    if isinstance(value, np.random.Generator):
        return value
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name}: got {value!r}, allowed is an integer seed or a numpy Generator")
    if value < 0:
        raise ValueError(f"{name}: got {value!r}, allowed is a seed of at least 0")
    return np.random.default_rng(int(value))


def path(name: str, value: Any, *suffixes: str) -> Path:
    """Return `value` as a path if it can be one, and if its name ends in one of the `suffixes`, where there are any."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name}: got a {type(value).__name__}, allowed is a path")
    if suffixes and Path(value).suffix not in suffixes:
        raise ValueError(f"{name}: got {Path(value).name!r}, allowed are names that end in {' or '.join(suffixes)}")
    return Path(value)


def table(name: str, value: Any, columns: Iterable[str]) -> pd.DataFrame:
    """Return `value` if it is a table with real numbers in these columns, and in `frame` if it has one."""
    if not isinstance(value, pd.DataFrame):
        raise TypeError(f"{name}: got a {type(value).__name__}, allowed is a DataFrame")
    columns = list(columns)
    missing = sorted(set(columns) - set(value), key=str)
    if missing:
        raise ValueError(f"{name}: got no column {missing}, needed are {', '.join(map(str, columns))}")
    for column in [*columns, *({"frame"} & set(value))]:
        if value[column].dtype.kind not in ("buif" if len(value) else "buifO"):  # without rows often without a type
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
    """Return `value` as a finite float32 array of `ndim` axes, none of them empty; masked entries are refused."""
    array = _real(name, value)
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


def _real(name: str, value: Any) -> NDArray:
    """Return `value` as an array of real numbers without masked entries."""
    _refuse_masked(name, value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name}: got what is no array ({error}), allowed are real numbers") from error
    if array.dtype.kind not in "buif":
        raise TypeError(f"{name}: got values of type {array.dtype}, allowed are real numbers")
    return array


def _refuse_masked(name: str, value: Any) -> None:
    """Refuse an array with masked entries, or a list with one in it: numpy would use what is under the mask."""
    parts = [value, *value] if isinstance(value, list | tuple) else [value]
    if any(np.ma.is_masked(part) for part in parts):
        raise ValueError(f"{name}: got masked entries, allowed is an array without (see numpy.ma.filled)")


def depths(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return `value` as depths (N,), which need more digits than images have."""
    real_array(name, value, 1)
    value = np.array(value, dtype=np.float64)
    steps = np.diff(value)
    if not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError(f"{name}: got depths that turn or repeat, allowed are strictly increasing or decreasing")
    return value
