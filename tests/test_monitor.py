"""The loop by hand: a camera that waits for the test, an evaluator that waits for the test. No clock decides."""

import gc
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from functools import partial
from pathlib import Path
from queue import Queue

import numpy as np
import pandas as pd
import pytest
from conftest import THOROUGH

from gdptlab import locate
from gdptlab.experiment import replay
from gdptlab.experiment.channel import Channel
from gdptlab.live import logbook
from gdptlab.live.logbook import Logbook, read_log
from gdptlab.live.monitor import Monitor
from gdptlab.live.own_process import OwnProcess
from gdptlab.live.sources import Frame, at_speed
from gdptlab.live.triggers import MiddleThird, Trigger, middle_thirds

SHAPE = (3, 5)


def image(fraction, value=0):
    """A frame that says which fraction of ten particles is inside."""
    return np.full(SHAPE, 100 * value + round(10 * fraction), dtype=np.uint16)


def ten(frame):
    """Evaluator: ten particles, of which some are inside."""
    inside = np.arange(10) < int(frame[0, 0]) % 100
    return pd.DataFrame({"x_px": 1.5, "inside": inside})


def inside(table):
    return table["inside"].mean() if len(table) else np.nan


def until(condition, timeout_s=120.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "never happened"
        time.sleep(0.002)


class Hand:
    """Camera that delivers what it is handed."""

    def __init__(self, *frames):
        self.queue = Queue()
        for frame in frames:
            self.queue.put(frame)

    def grab(self):
        return self.queue.get()


class Gate:
    """Evaluator that lets a frame through when told."""

    def __init__(self, evaluate=ten):
        self.evaluate, self.open, self.seen = evaluate, threading.Semaphore(0), []

    def __call__(self, frame):
        self.seen.append(int(frame[0, 0]))
        assert self.open.acquire(timeout=20)
        return self.evaluate(frame)


def through(frames, evaluate=ten, triggers=(), **settings):
    """Let a monitor see each frame; no one is dropped, for each waits for the one before."""
    camera = Hand()
    with Monitor(camera, evaluate, triggers, **settings) as monitor:
        for n, frame in enumerate(frames, 1):
            camera.queue.put(frame)
            until(lambda n=n: monitor.status().evaluated + monitor.status().failed == n)
        camera.queue.put(None)
        assert monitor.wait(20)
    return monitor


def trigger(name="w", calls=None, **settings):
    calls = [] if calls is None else calls
    settings = {"fraction": inside, "action": lambda r: calls.append(("on", r.frame))} | settings
    return Trigger(name=name, released=lambda r: calls.append(("off", r.frame)), **settings)


# -------------------- the newest frame


def test_the_newest_frame_wins_and_drops_are_counted(tmp_path):
    camera, gate = Hand(), Gate()
    with Monitor(camera, gate, log=tmp_path / "log") as monitor:
        camera.queue.put(image(0, 0))
        until(lambda: gate.seen == [0])
        for k in range(1, 6):
            camera.queue.put(image(0, k))
        until(lambda: monitor.status().grabbed == 6)
        assert monitor.status().dropped == 4 and monitor.status().evaluated == 0
        gate.open.release(2)
        until(lambda: monitor.status().evaluated == 2)
        camera.queue.put(None)
        assert monitor.wait(20)
    assert gate.seen == [0, 500]
    assert monitor.status().state == "ended"
    assert monitor.recent()["frame"].tolist() == [0, 5] and monitor.recent()["dropped"].tolist() == [0, 4]
    frames, _ = read_log(tmp_path / "log")
    assert frames["frame"].tolist() == [0, 5] and frames["dropped"].tolist() == [0, 4]


def test_a_source_that_never_waits_takes_no_memory_and_triggers_within_one_evaluation():
    shape, frames, looks, calls = (400, 600), 600, [], []

    def flood():
        for k in range(frames):
            yield np.full(shape, 9 if k >= 311 else 3, dtype=np.uint16)

    def slow(frame):
        time.sleep(0.02)
        return ten(frame)

    act = trigger(action=lambda r: calls.append(r.frame))
    tracemalloc.start()
    with Monitor(flood(), slow, [act]) as monitor:
        assert monitor.wait(60)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    status, looks = monitor.status(), monitor.recent()["frame"]
    assert status.grabbed == frames == status.evaluated + status.dropped
    assert status.dropped > 0
    assert peak < 10 * 2 * shape[0] * shape[1]  # bytes: a few frames, not 600
    assert looks.iloc[-1] == frames - 1  # what comes last is always looked at
    assert calls == [looks[looks >= 311].iloc[0]]


def test_memory_of_a_camera_may_be_used_again():
    camera, gate, memory = Hand(), Gate(), image(0.3)
    with Monitor(camera, gate) as monitor:
        camera.queue.put(memory)
        until(lambda: gate.seen)
        memory[:] = 9
        gate.open.release()
        until(lambda: monitor.status().evaluated == 1)
        assert monitor.latest.table["inside"].sum() == 3
        np.testing.assert_array_equal(monitor.latest.image, image(0.3))
        camera.queue.put(None)


# -------------------- sources


def test_any_source_will_do():
    frames = [image(0, k) for k in range(4)]
    hand = Hand(*frames, None)
    for source in (frames, iter(frames), (f for f in frames), Hand(*frames, None), hand.grab, at_speed(frames, 1000)):
        with Monitor(source, ten) as monitor:
            assert monitor.wait(20)
        status = monitor.status()
        assert (status.grabbed, status.state) == (4, "ended")
        assert status.evaluated + status.dropped == 4
        assert monitor.latest.frame == 3 and monitor.latest.image[0, 0] == 300


def test_at_speed_hands_out_no_frame_before_its_time():
    start, times = time.perf_counter(), []
    for k in at_speed(range(5), 50):
        times.append(time.perf_counter() - start)
        assert k == len(times) - 1
    assert (np.array(times) >= np.arange(5) / 50 - 1e-3).all()


def test_a_frame_can_bring_its_own_time():
    stamp = time.perf_counter() - 100
    monitor = through([Frame(image(0), stamp)])
    assert monitor.latest.t_s == stamp
    assert monitor.latest.latency_ms > 1e5
    assert monitor.status().latency_median_ms == pytest.approx(monitor.latest.latency_ms)


# -------------------- triggers


@pytest.mark.parametrize(
    ("on", "fraction", "count", "after"),
    [
        (False, 0.9, 10, True),
        (False, 0.89, 10, False),
        (True, 0.8, 10, True),
        (True, 0.79, 10, False),
        (False, 1.0, 4, False),  # too few to tell
        (True, 0.0, 4, True),
        (False, np.nan, 10, False),
        (True, np.nan, 10, True),
    ],
)
def test_a_trigger_has_hysteresis_and_a_least_count(on, fraction, count, after):
    assert trigger().after(on, fraction, count) is after


def test_actions_are_called_when_the_state_changes_and_only_then():
    calls = []
    act = [trigger("a", calls), trigger("b", [], level=0.5, release=0.5)]
    fractions = [0.1, 0.9, 1.0, 0.8, 0.7, 0.8, 0.9]
    monitor = through([image(s) for s in fractions], triggers=act)
    assert calls == [("on", 1), ("off", 4), ("on", 6)]
    recent = monitor.recent()
    assert recent["on_a"].tolist() == [False, True, True, True, False, False, True]
    np.testing.assert_allclose(recent["fraction_a"], fractions)
    assert monitor.status().on == {"a": True, "b": True}
    assert monitor.status().fraction == {"a": 0.9, "b": 0.9}
    assert monitor.latest.changed == ("a",)


def test_the_middle_third_is_that_of_the_replay():
    rng, channel = np.random.default_rng(0), Channel(width_um=90, height_um=60)
    table = pd.DataFrame({"y": rng.uniform(-45, 45, 40), "z_um": rng.uniform(-30, 30, 40)})
    expected = replay.fractions(table.rename(columns={"y": "y_channel_um"}).assign(frame=0), [0], channel).iloc[0]
    for of in "hw":
        fraction = MiddleThird(of=of, channel=channel, to_channel=lambda t: t.assign(y_channel_um=t["y"]))
        assert fraction(table) == expected[f"fraction_{of}"] > 0.1
        assert np.isnan(fraction(table[:0]))


def test_both_thirds_convert_a_table_once():
    channel, calls = Channel(width_um=90, height_um=60), []

    def to_channel(table):
        calls.append(len(table))
        return table.assign(y_channel_um=table["y"])

    thirds = middle_thirds(channel, to_channel)
    for rows in (3, 2):
        table = pd.DataFrame({"y": [0.0, 40, 40][:rows], "z_um": [0.0, 0, 30][:rows]})
        assert {of: third(table) for of, third in thirds.items()} == {"h": 2 / rows, "w": 1 / rows}
    assert calls == [3, 2]


# -------------------- what goes wrong


def fails(frame):
    if frame[0, 0] == 600:
        sys.exit("by design")
    if frame[0, 0] == 700:
        raise ZeroDivisionError("by design")
    if frame[0, 0] == 900:
        return ten(frame).set_axis(["x_px", "x_px"], axis=1)
    return None if frame[0, 0] == 800 else ten(frame)


class Unreadable:
    """Image of a camera whose memory is gone."""

    def __array__(self, *_, **__):
        raise OSError("buffer gone")


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        (image(0, 6), "SystemExit"),
        (image(0, 7), "ZeroDivisionError"),
        (image(0, 8), "evaluate"),
        (image(0, 9), "evaluate"),
        (np.full(SHAPE, np.nan), "frame"),
        (np.full(SHAPE, np.inf, dtype=np.float32), "frame"),
        (np.zeros((3, 4)), "frame"),
        (np.zeros((3, 5, 3)), "frame"),
        (np.zeros((0, 0)), "frame"),
        ("no frame", "frame"),
        ([[1, 2], [3]], "ValueError"),
        (Unreadable(), "buffer gone"),
    ],
)
def test_a_frame_that_cannot_be_evaluated_stops_nothing(bad, word, tmp_path):
    calls = []
    frames = [image(0.9), bad, image(0.9), bad, image(0.3)]
    monitor = through(frames, fails, [trigger(calls=calls)], log=tmp_path / "log")
    status = monitor.status()
    assert (status.evaluated, status.failed, status.dropped, status.state) == (3, 2, 0, "ended")
    assert word in status.error
    assert calls == [("on", 0), ("off", 4)]  # a bad frame changes nothing
    log, particles = read_log(tmp_path / "log")
    assert log["frame"].tolist() == [0, 1, 2, 3, 4]
    assert [word in text for text in log["error"]] == [False, True, False, True, False]
    assert particles["frame"].unique().tolist() == [0, 2, 4]


