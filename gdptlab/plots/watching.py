"""What a monitor sees at this moment, in a notebook or as a page: drawn by a process of its own that gives way."""

from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from threading import Lock, Thread
from time import perf_counter
from typing import Any, Self

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gdptlab._checks import function, instance, positive
from gdptlab.experiment.channel import Channel
from gdptlab.live.monitor import Monitor, Result, Status
from gdptlab.live.own_process import OwnProcess
from gdptlab.plots.experiment import TRIGGER_COLOURS, limit_to_channel
from gdptlab.plots.style import COLOURS, DEPTH, bare, grey, styled

REST = 4.0
"""Shortest pause between two pictures, in times that the last one took. Chosen: drawing then takes at most a fifth of a
core, and the lowest priority. With 0, a slow machine would do nothing but draw."""

FONT = {"family": "monospace", "size": 9}
"""Font of the panel's numbers."""

PAGE = b"""<!doctype html><title>gdptlab live</title><body style="margin:0;background:#fff">
<img id="panel" src="panel.png" style="width:100%"><script>
const panel = document.getElementById("panel");
panel.onload = panel.onerror = () => setTimeout(() => { panel.src = "panel.png?" + Date.now() }, 500);
</script>"""
"""A page that shows the newest picture, again and again."""


@styled
def live_panel(
    result: Result | None,
    recent: pd.DataFrame,
    status: Status,
    *,
    channel: Channel,
    to_channel: Callable[[pd.DataFrame], pd.DataFrame],
    level: float = 0.9,
    seconds: float = 10.0,
) -> Figure:
    """Show what a monitor sees at this moment.

    It only reads what `Monitor.latest`, `Monitor.recent` and `Monitor.status` give, so it can be drawn as rarely as
    one likes. About 0.2 s of one core.

    Parameters
    ----------
    result : Result or None
        The frame last looked at, if there is one.
    recent : DataFrame
    status : Status
    channel : Channel
    to_channel : callable
        As of `monitor.MiddleThird`.
    level : float
        Fraction that triggers.
    seconds : float
        How far the curves go back.

    Returns
    -------
    Figure
        The frame with its particles, coloured by depth; the cross-section with the middle thirds; fractions with
        their bands, and triggers (named 'h' and 'w'; thick where on); latencies; and the status in words.
    """
    figure, axes = plt.subplot_mosaic(
        [["frame", "section", "words"], ["frame", "fractions", "late"]],
        figsize=(10.5, 4.4),
        width_ratios=[1.25, 1, 1],
    )
    figure.subplots_adjust(left=0.01, right=0.985, bottom=0.12, top=0.92, wspace=0.28, hspace=0.42)
    half = channel.height_um / 2
    limit_to_channel(axes["section"], channel)
    axes["section"].set(xlabel="y (µm)", ylabel="z (µm)")
    bare(axes["frame"])
    if result is not None:
        if np.ndim(result.image) == 2:
            axes["frame"].imshow(result.image, **grey(result.image))
        axes["frame"].set_title(f"frame {result.frame}: {result.error or f'{len(result.table)} particles'}")
        if len(result.table):
            here = to_channel(result.table)
            colour = {"cmap": DEPTH, "vmin": -half, "vmax": half}
            rings = axes["frame"].scatter(here["x_px"], here["y_px"], s=120, lw=1.6, c=here["z_um"], **colour)
            rings.set_edgecolor(rings.to_rgba(here["z_um"]))
            rings.set_facecolor("none")
            axes["section"].scatter(
                here["y_channel_um"], here["z_um"], c=here["z_um"], s=18, ec="0.3", lw=0.4, **colour
            )
    _fractions(axes["fractions"], recent, level, seconds)
    _latencies(axes["late"], recent, seconds)
    axes["words"].axis("off")
    axes["words"].text(0, 1, _words(status), va="top", transform=axes["words"].transAxes, **FONT)
    return figure


def _span(recent: pd.DataFrame, seconds: float) -> tuple[float, float]:
    """Give the limits of the time axis: the last `seconds` before the newest decision."""
    end = recent["decision_s"].max() if len(recent) else 0.0
    return max(end - seconds, 0), max(end, 1.0)


def _fractions(axes: Axes, recent: pd.DataFrame, level: float, seconds: float) -> None:
    """Draw the two fractions against time, thick while their trigger is on."""
    axes.axhline(level, color="black", lw=0.8, ls=":")
    for name, colour in TRIGGER_COLOURS.items():
        if f"fraction_{name}" in recent:
            axes.plot(recent["t_s"], recent[f"fraction_{name}"], color=colour, lw=1.2, label=f"{name}/3")
            band = recent[f"low_{name}"], recent[f"high_{name}"]
            axes.fill_between(recent["t_s"], *band, color=colour, alpha=0.2, lw=0)
            on = recent[f"fraction_{name}"].where(recent[f"on_{name}"])
            axes.plot(recent["t_s"], on, color=colour, lw=4, solid_capstyle="butt")
            axes.legend(loc="lower right", fontsize="small")
    axes.set(xlabel="t (s)", ylabel="fraction (thick: on)", ylim=(0, 1.05), xlim=_span(recent, seconds))


