"""Processes that joblib starts for a film: they leave with the program that started them."""

import multiprocessing
import os
from threading import Thread
from time import sleep


def leave_with_parent() -> None:
    """In a process that joblib has just started, watch for the end of the program that started it, and end as well.

    If that program is killed, such a process would otherwise wait for more work, for some minutes. In a process of
    another kind nothing happens.
    """
    if not multiprocessing.current_process().name.startswith("LokyProcess"):
        return
    parent = multiprocessing.parent_process().pid

    def watch() -> None:
        """End this process once it is the child of another."""
        while os.getppid() == parent:
            sleep(0.5)
        os._exit(1)

    Thread(target=watch, name="leave with parent", daemon=True).start()
