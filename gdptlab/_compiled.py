"""How numbers are crunched: loops over pixels compiled, products of small matrices on one core."""

from numba import njit
from threadpoolctl import ThreadpoolController

compiled = njit(cache=True, fastmath=True, nogil=True)
"""Decorator: a function of arrays and numbers becomes machine code at its first call, and is kept on disk."""

inlined = njit(inline="always", fastmath=True, nogil=True)
"""Decorator: likewise, as a part of what is `compiled`. Called, it would be rounded as the compiler came upon it."""

on_one_core = ThreadpoolController().wrap(limits=1, user_api="blas")
"""Decorator: spread over cores, such products mostly wait for each other, and their last digits depend on how many."""
