"""A simulated device that runs by the clock: particles move, a camera takes frames, the sound can be switched off.

Another process renders each frame when its time has come, so that this process cannot delay the camera. The frames can
be computed again afterwards: those of a `Film` of `Switched` trajectories are the same, bit for bit.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from threading import Event, Lock
from time import perf_counter, sleep
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import choice, instance, instances, numbers, positive, whole
from gdptlab.experiment.channel import Trajectories
from gdptlab.experiment.film import Film
from gdptlab.experiment.trigger import fractions, trigger_time
from gdptlab.live.monitor import Monitor, Result
from gdptlab.live.own_process import PROCESSES, follow_parent
from gdptlab.live.sources import Frame
from gdptlab.live.triggers import MiddleThird, Trigger

SLOTS = 16
"""Number of frames that may wait to be grabbed; while all slots are full, the camera's frames are lost and counted.
Chosen: 0.64 s at 25 frames/s, and 8 MB of frames of 512 x 512 px. With 1, a grabber that is late by a moment loses a
frame; with hundreds, it would be handed frames that are seconds old."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Switched(Trajectories):
    """Paths of particles while the sound is on from 0 to `off_s`; from then on only the flow carries them.

    Attributes
    ----------
    off_s : float, optional
        When the sound is switched off, 0 or later; None: never.
    focusing, start, duration_s, view_length_um
        As in `Trajectories`.

    Raises
    ------
    TypeError, ValueError
        If a value is out of range.
    """

    off_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.off_s is not None:
            object.__setattr__(self, "off_s", positive("off_s", self.off_s, zero=True))

    def table(self, times_s: ArrayLike, *, border_um: float = 0.0) -> pd.DataFrame:
        """Positions at many times, as `Trajectories.table`."""
        if self.off_s is None:
            return super().table(times_s, border_um=border_um)
        t = numbers("times_s", times_s, 0, self.duration_s)
        border_um = positive("border_um", border_um, zero=True, infinite=True)
        on_s = np.minimum(t, self.off_s)
        table = super().table(on_s, border_um=np.inf)
        drifting = (t - on_s)[table["frame"]]
        speed = self.focusing.channel.velocity(table["y_channel_um"], table["z_um"])
        table["x_channel_um"] += speed * drifting
        table["t_s"] = t[table["frame"]]
        seen = table["x_channel_um"].between(-border_um, self.view_length_um + border_um)
        return table[seen].reset_index(drop=True)


def switched(film: Film, off_s: float | None) -> Film:
    """Return the film that would have been taken if the sound had been switched off at `off_s`."""
    old = instance("film", film, Film).trajectories
    fields = {name: getattr(old, name) for name in ("focusing", "start", "duration_s", "view_length_um")}
    return replace(film, trajectories=Switched(**fields, off_s=off_s))


