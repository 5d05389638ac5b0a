"""Speed: loops over pixels compiled to machine code, products of small matrices on one core."""

from collections.abc import Callable

import numba
from threadpoolctl import ThreadpoolController

from gdptlab._files import sources_folder


def compiled(function: Callable) -> Callable:
    """Decorator: compile a function of arrays and numbers to machine code at its first call, and keep it on disk.

    numba knows a kept function by the file that it stands in, but not by the `inlined` functions of other files that
    became parts of it. So the folder of the machine code changes with any source of the package. Where no folder can
    be written, the function is compiled in each process.
    """
    folder, before = sources_folder("machine-code"), numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder or "")
    try:
        return numba.njit(cache=folder is not None, fastmath=True, nogil=True)(function)
    finally:
        numba.config.CACHE_DIR = before  # other packages keep theirs where they did


inlined = numba.njit(inline="always", fastmath=True, nogil=True)
"""Decorator: compile a function as a part of each `compiled` function that calls it. Its rounding depends on where
it is called, so that Python must not call it itself."""

on_one_core = ThreadpoolController().wrap(limits=1, user_api="blas")
"""Decorator: compute matrix products on one core. Small products spread over cores mostly wait for each other, and
their last digits would depend on the number of cores."""
