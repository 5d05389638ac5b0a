"""Pictures of the experiment show the data they are given."""

import sys

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from gdptlab import plots
from gdptlab.experiment import replay
from gdptlab.experiment.channel import Focusing, Trajectories
from gdptlab.experiment.film import Film

LABELS = pd.DataFrame({"n": [51, 6, 6], "n_sub": [9, 6, 4], "refine": [True, False, True]})


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


@pytest.fixture(scope="module")
def monitor() -> pd.DataFrame:
    """A film of 5 s whose fractions rise evenly, the measured ones 0.4 s late."""
    t = np.arange(25) / 5
    true, late = np.minimum(0.3 + 0.3 * t, 1), np.minimum(0.2 + 0.3 * t, 1)
    columns = {"seed": 1, "image_type": "fluorescent", "frame": np.arange(0, 125, 5), "t_s": t, "count": 20}
    columns |= {"fraction_h": late, "fraction_w": late, "true_count": 25, "true_fraction_h": true}
    return pd.DataFrame(columns | {"true_fraction_w": true, "level": 0.9, "true_h_s": 2.0, "true_w_s": 2.0})


@pytest.fixture
def points() -> pd.DataFrame:
    """Summary of three settings for both triggers; the last never fired."""
    rows = pd.concat([LABELS.assign(trigger=a, tau_s=[0.012, 0.01, 0.009]) for a in "hw"])
    rows = rows.assign(films=10, replays=80, failed=[0, 16, 80] * 2)
    return rows.assign(
        **{
            f"{kind}_{k}": [0.1, 0.3, np.nan] * 2
            for kind in ("error_s", "own_error_s")
            for k in ("median", "q25", "q75")
        }
    )


@pytest.fixture(scope="module")
def film() -> Film:
    return Film.seeded(1, mean_in_view=6, duration_s=5)


def texts(figure: Figure) -> str:
    return " ".join(t.get_text() for t in figure.findobj(plt.Text))


def test_figure_4_draws_every_particle_of_the_view_at_each_instant() -> None:
    trajectories = Trajectories.seeded(Focusing(), 1, mean_in_view=20, duration_s=5)
    figure = plots.fig4_acoustophoresis(trajectories, (0, 2.5))
    for panel, t in zip(figure.subfigs[1].get_axes(), (0, 2.5), strict=True):
        here = trajectories.positions(t)
        np.testing.assert_array_equal(panel.get_lines()[0].get_xydata(), here[["y_um", "z_um"]])
    assert all(word in texts(figure) for word in ("w = 200 µm", "h = 100 µm", "t = 2.5 s", "x (µm), downstream"))


def test_forces_and_flow_have_units() -> None:
    shown = texts(plots.forces_and_flow(Focusing()))
    assert all(word in shown for word in ("y (µm)", "z (µm)", "$u_y$ (µm/s)", "$u_z$ (µm/s)", "u (µm/s)"))


def test_focusing_in_time(monitor: pd.DataFrame) -> None:
    fraction = {a: monitor["true_fraction_h"] for a in "hw"}
    figure = plots.focusing_in_time(monitor["t_s"], fraction, monitor, {"h": 2.0, "w": 2.0}, 0.9)
    assert "= 2.00 s" in texts(figure)


def test_monitor_marks_when_each_measured_fraction_first_reaches_the_level(monitor: pd.DataFrame) -> None:
    figure = plots.monitor_in_time(monitor)
    marked = [line.get_xdata()[0] for line in figure.axes[0].get_lines() if line.get_marker() == "v"]
    assert marked == pytest.approx([2.4, 2.4])


def test_figure_5_shows_failures_as_crosses_that_count_films(points: pd.DataFrame) -> None:
    band = replay.expected_delay([0.005, 0.02], 0.2, 0.04)
    counts = {name: pd.Series([9, 8], index=[0.0, 1.0]) for name in ("full", "true")}
    figure = plots.fig5(points, band, counts, colour="n")
    strip = figure.axes[0]
    crosses = [line.get_xydata()[0].tolist() for line in strip.get_lines() if line.get_marker() == "x"]
    assert crosses == [pytest.approx([10, 2]), pytest.approx([9, 10])]  # ms, films
    assert all(word in texts(figure) for word in ("(a)", "(b)", "(c)", "evaluation time τ (ms)", "failed, of 10"))


def test_error_against_tau(points: pd.DataFrame) -> None:
    band = replay.expected_delay([0.04, 1, 5])
    figure = plots.error_against_tau(points, band, by="n", tau_here_s=0.011)
    assert "here: 11 ms" in texts(figure)


def test_templates_and_densities_say_how_many_failed(points: pd.DataFrame) -> None:
    points = points.assign(density=[25.0, 25.0, 50.0] * 2, size=[31, 61, 31] * 2)
    found = pd.DataFrame({"density": [25.0, 50.0], "size": 31, "t_s": 0.0, "fraction": 0.9})
    shown = texts(plots.templates_and_densities(points, found))
    assert all(word in shown for word in ("0/10", "× 2/10", "× 10/10", "50 particles in view"))


def test_one_moment_of_the_replay(film: Film, monitor: pd.DataFrame) -> None:
    measured = film.truth()
    figure = plots.replay_view(film, measured, monitor, 50)
    here = int((measured["frame"] == 50).sum())
    assert f"{here} measured (dots) of {here} (crosses)" in texts(figure)
    shared = [a for a in figure.axes if a.get_ylabel() == "fraction of particles"]
    assert max(line.get_xdata()[-1] for line in shared[0].get_lines()[1:]) == pytest.approx(2.0)


def test_instants() -> None:
    images = {name: np.random.default_rng(1).normal(500, 40, (60, 90)) for name in ("t = 0 s", "t = 1 s")}
    assert "t = 1 s" in texts(plots.instants(images, 0.65))


def test_slider(film: Film, monitor: pd.DataFrame) -> None:
    ipywidgets = pytest.importorskip("ipywidgets")
    view = plots.scrub(film, film.truth(), monitor)
    assert isinstance(view, ipywidgets.VBox)
    assert len(view.children[0].options) == len(monitor)


def test_slider_without_ipywidgets_says_what_to_install(
    film: Film, monitor: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=r"pip install 'gdptlab\[widgets\]'"):
        plots.scrub(film, film.truth(), monitor)
