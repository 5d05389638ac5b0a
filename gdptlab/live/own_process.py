"""Evaluate frames in another process: what this one is busy with, such as drawing, does not delay it.

`concurrent.futures.ProcessPoolExecutor` would take fewer lines, but it cannot end a worker that hangs (before Python
3.14), and its workers go on when the program that started them is killed.
"""

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable
from contextlib import suppress
from threading import RLock, Thread
from typing import Any, Self

import pandas as pd
from numpy.typing import NDArray

from gdptlab._checks import positive, whole

PROCESSES = multiprocessing.get_context("spawn")
"""How processes are started: afresh, on every system. A forked copy of this process could hold a lock for ever."""

START_S = 120.0
"""Longest time, s, that a process may take to start, and that the very first frame may take. Chosen: imports take
some seconds and the compilation of machine code some ten, on a busy machine four times as long. Much shorter, a slow
start counts as a failure; much longer, the caller of a process that hangs waits in vain."""


class OwnProcess:
    """Evaluate frames in a process of its own; if that process dies or takes too long, the next frame starts another.

    The process takes some seconds to start, and serves one `Monitor` after the other. Threads that call it wait for
    each other. Use it in a `with` block, or `stop` it; it ends with the program in any case. A program that is a file
    must start it under ``if __name__ == "__main__":``, since the process reads that file, too.

    Parameters
    ----------
    evaluate : callable
        image -> DataFrame, that can be pickled: its parts come from modules, not from a notebook.
    timeout_s : float
        Longest time for one frame, but for the first, which may have to wait for machine code to be compiled.

    niceness : int
        By how much the process gives way to others, 0 to 19, as of `os.nice` (not on Windows). Drawing takes 19.

    Raises
    ------
    TypeError
        If `evaluate` is no function or cannot be pickled.
    ValueError
        If the time is not above 0, or the niceness out of range.
    """

    def __init__(
        self, evaluate: Callable[[NDArray], pd.DataFrame], *, timeout_s: float = 10.0, niceness: int = 0
    ) -> None:
        if not callable(evaluate):
            raise TypeError(f"evaluate: got {evaluate!r}, allowed is a function")
        try:
            self._pickled = pickle.dumps(evaluate)
        except Exception as error:
            raise TypeError(
                f"evaluate: got {evaluate!r}, which cannot be sent to another process ({as_text(error)}); allowed is a "
                "function from a module, not from a notebook's cells"
            ) from error
        self._timeout_s, self.follows = positive("timeout_s", timeout_s), getattr(evaluate, "follows", False)
        self._niceness = whole("niceness", niceness, 0, 19)
        self._process, self._number, self._one_caller, self._answered = None, 0, RLock(), False

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start the process, if it does not run, and wait until it is ready.

        Raises
        ------
        RuntimeError
            If it cannot be started.
        """
        with self._one_caller:
            if self._process is not None:
                return
            self._connection, other = PROCESSES.Pipe()
            self._process = PROCESSES.Process(target=_serve, args=(other, self._niceness), daemon=True)
            self._process.start()
            other.close()  # so that this process notices the end of the other
            try:
                self._answer(self._pickled, START_S)
            except RuntimeError:
                self.stop()
                raise

    def __call__(self, *frame: Any) -> pd.DataFrame:
        """Evaluate a frame in the process: what is given here is what the function there is called with.

        Raises
        ------
        RuntimeError
            With the text of the error that was raised there, or if the process died or took too long.
        """
        with self._one_caller:
            self.start()
            table = self._answer(frame, self._timeout_s if self._answered else max(START_S, self._timeout_s))
            self._answered = True
            return table

    def _answer(self, request: Any, timeout_s: float) -> pd.DataFrame | None:
        """Send a request, and return the answer that carries its number."""
        self._number += 1
        try:
            self._connection.send((self._number, request))
            number = None
            while number != self._number:
                if not self._connection.poll(timeout_s):
                    raise TimeoutError(f"no answer for {timeout_s:g} s")
                number, error, table = self._connection.recv()
        except (EOFError, OSError) as lost:
            self.stop()
            text = f"the evaluating process is lost, {as_text(lost)}; the next frame starts another"
            raise RuntimeError(text) from lost
        except BaseException:  # an interrupt: the next caller need not wait for this frame
            self.stop()
            raise
        if error:
            raise RuntimeError(error)
        return table

    def stop(self) -> None:
        """End the process at once; a thread that waits for its answer gets a RuntimeError."""
        with suppress(AttributeError, ValueError):  # there is none, or another thread has closed it
            self._process.kill()
        with self._one_caller:
            if self._process is not None:
                self._process.join()
                self._process.close()
                self._connection.close()
                self._process = None


def _serve(connection: Any, niceness: int) -> None:
    """Unpickle the evaluator in the first request through the connection, and evaluate the frames in all others."""
    follow_parent()
    if niceness and hasattr(os, "nice"):
        os.nice(niceness)
    evaluate = None
    with suppress(EOFError, OSError):
        while True:
            number, request = connection.recv()
            error, table = "", None
            try:
                if evaluate is None:
                    evaluate = pickle.loads(request)
                else:
                    table = evaluate(*request)
            except Exception as raised:
                error = as_text(raised)
            connection.send((number, error, table))


def follow_parent() -> None:
    """In a child process: leave interrupts to the parent, and end at once when the parent has ended or was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    Thread(target=lambda: (parent.join(), os._exit(1)), name="follow parent", daemon=True).start()


def as_text(error: BaseException) -> str:
    """Return the kind of an error, and what it says."""
    return f"{type(error).__name__}: {error}"
