"""Pictures of tracks show the data they are given."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gdptlab import plots
from gdptlab.experiment.channel import IN_CHANNEL, Acoustics, Channel, Focusing
from gdptlab.experiment.film import Film
from gdptlab.plots.style import MARK

FPS = 25.0


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


@pytest.fixture(scope="module")
def film() -> Film:
    focusing = Focusing(channel=Channel(width_um=180, height_um=90), acoustics=Acoustics(energy_density_J_m3=3))
    return Film.seeded(2, focusing=focusing, mean_in_view=6, duration_s=0.4, shape=(290, 200))


@pytest.fixture(scope="module")
def moving(film) -> pd.DataFrame:
    """Exact tracks and velocities."""
    table = film.to_channel(film.truth())
    focusing = film.trajectories.focusing
    speeds = {"x": focusing.channel.velocity(table.y_channel_um, table.z_um)}
    speeds |= {axis: focusing.radiation_velocity(axis, table[IN_CHANNEL[axis]]) for axis in "yz"}
    for k, axis in enumerate("xyz"):
        table[f"{axis}_std_um"], table[f"v{axis}_um_s"], table[f"v{axis}_std_um_s"] = 0.1 * (k + 1), speeds[axis], 0.5
    return table


def test_tracks_end_where_particles_are_and_show_no_future(film, moving):
    figure = plots.tracks_in_space(film, moving, frame=6)
    frame, section, bar = figure.axes
    now = moving[moving.frame == 6]
    np.testing.assert_allclose(frame.collections[0].get_offsets(), now[["x_px", "y_px"]])
    ends = {tuple(line.get_xydata()[-1].round(6)) for line in frame.get_lines()[: moving.particle.nunique()]}
    assert {tuple(place) for place in now[["x_px", "y_px"]].round(6).to_numpy()} <= ends
    begin = moving.groupby("particle").first()
    np.testing.assert_allclose(section.collections[0].get_offsets(), begin[["y_channel_um", "z_um"]])
    np.testing.assert_allclose(section.collections[0].get_array(), begin["z_um"])
    assert bar.get_ylabel() == "z at the start (µm)" and frame.get_title(loc="left") == "t = 0.24 s"


def test_one_track_has_its_axes_and_its_truth(moving):
    path = moving[moving.particle == moving.particle.iloc[0]]
    figure = plots.one_track(path.iloc[::2], path, FPS)
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["x (µm)", "y (µm)", "z (µm)", "$v_x$ (µm/s)", "$v_y$ (µm/s)", "$v_z$ (µm/s)"]
    for axes, name in zip(figure.axes, [*IN_CHANNEL.values(), "vx_um_s", "vy_um_s", "vz_um_s"], strict=True):
        true, seen = axes.get_lines()
        np.testing.assert_allclose(true.get_ydata(), path[name])
        np.testing.assert_allclose(seen.get_ydata(), path[name].iloc[::2])
        np.testing.assert_allclose(seen.get_xdata(), path["frame"].iloc[::2] / FPS)


def test_profiles_of_exact_velocities_lie_on_the_curves(film, moving):
    focusing = film.trajectories.focusing
    figure = plots.velocity_profiles(moving, focusing)
    for axes, axis in zip(figure.axes[1:], "yz", strict=True):
        dots, curve, medians = axes.get_lines()[:3]
        np.testing.assert_allclose(curve.get_ydata(), focusing.radiation_velocity(axis, curve.get_xdata()))
        at, median = medians.get_data()
        step = at[1] - at[0]
        known = np.isfinite(median)
        steepest = 2 * np.pi * focusing.amplitude_um_s(axis) / focusing.extent_um(axis)
        off = np.abs(median - focusing.radiation_velocity(axis, at))[known]
        assert known.any() and (off <= steepest * step / 2 + 1e-9).all()
        assert len(dots.get_xdata()) == len(moving)
    assert [t.get_text() for t in figure.axes[0].get_legend().get_texts()] == ["|z| < 9 µm", "18 < |z| < 27 µm"]


def test_links_in_time_show_both_fractions():
    scores = pd.DataFrame({"right": [1.0, 0.9], "found": [0.8, 0.5]}, index=[0.5, 1.5])
    right, found = plots.links_in_time({"thin": scores, "dense": scores / 2}).axes
    assert [line.get_ydata().tolist() for line in right.get_lines()] == [[1.0, 0.9], [0.5, 0.45]]
    assert [line.get_ydata().tolist() for line in found.get_lines()] == [[0.8, 0.5], [0.4, 0.25]]
    assert [t.get_text() for t in right.get_legend().get_texts()] == ["thin", "dense"]


def test_exact_paths_collapse_onto_their_line(film, moving):
    focusing = film.trajectories.focusing
    amplitudes = [focusing.amplitude_um_s(axis) for axis in "yz"]
    figure = plots.collapsed_paths(moving, focusing, amplitudes, FPS)
    for axes, axis in zip(figure.axes, "yz", strict=True):
        paths, line = axes.get_lines()
        slope = -1 / focusing.focusing_time_s(axis)
        assert len(paths.get_xdata()) > 10
        np.testing.assert_allclose(paths.get_ydata(), slope * paths.get_xdata(), atol=1e-9)
        np.testing.assert_allclose(np.diff(line.get_ydata()) / np.diff(line.get_xdata()), slope)


def test_intervals_that_miss_the_truth_are_marked():
    table = pd.DataFrame({"value": [2.2, 1.9, 2.0], "low": [2.1, 1.8, 1.9], "high": [2.3, 2.1, 2.1]})
    (axes,) = plots.energy_intervals({"E": table}, 2.0, {"E": "of E"}).axes
    covers, misses = axes.collections[:2]
    assert len(covers.get_segments()) == 2 and len(misses.get_segments()) == 1
    np.testing.assert_allclose(misses.get_segments()[0], [[2, 5], [2, 15]])  # sorted last; in %
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["covers: 2", "misses: 1"]
    assert axes.get_lines()[1].get_color() == MARK and axes.get_title(loc="left") == "of E"
