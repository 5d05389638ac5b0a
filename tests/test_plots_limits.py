"""Pictures of limits show the data they are given."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gdptlab import plots

Z_UM = np.array([-20.0, 0.0, 20.0])


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


@pytest.fixture
def expected():
    return pd.DataFrame({"z_um": Z_UM, "x_std_px": [0.1, 0.2, 0.3], "y_std_px": 0.2, "z_std_um": [1.0, 2.0, 4.0]})


def test_expected_errors(expected) -> None:
    figure = plots.expected_errors({"a": expected, "b": 2 * expected})
    lines = figure.axes[2].get_lines()
    assert [line.get_ydata().tolist() for line in lines] == [[1, 2, 4], [2, 4, 8]]
    assert figure.axes[0].get_ylabel() == "least error of x (px)"


def test_errors_stand_beside_the_bound_with_their_intervals(expected) -> None:
    table = pd.DataFrame(index=[-10.0, 10.0])
    for name, value in {"sigma_x_px": 0.3, "sigma_y_px": 0.4, "sigma_z_um": 3.0}.items():
        table[name], table[f"{name}_low"], table[f"{name}_high"] = value, 0.9 * value, 1.2 * value
    figure = plots.errors_against_bound(expected, {"one": table, "two": table})
    panel = figure.axes[2]
    assert panel.get_yscale() == "log"
    first, second = (c.lines[0] for c in panel.containers)
    assert first.get_ydata().tolist() == [3, 3] and (first.get_xdata() < second.get_xdata()).all()
    ends = panel.containers[0].lines[2][0].get_segments()[0][:, 1]
    np.testing.assert_allclose(ends, [2.7, 3.6])
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["impossible", "one", "two"]


def test_biases_have_a_band_of_a_third() -> None:
    table = pd.DataFrame({"mean": [0.1, -0.4], "sem": 0.02, "std": 0.9}, index=[0.0, 1.0])
    tables = {"dx (px) against x (px)": {"a": table, "b": table}, "dz (µm) against z (µm)": {"a": table}}
    figure = plots.biases(tables)
    panel = figure.axes[0]
    assert panel.get_xlabel() == "x (px)" and panel.get_ylabel() == "mean dx (px)"
    box = panel.patches[0].get_extents().transformed(panel.transData.inverted())
    np.testing.assert_allclose([box.y0, box.y1], [-0.3, 0.3])
    assert panel.get_ylim()[1] >= 0.42
