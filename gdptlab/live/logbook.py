"""A log of lines that survives what stops the program: a crash, `kill -9`, a power cut, a full disk.

Lines are JSON, one object each. A thread of its own writes all that wait, then asks the operating system to put
them on the disk (fsync), then writes what has come meanwhile. So nobody who appends ever waits for the disk; a
killed program leaves what was written up to some milliseconds before; a power cut, what had been put on the disk:
all but the lines of the last fsync, some tens of milliseconds. Either way only the last line can be incomplete,
and `read_log` leaves that one out. While nothing can be written, because the disk is full, lines wait in memory
and go to the file, in order, as soon as there is room.
"""

import json
import math
import os
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from threading import Condition, Thread
from typing import Any

import pandas as pd

from gdptlab._checks import whole

RETRY_S = 0.5
"""Pause before a failed write is tried again."""


class Logbook:
    """Append records to a file, from any thread, without waiting for the disk.

    Parameters
    ----------
    path : str or path-like
        Of the file; made if there is none, else continued. Its folder must exist.
    most : int
        Lines that may wait for the disk. Beyond that the oldest are lost, and counted.

    Attributes
    ----------
    written : int
        Lines that are on the disk.
    lost : int
        Lines that never will be.
    problem : str
        Why writing fails at present; empty if it does not.

    Raises
    ------
    OSError
        If the file cannot be opened.
    TypeError, ValueError
        If `most` is not a whole number above 0.
    """

    def __init__(self, path: str | os.PathLike[str], *, most: int = 10_000) -> None:
        self.written, self.lost, self.problem, self._appended = 0, 0, "", 0
        self._most = whole("most", most, 1, 2**31)
        self._lines: deque[bytes] = deque()
        self._changed, self._closing = Condition(), False
        _finish_last_line(Path(path))
        self._file = open(path, "ab", buffering=0)
        self._end = os.fstat(self._file.fileno()).st_size
        self._thread = Thread(target=self._run, name="logbook", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Lines that are not on the disk yet."""
        return self._appended - self.written - self.lost

    def append(self, record: Mapping[str, Any]) -> None:
        """Add one line. NaN and infinity become null."""
        line = json.dumps(_finite(record), separators=(",", ":"), allow_nan=False).encode() + b"\n"
        with self._changed:
            self._lines.append(line)
            self._appended += 1
            if len(self._lines) > self._most:
                self._lines.popleft()
                self.lost += 1
            self._changed.notify()

    def close(self, timeout_s: float = 5.0) -> None:
        """Write what waits, and close the file; what cannot be written is lost, and counted."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._closing)
                batch = list(self._lines)
                if not batch:
                    break
                self._lines.clear()
            try:
                data = b"".join(batch)
                _write(self._file, data)
                os.fsync(self._file.fileno())
            except OSError as error:
                with suppress(OSError):
                    self._file.truncate(self._end)  # no half a line
                with self._changed:
                    self.problem = f"{type(error).__name__}: {error}"
                    room = max(self._most - len(self._lines), 0)
                    keep = batch[len(batch) - min(room, len(batch)) :]
                    self.lost += len(batch) - len(keep)
                    self._lines.extendleft(reversed(keep))
                    if self._closing:
                        self.lost += len(self._lines)
                        self._lines.clear()
                        break
                    self._changed.wait_for(lambda: self._closing, RETRY_S)
            else:
                self._end += len(data)
                self.written, self.problem = self.written + len(batch), ""
        with suppress(OSError):
            self._file.close()


def _write(file: Any, data: bytes) -> None:
    """Write all of it: a system call may take a part only."""
    while data:
        data = data[file.write(data) :]


def _finish_last_line(path: Path) -> None:
    """Put an end to a line that a crash cut short, so that the next one begins on its own."""
    if path.is_file() and path.stat().st_size:
        with path.open("r+b") as file:
            file.seek(-1, os.SEEK_END)
            if file.read() != b"\n":
                file.write(b"\n")


def _finite(value: Any) -> Any:
    """The same without NaN and infinity, which are not JSON."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def read_log(path: str | os.PathLike[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read the log of a `Monitor`, finished or cut short.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    frames : DataFrame
        A row for each frame that was looked at: `run` (a file may hold several, from 0), `frame`, `t_s`,
        `decision_s`, `done_s`, `dropped`, `count`, `error`, `action_error`, and for each trigger `fraction_NAME`
        and `on_NAME` (see `monitor.Result`).
    particles : DataFrame
        `run`, `frame` and the columns of the evaluator's table, rounded; empty if it was not logged.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    run, rows, tables = -1, [], []
    with open(path, encoding="utf-8", errors="replace") as file:
        for text in file:
            try:
                line = json.loads(text)
            except ValueError:  # cut short
                continue
            if "frame" not in line:
                run += line.get("event") == "started"
                continue
            particles = line.pop("particles", None)
            for name in ("fraction", "on"):
                line |= {f"{name}_{trigger}": value for trigger, value in line.pop(name).items()}
            rows.append({"run": run} | line)
            if particles:
                tables.append(pd.DataFrame(particles).assign(run=run, frame=line["frame"]))
    together = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=["run", "frame"])
    return pd.DataFrame(rows), together[["run", "frame", *together.columns.drop(["run", "frame"])]]
