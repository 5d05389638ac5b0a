"""Checks of arguments: the message names the argument, what came and what is allowed."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import _checks as check


def test_number():
    assert check.number("at", np.float32(-2)) == -2
    for value, error in ((np.nan, ValueError), (-np.inf, ValueError), ("1", TypeError), (True, TypeError)):
        with pytest.raises(error, match=f"^at: .*{value!r}"):
            check.number("at", value)


@pytest.mark.parametrize("value", [1, 0.5, np.float32(2), np.int64(3)])
def test_positive_returns_a_float(value):
    assert check.positive("gap", value) == value
    assert type(check.positive("gap", value)) is float
    assert check.positive("gap", 0, zero=True) == 0


@pytest.mark.parametrize("value", [0, -1, np.nan, np.inf])
def test_positive_refuses_values(value):
    with pytest.raises(ValueError, match=rf"^gap: .*{value}"):
        check.positive("gap", value)


@pytest.mark.parametrize("value", ["1", None, True, 1j, [1]])
def test_positive_refuses_types(value):
    with pytest.raises(TypeError, match=r"^gap: "):
        check.positive("gap", value, zero=True)


@pytest.mark.parametrize("value", [2, 5, np.uint8(3)])
def test_whole_returns_an_int(value):
    assert check.whole("n", value, 2, 5) == value
    assert type(check.whole("n", value, 2, 5)) is int


@pytest.mark.parametrize(
    ("value", "error"), [(1, ValueError), (6, ValueError), (3.0, TypeError), ("3", TypeError), (True, TypeError)]
)
def test_whole_refuses(value, error):
    with pytest.raises(error, match=r"^n: .*2.*5"):
        check.whole("n", value, 2, 5)


def test_choice():
    assert check.choice("axis", "y", "xy") == "y"
    for value in ("z", None, 3):
        with pytest.raises(ValueError, match=f"^axis: .*{value!r}"):
            check.choice("axis", value, "xy")


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, np.float16, np.float64, ">u2"])
def test_real_array_gives_float32_of_any_real_type(dtype):
    given = np.array([[0, 1, 1], [1, 0, 1]], dtype=dtype)
    array = check.real_array("image", given, 2)
    assert array.dtype == np.float32 and array.flags.c_contiguous
    np.testing.assert_array_equal(array, given)


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ([1, 2], ValueError, r"\(2,\)"),
        (np.zeros((0, 3)), ValueError, r"\(0, 3\)"),
        (
            np.zeros((4, 5, 3)),
            ValueError,
            "channel",
        ),
        ([[1j]], TypeError, "complex128"),
        ([["a"]], TypeError, "<U1"),
        ([[None]], TypeError, "object"),
        ([[np.nan]], ValueError, "NaN"),
        ([[-np.inf]], ValueError, "infinity"),
        ([[1e39]], ValueError, "float32"),
    ],
)
def test_real_array_refuses(value, error, message):
    with pytest.raises(error, match=f"^image: .*{message}"):
        check.real_array("image", value, 2)


def test_a_table_without_rows_needs_no_types():
    empty = pd.DataFrame(columns=["frame", "x_px"])
    assert check.table("a", empty, ["x_px"]) is empty
    with pytest.raises(TypeError, match=r"^a: .*x_px"):
        check.table("a", pd.DataFrame({"x_px": ["b"]}), ["x_px"])


@pytest.mark.parametrize(
    ("call", "bad", "error"),
    [
        (lambda v: check.instance("a", v, str), 3, TypeError),
        (lambda v: check.instances("a", v, str), ["b", 3], TypeError),
        (lambda v: check.instances("a", v, str), None, TypeError),
        (lambda v: check.iterable("a", v), 3, TypeError),
        (lambda v: check.function("a", v), 3, TypeError),
        (lambda v: check.pair("a", v), 3, TypeError),
        (lambda v: check.pair("a", v), (0, 3), ValueError),
        (lambda v: check.numbers("a", v, 0, 5), [3, 6], ValueError),
        (lambda v: check.numbers("a", v), [np.nan], ValueError),
        (lambda v: check.numbers("a", v), ["b"], TypeError),
        (lambda v: check.generator("a", v), -1, ValueError),
        (lambda v: check.generator("a", v), 0.5, TypeError),
        (lambda v: check.path("a", v), 3, TypeError),
        (lambda v: check.path("a", v, ".csv"), "b.txt", ValueError),
        (lambda v: check.processes("a", v), 0, ValueError),
    ],
)
def test_what_is_not_as_it_should_be_is_refused_by_name(call, bad, error):
    with pytest.raises(error, match=r"^a\b"):
        call(bad)


def test_what_is_as_it_should_be_comes_back():
    rng = np.random.default_rng(1)
    assert check.generator("a", rng) is rng and check.generator("a", 1).random() == rng.random()
    assert check.instances("a", ("b", "c"), str) == ["b", "c"] and check.pair("a", [2, 3]) == (2, 3)
    assert check.path("a", "b.csv", ".csv").name == "b.csv" and check.processes("a", -1) == -1
    np.testing.assert_array_equal(check.numbers("a", [[1, 2]], 0, 2), [[1.0, 2.0]])
