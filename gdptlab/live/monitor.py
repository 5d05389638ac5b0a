"""A monitor beside a running camera: it evaluates the newest frame, decides, acts, and logs the result.

Two threads share one slot. One thread takes frames from the source as they come and puts each into the slot, on top of
the frame that is there; the other takes the frame in the slot, evaluates it, and decides. So the camera never waits,
memory holds two or three frames however fast the camera is, and the frame evaluated is always the newest; a frame that
is overwritten before it was taken is dropped, and counted. `replay.watch` computes the same clock without waiting.

No error of a frame stops the loop: the error is counted and logged, and the next frame is taken. An error that the
loop cannot survive ends it in the state 'failed', which `status` shows and `wait` raises. Whoever switches something
gives the monitor `safe`, such as "sound off": it is called when nobody watches any more, whatever the reason, and the
monitor then also fails where it is blind for too long, or where an action fails.

A thread shares Python's interpreter with the rest of the program, such as drawing. An evaluator wrapped in
`OwnProcess` works in another process, and drawing delays it no more than a busy core would.

All times are those of `time.perf_counter`, which is one clock for all processes of a machine.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from threading import Condition, Event, Lock, Thread, current_thread
from time import perf_counter
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import function, instances, positive, real_array, whole
from gdptlab._checks import path as check_path
from gdptlab.live.logbook import Logbook
from gdptlab.live.own_process import as_text
from gdptlab.live.sources import Frame
from gdptlab.live.triggers import Trigger, as_fraction

DIGITS = 3
"""Number of decimals of a particle's numbers in the log. Chosen: the least error measured is some 0.01 px. With 1,
the log would add an error of its own; with all digits, it would be three times as long."""

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
    fraction, low, high : dict
        Of each trigger, by name, and the ends of its band (`triggers.Fraction`); empty if there is an error.
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
    low: dict[str, float]
    high: dict[str, float]
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
    method : str
        How the evaluator says that it evaluated that frame; empty if it says nothing.
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
    method: str
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
        time is the moment at which it comes, or a `Frame`, which has a time of its own. Times must increase.
    evaluate : callable
        image -> DataFrame with a row for each particle: a `replay.Method`, `functools.partial(locate,
        calibration=...)`, or an `OwnProcess` around one of these. A `Follower`, whose attribute `follows` is true, is
        called with the frame's time, too.
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
    safe : callable, optional
        Called once, without arguments, when the monitor fails, ends or is stopped: what is switched must be off when
        nobody watches. With it the monitor fails where otherwise it would go on: where no frame could be evaluated
        for `patience_s` (the camera is silent, its frames are refused, the evaluator or an action hangs), where the
        source breaks, and where an action raises.
    patience_s : float
        For `safe`.

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
        safe: Callable[[], object] | None = None,
        patience_s: float = 1.0,
    ) -> None:
        if not (callable(source) or callable(getattr(source, "grab", None)) or hasattr(source, "__iter__")):
            raise TypeError(f"source: got {source!r}, allowed is one with a method grab, a function, or an iterable")
        function("evaluate", evaluate)
        if safe is not None:
            function("safe", safe)
        self._safe, self._patience_s = safe, positive("patience_s", patience_s)
        self._triggers = tuple(instances("triggers", triggers, Trigger))
        names = [trigger.name for trigger in self._triggers]
        if len(set(names)) < len(names):
            raise TypeError(f"triggers: got {names}, allowed are Triggers of different names")
        self._source, self._evaluate, self._log_particles = source, evaluate, log_particles
        self._follows = bool(getattr(evaluate, "follows", False))
        self._example = None if example is None else real_array("example", example, 2)
        self._log_path, self._log = None if log is None else check_path("log", log), None
        self._shape = None if self._example is None else self._example.shape
        self._changed, self._stopping, self._finished = Condition(), Event(), Event()
        self._slot: tuple[int, Frame] | None = None
        self._frame_s, self._good_s = -np.inf, np.nan  # times of the last frame, and of the last good result
        self._lock = Lock()  # of all below
        self._state, self._ended, self.started_s, self._last_s = "ready", False, np.nan, np.nan
        self._grabbed = self._evaluated = self._failed = self._dropped = self._actions_failed = 0
        self._error, self._latest = "", None
        self._over = False
        self._fraction, self._on, self._count = {}, dict.fromkeys(names, False), 0
        window = whole("window", window, 2, 10**6)
        self._arrived: deque[float] = deque(maxlen=window)
        self._rows: deque[dict[str, Any]] = deque(maxlen=window)
        runs = (self._grab, self._watch, self._guard)
        self._threads = [Thread(target=run, name=run.__name__, daemon=True) for run in runs]

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
        self._good_s = self.started_s
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
            self._end("stopped")  # if the frame takes longer
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
                method="" if self._latest is None else self._latest.table.attrs.get("method", ""),
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
            if self._safe is not None:
                self._end("failed", f"source: {as_text(error)}")
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _watch(self) -> None:
        """Run the loop, and note whether the source, `stop` or an error ended it."""
        try:
            self._loop()
            self._end("stopped" if self._stopping.is_set() else "ended")
        except BaseException as caught:
            self._end("failed", as_text(caught))

    def _guard(self) -> None:
        """Fail when no frame could be evaluated for too long, if that is asked for."""
        while self._safe is not None and not self._finished.wait(self._patience_s / 10):
            if perf_counter() - self._good_s > self._patience_s:
                self._end("failed", f"no frame could be evaluated for {self._patience_s:g} s; {self._error}")

    def _end(self, state: str, error: str = "") -> None:
        """Set the state at the end, switch to what is safe, and log it; only the first call counts."""
        with self._lock:
            first, self._over = not self._over, True
            if first:
                self._state, self._error = state, error or self._error
        if not first:
            return
        self._stopping.set()  # nobody takes the frames that the source may still deliver
        with self._changed:
            self._changed.notify_all()
        try:
            if self._safe is not None:
                self._safe()
        except BaseException as caught:
            error = f"{error}; safe: {as_text(caught)}".strip("; ")
            with self._lock:
                self._state, self._error = "failed", error
        try:
            event = {"event": self._state, "grabbed": self._grabbed, "dropped": self._dropped, "t_s": perf_counter()}
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
            if self._over:
                break  # it failed meanwhile, and made safe: nothing is switched any more
            last = number
            failures = self._acted(result)
            self._noted(result, failures)
            if failures and self._safe is not None:
                self._end("failed", failures[0])
        with self._lock:
            self._dropped += taken is not None  # by a stop

    def _decided(self, number: int, frame: Frame, dropped: int) -> Result:
        """Evaluate a frame, and decide which triggers are on; any error becomes the result's."""
        try:
            image = self._checked(frame.image)
            if frame.t_s <= self._frame_s:
                raise ValueError(
                    f"frame: got the time {frame.t_s:g} s, allowed is later than {self._frame_s:g}, as before"
                )
            self._frame_s = frame.t_s
            table = self._evaluate(image, frame.t_s) if self._follows else self._evaluate(image)
            if not isinstance(table, pd.DataFrame):
                raise TypeError(f"evaluate: got a {type(table).__name__} from it, allowed is a DataFrame")
            if not table.columns.is_unique:
                raise ValueError(f"evaluate: got columns {list(table)} from it, allowed are different names")
            fraction = {t.name: as_fraction(t.fraction(table)) for t in self._triggers}
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
            fraction={name: float(f) for name, f in fraction.items()},
            low={name: f.low for name, f in fraction.items()},
            high={name: f.high for name, f in fraction.items()},
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
        plain |= {name: result.table.attrs[name] for name in ("method", "note") if result.table.attrs.get(name)}
        row = {"t_s": result.t_s - self.started_s, "decision_s": result.decision_s - self.started_s}
        parts = {part: getattr(result, part) for part in ("fraction", "low", "high")}
        by_name = {f"{part}_{name}": value for part, values in parts.items() for name, value in values.items()}
        by_name |= {f"on_{name}": value for name, value in result.on.items()}
        with self._lock:
            self._latest, self._on = result, result.on
            if result.error:
                self._failed += 1
            else:
                self._evaluated, self._count, self._fraction = self._evaluated + 1, len(result.table), result.fraction
                self._good_s = done_s
            self._actions_failed += len(failures)
            self._error = (failures or [result.error or self._error])[-1]
            self._rows.append(plain | row | {"latency_ms": result.latency_ms} | by_name)
        line = plain | {"t_s": result.t_s, "decision_s": result.decision_s, "done_s": done_s}
        line |= {"action_error": "; ".join(failures), **parts, "on": result.on}
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