@pytest.mark.parametrize("error", [OSError, SystemExit])
def test_an_action_that_raises_stops_nothing(error, tmp_path):
    calls = []

    def raises(result):
        raise error("valve stuck")

    act = [trigger("a", action=raises), trigger("b", calls)]
    monitor = through([image(0.1), image(0.9), image(0.95)], triggers=act, log=tmp_path / "log")
    assert calls == [("on", 1)]  # the others act all the same
    assert monitor.status().actions_failed == 1 and "valve stuck" in monitor.status().error
    log, _ = read_log(tmp_path / "log")
    assert log["action_error"].tolist() == ["", f"a: {error.__name__}: valve stuck", ""]
    assert log["on_a"].tolist() == [False, True, True]


def odd(frame):
    """Evaluator of a table that JSON does not know."""
    table = pd.DataFrame({("x", "px"): [1.5, 2.5], "n": pd.array([1, None], dtype="Int64")})
    return table.assign(seen=pd.array([True, None], dtype="boolean"), when=pd.Timestamp(0))


def test_any_table_can_be_logged(tmp_path):
    monitor = through([image(0)] * 2, odd, [trigger(fraction=lambda t: np.float32(0.5))], log=tmp_path / "log")
    assert (monitor.status().evaluated, monitor.status().state) == (2, "ended")
    frames, particles = read_log(tmp_path / "log")
    assert frames["fraction_w"].tolist() == [0.5, 0.5]
    assert particles["n"].tolist()[0] == 1 and particles["n"].isna().tolist() == [False, True] * 2