def _latencies(axes: Axes, recent: pd.DataFrame, seconds: float) -> None:
    """Draw the latency of each evaluated frame against time."""
    if len(recent):
        axes.plot(recent["t_s"], recent["latency_ms"], ".", color=COLOURS[2], ms=4)
        axes.set_ylim(0, 1.15 * recent["latency_ms"].max())
    axes.set(xlabel="t (s)", ylabel="latency (ms)", xlim=_span(recent, seconds))


def _words(status: Status) -> str:
    """Write the monitor's state and its counts, a line for each."""
    lines = [
        f"{status.state}, {status.grabbed} frames",
        f"camera  {status.camera_hz:5.1f} /s",
        f"looks   {status.rate_hz:5.1f} /s",
        f"dropped {status.dropped:5d}",
        f"failed  {status.failed:5d}",
        f"latency {status.latency_median_ms:5.1f} ms, 99 %: {status.latency_p99_ms:.0f}",
        f"log     {status.log_written:5d} lines" + (" !" if status.log_problem else ""),
    ]
    if status.waiting_s > 1 and status.state == "running":
        lines.append(f"no frame for {status.waiting_s:.0f} s")
    if status.method:
        lines.append(f"by      {status.method}")
    if status.error:
        lines.append(status.error[:34])
    return "\n".join(lines)


class LivePanel:
    """Pictures of a monitor, drawn by a process of its own with the lowest priority, and not too often.

    Use it in a `with` block, which ends the process. A picture that cannot be drawn is the one before: drawing stops
    nothing.

    Parameters
    ----------
    monitor : Monitor
    period_s : float
        Shortest time between two pictures; it is at least `REST` times what one takes.
    **settings
        Of `live_panel`. They must be such that they can be sent to another process.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of its kind.
    """

    def __init__(self, monitor: Monitor, *, period_s: float = 1.0, **settings: Any) -> None:
        self._monitor, self.period_s = instance("monitor", monitor, Monitor), positive("period_s", period_s)
        function("to_channel", settings.get("to_channel"))
        self._draw = OwnProcess(partial(drawn, **settings), timeout_s=60.0, niceness=19)
        self._one_at_a_time, self._png, self._next_s = Lock(), b"", -1.0

    def __enter__(self) -> Self:
        self._draw.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._draw.stop()

    def png(self, at_once: bool = False) -> bytes:
        """Return the picture as PNG: a new one if it is time for that, or wanted at once, else the one before."""
        with self._one_at_a_time:
            start = perf_counter()
            if at_once or start >= self._next_s:
                monitor = self._monitor
                try:
                    self._png = self._draw((monitor.latest, monitor.recent(), monitor.status()))
                except RuntimeError:
                    pass  # the next is drawn by a new process
                now = perf_counter()
                self._next_s = max(start + self.period_s, now + REST * (now - start))
            return self._png


def drawn(seen: tuple[Result | None, pd.DataFrame, Status], **settings: Any) -> bytes:
    """Return `live_panel` of result, recent frames and status as PNG."""
    plt.switch_backend("agg")
    file = BytesIO()
    live_panel(*seen, **settings).savefig(file, format="png")
    return file.getvalue()


def watch_live(monitor: Monitor, *, period_s: float = 1.0, **settings: Any) -> None:
    """Show `live_panel` in a notebook, again and again, until the monitor's source has ended.

    A monitor that has not started is started when all that drawing takes is there.

    Parameters
    ----------
    monitor, period_s, **settings
        As of `LivePanel`.
    """
    from IPython.display import Image, display

    shown, ended = None, False
    with LivePanel(monitor, period_s=period_s, **settings) as panel:
        if monitor.status().state == "ready":
            panel.png()
            monitor.start()
        while not ended:
            ended = monitor.wait(period_s)
            picture = Image(panel.png(at_once=ended))  # the last shows the end
            if shown is None:
                shown = display(picture, display_id=True)
            else:
                shown.update(picture)


class LivePage:
    """A page for the screen beside the microscope, that shows a panel to a browser of this machine.

    Use it in a `with` block. The standard library's server is enough for one picture; nothing else is needed.

    Parameters
    ----------
    panel : LivePanel
    port : int
        Of the page; 0: any that is free.

    Attributes
    ----------
    url : str
    """

    def __init__(self, panel: LivePanel, port: int = 0) -> None:
        instance("panel", panel, LivePanel)

        class Handler(BaseHTTPRequestHandler):
            """Answers with the page, or with the picture."""

            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                body, kind = {"/": (PAGE, "text/html"), "/panel.png": (None, "image/png")}.get(path, (b"", ""))
                body = panel.png() if body is None else body
                self.send_response(200 if kind else 404)
                self.send_header("Content-Type", kind or "text/plain")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                """Print nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}/"
        self._thread = Thread(target=self._server.serve_forever, name="live page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