class Device:
    """Channel, sound, microscope and camera, in another process that keeps to the clock.

    A device is a source for a `Monitor`. It does one experiment after the other. Use it in a `with` block, or
    `close` it; it ends with the program in any case. A program that is a file must start it under
    ``if __name__ == "__main__":``, since the process reads that file, too.

    Parameters
    ----------
    shape : (rows, columns)
        Of the camera.

    Attributes
    ----------
    start_s : float
        When the experiment began, on the clock of `time.perf_counter`; NaN before.
    shown : list of int
        Number in the film of each frame that was grabbed in this experiment.
    """

    def __init__(self, shape: tuple[int, int] = (512, 512)) -> None:
        self.shape = shape
        self._shared = _Shared(
            pixels=PROCESSES.RawArray("H", SLOTS * shape[0] * shape[1]),
            taken=PROCESSES.RawValue("q", 0),
            missed=PROCESSES.RawValue("q", 0),
            off_s=PROCESSES.RawValue("d", np.nan),
            stopped=PROCESSES.RawValue("b", 0),
        )
        self._orders, orders = PROCESSES.Pipe()
        self._bell, bell = PROCESSES.Pipe(duplex=False)
        self._process = PROCESSES.Process(target=_camera, args=(orders, bell, self._shared, shape), daemon=True)
        self._process.start()
        orders.close(), bell.close()
        self._film: Film | None = None
        self._running, self._run, self._one_at_a_time = False, 0, Lock()
        self.start_s, self.shown = np.nan, []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        self._running = False
        self._process.kill()
        self._process.join()
        self._orders.close(), self._bell.close()

    def run(self, film: Film, *, ahead: int = 0) -> None:
        """Prepare an experiment. It begins with the first `grab`: the sound is on, frames come at the film's rate.

        If a frame takes longer to render than the time between frames, the camera skips the next.

        Parameters
        ----------
        film : Film
            Of the experiment if nobody switches the sound off.
        ahead : int
            Number of frames that are rendered before the clock starts, and then shown to and fro: for rates that
            rendering could not keep up with. Switching the sound off does not change them. 0: render each in its time.

        Raises
        ------
        TypeError, ValueError
            If `film` is no film or not of the camera's shape, or `ahead` is above its number of frames.
        RuntimeError
            If the process is gone.
        """
        instance("film", film, Film)
        whole("ahead", ahead, 0, len(film))
        if film.shape != self.shape:
            raise ValueError(f"film: got frames of {film.shape}, allowed are {self.shape}")
        self.halt()
        shared = self._shared
        shared.taken.value = shared.missed.value = shared.stopped.value = 0
        shared.off_s.value = self.start_s = np.nan
        try:
            self._orders.send((film, ahead))
            self._orders.recv()
        except (EOFError, OSError) as error:
            raise RuntimeError("the device's process is gone") from error
        self._film, self._running, self._run, self.shown = film, True, self._run + 1, []

    def halt(self) -> None:
        """End the experiment, if there is one."""
        self._shared.stopped.value = 1
        while self.grab() is not None:
            pass

    def grab(self) -> Frame | None:
        """Return the next frame, as soon as there is one; None if the experiment is over."""
        run = self._run
        while True:
            with self._one_at_a_time:  # a monitor that was stopped may still be waiting for its last frame
                if not self._running or run != self._run:
                    return None
                try:
                    if np.isnan(self.start_s):
                        self._orders.send(None)
                        self.start_s = self._orders.recv()
                    if not self._bell.poll(0.1):
                        continue
                    told = self._bell.recv()
                except (EOFError, OSError):  # the process is gone
                    told = None
                if told is None:
                    self._running = False
                    return None
                i, t_s = told
                frame = _slot(self._shared.pixels, self.shape, len(self.shown)).copy()
                self.shown.append(i)
                self._shared.taken.value = len(self.shown)
                return Frame(frame, t_s)

    def switch_off(self, _: object = None) -> None:
        """Switch the sound off, now. The argument has no effect: it lets the method be the action of a `Trigger`."""
        if np.isnan(self._shared.off_s.value):
            self._shared.off_s.value = perf_counter()

    @property
    def off_s(self) -> float | None:
        """Time at which the sound was switched off, s since the experiment began; None if it was not."""
        off_s = self._shared.off_s.value - self.start_s
        return None if np.isnan(off_s) else off_s

    @property
    def missed(self) -> int:
        """Number of frames that were lost because all slots were full."""
        return self._shared.missed.value

    @property
    def film(self) -> Film | None:
        """The film of the experiment so far, with the sound switched off when it was; None before the first."""
        return self._film and switched(self._film, self.off_s)


@dataclass(frozen=True, eq=False)
class _Shared:
    """Memory that both processes use: pixels of the slots, numbers of frames taken and missed, switches."""

    pixels: Any
    taken: Any
    missed: Any
    off_s: Any
    stopped: Any


def _slot(pixels: Any, shape: tuple[int, int], number: int) -> NDArray[np.uint16]:
    """Return the shared memory of the frame of this number, (rows, columns)."""
    return np.frombuffer(pixels, np.uint16).reshape(SLOTS, *shape)[number % SLOTS]


def _camera(orders: Any, bell: Any, shared: _Shared, shape: tuple[int, int]) -> None:
    """Do one experiment after the other, until the orders end (the device's process)."""
    follow_parent()
    try:
        while True:
            film, ahead = orders.recv()
            made = [film[k] for k in range(ahead)]
            frames = film
            frames[0]  # what is made at first use is there when the clock starts
            orders.send(None)
            orders.recv()
            start_s, number, i = perf_counter(), 0, 0
            orders.send(start_s)
            while i < len(film) and not shared.stopped.value:
                sleep(max(start_s + i / film.frame_rate_hz - perf_counter(), 0))
                off_s = shared.off_s.value - start_s
                if off_s >= 0 and frames is film:
                    frames = switched(film, off_s)
                shown = ahead - 1 - abs(ahead - 1 - i % max(2 * ahead - 2, 1)) if ahead else i
                image = made[shown] if ahead else frames[shown]
                if number - shared.taken.value < SLOTS:
                    _slot(shared.pixels, shape, number)[:] = image
                    bell.send((shown, perf_counter()))
                    number += 1
                else:
                    shared.missed.value += 1
                # The next frame, or the newest whose time has come.
                i = max(i + 1, int((perf_counter() - start_s) * film.frame_rate_hz))
            bell.send(None)
    except (EOFError, OSError):
        pass


# -------------------- the sound switched off by a monitor, or by a timer