@pytest.mark.parametrize("stamp", [np.float32(0.5), np.int64(3)])
def test_a_time_may_be_a_scalar_of_numpy(stamp, tmp_path):
    monitor = through([Frame(image(0), stamp)], log=tmp_path / "log")
    assert monitor.status().evaluated == 1 and np.isnan(monitor.status().camera_hz)  # there is one time
    assert read_log(tmp_path / "log")[0]["t_s"].tolist() == [float(stamp)]


def test_times_that_repeat_or_go_back_are_refused_and_told(tmp_path):
    frames = [Frame(image(0), t) for t in (1.0, 1.0, 0.5, 1.1)]
    monitor = through(frames, log=tmp_path / "log")
    assert (monitor.status().evaluated, monitor.status().failed) == (2, 2)
    assert read_log(tmp_path / "log")[0]["error"].str.contains("the time").tolist() == [False, True, True, False]


@pytest.mark.parametrize("stamp", [pd.Timedelta(1, "s"), "0.5", None, np.nan])
def test_a_time_that_is_no_number_is_refused_and_told(stamp):
    with pytest.raises((TypeError, ValueError), match="t_s"):
        Frame(image(0), stamp)
    with Monitor((Frame(image(0), stamp) for _ in range(3)), ten) as monitor:
        assert monitor.wait(20)
    assert "t_s" in monitor.status().error


def test_what_the_loop_cannot_survive_is_seen(tmp_path, monkeypatch):
    def broken(self, result, failures):
        raise MemoryError("no room")

    monkeypatch.setattr(Monitor, "_noted", broken)
    with Monitor([image(0)], ten, log=tmp_path / "log") as monitor:
        with pytest.raises(RuntimeError, match="no room"):
            monitor.wait(20)
        assert monitor.status().state == "failed" and "no room" in monitor.status().error
    assert monitor.status().state == "failed"
    assert '"event":"failed"' in (tmp_path / "log").read_text()


