"""A device that keeps to the clock shows what can be computed at leisure."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gdptlab.experiment import fractions, trigger_time
from gdptlab.experiment.channel import Acoustics, Focusing, Trajectories
from gdptlab.experiment.film import Film
from gdptlab.live.device import SLOTS, Device, Switched, closed_loop, switched, timed, true_fractions

FAST = Focusing(acoustics=Acoustics(energy_density_J_m3=30.0))  # all is over after half a second
SHAPE = (320, 180)
FAST_FILM = {"focusing": FAST, "mean_in_view": 8, "shape": SHAPE, "frame_rate_hz": 20.0}


def film(seed=0, **fields):
    return Film.seeded(seed, **FAST_FILM | {"duration_s": 0.6} | fields)


@pytest.fixture(scope="module")
def device():
    with Device(SHAPE) as device:
        yield device


# -------------------- paths


def test_until_it_is_switched_off_nothing_differs():
    plain = film().trajectories
    off = switched(film(), 0.3).trajectories
    times = [0.0, 0.1, 0.3]
    pd.testing.assert_frame_equal(off.table(times), plain.table(times))
    never = switched(film(), None).trajectories
    pd.testing.assert_frame_equal(never.table([0.0, 0.5]), plain.table([0.0, 0.5]))


def test_then_only_the_flow_goes_on():
    off = switched(film(), 0.1).trajectories
    a, b, c = (off.positions(t, border_um=np.inf).set_index("particle") for t in (0.1, 0.1 + 0.03, 0.6))
    for later, seconds in ((b, 0.03), (c, 0.5)):
        assert (later[["y_channel_um", "z_um"]] == a[["y_channel_um", "z_um"]]).all(axis=None)
        moved = FAST.channel.velocity(a["y_channel_um"], a["z_um"]) * seconds
        np.testing.assert_allclose(later["x_channel_um"], a["x_channel_um"] + moved)
    assert c["t_s"].eq(0.6).all() and (c["x_channel_um"] > a["x_channel_um"]).all()
    before = off.positions(0.05, border_um=np.inf).set_index("particle")
    assert (before["y_channel_um"].abs() > a["y_channel_um"].abs()).all()


def test_particles_are_kept_up_to_the_border():
    plain = film().trajectories
    off = switched(film(), 0.0).trajectories
    everywhere = off.positions(0.6, border_um=np.inf)
    for border in (0.0, 12.5):
        kept = everywhere["x_channel_um"].between(-border, plain.view_length_um + border)
        assert 0 < kept.sum() < len(kept)
        seen = off.positions(0.6, border_um=border)
        pd.testing.assert_frame_equal(seen, everywhere[kept].reset_index(drop=True))


@pytest.mark.parametrize("off_s", [-1.0, np.nan, np.inf])
def test_a_time_that_cannot_be_is_refused(off_s):
    with pytest.raises(ValueError, match="off_s"):
        switched(film(), off_s)
    with pytest.raises(ValueError, match="times_s"):
        switched(film(), 0.1).trajectories.table([0.7])
    with pytest.raises(ValueError, match="border_um"):
        switched(film(), 0.1).trajectories.table([0.1], border_um=-1.0)
    with pytest.raises(TypeError):
        Switched(focusing=FAST, start=film().trajectories.start, of_s=0.1)


# -------------------- the device


def frames_of(device):
    shown = []
    while (frame := device.grab()) is not None:
        shown.append(frame)
    return shown


def test_the_camera_shows_the_film(device):
    made = film(3)
    device.run(made)
    assert np.isnan(device.start_s) and device.off_s is None
    shown = frames_of(device)
    assert device.shown[0] == 0 and (np.diff(device.shown) > 0).all()
    for i, frame in zip(device.shown, shown, strict=True):
        np.testing.assert_array_equal(frame.image, made[i])
        assert frame.t_s >= device.start_s + i / made.frame_rate_hz
    assert device.grab() is None and device.missed == 0
    np.testing.assert_array_equal(device.film[5], made[5])


def test_after_the_switch_it_shows_the_film_without_sound(device):
    made = film(4, duration_s=1.0)
    device.run(made)
    while len(device.shown) < 4:
        before = device.grab()
    device.switch_off()
    off_s = device.off_s
    device.switch_off()
    assert device.off_s == off_s > 0
    shown = frames_of(device)
    late = [k for k, i in enumerate(device.shown[-len(shown) :]) if i / made.frame_rate_hz > off_s]
    assert late
    for k in late:
        i = device.shown[-len(shown) :][k]
        np.testing.assert_array_equal(shown[k].image, device.film[i])
        assert (shown[k].image != made[i]).any()
    assert before.t_s < device.start_s + off_s


def test_frames_made_ahead_come_at_any_rate(device):
    made = film(5, frame_rate_hz=400.0, duration_s=0.1)
    device.run(made, ahead=4)
    shown = frames_of(device)
    assert device.missed + len(shown) <= 40 and len(shown) >= SLOTS
    if device.missed == 0 and len(shown) == 40:
        assert device.shown[:9] == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    for i, frame in zip(device.shown, shown, strict=True):
        np.testing.assert_array_equal(frame.image, made[i])


def test_a_camera_that_nobody_asks_does_not_wait(device):
    made = film(6, frame_rate_hz=400.0, duration_s=2.0)
    device.run(made, ahead=1)
    device.grab()
    end = time.monotonic() + 60
    while device.missed < 30:
        assert time.monotonic() < end
        time.sleep(0.01)
    shown = frames_of(device)
    assert len(shown) <= 800 - 30 and len(device.shown) == len(shown) + 1
    np.testing.assert_array_equal(shown[0].image, made[0])


def test_one_experiment_after_the_other(device):
    device.run(film(7, duration_s=30.0, mean_in_view=1))
    assert device.grab() is not None
    device.switch_off()
    device.run(film(8))  # halts the first
    assert device.off_s is None and device.shown == []
    np.testing.assert_array_equal(device.grab().image, film(8)[0])
    device.halt()
    assert device.grab() is None


def test_what_it_cannot_show_is_refused(device):
    with pytest.raises(TypeError, match="film"):
        device.run(3)
    with pytest.raises(ValueError, match="film"):
        device.run(film(shape=(310, 180)))
    with pytest.raises(ValueError, match="ahead"):
        device.run(film(), ahead=13)


ORPHAN = """
import sys
sys.path.insert(0, sys.argv[1])
from test_device import SHAPE, Device, film

