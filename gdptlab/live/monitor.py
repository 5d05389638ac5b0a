"""A monitor beside a running camera: it evaluates the newest frame, decides, acts, and logs the result.

Two threads share one slot. One thread takes frames from the source as they come and puts each into the slot, on top of
the frame that is there; the other takes the frame in the slot, evaluates it, and decides. So the camera never waits,
memory holds two or three frames however fast the camera is, and the frame evaluated is always the newest; a frame that
is overwritten before it was taken is dropped, and counted. `replay.watch` computes the same clock without waiting.

No error of a frame stops the loop: the error is counted and logged, and the next frame is taken. An error that the
loop cannot survive ends it in the state 'failed', which `status` shows and `wait` raises.

A thread shares Python's interpreter with the rest of the program, such as drawing. An evaluator wrapped in
`OwnProcess` works in another process, and drawing delays it no more than a busy core would.

All times are those of `time.perf_counter`, which is one clock for all processes of a machine.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from threading import Condition, Event, Lock, Thread, current_thread
from time import perf_counter, sleep
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import choice, function, instance, instances, iterable, number, positive, rate, real_array, whole
from gdptlab._checks import path as check_path
from gdptlab.experiment.channel import Channel
from gdptlab.experiment.trigger import in_middle_third
from gdptlab.live.logbook import Logbook
from gdptlab.live.own_process import as_text

DIGITS = 3
"""Number of decimals of a particle's numbers in the log. Chosen: the least error measured is some 0.01 px. With 1,
the log would add an error of its own; with all digits, it would be three times as long."""

# -------------------- what goes in


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame, and when the camera delivered it.

    Attributes
    ----------
    image : array (rows, columns)
    t_s : float
        On the clock of `time.perf_counter`.

    Raises
    ------
    TypeError, ValueError
        If the time is not a finite number.
    """

    image: ArrayLike
    t_s: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "t_s", number("t_s", self.t_s))


def at_speed(frames: Iterable[ArrayLike], rate_hz: float) -> Iterator[ArrayLike]:
    """Yield frames at true speed: the first at once, frame i at i / rate_hz, none before its time.

    Parameters
    ----------
    frames : iterable of arrays (rows, columns)
        Such as a `Film`. A frame that is not ready in time comes late, and so may the frames after it.
    rate_hz : float
        Frames in a second.

    Yields
    ------
    array (rows, columns)

    Raises
    ------
    TypeError, ValueError
        If the rate is not a number above 0.
    """
    iterable("frames", frames)
    period_s = 1 / rate("rate_hz", rate_hz)

    def paced() -> Iterator[ArrayLike]:
        """Sleep until the time of each frame (the check of the rate must not wait for the first)."""
        start = perf_counter()
        for i, frame in enumerate(frames):
            sleep(max(start + i * period_s - perf_counter(), 0))
            yield frame

    return paced()


@dataclass(frozen=True, kw_only=True)
class MiddleThird:
    """Fraction of the particles in the middle third of the channel's height or width: the paper's two triggers.

    Attributes
    ----------
    of : str
        'h' (|z| ≤ h/6) or 'w' (|y| ≤ w/6), as in `experiment.fractions`.
    channel : Channel
    to_channel : callable
        Table of an evaluator -> the same with `y_channel_um` and `z_um`; for example `Film.to_channel`.

    Raises
    ------
    TypeError, ValueError
        If a field is not of its kind.
    """

    of: str
    channel: Channel
    to_channel: Callable[[pd.DataFrame], pd.DataFrame]

    def __post_init__(self) -> None:
        choice("of", self.of, "hw")
        instance("channel", self.channel, Channel)
        function("to_channel", self.to_channel)

    def __call__(self, table: pd.DataFrame) -> float:
        """Return the fraction, from 0 to 1; NaN without particles."""
        inside = in_middle_third(self.to_channel(table), self.of, self.channel)
        return float(inside.mean()) if len(inside) else np.nan


def middle_thirds(channel: Channel, to_channel: Callable[[pd.DataFrame], pd.DataFrame]) -> dict[str, MiddleThird]:
    """Return the `MiddleThird` of height, 'h', and of width, 'w', which convert the table of a frame only once.

    Parameters
    ----------
    channel, to_channel
        As of `MiddleThird`.

    Raises
    ------
    TypeError
        If one is not of its kind.
    """
    function("to_channel", to_channel)
    last: tuple[pd.DataFrame | None, pd.DataFrame | None] = (None, None)

    def converted(table: pd.DataFrame) -> pd.DataFrame:
        """Convert a table, unless it is the one converted last."""
        nonlocal last
        if table is not last[0]:
            last = table, to_channel(table)
        return last[1]

    return {of: MiddleThird(of=of, channel=channel, to_channel=converted) for of in "hw"}


