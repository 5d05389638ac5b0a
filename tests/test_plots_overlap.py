"""Pictures of overlap show the data they are given."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gdptlab import plots
from gdptlab.plots.style import COLOURS


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


def test_found_missed_and_false_are_told_apart() -> None:
    image = np.random.default_rng(1).normal(500, 38, (40, 60))
    true = pd.DataFrame({"x_px": [5.0, 30.0, 50.0], "y_px": [6.0, 20.0, 30.0]})
    measured = {"one": pd.DataFrame({"x_px": [5.2, 41.0], "y_px": [6.1, 11.0]}), "two": true.iloc[::-1]}
    pairs = {"one": pd.DataFrame({"measured": [0], "true": [0]})}
    pairs["two"] = pd.DataFrame({"measured": [0, 1, 2], "true": [0, 1, 2]})
    left = {"one": np.full((40, 60), 7.0), "two": np.zeros((40, 60))}
    figure = plots.found_and_left(image, true, measured, pairs, left)
    first, second, below, _, bar = figure.axes
    found, missed, false = (c.get_offsets().tolist() for c in first.collections)
    assert (found, missed, false) == ([[5, 6]], [[30, 20], [50, 30]], [[41, 11]])
    assert first.get_title(loc="left") == "one: 1 found, 2 missed, 1 false"
    assert second.get_title(loc="left") == "two: 3 found, 0 missed, 0 false"
    np.testing.assert_array_equal(below.images[0].get_array(), left["one"])
    assert below.images[0].get_clim() == (-plots.RESIDUAL_END, plots.RESIDUAL_END)
    assert bar.get_ylabel() == "residual (noise of a pixel)"
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["found", "missed", "false"]


def test_a_particle_laid_bare_has_a_scale_for_each_half_of_its_row() -> None:
    rng = np.random.default_rng(2)
    frame, neighbours, alone = (rng.uniform(0, top, (9, 9)) for top in (100, 90, 10))
    rows = {"a": (frame, neighbours, frame - neighbours, alone)}
    figure = plots.laid_bare(rows, ["1", "2", "3", "4"], 0.3)
    limits = [axes.images[0].get_clim() for axes in figure.axes]
    assert limits[0] == limits[1] and limits[2] == limits[3] and limits[0] != limits[2]
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["1", "2", "3", "4"]
    assert figure.axes[0].get_ylabel() == "a"
    np.testing.assert_array_equal(figure.axes[3].images[0].get_array(), alone)


def test_error_ratios_keep_what_is_beyond_the_scale() -> None:
    table = pd.DataFrame({"x": [-1.0, 0.0, 1.0, 99.0], "z": [1.0, 1.0, 1.0, 1.0]})
    figure = plots.error_ratios({"few": table}, limit=6)
    left, right = figure.axes
    (stairs,) = left.patches
    density, edges, _ = stairs.get_data()
    assert edges[[0, -1]].tolist() == [-6, 6]
    np.testing.assert_allclose((density * np.diff(edges)).sum(), 1)
    assert density[-1] > 0  # the one at 99
    assert right.get_title(loc="left") == "z\nfew: 1.5 robust, 1.0 plain"
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["normal", "few, n = 4"]


def test_film_followed_marks_where_a_measured_fraction_reaches_the_level() -> None:
    t = np.array([0.0, 1.0, 2.0])
    never = pd.DataFrame({"t_s": t, "valid": [0.3, 0.2, 0.1], "fraction_h": 0.4, "fraction_w": [np.nan, 0.2, 0.3]})
    good = pd.DataFrame({"t_s": t, "valid": 1.0, "fraction_h": [0.5, 0.95, 1.0], "fraction_w": [0.4, 0.6, 0.92]})
    true = pd.DataFrame({"t_s": t, "fraction_h": [0.5, 0.9, 1.0], "fraction_w": [0.4, 0.6, 0.9]})
    triggers = {"h": 1.0, "w": 2.0}
    figure = plots.film_followed({"one": never, "two": good}, true, triggers, 0.9)
    valid, height, width = figure.axes
    np.testing.assert_array_equal(valid.get_lines()[3].get_ydata(), good["valid"])
    assert [line.get_xdata()[0] for line in valid.get_lines()[:2]] == [1.0, 2.0]
    for panel, at in ((height, 1.0), (width, 2.0)):
        (triangle,) = (line for line in panel.get_lines() if line.get_marker() == "v")
        assert triangle.get_xdata() == [at] and triangle.get_color() == COLOURS[1]
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["one", "two", "true"]
