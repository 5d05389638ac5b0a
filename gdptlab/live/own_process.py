"""Evaluate frames in another process: what this one is busy with, such as drawing, does not delay it."""

import multiprocessing
import pickle
import signal
from collections.abc import Callable
from typing import Any, Self

import pandas as pd
from numpy.typing import NDArray

from gdptlab._checks import positive

PROCESSES = multiprocessing.get_context("spawn")
"""How processes are started: afresh, on every system. A copy of this one could hold a lock that nobody releases."""

START_S = 120.0
"""How long a process may take to start."""


class OwnProcess:
    """Evaluate frames in a process of its own; if it dies, or takes too long, the next frame starts another.

    It takes some seconds to start, and serves one `Monitor` after the other. Use it in a `with` block, or `stop`
    it; it ends with the program in any case. A program that is a file must start it under
    ``if __name__ == "__main__":``, since the process reads that file, too.

    Parameters
    ----------
    evaluate : callable
        image -> DataFrame, that can be pickled: what it consists of comes from modules, not from a notebook.
    timeout_s : float
        For one frame.

    Raises
    ------
    TypeError
        If `evaluate` is no function or cannot be pickled.
    ValueError
        If the time is not above 0.
    """

    def __init__(self, evaluate: Callable[[NDArray], pd.DataFrame], *, timeout_s: float = 10.0) -> None:
        if not callable(evaluate):
            raise TypeError(f"evaluate: got {evaluate!r}, allowed is a function")
        try:
            self._pickled = pickle.dumps(evaluate)
        except Exception as error:
            raise TypeError(
                f"evaluate: got {evaluate!r}, which a process of its own cannot be given ({as_text(error)}); allowed "
                "is what comes from modules, not from a notebook's cells"
            ) from error
        self._timeout_s = positive("timeout_s", timeout_s)
        self._process = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start the process, if it does not run, and wait until it is there.

        Raises
        ------
        RuntimeError
            If it cannot be started.
        """
        if self._process is not None:
            return
        self._connection, other = PROCESSES.Pipe()
        self._process = PROCESSES.Process(target=_serve, args=(other, self._pickled), daemon=True)
        self._process.start()
        other.close()  # so that either process sees the end of the other
        self._answer(START_S)

    def __call__(self, image: NDArray) -> pd.DataFrame:
        """Evaluate a frame there.

        Raises
        ------
        RuntimeError
            With the text of what was raised there, or if it died or took too long.
        """
        self.start()
        try:
            self._connection.send(image)
        except OSError:
            pass  # it is gone, as no answer will tell
        return self._answer(self._timeout_s)

    def _answer(self, timeout_s: float) -> Any:
        try:
            if not self._connection.poll(timeout_s):
                raise TimeoutError(f"no answer for {timeout_s:g} s")
            error, table = self._connection.recv()
        except (EOFError, OSError) as lost:
            self.stop()
            raise RuntimeError(
                f"the evaluating process is lost, {as_text(lost)}; the next frame starts another"
            ) from lost
        if error:
            raise RuntimeError(error)
        return table

    def stop(self) -> None:
        """End the process, at once."""
        if self._process is not None:
            self._connection.close()
            self._process.kill()
            self._process.join()
            self._process.close()
            self._process = None


def _serve(connection: Any, pickled: bytes) -> None:
    """Evaluate what comes through the connection, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the program that started this one
    try:
        evaluate = pickle.loads(pickled)
    except Exception as error:
        connection.send((as_text(error), None))
        return
    connection.send(("", None))
    try:
        while True:
            image = connection.recv()
            try:
                answer = "", evaluate(image)
            except Exception as error:
                answer = as_text(error), None
            connection.send(answer)
    except (EOFError, OSError):
        pass


def as_text(error: BaseException) -> str:
    """Kind of an error, and what it says."""
    return f"{type(error).__name__}: {error}"
