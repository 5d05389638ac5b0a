"""Plans: what is prepared once for frames of one shape, and kept for the next frame."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar
from weakref import WeakKeyDictionary

Owner = TypeVar("Owner")
Plan = TypeVar("Plan")

KEPT = 8
"""Number of plans that are kept for one owner. Chosen: a plan holds the working memory of some ten frames, and takes
less than the evaluation of one frame to make. Two or three shapes in each of a few threads need up to eight; with
fewer, such threads make each other's plans again; with more, old shapes hold memory that nobody uses."""

_plans: WeakKeyDictionary[object, OrderedDict] = WeakKeyDictionary()
_lock = threading.Lock()


def planned(owner: Owner, make: Callable[[Owner, tuple[int, int]], Plan], shape: tuple[int, int]) -> Plan:
    """Return ``make(owner, shape)``, kept for the next call by the same thread (plans hold working memory).

    Plans vanish with their owner. They do not follow the owner into other processes or into copies.

    Parameters
    ----------
    owner : object
        Such as a calibration; a plan must not refer to its owner.
    make : callable
        A function of a module, not a method bound to the owner.
    shape : (rows, columns)
        Of the frames.
    """
    key = make, shape, threading.get_ident()
    with _lock:
        kept = _plans.setdefault(owner, OrderedDict())
        if key in kept:
            kept.move_to_end(key)
            return kept[key]
    plan = make(owner, shape)
    with _lock:
        kept[key] = plan
        while len(kept) > KEPT:
            kept.popitem(last=False)
    return plan
