"""Pictures of speed show the data they are given."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gdptlab import plots


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


def test_frame_times_has_a_panel_for_each_thing_varied() -> None:
    rows = [("N", v, m, v * k) for v in (9, 3) for k, m in enumerate("ab", 1)]
    rows += [("frame (px)", 256, "a", 4.0), ("frame (px)", 512, "a", 20.0), ("frame (px)", 256, "b", 30.0)]
    times = pd.DataFrame(rows, columns=["varied", "value", "method", "ms"])
    figure = plots.frame_times(times, {"one FFT": pd.Series({256: 0.2, 512: 0.9})})
    left, right = figure.axes
    assert [a.get_xlabel() for a in figure.axes] == ["N", "frame (px)"]
    np.testing.assert_array_equal(left.get_lines()[1].get_xydata(), [[3, 6], [9, 18]])
    assert [t.get_text() for t in right.get_xticklabels()] == ["256", "512"]
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["a", "b", "one FFT"]
    assert [line.get_label() for line in left.get_lines()] == ["a", "b"]


def test_parts_follow_each_other() -> None:
    figure = plots.breakdown(pd.Series({"first": 2.0, "second": 0.5, "third": 4.0}))
    bars = figure.axes[0].patches
    assert [(bar.get_x(), bar.get_width()) for bar in bars] == [(0, 2), (2, 0.5), (2.5, 4)]
    assert [t.get_text() for t in figure.axes[0].texts] == ["2.0 ms", "0.5 ms", "4.0 ms"]


def test_scaling_is_beside_what_is_in_proportion() -> None:
    figure = plots.scaling(pd.Series({1: 40.0, 2: 70.0}))
    ideal, measured = figure.axes[0].get_lines()
    np.testing.assert_array_equal(ideal.get_xydata(), [[0, 0], [2, 80]])
    np.testing.assert_array_equal(measured.get_xydata(), [[1, 40], [2, 70]])


def test_real_time_shows_ages_in_milliseconds() -> None:
    used = pd.DataFrame({"t_s": [0.0, 0.04, 0.12], "decision_s": [0.01, 0.09, 0.14]})
    figure = plots.real_time(used, 0.04, 1)
    np.testing.assert_allclose(figure.axes[0].get_lines()[0].get_ydata(), [10, 50, 20])
    assert figure.axes[0].get_title(loc="left") == "3 frames evaluated, 1 dropped"