if __name__ == "__main__":
    with Device(SHAPE) as device:
        device.run(film(duration_s=1000.0, mean_in_view=1))
        device.grab()
        print("runs", flush=True)
        while True:
            device.grab()
"""


def test_a_device_leaves_when_its_parent_is_killed(tmp_path):
    (tmp_path / "orphan.py").write_text(ORPHAN)
    command = [sys.executable, str(tmp_path / "orphan.py"), str(Path(__file__).parent)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert parent.stdout.readline() == "runs\n"
    finally:
        parent.kill()
    start = time.monotonic()
    parent.communicate(timeout=60)  # until nobody holds its output open
    assert time.monotonic() - start < 10


def test_a_device_that_is_gone():
    device = Device(SHAPE)
    device.run(film(duration_s=30.0, mean_in_view=1))
    assert device.grab() is not None
    device._process.kill()
    while device.grab() is not None:
        pass
    with pytest.raises(RuntimeError, match="process"):
        device.run(film())
    device.close()


# -------------------- loop and timer


def test_true_fractions_are_those_of_the_film():
    made = film(9)
    expected = fractions(made.to_channel(made.truth()), np.arange(len(made)), FAST.channel)
    found = true_fractions(made, made.times_s)
    for name in ("count", "fraction_h", "fraction_w"):
        np.testing.assert_array_equal(found[name], expected[name])


class Slow:
    """Evaluator that says no twice, then yes."""

    def __init__(self, rows=SHAPE[0], no=2):
        self.calls, self.rows, self.no = -1, rows, no  # the first call is the example's

    def __call__(self, image):
        self.calls += 1
        y_px = (self.rows - 1) / 2 if self.calls > self.no else 0.0
        return pd.DataFrame({"x_px": [50.0] * 10, "y_px": y_px, "z_um": 0.0})


def test_the_monitor_switches_the_sound_off(device, tmp_path):
    made = film(10, duration_s=3.0)
    row = closed_loop(device, made, Slow(), linger_s=0.1, log=tmp_path / "log")
    assert row["seed"] == 10 and row["energy_density_J_m3"] == 30
    assert 0 < row["exposed_s"] <= row["delivered_s"] < row["off_s"] < 3
    assert row["delay_ms"] == pytest.approx(1e3 * (row["off_s"] - row["delivered_s"]))
    assert row["exposure_delay_ms"] >= row["delay_ms"] > 0
    assert row["fraction"] == 1
    assert row["true_fraction"] == true_fractions(device.film, [row["off_s"]])["fraction_w"].item()
    times = np.arange(0, 3, 0.01)
    assert row["needed_s"] == trigger_time(times, true_fractions(made, times)["fraction_w"])
    assert device.off_s == row["off_s"] and device.grab() is None
    assert (tmp_path / "log").exists()


def test_a_monitor_that_never_fires(device):
    row = closed_loop(device, film(11), Slow(no=10**6), of="w")
    assert np.isnan(row["off_s"]) and np.isnan(row["delay_ms"]) and row["frames"] > 1


def test_a_timer_knows_nothing_of_the_particles():
    films = [film(12), film(13)]
    table = timed(films, [0.01, 0.5], of="h")
    assert table["seed"].tolist() == [12, 12, 13, 13] and table["off_s"].tolist() == [0.01, 0.5] * 2
    for made, part in zip(films, (table[:2], table[2:]), strict=True):
        here = made.trajectories.positions(0.5)
        assert part["true_fraction"].iloc[1] == (here["z_um"].abs() <= 100 / 6).mean()
        assert part["true_fraction"].iloc[0] < part["true_fraction"].iloc[1]
    with pytest.raises(ValueError, match="of"):
        timed(films, [0.1], of="x")
    assert isinstance(films[0].trajectories, Trajectories)
