"""The joint fit in the loop: over dropped frames, when it was lost, has no time, or fails."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, locate
from gdptlab.experiment import Acoustics, Film, Focusing
from gdptlab.live import Follower, OwnProcess, following

FOCUSING = Focusing(acoustics=Acoustics(energy_density_J_m3=2.4))
SHAPE = (320, 180)


def film(seed=0):
    return Film.seeded(seed, focusing=FOCUSING, mean_in_view=12, shape=SHAPE, duration_s=1.0)


@pytest.fixture(scope="module")
def calibration():
    return Calibration.from_stack(*film().stack(n=26), n_sub=9)


def missed(table, made, k):
    """True particles of a frame without one measured within 2 px and 3 µm, and rows too many."""
    truth = made.truth()
    truth = truth[truth["frame"] == k]
    off = [
        (np.hypot(table["x_px"] - x, table["y_px"] - y) < 2) & ((table["z_um"] - z).abs() < 3)
        for x, y, z in truth[["x_px", "y_px", "z_um"]].to_numpy()
    ]
    return sum(not near.any() for near in off), len(table) - len(truth)


@pytest.mark.parametrize("every", [1, 3])
def test_particles_are_followed_over_dropped_frames(calibration, every, monkeypatch):
    made, follower = film(), Follower(calibration)
    follower(made[0])
    if every == 1:
        monkeypatch.setattr(following.Joint, "first", None)  # no search is needed
    for k in range(0, 10, every):
        table = follower(made[k], made.times_s[k])
        lost, false = missed(table, made, k)
        assert lost <= (k == every == 3) and false == 0  # at first, no velocity is known
        assert table.attrs["method"] == "joint"


def test_the_velocity_is_per_second(calibration):
    made, follower = film(), Follower(calibration)
    for k in (0, 1, 2, 4, 7):
        follower(made[k], made.times_s[k])
    found, at = follower._before, made.trajectories
    near = at.positions(0.25), at.positions(0.30)
    true = (near[1].set_index("particle")["y_channel_um"] - near[0].set_index("particle")["y_channel_um"]) / 0.05
    assert np.abs(found.velocity[:, 0]).max() * made.microscope.um_per_px == pytest.approx(true.abs().max(), rel=0.4)


def test_it_begins_anew_when_lost_and_after_a_pause(calibration, monkeypatch):
    made, other, follower, searches = film(), film(1), Follower(calibration), []
    first = following.Joint.first
    monkeypatch.setattr(following.Joint, "first", lambda self, frame: searches.append(1) or first(self, frame))
    follower(made[0], 0.0)
    assert len(searches) == 1
    assert missed(follower(other[3], 0.04), other, 3) == (0, 0)  # other particles: by repeats or by a search
    before = len(searches)
    assert missed(follower(made[5], 0.04 + 2 * following.FORGET_S), made, 5) == (0, 0)
    assert len(searches) == before + 1


def test_it_finds_the_same_with_two_threads_and_in_another_process(calibration):
    made = film()
    tables = []
    with OwnProcess(Follower(calibration)) as apart:
        assert apart.follows
        for follower in (Follower(calibration), Follower(calibration, threads=2), apart):
            follower(made[0])
            tables.append(follower(made[1], 0.04))
    for table in tables[1:]:
        pd.testing.assert_frame_equal(table, tables[0])
    assert tables[2].attrs["method"] == "joint"


def test_slow_frames_are_left_to_the_cheaper_evaluator_and_it_comes_back(calibration, monkeypatch):
    clock, took = [0.0], [0.05]
    monkeypatch.setattr(following, "perf_counter", lambda: clock[0])

    def fitted(self, image, t_s):
        clock[0] += took[0]
        return pd.DataFrame({"x_px": [1.0]})

    monkeypatch.setattr(Follower, "_followed", fitted)
    plain = Calibration.from_stack(calibration.stack, calibration.z_um, n_sub=4)
    follower = Follower(calibration, interval_s=0.02, cheaper=lambda image: locate(image, plain))
    methods, notes = [], []
    for k in range(32):
        if k == 20:
            took[0] = 0.01
        table = follower(np.zeros(SHAPE), 0.02 * k)
        methods.append(table.attrs["method"][0])
        notes.append(table.attrs.get("note", ""))
    # 1, 2, 4 and 5 (a tenth of a second) by the other, after three slow ones; at the next trial the machine is quick.
    assert "".join(methods) == "jjj" + "c" + "jjj" + "cc" + "jjj" + "cccc" + "jjj" + "ccccc" + "j" * 8
    assert notes[2] == "the joint fit took 50 ms, allowed 20: the next 1 by the cheaper evaluator"
    assert [bool(note) for note in notes].index(True) == 2 and not any(notes[20:])


def test_a_fit_that_diverges_is_told_and_the_next_frame_begins_anew(calibration, monkeypatch):
    made, follower = film(), Follower(calibration)
    table = following.Joint.table
    follower(made[0], 0.0)
    monkeypatch.setattr(following.Joint, "table", lambda *a: table(*a).assign(z_um=np.nan))
    with pytest.raises(FloatingPointError, match="diverged"):
        follower(made[1], 0.04)
    assert follower._before is None
    monkeypatch.setattr(following.Joint, "table", table)
    assert missed(follower(made[2], 0.08), made, 2) == (0, 0)


def test_a_time_that_goes_back_and_bad_arguments_are_refused(calibration):
    made, follower = film(), Follower(calibration)
    follower(made[0], 1.0)
    with pytest.raises(ValueError, match="t_s"):
        follower(made[1], 1.0)
    follower(made[1], 0.5)  # a clock that was set back
    for bad, kind, name in [
        (lambda: Follower(3), TypeError, "calibration"),
        (lambda: Follower(calibration, interval_s=0.04), TypeError, "cheaper"),
        (lambda: Follower(calibration, interval_s=0.0, cheaper=print), ValueError, "interval_s"),
        (lambda: Follower(calibration, threads=0), ValueError, "threads"),
        (lambda: follower(np.zeros((5, 5)), 2.0), ValueError, "image"),
        (lambda: follower(made[2], "2"), TypeError, "t_s"),
    ]:
        with pytest.raises(kind, match=name):
            bad()