@dataclass(frozen=True, kw_only=True)
class Trigger:
    """When to act.

    The trigger goes on with the first frame whose fraction is at or above `level`, and off again with the first whose
    fraction is below `release`. Between the two, and in a frame with fewer than `least` particles, it does not change.

    Attributes
    ----------
    name : str
    fraction : callable
        Table of the evaluator -> number, such as a `MiddleThird`. A NaN changes nothing.
    action : callable
        Called with the `Result` when the trigger goes on, in the evaluating thread: the next frame waits for it.
    released : callable, optional
        Called with the `Result` when the trigger goes off.
    level : float
        Fraction at which the trigger goes on (paper: 0.9).
    release : float
        Fraction below which the trigger goes off; at most `level`.
    least : int
        Smallest number of particles in a frame that may change the trigger.

    Raises
    ------
    TypeError, ValueError
        If a field is not of its kind or out of range.
    """

    name: str
    fraction: Callable[[pd.DataFrame], float]
    action: Callable[["Result"], object]
    released: Callable[["Result"], object] | None = None
    level: float = 0.9
    release: float = 0.8
    least: int = 5

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise TypeError(f"name: got {self.name!r}, allowed is a word")
        for part in ("fraction", "action", "released"):
            if part != "released" or self.released is not None:
                function(part, getattr(self, part))
        positive("level", self.level)
        if positive("release", self.release, zero=True) > self.level:
            raise ValueError(f"release: got {self.release:g}, allowed is up to level, {self.level:g}")
        whole("least", self.least, 0, 2**31)

    def after(self, on: bool, fraction: float, count: int) -> bool:
        """Return whether the trigger is on after a frame, given whether it was on before."""
        if count < self.least:
            return on
        return bool(fraction >= (self.release if on else self.level) or (on and np.isnan(fraction)))


# -------------------- what comes out


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """What the monitor made of one frame.

    Attributes
    ----------
    frame : int
        Its number among all frames of the source, from 0.
    t_s, decision_s : float
        When it was delivered, and when its evaluation ended.
    dropped : int
        Number of frames dropped between this one and the one evaluated before.
    image : array (rows, columns), or what else came
    table : DataFrame
        From the evaluator; without rows if there is an error.
    fraction : dict
        Of each trigger, by name; empty if there is an error.
    on : dict
        Whether each trigger is on, by name.
    changed : tuple of str
        Names of the triggers that went on or off with this frame.
    error : str
        Why the frame could not be evaluated; empty if it could.
    """

    frame: int
    t_s: float
    decision_s: float
    dropped: int
    image: Any
    table: pd.DataFrame
    fraction: dict[str, float]
    on: dict[str, bool]
    changed: tuple[str, ...] = ()
    error: str = ""

    @property
    def latency_ms(self) -> float:
        """From the frame's delivery to the decision."""
        return 1e3 * (self.decision_s - self.t_s)


@dataclass(frozen=True, kw_only=True)
class Status:
    """How a monitor is doing.

    Rates and latencies are those of the last `window` frames.

    Attributes
    ----------
    state : str
        'ready', 'running', 'ended' (the source has no more frames, and all are evaluated), 'stopped', or 'failed' (an
        error ended the loop).
    grabbed, evaluated, failed, dropped : int
        Numbers of frames that came, that were evaluated, that could not be evaluated, and that were dropped. Up to two
        more are under way.
    camera_hz, rate_hz : float
        Frames that came, and that were evaluated, in a second; NaN before there are two at different times.
    latency_median_ms, latency_p99_ms, latency_max_ms : float
        From a frame's delivery to the decision; NaN before the first.
    waiting_s : float
        Since the last frame came, or the start.
    count : int
        Number of particles in the last frame that was evaluated.
    fraction, on : dict
        Of each trigger, by name.
    actions_failed : int
        Number of actions of triggers that raised an error.
    error : str
        The last error of a frame, an action, the source or the loop; empty if there was none.
    log_written, log_waiting, log_lost : int
        Numbers of lines on the disk, on the way there, and lost.
    log_problem : str
        Why the log cannot be written at present; empty if it can.
    """

    state: str
    grabbed: int
    evaluated: int
    failed: int
    dropped: int
    camera_hz: float
    rate_hz: float
    latency_median_ms: float
    latency_p99_ms: float
    latency_max_ms: float
    waiting_s: float
    count: int
    fraction: dict[str, float]
    on: dict[str, bool]
    actions_failed: int
    error: str
    log_written: int
    log_waiting: int
    log_lost: int
    log_problem: str


