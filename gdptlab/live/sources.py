"""Where a `Monitor` gets its frames: a film at true speed, a folder that fills, a camera of Micro-Manager."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from os import PathLike
from time import perf_counter, sleep
from typing import Any

from numpy.typing import ArrayLike

from gdptlab._checks import instance, iterable, number, positive, rate
from gdptlab._checks import path as check_path

POLL_S = 0.002
"""Pause, s, between two looks for a new frame. Chosen: a twentieth of the time between frames at 25 frames/s. With 0,
looking would keep a core busy; with 0.02, a frame would be 10 ms old on average when it is seen."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame, and when the camera delivered it.

    Attributes
    ----------
    image : array (rows, columns)
    t_s : float
        On the clock of `time.perf_counter`.

    Raises
    ------
    TypeError, ValueError
        If the time is not a finite number.
    """

    image: ArrayLike
    t_s: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "t_s", number("t_s", self.t_s))


def at_speed(frames: Iterable[ArrayLike], rate_hz: float) -> Iterator[ArrayLike]:
    """Yield frames at true speed: the first at once, frame i at i / rate_hz, none before its time.

    Parameters
    ----------
    frames : iterable of arrays (rows, columns)
        Such as a `Film`. A frame that is not ready in time comes late, and so may the frames after it.
    rate_hz : float
        Frames in a second.

    Yields
    ------
    array (rows, columns)

    Raises
    ------
    TypeError, ValueError
        If the rate is not a number above 0.
    """
    iterable("frames", frames)
    period_s = 1 / rate("rate_hz", rate_hz)

    def paced() -> Iterator[ArrayLike]:
        """Sleep until the time of each frame (the check of the rate must not wait for the first)."""
        start = perf_counter()
        for i, frame in enumerate(frames):
            sleep(max(start + i * period_s - perf_counter(), 0))
            yield frame

    return paced()


class FillingFolder:
    """Source of a `Monitor`: the images that another program writes into a folder, by name, newest last.

    Images that are there already are not read. A file is read once its size has stayed the same between two looks;
    of several new ones all are read, since only the monitor drops frames.

    Parameters
    ----------
    folder : str or path-like
    pattern : str
        Of the names of TIFF files.
    patience_s : float
        Time without a new file after which there are no more frames.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    TypeError, ValueError
        If the time is not above 0.
    """

    def __init__(self, folder: str | PathLike[str], pattern: str = "*.tif*", *, patience_s: float = 10.0) -> None:
        self._folder, self._pattern = check_path("folder", folder), pattern
        if not self._folder.is_dir():
            raise FileNotFoundError(f"folder: got {str(folder)!r}, allowed is a folder")
        if not instance("pattern", pattern, str) or "/" in pattern or "\\" in pattern or "**" in pattern:
            raise ValueError(f"pattern: got {pattern!r}, allowed is one of names, such as *.tif")
        self._patience_s = positive("patience_s", patience_s)
        self._last = max((p.name for p in self._folder.glob(pattern)), default="")
        self._sizes: dict[str, int] = {}

    def grab(self) -> Frame | None:
        """Return the next image; None when none has come for `patience_s`."""
        import tifffile

        end = perf_counter() + self._patience_s
        while perf_counter() < end:
            for path in sorted(p for p in self._folder.glob(self._pattern) if p.name > self._last)[:1]:
                size = path.stat().st_size
                if size and self._sizes.pop(path.name, None) == size:
                    self._last = path.name
                    return Frame(tifffile.imread(path), perf_counter())
                self._sizes[path.name] = size
            sleep(POLL_S)
        return None


class MicroManagerCamera:
    """Source of a `Monitor`: the camera of a Micro-Manager configuration, by `pymmcore-plus` (extra `camera`).

    Parameters
    ----------
    core : pymmcore_plus.CMMCorePlus
        With a camera. It is started by the first `grab`, if it does not run yet, and stopped by whoever owns it.

    Examples
    --------
    >>> core = CMMCorePlus()  # doctest: +SKIP
    >>> core.loadSystemConfiguration("microscope.cfg")  # doctest: +SKIP
    >>> Monitor(MicroManagerCamera(core), evaluate, triggers, safe=sound_off)  # doctest: +SKIP
    """

    def __init__(self, core: Any) -> None:
        if not hasattr(core, "popNextImage"):
            raise TypeError(f"core: got {core!r}, allowed is a CMMCorePlus of pymmcore_plus")
        self._core, self._started = core, False

    def grab(self) -> Frame | None:
        """Return the next frame, as soon as there is one; None when the camera was stopped.

        Raises
        ------
        OSError
            If the camera's memory overflowed: frames were lost.
        """
        core = self._core
        if not self._started and not core.isSequenceRunning():
            core.startContinuousSequenceAcquisition()
        self._started = True
        while not core.getRemainingImageCount():
            if not core.isSequenceRunning():
                return None
            sleep(POLL_S)
        if core.isBufferOverflowed():
            raise OSError("the camera's memory overflowed")
        return Frame(core.popNextImage(), perf_counter())
