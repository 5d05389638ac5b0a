"""Kernels on several threads, with the same result to the last bit on any number of them."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

CHUNKS = 8
"""Parts into which the work is cut, on any number of threads: enough that two or four of them end at about one time."""


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def in_parts(threads: int, cost: np.ndarray, kernel: Callable[[int, int], None]) -> None:
    """Call `kernel(first, end)` for parts of the items whose `cost` (n,) is about equal.

    Each part must write to memory of its own.
    """
    count = len(cost)
    if threads == 1 or count < CHUNKS:
        kernel(0, count)
        return
    total = np.cumsum(cost)
    ends = np.searchsorted(total, total[-1] * np.arange(1, CHUNKS) / CHUNKS)
    ends = np.concatenate([[0], ends, [count]])
    list(_pool(threads).map(kernel, ends[:-1].tolist(), ends[1:].tolist()))