# -------------------- the loop


class Monitor:
    """Evaluate the newest frame of a source, decide, act, log the result, and take the newest frame again.

    Use it in a `with` block, which stops it at the end, or `start` and `stop` it.

    Parameters
    ----------
    source : object
        A camera with a method `grab`, or a function: it is called for one frame after the other, and waits until there
        is one (None: no more). Or an iterable of frames, such as `at_speed(film, 25)`. A frame is an array, whose
        time is the moment at which it comes, or a `Frame`, which has a time of its own.
    evaluate : callable
        image -> DataFrame with a row for each particle: a `replay.Method`, `functools.partial(locate,
        calibration=...)`, or an `OwnProcess` around one of these.
    triggers : sequence of Trigger
    log : str or path-like, optional
        File to which a line is added for each frame evaluated (see `logbook`).
    log_particles : bool
        Put the particles into the log, too: about 3 kB for 100 particles.
    example : array (rows, columns), optional
        A frame like those to come. It is evaluated at the start, so that what is made at first use is there when
        the first frame comes; and frames of another shape are refused. Without it the first frame sets the shape.
    window : int
        Number of last frames in rates, latencies and `recent`.

    Attributes
    ----------
    started_s : float
        When the monitor began to take frames; NaN before.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of its kind.
    """

    def __init__(
        self,
        source: Any,
        evaluate: Callable[[NDArray], pd.DataFrame],
        triggers: Sequence[Trigger] = (),
        *,
        log: str | os.PathLike[str] | None = None,
        log_particles: bool = True,
        example: ArrayLike | None = None,
        window: int = 1000,
    ) -> None:
        if not (callable(source) or callable(getattr(source, "grab", None)) or hasattr(source, "__iter__")):
            raise TypeError(f"source: got {source!r}, allowed is one with a method grab, a function, or an iterable")
        function("evaluate", evaluate)
        self._triggers = tuple(instances("triggers", triggers, Trigger))
        names = [trigger.name for trigger in self._triggers]
        if len(set(names)) < len(names):
            raise TypeError(f"triggers: got {names}, allowed are Triggers of different names")
        self._source, self._evaluate, self._log_particles = source, evaluate, log_particles
        self._example = None if example is None else real_array("example", example, 2)
        self._log_path, self._log = None if log is None else check_path("log", log), None
        self._shape = None if self._example is None else self._example.shape
        self._changed, self._stopping, self._finished = Condition(), Event(), Event()
        self._slot: tuple[int, Frame] | None = None
        self._lock = Lock()  # of all below
        self._state, self._ended, self.started_s, self._last_s = "ready", False, np.nan, np.nan
        self._grabbed = self._evaluated = self._failed = self._dropped = self._actions_failed = 0
        self._error, self._latest = "", None
        self._fraction, self._on, self._count = {}, dict.fromkeys(names, False), 0
        window = whole("window", window, 2, 10**6)
        self._arrived: deque[float] = deque(maxlen=window)
        self._rows: deque[dict[str, Any]] = deque(maxlen=window)
        self._threads = [Thread(target=run, name=run.__name__, daemon=True) for run in (self._grab, self._watch)]

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Evaluate the example, then begin to take frames.

        Raises
        ------
        RuntimeError
            If the monitor was started before, or the example cannot be evaluated.
        OSError
            If the log cannot be opened.
        """
        if self._state != "ready":
            raise RuntimeError(f"the monitor is {self._state}, and starts only once")
        self._log = None if self._log_path is None else Logbook(self._log_path)
        try:
            if self._example is not None:
                self._evaluate(self._example)
        except Exception as error:
            self._close()
            raise RuntimeError(f"the example could not be evaluated: {as_text(error)}") from error
        self._state, self.started_s = "running", perf_counter()
        self._write({"event": "started", "utc": datetime.now(UTC).isoformat(), "t_s": self.started_s})
        for thread in self._threads:
            thread.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the source has ended and all frames are evaluated; False if that takes longer than `timeout_s`.

        Raises
        ------
        RuntimeError
            If an error ended the loop (state 'failed').
        """
        finished = self._finished.wait(timeout_s)
        if self._state == "failed":
            raise RuntimeError(f"the monitor failed: {self._error}")
        return finished

    def stop(self, timeout_s: float = 5.0) -> None:
        """Finish the frame under evaluation, if that takes no longer than `timeout_s`, and close the log.

        A source that waits for a frame goes on waiting until the program ends. An action may call `stop`, too; then
        the log is closed where the `with` block ends, or by another call.
        """
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        if current_thread() is self._threads[1]:
            return
        if self._state == "running":
            self._finished.wait(timeout_s)
            self._threads[0].join(0.2)  # it ends at once, unless its source waits
        self._close()

    def _close(self) -> None:
        """Set the state at the end, and close the log."""
        with self._lock:
            self._state = "stopped" if self._state in ("ready", "running") else self._state
        if self._log is not None:
            self._log.close()

    # What can be asked at any time, from any thread.

    @property
    def latest(self) -> Result | None:
        """Result of the frame evaluated last."""
        return self._latest

    def recent(self) -> pd.DataFrame:
        """Return the last frames evaluated: `frame`, `t_s` and `decision_s` since the start, `latency_ms`, `dropped`,
        `count`, `error`, and `fraction_NAME`, `on_NAME` of each trigger."""
        with self._lock:
            return pd.DataFrame(list(self._rows))

    def status(self) -> Status:
        """Return state, counts, rates and the last error."""
        with self._lock:
            latency = np.array([row["latency_ms"] for row in self._rows] or [np.nan])
            since = self._last_s if self._grabbed else self.started_s
            log = self._log
            return Status(
                state=self._state,
                grabbed=self._grabbed,
                evaluated=self._evaluated,
                failed=self._failed,
                dropped=self._dropped,
                camera_hz=_rate(list(self._arrived)),
                rate_hz=_rate([row["decision_s"] for row in self._rows]),
                latency_median_ms=float(np.median(latency)),
                latency_p99_ms=float(np.percentile(latency, 99)),
                latency_max_ms=float(latency.max()),
                waiting_s=perf_counter() - since,
                count=self._count,
                fraction=dict(self._fraction),
                on=dict(self._on),
                actions_failed=self._actions_failed,
                error=self._error,
                log_written=log.written if log else 0,
                log_waiting=log.waiting if log else 0,
                log_lost=log.lost if log else 0,
                log_problem=log.problem if log else "",
            )

    # The two threads.

    def _grab(self) -> None:
        """Put each frame of the source into the slot."""
        try:
            for item in _frames(self._source):
                if self._stopping.is_set():
                    break
                frame = _copied(item if isinstance(item, Frame) else Frame(item, perf_counter()))
                with self._lock:
                    number, self._grabbed = self._grabbed, self._grabbed + 1
                    self._last_s = perf_counter()
                    self._arrived.append(frame.t_s)
                with self._changed:
                    missed, self._slot = self._slot, (number, frame)
                    self._changed.notify()
                if missed is not None:
                    with self._lock:
                        self._dropped += 1
        except BaseException as error:  # sys.exit as well: in a thread, nobody would see it
            with self._lock:
                self._error = f"source: {as_text(error)}"
            self._write({"event": "source failed", "error": as_text(error), "t_s": perf_counter()})
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _watch(self) -> None:
        """Run the loop, and note whether the source, `stop` or an error ended it."""
        try:
            self._loop()
            state, error = "stopped" if self._stopping.is_set() else "ended", ""
        except BaseException as caught:
            state, error = "failed", as_text(caught)
        with self._lock:
            self._state, self._error = state, error or self._error
        self._stopping.set()  # nobody takes the frames that the source may still deliver
        try:
            event = {"event": state, "grabbed": self._grabbed, "dropped": self._dropped, "t_s": perf_counter()}
            self._write(event | ({"error": error} if error else {}))
        finally:
            self._finished.set()

    def _loop(self) -> None:
        """Take the frame in the slot, evaluate it, decide, act, and log it, until there are no more."""
        last = -1
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._slot is not None or self._ended or self._stopping.is_set())
                taken, self._slot = self._slot, None
            if taken is None or self._stopping.is_set():
                break
            number, frame = taken
            result = self._decided(number, frame, number - last - 1)
            last = number
            self._noted(result, self._acted(result))
        with self._lock:
            self._dropped += taken is not None  # by a stop

    def _decided(self, number: int, frame: Frame, dropped: int) -> Result:
        """Evaluate a frame, and decide which triggers are on; any error becomes the result's."""
        try:
            table = self._evaluate(self._checked(frame.image))
            if not isinstance(table, pd.DataFrame):
                raise TypeError(f"evaluate: got a {type(table).__name__} from it, allowed is a DataFrame")
            if not table.columns.is_unique:
                raise ValueError(f"evaluate: got columns {list(table)} from it, allowed are different names")
            fraction = {t.name: float(t.fraction(table)) for t in self._triggers}
            on = {t.name: t.after(self._on[t.name], fraction[t.name], len(table)) for t in self._triggers}
            error = ""
        except BaseException as caught:  # sys.exit as well
            table, fraction, on, error = pd.DataFrame(), {}, self._on, as_text(caught)
        return Result(
            frame=number,
            t_s=frame.t_s,
            decision_s=perf_counter(),
            dropped=dropped,
            image=frame.image,
            table=table,
            fraction=fraction,
            on=on,
            changed=tuple(name for name, value in on.items() if value != self._on[name]),
            error=error,
        )

    def _checked(self, image: Any) -> NDArray:
        """Return a frame as an array (rows, columns) of finite numbers in the shape of those before, or refuse it."""
        image = np.asarray(image)
        if image.ndim != 2 or image.dtype.kind not in "buif":
            raise ValueError(f"frame: got {image.dtype} of shape {image.shape}, allowed are numbers on two axes")
        if self._shape is None:
            self._shape = image.shape
        if image.shape != self._shape:
            raise ValueError(f"frame: got shape {image.shape}, allowed is {self._shape}, as before")
        if image.dtype.kind == "f" and not np.isfinite(image).all():
            raise ValueError("frame: got NaN or infinity, allowed are finite numbers")
        return image

    def _acted(self, result: Result) -> list[str]:
        """Call the actions of the triggers that changed, and return the errors that they raised."""
        failures = []
        for trigger in self._triggers:
            if trigger.name in result.changed:
                call = trigger.action if result.on[trigger.name] else trigger.released
                try:
                    if call is not None:
                        call(result)
                except BaseException as error:  # sys.exit as well
                    failures.append(f"{trigger.name}: {as_text(error)}")
        return failures

    def _noted(self, result: Result, failures: list[str]) -> None:
        """Count the result and the errors of actions, keep them for `status` and `recent`, and log them."""
        done_s = perf_counter()
        plain = {"frame": result.frame, "dropped": result.dropped, "count": len(result.table), "error": result.error}
        row = {"t_s": result.t_s - self.started_s, "decision_s": result.decision_s - self.started_s}
        by_name = {f"fraction_{name}": value for name, value in result.fraction.items()}
        by_name |= {f"on_{name}": value for name, value in result.on.items()}
        with self._lock:
            self._latest, self._on = result, result.on
            if result.error:
                self._failed += 1
            else:
                self._evaluated, self._count, self._fraction = self._evaluated + 1, len(result.table), result.fraction
            self._actions_failed += len(failures)
            self._error = (failures or [result.error or self._error])[-1]
            self._rows.append(plain | row | {"latency_ms": result.latency_ms} | by_name)
        line = plain | {"t_s": result.t_s, "decision_s": result.decision_s, "done_s": done_s}
        line |= {"action_error": "; ".join(failures), "fraction": result.fraction, "on": result.on}
        if self._log_particles and len(result.table):
            columns = result.table.select_dtypes(["number", "bool"])
            line["particles"] = {name: columns[name].round(DIGITS).tolist() for name in columns}
        self._write(line)

    def _write(self, record: dict[str, Any]) -> None:
        """Add a line to the log, if there is one."""
        if self._log is not None:
            self._log.append(record)


def _frames(source: Any) -> Iterator[Any]:
    """Yield the frames of a camera, a function or an iterable."""
    take = getattr(source, "grab", source)
    if not callable(take):
        yield from source
    else:
        while (frame := take()) is not None:
            yield frame


def _copied(frame: Frame) -> Frame:
    """Return a copy, as a camera may use its memory again; or the frame itself if its image is no array."""
    try:
        return Frame(np.array(frame.image), frame.t_s)
    except BaseException:  # the error comes again, and is noted, where the frame is evaluated
        return frame


def _rate(times_s: list[float]) -> float:
    """Return the number of times (n,) in a second, NaN if they do not differ."""
    span_s = times_s[-1] - times_s[0] if times_s else 0.0
    return (len(times_s) - 1) / span_s if span_s > 0 else np.nan
