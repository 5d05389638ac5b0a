"""Pictures of the experiment show the data they are given."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image

from gdptlab import plots
from gdptlab.experiment import replay
from gdptlab.experiment.channel import Focusing, Trajectories
from gdptlab.experiment.film import Film


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
    """Verdicts on three settings of two evaluators, for both triggers; all films of the last failed."""
    rows = pd.DataFrame(
        {"evaluator": ["gdptlab", "OpenCV", "OpenCV"], "n_sub": [9, 9, 4], "refine": [True, False, True]}
    )
    rows = rows.assign(
        tau_s=[0.01, 0.1, 0.2], median=[0.1, 0.3, np.nan], q25=[0.0, 0.2, np.nan], q75=[0.2, 0.5, np.nan]
    )
    rows = rows.assign(failed=[0.0, 0.2, 1.0], failed_low=[0, 0.1, 0.7], failed_high=[0.2, 0.4, 1.0], films=10)
    return pd.concat([rows.assign(trigger=a) for a in "hw"], ignore_index=True)


@pytest.fixture(scope="module")
def film() -> Film:
    return Film.seeded(1, mean_in_view=6, duration_s=5)


def texts(figure: Figure) -> str:
    return " ".join(t.get_text() for t in figure.findobj(plt.Text))


def test_figure_4_draws_every_particle_of_the_view_at_each_instant() -> None:
    trajectories = Trajectories.seeded(Focusing(), 1, mean_in_view=20, duration_s=5)
    figure = plots.fig4_acoustophoresis(trajectories, trajectories, {"start": 0, "later": 2.5})
    for panel, t in zip(figure.subfigs[1].get_axes(), (0, 2.5), strict=True):
        here = trajectories.positions(t)
        np.testing.assert_array_equal(panel.get_lines()[0].get_xydata(), here[["y_channel_um", "z_um"]])
    shown = texts(figure)
    assert all(word in shown for word in ("w = 200 µm", "h = 100 µm", "later: 2.5 s", "x (µm), downstream"))
    assert f"{len(trajectories.start)} paths" in shown


def test_monitor_marks_when_each_measured_fraction_first_reaches_the_level(monitor: pd.DataFrame) -> None:
    figure, axes = plt.subplots()
    plots.draw_monitor(axes, monitor)
    marked = [line.get_xdata()[0] for line in axes.get_lines() if line.get_marker() == "v"]
    assert marked == pytest.approx([2.4, 2.4])
    plt.close(figure)


def test_figure_5_counts_films_that_failed_on_top(points: pd.DataFrame) -> None:
    band = replay.expected_delay([0.005, 0.5], 0.2, 0.04)
    figure = plots.fig5_times(points, band, colour="n_sub")
    strip = figure.axes[0]
    heights = [line.get_ydata()[0] for line in strip.get_lines() if len(line.get_ydata()) == 1]
    assert heights == pytest.approx([0, 20, 100])  # %
    assert all(word in texts(figure) for word in ("(a)", "(b)", "measured evaluation time τ (s)", "10 films"))


def test_settings_side_by_side_say_how_many_films_failed(points: pd.DataFrame) -> None:
    both = pd.concat([points.assign(refine=r) for r in (True, False)]).set_index("n_sub")
    both = both[both["evaluator"] == "OpenCV"]
    time = pd.DataFrame({"count": [9, 8], "valid": [9, 7]}, index=[0.0, 1.0])
    figure = plots.fig5_settings(both, {9: "nine", 4: "four"}, {"full": time, "true": time[["count"]]})
    shown = texts(figure)
    assert all(word in shown for word in ("20% (10%–40%)", "100% (70%–100%)", "nine", "four"))
    lines = [line.get_ydata() for line in figure.axes[2].get_lines()]
    assert [list(y) for y in lines] == [[9, 8], [9, 7], [9, 8]]


def test_error_against_tau(points: pd.DataFrame) -> None:
    band = replay.expected_delay([0.04, 1, 5])
    figure = plots.error_against_tau(points, band, by="evaluator")
    assert {"gdptlab", "OpenCV"} <= {t.get_text() for t in figure.axes[2].get_legend().get_texts()}


def test_three_answers_draw_what_they_are_given(points: pd.DataFrame) -> None:
    slower = points[points["evaluator"] == "gdptlab"].drop_duplicates(["trigger", "tau_s"])
    change = pd.DataFrame({"setting": "a", "trigger": ["h", "w"], "mean": [0.1, 0.0], "low": -0.2, "high": 0.3})
    columns = ["fraction_h", "fraction_w", "true_fraction_h", "true_fraction_w", "valid"]
    seen = pd.DataFrame(np.linspace(0, 1, 10).reshape(2, 5), columns=columns, index=[0.0, 1.0])
    figure = plots.three_answers(slower, change, seen, 0.9, {"here": 1.0}, ("none", "little", "there"))
    shown = texts(figure)
    assert all(word in shown for word in ("What does refinement buy?\nlittle", "here ", "valid / true"))
    right = figure.axes[0].get_lines()[0].get_ydata()
    assert list(right) == list(100 - 100 * slower[slower["trigger"] == "h"].sort_values("tau_s")["failed"])


def test_an_animation_shows_each_moment(film: Film, monitor: pd.DataFrame, tmp_path: Path) -> None:
    animation = plots.replay_animation(film, film.truth(), monitor, [0, 50])
    plots.save_animation(animation, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as picture:
        assert picture.n_frames == 2
    assert "<script" in plots.player(animation)


def test_one_moment_of_the_replay(film: Film, monitor: pd.DataFrame) -> None:
    measured = film.truth()
    figure = plots.replay_view(film, measured, monitor, 50)
    here = int((measured["frame"] == 50).sum())
    assert f"{here} measured (dots) of {here} (crosses)" in texts(figure)
    curves = next(a for a in figure.axes if a.get_ylabel() == "fraction of particles")
    assert max(line.get_xdata()[-1] for line in curves.get_lines()[1:]) == pytest.approx(2.0)