def test_a_source_may_exit():
    def exits():
        yield image(0.1)
        sys.exit("by design")

    with Monitor(exits(), ten) as monitor:
        assert monitor.wait(20)
    assert monitor.status().error == "source: SystemExit: by design"


def test_a_source_may_stall(tmp_path):
    camera = Hand(image(0.1))
    with Monitor(camera, ten, log=tmp_path / "log") as monitor:
        until(lambda: monitor.status().evaluated == 1)
        until(lambda: monitor.status().waiting_s > 2)
        assert monitor.status().state == "running"
        camera.queue.put(image(0.2))
        until(lambda: monitor.status().evaluated == 2)
        assert monitor.status().waiting_s < 2
        camera.queue.put(None)
        assert monitor.wait(20)
    assert read_log(tmp_path / "log")[0]["frame"].tolist() == [0, 1]


def test_a_source_may_break(tmp_path):
    def breaks():
        yield image(0.1)
        raise RuntimeError("cable pulled")

    with Monitor(breaks(), ten, log=tmp_path / "log") as monitor:
        assert monitor.wait(20)
    assert monitor.status().state == "ended"
    assert monitor.status().error == "source: RuntimeError: cable pulled"
    assert monitor.status().evaluated == 1
    assert "cable pulled" in (tmp_path / "log").read_text()


def test_stop_does_not_wait_for_the_source(tmp_path):
    camera = Hand(image(0.1))
    with Monitor(camera, ten, log=tmp_path / "log") as monitor:
        until(lambda: monitor.status().evaluated == 1)
    assert monitor.status().state == "stopped"
    events = [json.loads(line).get("event") for line in (tmp_path / "log").read_text().splitlines()]
    assert events == ["started", None, "stopped"]
    camera.queue.put(image(0.1))
    time.sleep(0.05)
    assert monitor.status().evaluated == 1


def test_an_action_may_stop_the_monitor(tmp_path):
    camera = Hand()
    with Monitor(camera, ten, [trigger(action=lambda r: monitor.stop())], log=tmp_path / "log") as monitor:
        camera.queue.put(image(0.95))  # not before the name of the monitor is known to the action
        assert monitor.wait(60)
        assert monitor.status().state == "stopped"
    assert read_log(tmp_path / "log")[0]["on_w"].tolist() == [True]


def test_stop_counts_the_frame_it_leaves_as_dropped():
    camera, gate = Hand(image(0), image(0)), Gate()
    monitor = Monitor(camera, gate)
    monitor.start()
    until(lambda: monitor.status().grabbed == 2 and gate.seen)
    threading.Timer(0.1, gate.open.release).start()
    monitor.stop()
    status = monitor.status()
    assert (status.grabbed, status.evaluated, status.dropped, status.state) == (2, 1, 1, "stopped")


def test_a_monitor_that_has_not_started_can_be_asked_and_starts_once():
    monitor = Monitor([image(0)], ten, [trigger()])
    status = monitor.status()
    assert (status.state, status.grabbed, status.on) == ("ready", 0, {"w": False})
    assert np.isnan([status.latency_median_ms, status.rate_hz, status.waiting_s]).all()
    assert monitor.latest is None and monitor.recent().empty
    with monitor:
        monitor.wait(20)
    with pytest.raises(RuntimeError, match="ended"):
        monitor.start()


def test_the_example_is_evaluated_first_and_sets_the_shape():
    seen = []
    monitor = through([image(0.4)], lambda f: seen.append(f.shape) or ten(f), example=np.zeros(SHAPE))
    assert seen == [SHAPE, SHAPE]
    assert monitor.status().evaluated == 1
    assert through([image(0.4)], example=np.zeros((4, 4))).status().failed == 1
    with pytest.raises(RuntimeError, match="example"):
        Monitor([], fails, example=image(0, 7)).start()


# -------------------- sound off by default


def safely(source, evaluate=ten, triggers=(), *, patience_s=0.3, ends="failed", within_s=20.0):
    """Run a monitor to its end; it must have made safe, once."""
    calls = []
    with Monitor(source, evaluate, triggers, safe=lambda: calls.append(1), patience_s=patience_s) as monitor:
        monitor._finished.wait(within_s)
        assert monitor.status().state == ends
    assert calls == [1]
    if ends == "failed":
        with pytest.raises(RuntimeError, match="failed"):
            monitor.wait()
    return monitor.status()


