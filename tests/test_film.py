"""Films: what is where, the same whatever the order, and fields that must agree."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from gdptlab.experiment import Camera
from gdptlab.experiment.channel import Acoustics, Channel, Focusing, Suspension, Trajectories
from gdptlab.experiment.film import Film
from gdptlab.experiment.microscope import Microscope

SHAPE = (330, 210)
QUIET = Camera(read_noise=0.0)
SHORT = {"duration_s": 0.4, "mean_in_view": 12, "shape": SHAPE}


def film_of(x, y, z, **fields):
    """Film of particles at given places, with next to no flow and sound."""
    focusing = Focusing(channel=Channel(flow_rate_ul_h=1e-9), acoustics=Acoustics(energy_density_J_m3=1e-9))
    start = pd.DataFrame({"x_channel_um": x, "y_channel_um": y, "z_um": z}).assign(particle=range(len(x)))
    view = {"duration_s": 0.2, "view_length_um": SHAPE[1] * 0.65}
    trajectories = Trajectories(focusing=focusing, start=start, **view)
    return Film(trajectories=trajectories, shape=SHAPE, **fields)


def test_axes_of_frame_and_channel():
    # The centre of the first column is half a pixel from x = 0; rows 0 and 329 lie evenly about y = 0.
    film = film_of([0.325, 50.0, 100.0], [0.0, -60.0, 33.0], [10.0, -20.0, 30.0])
    truth = film.truth().query("frame == 0")
    np.testing.assert_allclose(truth["x_px"], [0, 50 / 0.65 - 0.5, 100 / 0.65 - 0.5])
    np.testing.assert_allclose(truth["y_px"], [164.5, 164.5 - 60 / 0.65, 164.5 + 33 / 0.65])
    np.testing.assert_allclose(truth["z_um"], [10, -20, 30])
    back = film.to_channel(truth)
    np.testing.assert_allclose(back["x_channel_um"], [0.325, 50, 100])
    np.testing.assert_allclose(back["y_channel_um"], [0, -60, 33], atol=1e-12)
    assert "x_std_um" not in back
    measured = film.to_channel(truth.assign(x_std_px=0.1, y_std_px=[0.2, 0.4, 0.0]))
    np.testing.assert_allclose(measured["x_std_um"], 0.065)
    np.testing.assert_allclose(measured["y_std_um"], [0.13, 0.26, 0])


def test_light_is_where_the_truth_says():
    film = film_of([60.0], [-40.0], [0.0], camera=QUIET)
    light = film[3].astype(float) - QUIET.background
    y, x = np.indices(SHAPE)
    truth = film.truth().iloc[0]
    assert (x * light).sum() / light.sum() == pytest.approx(truth["x_px"], abs=0.05)
    assert (y * light).sum() / light.sum() == pytest.approx(truth["y_px"], abs=0.05)


def test_truth_holds_particles_in_the_frame_and_light_those_beside_it_too():
    inside = film_of([70.0], [0.0], [40.0], camera=QUIET)
    beside = film_of([-8.0, 70.0], [50.0, 0.0], [40.0, 40.0], camera=QUIET)
    assert set(beside.truth()["particle"]) == {1}
    assert (beside[0][:, :5].astype(int) - inside[0][:, :5]).max() > 50


def test_truth_follows_the_trajectories():
    film = Film.seeded(4, **SHORT)
    assert len(film) == 10
    np.testing.assert_allclose(film.times_s, np.arange(10) / 25)
    truth = film.to_channel(film.truth())
    expected = film.trajectories.positions(7 / 25)
    seen = truth[truth["frame"] == 7]
    assert list(film.truth()) == ["frame", "particle", "x_px", "y_px", "z_um"]
    assert seen["particle"].tolist() == expected["particle"].tolist()
    columns = ["x_channel_um", "y_channel_um", "z_um"]
    np.testing.assert_allclose(seen[columns], expected[columns], atol=1e-9)
    assert truth["x_px"].between(-0.5, 209.5).all()


def test_frames_do_not_depend_on_the_order():
    film, again = Film.seeded(3, **SHORT), Film.seeded(3, **SHORT)
    backwards = [again[i] for i in (9, 4, 0, -6)]
    frames = list(film)
    assert len(frames) == len(film)
    for frame, other in zip((frames[9], frames[4], frames[0], frames[4]), backwards, strict=True):
        np.testing.assert_array_equal(frame, other)
    assert frames[0].shape == SHAPE
    assert frames[0].dtype == np.uint16
    with pytest.raises(IndexError, match="frame"):
        film[10]


def test_noise_differs_between_frames_and_seeds():
    film = film_of([60.0], [0.0], [0.0])
    other = dataclasses.replace(film, seed=1)
    noise = [(f[i].astype(float) - 500)[:60].ravel() for f, i in ((film, 0), (film, 1), (other, 0))]
    assert np.abs(np.corrcoef(noise)[np.triu_indices(3, 1)]).max() < 0.05


def test_image_types_show_the_same_particles():
    dark = Film.seeded(3, camera=QUIET, **SHORT)
    bright = Film.seeded(3, camera=QUIET, image_type="brightfield", **SHORT)
    pd.testing.assert_frame_equal(dark.truth(), bright.truth())
    total = dark[2].astype(int) + bright[2]
    assert np.ptp(total) <= 2  # both are rounded


def test_stack_is_of_the_film_and_recorded_once():
    film = Film.seeded(3, image_type="brightfield", **SHORT)
    stack, z_um = film.stack(5, 41)
    assert stack.shape == (5, 41, 41)
    np.testing.assert_allclose(z_um, [-50, -25, 0, 25, 50])
    assert stack[2, 20, 20] < np.median(stack[2]) - 1000
    np.testing.assert_array_equal(stack, Film.seeded(9, image_type="brightfield", **SHORT).stack(5, 41)[0])
    assert (stack != film.stack(5, 41, seed=1)[0]).any()


def test_a_longer_film_begins_with_the_frames_of_a_shorter_one():
    fields = SHORT | {"focusing": Focusing(channel=Channel(flow_rate_ul_h=40.0))}  # fast: many come from upstream
    short, long = (Film.seeded(3, **fields | {"duration_s": t}) for t in (0.4, 1.0))
    assert long.truth()["particle"].max() > short.truth()["particle"].max()
    for i in (0, 9):
        difference = long[i].astype(int) - short[i]
        assert np.abs(difference).max() <= 1 and (difference != 0).mean() < 1e-3


GOOD = film_of([60.0], [0.0], [0.0])


@pytest.mark.parametrize(
    ("fields", "error", "name"),
    [
        ({"trajectories": None}, TypeError, "trajectories"),
        ({"microscope": "10x"}, TypeError, "microscope"),
        ({"camera": None}, TypeError, "camera"),
        ({"image_type": "x-ray"}, ValueError, "image_type"),
        ({"frame_rate_hz": 0}, ValueError, "frame_rate_hz"),
        ({"frame_rate_hz": float("nan")}, ValueError, "frame_rate_hz"),
        ({"frame_rate_hz": 4.0}, ValueError, "frame_rate_hz"),
        ({"shape": 512}, TypeError, "shape"),
        ({"shape": (330, 210, 3)}, TypeError, "shape"),
        ({"shape": (0, 210)}, ValueError, r"shape\[0\]"),
        ({"shape": (307, 210)}, ValueError, "width_um"),
        ({"shape": (330, 211)}, ValueError, "view_length_um"),
        ({"seed": -1}, ValueError, "seed"),
        ({"seed": 1.5}, TypeError, "seed"),
        ({"microscope": Microscope(diameter_um=4)}, ValueError, "diameter_um"),
        ({"microscope": Microscope(depth_um=90)}, ValueError, "height_um"),
    ],
)
def test_fields_that_cannot_be(fields, error, name):
    with pytest.raises(error, match=name):
        dataclasses.replace(GOOD, **fields)


def test_arguments_that_cannot_be():
    with pytest.raises(ValueError, match="radius_um"):
        Film.seeded(0, focusing=Focusing(suspension=Suspension(radius_um=50)))
    with pytest.raises(ValueError, match="mean_in_view"):
        Film.seeded(0, mean_in_view=0)
    with pytest.raises(ValueError, match="mean_in_view"):
        Film.seeded(0, mean_in_view=1e-6)
    with pytest.raises(ValueError, match="seed"):
        Film.seeded(-1)
    with pytest.raises(ValueError, match="table"):
        GOOD.to_channel(pd.DataFrame({"x_px": [1.0]}))
    with pytest.raises(ValueError, match="size"):
        GOOD.stack(5, 40)
    with pytest.raises(ValueError, match="n"):
        GOOD.stack(1)


def test_a_frame_without_particles_is_background():
    film = film_of([900.0], [0.0], [0.0], camera=QUIET)
    assert film.truth().empty
    assert (film[0] == QUIET.background).all()
    assert film.to_channel(film.truth()).empty
