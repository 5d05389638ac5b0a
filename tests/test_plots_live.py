"""Pictures of a monitor show what it saw."""

import sys
import time
import types
from dataclasses import replace
from io import BytesIO
from urllib.error import HTTPError
from urllib.request import urlopen

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gdptlab import plots
from gdptlab.experiment.channel import Channel
from gdptlab.live import Monitor, Trigger, middle_thirds
from gdptlab.plots import watching

CHANNEL = Channel(width_um=120, height_um=60)


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


def to_channel(table):
    return table.assign(y_channel_um=table["y_px"] - 30)


def seen(image):
    n = int(image[0, 0])
    y_px = np.where(np.arange(10) < n, 31.0, 80.0)
    return pd.DataFrame({"x_px": np.arange(10.0), "y_px": y_px, "z_um": 3.0})


@pytest.fixture
def monitor():
    thirds = middle_thirds(CHANNEL, to_channel).values()
    triggers = [Trigger(name=third.of, fraction=third, action=str) for third in thirds]
    frames = iter([np.full((90, 40), n, np.uint8) for n in (4, 9)])
    monitor = Monitor(lambda: slowly(monitor, frames), seen, triggers)
    with monitor:
        assert monitor.wait(60)
    return monitor


def slowly(monitor, frames):
    """The next frame when the one before has been seen."""
    while (status := monitor.status()).grabbed > status.evaluated:
        time.sleep(0.001)
    return next(frames, None)


def panel_of(monitor, **changed):
    status = replace(monitor.status(), **changed)
    settings = {"channel": CHANNEL, "to_channel": to_channel, "level": 0.85}
    return plots.live_panel(monitor.latest, monitor.recent(), status, **settings)


def test_the_panel_shows_the_last_frame_and_the_past(monitor):
    figure = panel_of(monitor)
    frame, section, words, fractions, late = figure.axes
    assert frame.get_title(loc="left") == "frame 1: 10 particles"
    np.testing.assert_array_equal(frame.images[0].get_array(), np.full((90, 40), 9))
    np.testing.assert_array_equal(frame.collections[0].get_offsets()[:, 0], np.arange(10))
    np.testing.assert_array_equal(section.collections[0].get_offsets()[[0, 9]], [[1, 3], [50, 3]])
    lines = {line.get_label(): line.get_ydata() for line in fractions.get_lines()}
    np.testing.assert_allclose(lines["h/3"], [1, 1])
    np.testing.assert_allclose(lines["w/3"], [0.4, 0.9])
    band = fractions.collections[1].get_paths()[0].get_extents()  # of the width
    assert band.y0 == pytest.approx(monitor.recent()["low_w"].min()) and 0.9 < band.y1 < 1
    np.testing.assert_array_equal(late.get_lines()[0].get_ydata(), monitor.recent()["latency_ms"])
    assert words.texts[0].get_text().startswith("ended, 2 frames\n")


def test_the_panel_says_what_is_wrong(monitor):
    text = (
        panel_of(monitor, state="running", waiting_s=7.2, error="ValueError: no", log_problem="full").axes[2].texts[0]
    )
    assert "no frame for 7 s" in text.get_text() and "ValueError: no" in text.get_text()
    assert "lines !" in text.get_text()


def test_the_panel_of_a_monitor_that_has_seen_nothing():
    monitor = Monitor([], seen)
    settings = {"channel": CHANNEL, "to_channel": to_channel}
    figure = plots.live_panel(monitor.latest, monitor.recent(), monitor.status(), **settings)
    assert len(figure.axes[0].images) == 0


def test_it_is_drawn_until_the_source_ends(monitor, monkeypatch):
    shown = []
    handle = types.SimpleNamespace(update=shown.append)
    display = types.SimpleNamespace(display=lambda p, display_id: shown.append(p) or handle, Image=bytes)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setattr(watching.LivePanel, "__enter__", lambda self: self)  # no process
    monkeypatch.setattr(watching.LivePanel, "png", lambda self, at_once: b"last" if at_once else b"picture")
    waits = iter([False, False, True])
    monkeypatch.setattr(monitor, "wait", lambda seconds: next(waits))
    plots.watch_live(monitor, period_s=0.1, channel=CHANNEL, to_channel=to_channel)
    assert shown == [b"picture", b"picture", b"last"]


def test_a_page_shows_the_picture_that_another_process_drew(monitor):
    with plots.LivePanel(monitor, channel=CHANNEL, to_channel=to_channel) as panel, plots.LivePage(panel) as page:
        assert b"panel.png" in urlopen(page.url).read()
        first = urlopen(page.url + "panel.png?1").read()
        assert plt.imread(BytesIO(first), format="png").shape[:2] == (352, 840)
        start = time.perf_counter()
        assert urlopen(page.url + "panel.png?2").read() == first  # not drawn again so soon
        assert time.perf_counter() - start < 1
        with pytest.raises(HTTPError, match="404"):
            urlopen(page.url + "../etc/passwd")


def test_pictures_that_cannot_be_drawn_stop_nothing(monitor):
    with plots.LivePanel(monitor, channel=CHANNEL, to_channel=to_channel) as panel:
        panel._draw.stop()
        panel._draw._pickled = b"no pickle"
        assert panel.png() == b""


def test_what_was_seen_stands_beside_what_is_true():
    seen = pd.DataFrame({"t_s": [0.0, 0.1]})
    for of in "hw":
        seen = seen.assign(**{f"{what}_{of}": [0.4, 0.95] for what in ("true", "correlation", "joint")})
        seen[f"joint_{of}_low"] = [0.3, 0.8]
    for axes in plots.seen_and_true(seen, 0.9).axes:
        np.testing.assert_array_equal(axes.get_lines()[1].get_ydata(), [0.4, 0.95])
        assert axes.collections[0].get_paths()[0].get_extents().y0 == 0.3


def test_off_times_count_those_that_never_are():
    decided = pd.DataFrame({"way": "joint", "of": "h", "true_s": 1.0, "off_s": [1.02, 0.9, np.nan, 1.2]})
    (step,) = plots.off_times(decided, 0.1).axes[0].get_lines()
    np.testing.assert_allclose(step.get_xydata(), [[-1, 0], [-0.1, 25], [0.02, 50], [0.2, 75], [1, 75]], atol=1e-9)


def test_loops_and_timer():
    loop = pd.DataFrame({"energy_density_J_m3": [4.0, 6.0], "needed_s": [1.2, 0.9], "off_s": [1.3, 1.0]})
    loop["true_fraction"] = [0.95, 0.89]
    timers = pd.DataFrame(
        {"seed": [1, 2, 1, 2], "off_s": [0.5, 0.5, 1.5, 1.5], "true_fraction": [0.5, 0.95, 0.93, 0.99]}
    )
    left, right = plots.loop_and_timer(loop, timers, 0.9, {"nominal": 1.1}).axes
    np.testing.assert_array_equal(left.get_lines()[1].get_xydata(), [[4, 1.3], [6, 1]])
    np.testing.assert_array_equal(right.get_lines()[0].get_xydata(), [[0.5, 50], [1.5, 0]])
    assert right.get_lines()[1].get_ydata()[0] == 50