def endless(**changes):
    """A camera that goes wrong at its fourth frame."""
    for k in range(10_000):
        time.sleep(0.01)
        frame, stamp = image(0.1), time.perf_counter()
        if k >= 3 and "shape" in changes:
            frame = np.zeros(changes["shape"])
        if k >= 3 and "stamp" in changes:
            stamp = changes["stamp"]
        yield Frame(frame, stamp)


def test_a_camera_that_stalls_makes_safe():
    status = safely(Hand(image(0.1)))
    assert "no frame could be evaluated for 0.3 s" in status.error and status.evaluated == 1


@pytest.mark.parametrize(("changes", "word"), [({"shape": (4, 4)}, "shape"), ({"stamp": 1e-3}, "the time")])
def test_a_camera_whose_frames_are_refused_makes_safe(changes, word):
    status = safely(endless(**changes))
    assert word in status.error and status.evaluated <= 3


def test_an_evaluator_that_hangs_or_diverges_makes_safe():
    def diverges(frame):
        raise FloatingPointError("the joint fit diverged")

    assert "diverged" in safely(endless(), diverges).error
    gate, acted = threading.Event(), []
    late = trigger(action=acted.append, level=0.05, release=0.0)
    assert "no frame" in safely(endless(), lambda frame: gate.wait(20) and ten(frame), [late]).error
    gate.set()
    time.sleep(0.1)
    assert acted == []  # what comes after it was made safe switches nothing


def test_a_device_that_does_not_answer_makes_safe():
    def refuses(result):
        raise TimeoutError("no answer")

    assert "no answer" in safely([image(1.0)] * 3, triggers=[trigger(action=refuses)]).error
    gate = threading.Event()
    safely(endless(), lambda f: ten(image(1.0)), [trigger(action=lambda result: gate.wait(20))])
    gate.set()


def test_a_source_that_breaks_makes_safe():
    def breaks():
        yield image(0.1)
        time.sleep(0.05)
        raise OSError("cable pulled")

    assert "cable pulled" in safely(breaks()).error


def test_the_end_and_a_stop_make_safe_too_and_few_bad_frames_do_not():
    safely([image(0.1)], ends="ended")
    safely(endless(), ends="running", within_s=0.1)  # and then stopped
    monitor = through([image(0.1), np.zeros((4, 4)), image(0.2)], safe=list, patience_s=20.0)
    assert monitor.status().state == "ended" and monitor.status().failed == 1


def test_what_is_safe_may_fail_and_is_told():
    with Monitor([image(0.1)], ten, safe=lambda: 1 / 0) as monitor, pytest.raises(RuntimeError, match="ZeroDivision"):
        monitor.wait(20)


def test_an_evaluator_that_follows_is_given_the_time_and_says_how(tmp_path):
    def follows(frame, t_s):
        table = ten(frame)
        table.attrs |= {"method": "joint" if t_s < 2 else "correlation", "note": "" if t_s < 2 else "too slow"}
        return table

    follows.follows = True
    frames = [Frame(image(0.1), t) for t in (1.0, 2.0)]
    monitor = through(frames, follows, log=tmp_path / "log")
    assert monitor.status().method == "correlation"
    log, _ = read_log(tmp_path / "log")
    assert log["method"].tolist() == ["joint", "correlation"] and log["note"].tolist()[1] == "too slow"


# -------------------- the log


def test_the_log_holds_what_was_seen(tmp_path):
    path = tmp_path / "log"
    runs = [through([image(s) for s in (0.2, 0.9)], triggers=[trigger("a")], log=path) for _ in range(2)]
    log, particles = read_log(path)
    assert log["run"].tolist() == [0, 0, 1, 1] and log["frame"].tolist() == [0, 1, 0, 1]
    assert log["fraction_a"].tolist() == [0.2, 0.9] * 2 and log["on_a"].tolist() == [False, True] * 2
    assert (log["t_s"] <= log["decision_s"]).all() and (log["decision_s"] <= log["done_s"]).all()
    assert log["decision_s"].iloc[-1] == runs[1].latest.decision_s
    assert particles.groupby(["run", "frame"]).size().tolist() == [10] * 4
    seen = particles.query("run == 1 and frame == 1").drop(columns=["run", "frame"]).reset_index(drop=True)
    pd.testing.assert_frame_equal(seen, ten(image(0.9)))
    status = runs[1].status()
    assert (status.log_written, status.log_waiting, status.log_lost, status.log_problem) == (4, 0, 0, "")


def test_the_log_can_leave_particles_out_and_nan_is_null(tmp_path):
    through([image(0.2)], triggers=[trigger(fraction=lambda t: np.nan)], log=tmp_path / "log", log_particles=False)
    assert '"fraction":{"w":null}' in (tmp_path / "log").read_text()
    assert read_log(tmp_path / "log")[1].empty


