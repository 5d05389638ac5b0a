"""The joint fit in the loop: each frame begins with the particles of the last one that was fitted.

Frames between the two were dropped, so particles are moved on by their velocity times the time that has passed. Where
that leaves more of the frame unexplained than before, the fit is repeated from where it ended, with the particles that
it found in what was left, which costs a fraction of a search; only where that does not help are all sought anew. Where
frames take longer than the camera's interval, some are left to a cheaper evaluator, and the table says so; then the fit
is tried again.
"""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import function, instance, number, positive, whole
from gdptlab._compiled import on_one_core
from gdptlab.calibration import Calibration
from gdptlab.fit.joint import Explained, Joint
from gdptlab.locate import checked_image

FORGET_S = 0.5
"""Time, s, after which particles are sought anew. Chosen: at 6 J/m³ a particle moves by 37 µm in that time, a third of
the channel's height, and changes its velocity on the way. With 0.1, a pause of the camera would cost a search; with 2,
particles would be looked for where they are not."""

REPEATS, LOST, HOPELESS = 3, 1.5, 2.0
"""Largest number of times that a frame is fitted again; the factor by which its mean squared residual must exceed that
of the frame before for that; and the factor from which on all particles are sought anew. Chosen on films of 25 to 100
in view: the residual is 0.8 to 1.2 times that before where all is found, 1.2 to 1.45 in one of a hundred frames when
particles line up, where a repeat finds no more, and 2 to 8 times where a third is lost; there one repeat finds nearly
all of them, the second the rest."""

SLOW = 3
"""Number of frames in a row that must take longer than the interval for the next to be left to the cheaper evaluator.
Chosen: one slow frame, such as the first or one that is searched anew, costs some dropped frames, and the fit bridges
them. With 1, each of these would cost a wrong fraction as well; with 10, the monitor would be late for a second."""

LONGEST_S = 0.1
"""Longest time, s, that is left to the cheaper evaluator at once: much less than FORGET_S, so that the fit goes on
where it was. Chosen between 0.08 and 2.6 s with `tests/benchmark_live.py` on two cores, where a fit takes about as long
as the interval: of 500 frames, 25 a second with 100 in view, 251 are dropped with 2.6 s, 34 with 0.3, 14 with 0.08;
after 2.6 s particles are sought anew, which takes a second when they have lined up, and frames are left again."""


