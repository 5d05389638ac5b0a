"""Figures show the data they are given, say what they show, and stay out of pyplot's way."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from gdptlab import Calibration, plots
from gdptlab.denoising import signal_to_noise
from gdptlab.plots.style import FIGURES, stretched


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """Ellipses that turn from tall to squat over 13 depths, in noise."""
    r = np.arange(21) - 10
    z_um = np.linspace(-30, 30, 13)
    noise = 5 * np.random.default_rng(3).standard_normal((13, 21, 21))
    stack = [900 * np.exp(-((r / (4 + z / 20)) ** 2) - (r[:, None] / (4 - z / 20)) ** 2) for z in z_um]
    return Calibration.from_stack(stack + noise, z_um, n_sub=4)


@pytest.fixture
def particles() -> pd.DataFrame:
    return pd.DataFrame({"x_px": [20.0, 70.0], "y_px": [30.0, 12.0], "z_um": [-20.0, 25.0]})


@pytest.fixture
def frame() -> np.ndarray:
    return np.random.default_rng(1).normal(500, 40, (60, 90))


def labels(figure: Figure) -> list[str]:
    """Every label and title of a figure and its parts."""
    axes = [a for part in (figure, *figure.subfigs) for a in part.get_axes()]
    return [text for a in axes for text in (a.get_xlabel(), a.get_ylabel(), a.get_title(loc="left"))]


def curve(axes: plt.Axes, number: int = 0) -> np.ndarray:
    return np.asarray(axes.get_lines()[number].get_ydata(), dtype=float)


def test_frame_has_y_down_and_circles_at_their_pixels(frame: np.ndarray, particles: pd.DataFrame) -> None:
    figure = plots.frame_with_particles(frame, particles, window_px=21)
    axes, bar = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), bar.get_ylabel()) == ("x (px)", "y (px)", "z (µm)")
    assert axes.get_xlim() == (-0.5, 89.5)
    assert axes.get_ylim() == (59.5, -0.5)
    np.testing.assert_array_equal(axes.collections[0].get_offsets(), particles[["x_px", "y_px"]])
    line = axes.get_lines()[0].get_xydata()  # where a window of 21 px still fits
    assert line.min(axis=0).tolist() == [10, 10]
    assert line.max(axis=0).tolist() == [79, 49]


def test_frame_without_particles(frame: np.ndarray, particles: pd.DataFrame) -> None:
    assert "0 particles" in labels(plots.frame_with_particles(frame, particles[:0]))


def test_particles_in_space_are_in_micrometres(particles: pd.DataFrame) -> None:
    figure = plots.particles_3d(particles, 0.5, true=particles)
    axes = figure.axes[0]
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == ["x (µm)", "y (µm)", "z (µm)"]
    for dots in axes.collections:
        x, y, z = dots._offsets3d
        np.testing.assert_allclose(np.column_stack([x, y, z]), particles * np.array([0.5, 0.5, 1]))
    assert axes.yaxis_inverted()


def test_contact_sheet_has_a_row_for_each_stack(calibration: Calibration) -> None:
    stack = calibration.stack[::6]
    figure = plots.contact_sheet({"one": stack, "two": -stack}, calibration.z_um[::6], 0.5)
    assert len(figure.axes) == 6
    np.testing.assert_array_equal(figure.axes[4].images[0].get_array(), -stack[1])
    assert [figure.axes[k].get_ylabel() for k in (0, 3)] == ["one", "two"]
    assert [a.get_title() for a in figure.axes[:3]] == ["z = −30 µm", "0", "+30"]


def test_scale_bar_is_as_long_as_it_says(frame: np.ndarray) -> None:
    figure = plots.side_by_side({"fluorescent": frame, "brightfield": 1000 - frame}, 2.5)
    x = figure.axes[0].get_lines()[0].get_xdata()
    assert np.ptp(x) * 2.5 == pytest.approx(50)
    assert figure.axes[0].texts[0].get_text() == "50 µm"
    assert labels(figure)[2::3] == ["fluorescent", "brightfield"]


def test_stretching_shows_dim_particles_on_dark_and_on_bright() -> None:
    light = np.zeros((9, 9))
    light[2, 2], light[6, 6] = 400.0, 4000.0
    dark, bright = stretched(light), stretched(20_000 - light)
    assert dark[2, 2] == pytest.approx(np.sqrt(0.1)) and dark[6, 6] == 1
    np.testing.assert_allclose(bright, 1 - dark)


def test_calibration_quality(calibration: Calibration) -> None:
    figure = plots.calibration_quality(calibration)
    np.testing.assert_array_equal(curve(figure.axes[1]), signal_to_noise(calibration.stack))
    assert figure.axes[1].get_xlabel() == "z (µm)"


def test_expected_profiles_are_rows_of_the_map(calibration: Calibration) -> None:
    figure = plt.figure()
    plots.expected_profiles(figure, calibration)
    map_, rows = figure.subfigs[1].axes[:2]
    np.testing.assert_array_equal(map_.images[0].get_array(), calibration.expected)
    np.testing.assert_array_equal(curve(rows), calibration.expected[2])  # the second of six depths
    assert map_.get_ylabel() == "z of the particle (µm)"
    titles = [a.get_title() for a in figure.subfigs[0].axes if a.images]
    assert len(titles) == 13 + 4  # the stack, and the subset
    plt.close(figure)


@pytest.mark.parametrize("half", [False, True])
def test_maps_are_cut_out_around_the_particle(frame: np.ndarray, half: bool) -> None:
    r = np.arange(25) - 12
    width = np.linspace(6, 8, 5) if half else np.linspace(0.7, 0.9, 5)  # px: blurred, or too sharp to be halved
    stack = np.exp(-(r**2 + r[:, None] ** 2) / (2 * width[:, None, None] ** 2))
    calibration = Calibration.from_stack(stack, np.arange(5.0), n_sub=2)
    assert calibration.half_resolution == half
    scale = 2 if half else 1
    margin = calibration.search_templates.shape[-1] // 2
    maps = np.zeros((2, *(n // scale - 2 * margin for n in frame.shape)))
    row, column = 30 // scale - margin, 40 // scale - margin
    maps[1, row, column] = 0.75
    figure = plt.figure()
    plots.maps_around(figure, frame, maps, calibration, pd.Series({"x_px": 40.0, "y_px": 30.0}))
    panel = next(a for a in figure.subfigs[1].axes[1:] if "0.75" in a.get_title())
    x, y = panel.get_lines()[0].get_xydata()[0].astype(int)
    assert panel.images[0].get_array()[y, x] == 0.75
    plt.close(figure)


def test_profile_and_peak_show_what_they_are_given(calibration: Calibration, frame: np.ndarray) -> None:
    profile, agreement = np.array([0.5, 0.7, 0.9, 0.6]), np.linspace(-1, 1, 13)
    figure = plt.figure()
    c, d = figure.subfigures(2, 1)
    plots.profile_match(c, profile, calibration, agreement)
    plots.correlation_peak(d, frame[:41, :41], calibration.templates[6], np.eye(21), 0.65)
    np.testing.assert_array_equal(c.axes[0].get_lines()[-1].get_ydata(), profile)
    assert c.axes[1].get_title().endswith("+30 µm")
    assert d.axes[2].get_title() == "peak $C_m$ = 1.00"
    plt.close(figure)


def test_mean_errors_are_those_of_the_bins() -> None:
    pairs = pd.DataFrame({"z_um": [-5.0, -5.0, 5.0], "dz_um": [1.0, 3.0, -1.0]})
    figure = plots.z_errors({"first": pairs, "second": pairs}, [-10, 0, 10])
    mean = figure.axes[0].get_lines()[-1]
    np.testing.assert_array_equal(mean.get_xydata(), [[-5, 2], [5, -1]])
    assert figure.axes[0].get_ylabel() == "error in z (µm)"


def test_score_curves_with_spread_and_a_chosen_setting() -> None:
    table = pd.DataFrame({"recall": [0.9, 0.8], "recall_std": [0.01, 0.02], "sigma_z_um": [0.5, 1]}, index=[3, 9])
    figure = plots.score_curves({"a": table}, "N_sub", columns=["recall", "sigma_z_um"], chosen=9, log=True)
    assert curve(figure.axes[0]).tolist() == [0.9, 0.8]
    assert [a.get_ylabel() for a in figure.axes] == ["recall", "σ$_z$ (µm)"]
    assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == ["3", "9"]


def test_scores_that_are_not_there_can_be_drawn() -> None:
    nothing = pd.DataFrame({"sigma_z_um": [np.nan, np.nan]}, index=[1.0, 2.0])
    figure = plots.score_curves({"a": nothing}, "x", columns=["sigma_z_um"])
    assert figure.axes[0].get_ylim()[1] > 0


def test_saved_figures_are_the_same_each_time(tmp_path: Path, frame: np.ndarray) -> None:
    for name in ("one.png", "two.png"):
        plots.save(plots.side_by_side({"a": frame}, 1.0), name, tmp_path)
    one, two = (Path(tmp_path, name).read_bytes() for name in ("one.png", "two.png"))
    assert one == two
    assert b"Software" not in one
    with pytest.raises(ValueError, match="name"):
        plots.save(Figure(), "fig.pdf", tmp_path)


def test_figures_of_the_repository_are_kept_unless_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdptlab.plots.style.FIGURES", tmp_path)
    monkeypatch.delenv("GDPTLAB_SAVE", raising=False)
    plots.save(Figure(), "a.png")
    assert [p.name for p in tmp_path.iterdir()] == ["mine"] and (tmp_path / "mine" / "a.png").exists()
    monkeypatch.setenv("GDPTLAB_SAVE", "1")
    plots.save(Figure(), "a.png")
    assert (tmp_path / "a.png").exists()


def test_a_figure_that_fails_is_closed() -> None:
    with pytest.raises(KeyError):
        plots.frame_with_particles(np.eye(9), pd.DataFrame({"x": [1]}))


def test_figures_lie_in_the_repository() -> None:
    assert FIGURES == Path(__file__).parents[1] / "figures"