def test_a_full_disk_is_reported_and_no_line_is_lost(tmp_path, monkeypatch):
    full, real = threading.Event(), logbook._write

    def write(file, data):
        if full.is_set():
            real(file, data[: len(data) // 2])  # half a line still fits
            raise OSError(28, "No space left on device")
        real(file, data)

    monkeypatch.setattr(logbook, "_write", write)
    monkeypatch.setattr(logbook, "RETRY_S", 0.02)
    camera = Hand()
    with Monitor(camera, ten, log=tmp_path / "log") as monitor:
        for n in range(1, 31):
            if n == 11:
                until(lambda: monitor.status().log_written == 11)
                full.set()
            if n == 21:
                until(lambda: "No space left" in monitor.status().log_problem)
                assert monitor.status().log_waiting > 0
                full.clear()
            camera.queue.put(image(0))
            until(lambda n=n: monitor.status().evaluated == n)
        camera.queue.put(None)
        assert monitor.wait(20)
    assert monitor.status().log_problem == "" and monitor.status().log_lost == 0
    assert read_log(tmp_path / "log")[0]["frame"].tolist() == list(range(30))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a disk that is always full is a device of Linux")
def test_a_disk_that_stays_full_stops_nothing():
    monitor = through([image(0)] * 3, log="/dev/full")
    status = monitor.status()
    assert status.evaluated == 3
    assert "No space left" in status.log_problem and status.log_lost == 5 and status.log_written == 0


def test_lines_that_cannot_wait_are_counted(tmp_path, monkeypatch):
    def full(file, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(logbook, "_write", full)
    log = Logbook(tmp_path / "log", most=5)
    for k in range(20):
        log.append({"k": k})
    until(lambda: log.problem)
    assert log.waiting <= 5
    log.close()
    assert log.lost == 20 and log.written == 0


def test_a_torn_line_is_left_out_and_the_next_run_begins_on_its_own(tmp_path):
    path = tmp_path / "log"
    through([image(0.1)] * 2, log=path)
    with path.open("ab") as file:
        file.write(b'{"frame":2,"t_s":1')
    assert len(read_log(path)[0]) == 2
    through([image(0.1)], log=path)
    assert read_log(path)[0]["run"].tolist() == [0, 0, 1]


def test_an_empty_log(tmp_path):
    (tmp_path / "log").touch()
    frames, particles = read_log(tmp_path / "log")
    assert frames.empty and particles.empty
    with pytest.raises(FileNotFoundError):
        read_log(tmp_path / "none")
    with pytest.raises(FileNotFoundError):
        Monitor([], ten, log=tmp_path / "none" / "log").start()


def test_a_log_that_is_removed_or_renamed_is_begun_anew(tmp_path):
    path, camera = tmp_path / "log", Hand()
    with Monitor(camera, ten, log=path) as monitor:
        for n in range(1, 31):
            camera.queue.put(image(0))
            until(lambda n=n: monitor.status().evaluated == n and monitor.status().log_waiting == 0)
            if n == 10:
                path.rename(tmp_path / "old")
            if n == 20:
                path.unlink()
        camera.queue.put(None)
        assert monitor.wait(20)
    assert read_log(tmp_path / "old")[0]["frame"].tolist() == list(range(10))
    assert read_log(path)[0]["frame"].tolist() == list(range(20, 30))


def test_a_log_whose_folder_is_removed_is_a_problem_until_it_is_back(tmp_path):
    folder = tmp_path / "of today"
    folder.mkdir()
    log = Logbook(folder / "log")
    log.append({"frame": 0})
    until(lambda: log.written == 1)
    (folder / "log").unlink()
    folder.rmdir()
    log.append({"frame": 1})
    until(lambda: log.problem)
    assert log.waiting == 1
    folder.mkdir()
    until(lambda: log.written == 2)
    log.close()
    assert log.problem == "" and json.loads((folder / "log").read_text())["frame"] == 1


def test_two_monitors_may_share_a_log(tmp_path):
    cameras = Hand(), Hand()
    with (
        Monitor(cameras[0], ten, [trigger("a")], log=tmp_path / "log") as first,
        Monitor(cameras[1], ten, [trigger("a")], log=tmp_path / "log") as second,
    ):
        for n in range(1, 11):
            for camera, monitor, fraction in zip(cameras, (first, second), (0.1, 0.9), strict=True):
                camera.queue.put(image(fraction))
                until(lambda n=n, m=monitor: m.status().evaluated == n)
        for camera, monitor in zip(cameras, (first, second), strict=True):
            camera.queue.put(None)
            assert monitor.wait(20)
    frames, particles = read_log(tmp_path / "log")
    for run in (0, 1):
        part = frames[frames["run"] == run]
        assert part["frame"].tolist() == list(range(10)) and part["fraction_a"].nunique() == 1
        assert particles[particles["run"] == run].groupby("frame").size().tolist() == [10] * 10
    assert sorted(frames["fraction_a"].unique()) == [0.1, 0.9]


ENDLESS = """
import sys
sys.path.insert(0, sys.argv[2])
import itertools
from test_monitor import Monitor, image, ten

with Monitor((image(0.5) for _ in itertools.count()), ten, log=sys.argv[1]) as monitor:
    monitor.wait()
"""


def test_a_killed_monitor_leaves_a_log_that_can_be_read(tmp_path):
    rng = random.Random(1)
    for kill in range(round(100 * THOROUGH) or 1):
        path = tmp_path / f"log{kill}"
        command = [sys.executable, "-c", ENDLESS, str(path), str(Path(__file__).parent)]
        process = subprocess.Popen(command)
        try:
            until(lambda path=path, process=process: grown(path) or process.poll() is not None)
            time.sleep(rng.uniform(0, 0.2))
            assert process.poll() is None
        finally:
            process.kill()  # -9
            process.wait()
        lines = path.read_bytes().split(b"\n")
        assert all(json.loads(line) for line in lines[:-1])  # all but the last, at most
        frames, particles = read_log(path)
        assert len(frames) > 50 and frames["frame"].is_monotonic_increasing
        assert (frames["frame"].diff().dropna() - 1 == frames["dropped"][1:]).all()  # none is missing
        assert len(particles) == 10 * len(frames)


def grown(path):
    """Whether there are some hundred lines in a log."""
    return path.exists() and path.stat().st_size > 50_000


def resident_mb():
    """Memory that this process takes now."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells the memory of the moment")
def test_memory_is_flat(tmp_path):
    """An hour of a camera at 25 frames/s (a minute, if not thorough), but each frame as soon as the last is done."""
    number, calls, taken, done = round(90_000 * THOROUGH) or 1500, [], {}, threading.Semaphore(1)

    def camera():
        for k in range(number):
            assert done.acquire(timeout=60)
            if k in (number // 3, number - 1):
                taken[k] = resident_mb()
            frame = np.zeros((200, 300), np.uint16)  # 0.1 MB
            frame[0, 0] = 9 if k // 50 % 2 else 1
            yield Frame(frame, k / 25)

    def evaluate(frame):
        done.release()
        return ten(frame)

    with Monitor(camera(), evaluate, [trigger(calls=calls)], log=tmp_path / "log") as monitor:
        assert monitor.wait(36_000)
    status, (early, late) = monitor.status(), taken.values()
    print(f"{number} frames, {number / 25:.0f} s of a camera; {early:.1f} MB after a third, {late:.1f} MB at the end")
    assert status.evaluated + status.dropped == number and status.failed == status.log_lost == 0
    assert len(calls) >= number // 50 - 5
    assert late - early < 10


# -------------------- a process of its own


def dies(frame):
    if frame[0, 0] == 700:
        os._exit(3)
    if frame[0, 0] == 800:
        time.sleep(100)
    return ten(frame)


def test_a_process_of_its_own_may_die(tmp_path):
    frames = [image(0.1), image(0, 7), image(0.2), image(0, 8)]
    with OwnProcess(dies, timeout_s=1.0) as evaluate:
        first = evaluate(image(0.1))
        pd.testing.assert_frame_equal(first, ten(image(0.1)))
        monitor = through(frames, evaluate, log=tmp_path / "log")
        assert (monitor.status().evaluated, monitor.status().failed) == (2, 2)
        log, _ = read_log(tmp_path / "log")
        assert "the evaluating process is lost" in log["error"][1]
        assert "no answer for 1 s" in log["error"][3]
    evaluate.stop()  # again does no harm


@pytest.mark.skipif(sys.platform == "win32", reason="an interrupt of one process only")
def test_after_an_interrupt_no_frame_gets_the_answer_of_another():
    signal.signal(signal.SIGINT, signal.default_int_handler)  # not there if the shell ignores it for its own reasons
    with OwnProcess(dies) as evaluate:
        evaluate(image(0.1))
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            evaluate(image(0, 8))  # would sleep for 100 s
        for fraction in (0.2, 0.3):
            pd.testing.assert_frame_equal(evaluate(image(fraction)), ten(image(fraction)))


def test_threads_get_their_own_answers():
    wrong = []

    def ask(k):
        for _ in range(40):
            if evaluate(image(k / 10))["inside"].sum() != k:
                wrong.append(k)

    with OwnProcess(ten) as evaluate:
        threads = [threading.Thread(target=ask, args=(k,)) for k in (1, 5, 9)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


def test_a_process_that_is_stopped_tells_who_waits():
    told = []

    def ask():
        with pytest.raises(RuntimeError) as caught:
            evaluate(image(0, 8))
        told.append(str(caught.value))

    with OwnProcess(dies, timeout_s=60.0) as evaluate:
        evaluate(image(0.1))
        thread = threading.Thread(target=ask)
        thread.start()
        time.sleep(0.3)
        evaluate.stop()
        thread.join(20)
    assert len(told) == 1 and "lost" in told[0]


def test_an_evaluator_that_cannot_be_read_there_is_told():
    for _ in range(2):
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            OwnProcess(Unpicklable()).start()


class Unpicklable:
    """Evaluator that can be pickled, but not read again."""

    def __call__(self, frame):
        return ten(frame)

    def __reduce__(self):
        return divmod, (1, 0)


ORPHAN = """
import sys
sys.path.insert(0, sys.argv[1])
from test_monitor import OwnProcess, dies, image

if __name__ == "__main__":
    with OwnProcess(dies, timeout_s=1000.0) as evaluate:
        evaluate(image(0.1))
        print("evaluates", flush=True)
        evaluate(image(0, 8))  # sleeps for 100 s
"""


def test_an_evaluating_process_leaves_when_its_parent_is_killed(tmp_path):
    (tmp_path / "orphan.py").write_text(ORPHAN)
    command = [sys.executable, str(tmp_path / "orphan.py"), str(Path(__file__).parent)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert parent.stdout.readline() == "evaluates\n"
        time.sleep(0.3)
    finally:
        parent.kill()
    start = time.monotonic()
    parent.communicate(timeout=60)  # until nobody holds its output open
    assert time.monotonic() - start < 10


def test_a_process_of_its_own_finds_the_same(few, calibration):
    frame, _ = few
    method = replay.Method(evaluator=locate, calibration=calibration)
    with OwnProcess(method) as evaluate:
        pd.testing.assert_frame_equal(evaluate(frame), locate(frame, calibration), rtol=1e-9)
        with pytest.raises(RuntimeError, match="image"):
            evaluate(np.zeros((5, 5)))
        pd.testing.assert_frame_equal(evaluate(frame), locate(frame, calibration), rtol=1e-9)


# -------------------- bad input


@pytest.mark.parametrize(
    ("call", "error", "name"),
    [
        (lambda: Monitor(3, ten), TypeError, "source"),
        (lambda: Monitor([], 3), TypeError, "evaluate"),
        (lambda: Monitor([], ten, ["w"]), TypeError, "triggers"),
        (lambda: Monitor([], ten, [trigger(), trigger()]), TypeError, "triggers"),
        (lambda: Monitor([], ten, window=1), ValueError, "window"),
        (lambda: Monitor([], ten, safe=1), TypeError, "safe"),
        (lambda: Monitor([], ten, safe=print, patience_s=0), ValueError, "patience_s"),
        (lambda: OwnProcess(ten, niceness=20), ValueError, "niceness"),
        (lambda: Monitor([], ten, example=[1]), ValueError, "example"),
        (lambda: trigger(""), TypeError, "name"),
        (lambda: trigger(action=None), TypeError, "action"),
        (lambda: trigger(fraction=0.9), TypeError, "fraction"),
        (lambda: trigger(level=0.5), ValueError, "release"),
        (lambda: trigger(level=-1), ValueError, "level"),
        (lambda: trigger(least=-1), ValueError, "least"),
        (lambda: at_speed([], 0), ValueError, "rate_hz"),
        (lambda: OwnProcess(lambda frame: None), TypeError, "evaluate"),
        (lambda: OwnProcess(3), TypeError, "evaluate"),
        (lambda: OwnProcess(ten, timeout_s=0), ValueError, "timeout_s"),
        (lambda: Logbook("x", most=0), ValueError, "most"),
        (lambda: MiddleThird(of="x", channel=Channel(), to_channel=ten), ValueError, "of"),
        (lambda: MiddleThird(of="h", channel=3, to_channel=ten), TypeError, "channel"),
        (lambda: MiddleThird(of="h", channel=Channel(), to_channel=3), TypeError, "to_channel"),
        (lambda: middle_thirds(Channel(), 3), TypeError, "to_channel"),
    ],
)
def test_bad_input_is_refused(call, error, name):
    with pytest.raises(error, match=name):
        call()


def test_a_partial_function_is_an_evaluator(few, calibration):
    frame, particles = few
    monitor = through([frame], partial(locate, calibration=calibration))
    assert len(monitor.latest.table) == len(particles)


def test_a_log_is_no_folder(tmp_path):
    with pytest.raises(ValueError, match=r"^path: .*folder"):
        Logbook(tmp_path)