class Follower:
    """Evaluator of a `Monitor`: the joint fit of one frame after the other, with motion predicted over those dropped.

    Its tables are those of ``locate(..., method="joint")``; `attrs` has `method`, "joint" or "correlation" (the cheaper
    evaluator), and `note`, in words, where it changes. It follows one film at a time, in one thread at a time, and can
    be sent to another process (`OwnProcess`). An image without a time is an example, of particles at rest: the first
    frame begins with them.

    Parameters
    ----------
    calibration : Calibration
    interval_s : float, optional
        Longest time that a frame may take: that between two frames of the camera. Without it the fit takes its time.
    cheaper : callable, optional
        image -> DataFrame, for frames that the fit has no time for. It comes with `interval_s`.
    threads : int
        Within a frame; the table does not depend on their number.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of its kind, or one of `interval_s` and `cheaper` comes without the other.
    """

    follows = True
    """A `Monitor` gives the time of a frame as well."""

    def __init__(
        self,
        calibration: Calibration,
        *,
        interval_s: float | None = None,
        cheaper: Callable[[NDArray], pd.DataFrame] | None = None,
        threads: int = 1,
    ) -> None:
        self._calibration = instance("calibration", calibration, Calibration)
        if (interval_s is None) != (cheaper is None):
            raise TypeError(f"cheaper: got {cheaper!r} with interval_s = {interval_s}, allowed are both or neither")
        if cheaper is not None:
            function("cheaper", cheaper)
        self._interval_s = np.inf if interval_s is None else positive("interval_s", interval_s)
        self._cheaper, self._threads = cheaper, whole("threads", threads, 1, 64)
        self._joint: Joint | None = None
        self._forget()
        self._slow, self._left, self._pause = 0, 0, 1  # slow frames in a row; frames left to the other; of how many

    def _forget(self) -> None:
        """Know nothing of the next frame."""
        self._before: Explained | None = None  # its velocity is per second
        self._usual = np.inf  # mean squared residual
        self._t_s = -np.inf

    @on_one_core
    def __call__(self, image: ArrayLike, t_s: float | None = None) -> pd.DataFrame:
        """Evaluate a frame (rows, columns) of the time `t_s`, s.

        Raises
        ------
        TypeError, ValueError
            If the image is no frame, or the time is not later than that of the frame before.
        FloatingPointError
            If the fit diverged. The next frame begins anew.
        """
        image = checked_image(image, self._calibration)
        if self._joint is None or self._joint.shape != image.shape:
            self._joint = Joint(self._calibration.model, image.shape, self._threads)
            self._forget()
        if t_s is None:
            return self._example(image)
        if number("t_s", t_s) <= self._t_s:
            last, self._t_s = self._t_s, -np.inf  # a clock that was set back is refused once
            self._before = None
            raise ValueError(f"t_s: got {t_s:g}, allowed is later than that of the frame before, {last:g}")
        if self._left:
            self._left -= 1
            table = self._cheaper(image)
            table.attrs |= {"method": "correlation"}
            return table
        start = perf_counter()
        table = self._followed(image, t_s)
        table.attrs |= {"method": "joint", "note": self._judged(perf_counter() - start)}
        return table

    def _example(self, image: NDArray[np.float32]) -> pd.DataFrame:
        """Fit a frame as the first and as the next, so that all that either takes is there."""
        found = self._joint.first(image)
        self._joint.following(image, found)
        if self._cheaper is not None:
            self._cheaper(image)
        self._before, self._t_s, self._usual = found, -np.inf, unexplained(found)
        table = self._joint.table(found)
        table.attrs |= {"method": "joint"}
        return table

    def _followed(self, image: NDArray[np.float32], t_s: float) -> pd.DataFrame:
        """Fit a frame, from the one before if that is not too old."""
        before, usual, gap_s, joint = self._before, self._usual, t_s - self._t_s, self._joint
        self._forget()
        tried = []
        if before is not None and (gap_s <= FORGET_S or gap_s == np.inf):  # infinite: an example, at rest
            moved = before.velocity * (gap_s if np.isfinite(gap_s) else 0)
            found = joint.following(image, replace(before, velocity=moved))
            for _ in range(REPEATS):
                if unexplained(found) <= LOST * usual:
                    break
                found = joint.following(image, replace(found, places=_moved_back(found)))
            tried.append(replace(found, velocity=found.velocity / gap_s))
        if not tried or unexplained(tried[0]) > HOPELESS * usual:
            tried.append(joint.first(image))
        found = min(tried, key=unexplained)
        table = self._joint.table(found)
        if not np.isfinite(table[["x_px", "y_px", "z_um", "x_std_px", "y_std_px", "z_std_um"]].to_numpy()).all():
            raise FloatingPointError("the joint fit diverged")
        self._before, self._t_s, self._usual = found, t_s, unexplained(found)
        return table

    def _judged(self, took_s: float) -> str:
        """Decide who evaluates the next frames, by what this one took; what to say of it, in words."""
        if took_s <= self._interval_s:
            self._slow, self._pause = 0, 1
            return ""
        self._slow += 1
        if self._slow < SLOW:
            return ""
        self._slow = 0  # a trial may begin with a search, which is slow once
        self._left = self._pause
        self._pause = min(2 * self._pause, max(int(LONGEST_S / self._interval_s), 1))
        took = f"{1e3 * took_s:.0f} ms, allowed {1e3 * self._interval_s:.0f}"
        return f"the joint fit took {took}: the next {self._left} by the cheaper evaluator"


def unexplained(found: Explained) -> float:
    """Return the mean squared residual of a frame, over its variance: about 1 where all is explained."""
    residual = found.fit.residual
    return float(np.mean(residual * residual * found.variance.weight(found.fit.image, found.pixels.valid)))


def _moved_back(found: Explained) -> NDArray[np.float64]:
    """Return the places (P, 4 + K) from which the next fit, which moves them on, begins where this one ended."""
    places = found.places.copy()
    places[:, :3] -= found.velocity
    return places
