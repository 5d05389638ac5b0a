"""Pictures of quality show the data they are given, and the panel what `locate` finds."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gdptlab import locate, plots
from gdptlab.pipeline import ScanReport
from gdptlab.pipeline.settings import choose_settings


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


def test_calibration_page(calibration) -> None:
    beads = pd.DataFrame({"x_px": [20.0, 50.0], "y_px": [30.0, 9.0], "verdict": ["used", "clipped"]})
    n = len(calibration)
    drift = np.stack([np.linspace(-1, 1, n), np.zeros(n)], axis=1)
    clipped = np.where(np.arange(n) == 5, 0.5, 0)
    overview = np.ones((60, 80), np.float32)
    made = replace(calibration, report=ScanReport(beads, drift, clipped, pd.DataFrame(), overview, noise=38.0))
    figure = plots.calibration_page(made, shown=4)
    titles = [axes.get_title() + axes.get_title(loc="left") for axes in figure.axes]
    assert {"Drift", "Least error", "Visible (shaded: clipped)", "−50 µm", "+50 µm"} <= set(titles)
    labels = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert labels == ["used (1)", "clipped (1)"]
    np.testing.assert_allclose(figure.axes[titles.index("Drift")].get_lines()[0].get_ydata(), drift[:, 0])


def test_measured_page(few, calibration) -> None:
    settings = choose_settings([few[0]], calibration, method="correlation")
    table = locate(few[0], calibration, **settings.arguments)
    figure = plots.measured_page(few[0], table, settings, calibration)
    assert figure.axes[0].get_title(loc="left") == "4 particles"
    seen = [axes.get_title() for axes in figure.axes if axes.get_title().startswith("$C_m$")]
    assert len(seen) == 4
    plots.measured_page(few[0], table.iloc[:0], settings, calibration)  # nothing found, nothing raised


def test_symptoms(few, calibration) -> None:
    table = locate(few[0], calibration)
    figure = plots.symptoms({"well": (*few[:1], table, few[1]), "blind": (few[0], table.iloc[:0], few[1])})
    titles = [axes.get_title(loc="left") for axes in figure.axes[:2]]
    assert titles == ["well\n4 right, 0 wrong, 0 missed", "blind\n0 right, 0 wrong, 4 missed"]


def test_depth_against_truth() -> None:
    pairs = pd.DataFrame({"z_um": [1.0, 2.0], "dz_um": [0.5, -0.5]})
    dots = plots.depth_against_truth({"a": pairs}).axes[0].get_lines()[1]
    np.testing.assert_allclose(dots.get_xydata(), [[1, 1.5], [2, 1.5]])