def true_fractions(film: Film, times_s: ArrayLike) -> pd.DataFrame:
    """Return the true fraction of the particles in view that are in the middle thirds.

    Parameters
    ----------
    film : Film
    times_s : array (n,)
        Increasing, within the film.

    Returns
    -------
    DataFrame
        `t_s`, `count`, `fraction_h`, `fraction_w`, as in `experiment.fractions`.
    """
    film = instance("film", film, Film)
    table = fractions(film.trajectories.table(times_s), np.arange(len(times_s)), film.trajectories.focusing.channel)
    return table.drop(columns="frame").assign(t_s=times_s)


def closed_loop(
    device: Device,
    film: Film,
    evaluate: Callable[[NDArray], pd.DataFrame],
    *,
    of: str = "w",
    level: float = 0.9,
    sure: bool = False,
    linger_s: float = 0.2,
    log: str | os.PathLike[str] | None = None,
) -> dict[str, float]:
    """Do one experiment in real time: a monitor switches the sound off when the particles are in the middle.

    Parameters
    ----------
    device : Device
    film : Film
    evaluate : callable
        As of a `Monitor`.
    of : str
        Middle third of the height, 'h', or of the width, 'w'.
    level, sure
        As of a `Trigger`: the fraction at which the sound is switched off (paper: 0.9), and whether it must be sure.
        The sound also goes off when the monitor fails.
    linger_s : float
        Time for which the experiment goes on afterwards.
    log : str or path-like, optional
        As of a `Monitor`.

    Returns
    -------
    dict
        `seed`, `energy_density_J_m3`; `needed_s`, when the true fraction reached the level (NaN: never); `off_s`, when
        the sound was switched off, and `true_fraction` then; `exposed_s` and `delivered_s`, when the deciding frame
        was exposed and delivered, and `fraction`, measured in it: all NaN if the sound was never switched off;
        `delay_ms` from the frame's delivery and `exposure_delay_ms` from its exposure until the sound was off;
        `frames`, the number that the camera delivered until the end, and `dropped`.
    """
    channel = film.trajectories.focusing.channel
    middle = MiddleThird(of=of, channel=channel, to_channel=film.to_channel)
    off = Event()

    def act(_: Result) -> None:
        """Switch the sound off, and tell the waiting thread."""
        device.switch_off()
        off.set()

    trigger = Trigger(name=of, fraction=middle, action=act, level=level, sure=sure)
    device.run(film)
    with Monitor(device, evaluate, [trigger], example=film[0], log=log, safe=device.switch_off) as monitor:
        if off.wait(len(film) / film.frame_rate_hz):
            sleep(linger_s)
        seen, status = monitor.recent(), monitor.status()
    device.halt()
    times = np.arange(0, film.trajectories.duration_s, 0.01)
    row = {
        "seed": film.seed,
        "energy_density_J_m3": film.trajectories.focusing.acoustics.energy_density_J_m3,
        "needed_s": trigger_time(times, true_fractions(film, times)[f"fraction_{of}"], level),
    }
    fields = ("off_s", "true_fraction", "exposed_s", "delivered_s", "fraction", "delay_ms", "exposure_delay_ms")
    row |= dict.fromkeys(fields, np.nan)
    if off.is_set():
        first = seen[seen[f"on_{of}"]].iloc[0]
        row["off_s"] = device.off_s
        row["true_fraction"] = true_fractions(film, [device.off_s])[f"fraction_{of}"].iloc[0]
        row["exposed_s"] = device.shown[int(first["frame"])] / film.frame_rate_hz
        row["delivered_s"] = first["t_s"] + monitor.started_s - device.start_s
        row["fraction"] = first[f"fraction_{of}"]
        row["delay_ms"] = 1e3 * (device.off_s - row["delivered_s"])
        row["exposure_delay_ms"] = 1e3 * (device.off_s - row["exposed_s"])
    return row | {"frames": status.grabbed, "dropped": status.dropped}


def timed(films: Iterable[Film], timers_s: ArrayLike, of: str = "w") -> pd.DataFrame:
    """Compute the same experiments with a timer that switches the sound off; no clock needs to run for that.

    Parameters
    ----------
    films : iterable of Film
    timers_s : array (n,)
        Settings of the timer, increasing.
    of : str
        'h' or 'w'.

    Returns
    -------
    DataFrame
        A row for each film and setting: `seed`, `energy_density_J_m3`, `off_s`, `true_fraction`.
    """
    choice("of", of, "hw")
    parts = []
    for film in instances("films", films, Film):
        numbers("timers_s", timers_s, 0, film.trajectories.duration_s)
        energy = film.trajectories.focusing.acoustics.energy_density_J_m3
        table = true_fractions(film, timers_s).rename(columns={"t_s": "off_s", f"fraction_{of}": "true_fraction"})
        parts.append(table[["off_s", "true_fraction"]].assign(seed=film.seed, energy_density_J_m3=energy))
    if not parts:
        raise ValueError("films: got none, allowed are one or more")
    return pd.concat(parts, ignore_index=True)
