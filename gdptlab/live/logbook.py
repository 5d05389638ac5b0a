"""A log of lines that survives what stops the program: a crash, `kill -9`, a power cut, a full disk.

Lines are JSON, one object each, and each carries the identifier of its run, since two monitors may write to one file.
A thread of its own writes all lines that wait, asks the operating system to put them on the disk (fsync), and then
writes the lines that have come meanwhile. So nobody who appends waits for the disk. A killed program leaves all lines
but those of the last milliseconds; a power cut all but those of the last fsync, some tens of milliseconds. A line that
was cut short is alone on its line, and `read_log` leaves it out. While nothing can be written, because the disk is
full, lines wait in memory and go to the file, in order, as soon as there is room. If the file is removed or renamed
meanwhile, the next lines go to a new file of the same name.

The handlers of `logging` promise less: `QueueListener` drops what its handler could not write, and does not count it.
"""

import json
import math
import os
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from threading import Condition, Thread
from typing import Any
from uuid import uuid4

import numpy as np
import pandas as pd

from gdptlab._checks import path as check_path
from gdptlab._checks import whole

RETRY_S = 0.5
"""Pause, s, before a failed write is tried again. Chosen: with 0, a full disk keeps a core busy; with many seconds,
lines wait in memory for longer than the disk is full."""


class Logbook:
    """Append records to a file, from any thread, without waiting for the disk.

    Parameters
    ----------
    path : str or path-like
        Of the file; made if there is none, else continued. Its folder must exist.
    most : int
        Largest number of lines that may wait for the disk. Beyond that the oldest are lost, and counted.

    Attributes
    ----------
    run : str
        Identifier of this run, in each line.
    written : int
        Number of lines that are on the disk.
    lost : int
        Number of lines that never will be.
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
        self.run, self.written, self.lost, self.problem, self._appended = uuid4().hex[:12], 0, 0, "", 0
        self._most, self._path = whole("most", most, 1, 2**31), check_path("path", path)
        if self._path.is_dir():
            raise ValueError(f"path: got {path}, a folder, allowed is a file")
        self._lines: deque[bytes] = deque()
        self._changed, self._closing = Condition(), False
        self._open()
        self._thread = Thread(target=self._write_lines, name="logbook", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of lines that are not on the disk yet."""
        return self._appended - self.written - self.lost

    def append(self, record: Mapping[str, Any]) -> None:
        """Add one line. NaN, infinity and missing values become null; what JSON does not know becomes text."""
        line = json.dumps(_as_json({"run": self.run, **record}), separators=(",", ":"), allow_nan=False, default=str)
        with self._changed:
            self._lines.append(line.encode() + b"\n")
            self._appended += 1
            if len(self._lines) > self._most:
                self._lines.popleft()
                self.lost += 1
            self._changed.notify()

    def close(self, timeout_s: float = 5.0) -> None:
        """Write the lines that wait, and close the file; lines that cannot be written are lost, and counted."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def _open(self) -> None:
        """Open the file at its end, and note whether its last line was cut short."""
        self._file = open(self._path, "ab", buffering=0)
        self._cut_short = False
        if self._path.is_file() and self._path.stat().st_size:
            with self._path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                self._cut_short = file.read() != b"\n"

    def _put(self, lines: deque[bytes]) -> None:
        """Write lines to the disk, and remove each from `lines` once it is in the file."""
        same = self._path.exists() and not self._file.closed
        if not (same and os.path.samestat(self._path.stat(), os.fstat(self._file.fileno()))):
            self._file.close()
            self._open()  # the file was removed or renamed
        while lines:
            data = b"\n" * self._cut_short + lines[0]
            self._cut_short = True
            _write(self._file, data)
            self._cut_short = False
            lines.popleft()
        os.fsync(self._file.fileno())

    def _write_lines(self) -> None:
        """Write what waits until `close` is called (the thread)."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._closing)
                lines, self._lines = self._lines, deque()
            count = len(lines)
            if not count:
                break
            try:
                self._put(lines)
                self.written, self.problem = self.written + count, ""
            except OSError as error:
                with self._changed:
                    self.written, self.problem = self.written + count - len(lines), f"{type(error).__name__}: {error}"
                    self._lines.extendleft(reversed(lines))
                    excess = len(self._lines) - (0 if self._closing else self._most)
                    for _ in range(excess):
                        self._lines.popleft()
                        self.lost += 1
                    if self._closing:
                        break
                    self._changed.wait_for(lambda: self._closing, RETRY_S)
        with suppress(OSError):
            self._file.close()


def _write(file: Any, data: bytes) -> None:
    """Write all bytes to an unbuffered file, of which one system call may take a part only."""
    while data:
        data = data[file.write(data) :]


def _as_json(value: Any) -> Any:
    """Return a value with NaN, infinity and missing values as None, numpy's scalars as Python's, and names as text."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is pd.NA or value is pd.NaT or (isinstance(value, float) and not math.isfinite(value)):
        return None
    if isinstance(value, Mapping):
        return {str(name): _as_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    return value


def read_log(path: str | os.PathLike[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read the log of a `Monitor`, finished or cut short.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    frames : DataFrame
        A row for each frame that was evaluated: `run` (a file may hold several, numbered from 0 in the order in which
        they began), `frame`, `t_s`, `decision_s`, `done_s`, `dropped`, `count`, `error`, `action_error`, `method` and
        `note` where the evaluator gives them, and for each trigger `fraction_NAME`, `low_NAME`, `high_NAME` and
        `on_NAME` (see `monitor.Result`).
    particles : DataFrame
        `run`, `frame` and the columns of the evaluator's table, rounded; empty if it was not logged.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    runs, rows, tables = {}, [], []
    path = check_path("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"path: got {str(path)!r}, allowed is a file")
    with path.open(encoding="utf-8", errors="replace") as file:
        for text in file:
            try:
                line = json.loads(text)
            except ValueError:  # cut short
                continue
            run = runs.setdefault(line.pop("run", ""), len(runs))
            if "frame" not in line:
                continue
            particles = line.pop("particles", None)
            for name in ("fraction", "low", "high", "on"):
                line |= {f"{name}_{trigger}": value for trigger, value in line.pop(name, {}).items()}
            rows.append({"run": run} | line)
            if particles:
                tables.append(pd.DataFrame(particles).assign(run=run, frame=line["frame"]))
    together = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=["run", "frame"])
    return pd.DataFrame(rows), together[["run", "frame", *together.columns.drop(["run", "frame"])]]
