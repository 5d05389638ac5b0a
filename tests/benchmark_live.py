"""The monitor in real time, against its targets: for a machine that does nothing else. Writes figures/live_timings.csv.

python tests/benchmark_live.py --seconds 20 --experiments 24
"""

import argparse
import sys

import numpy as np
import pandas as pd

from gdptlab import Calibration, locate, plots
from gdptlab._files import written_whole
from gdptlab.experiment import Method
from gdptlab.experiment.channel import Acoustics, Focusing
from gdptlab.experiment.film import Film
from gdptlab.live import Follower, Monitor, Status, Trigger, middle_thirds
from gdptlab.live.device import Device, closed_loop
from gdptlab.live.own_process import OwnProcess

AHEAD = 100  # frames rendered before a camera runs
IN_VIEW = 100.0
SIZE_PX = 31  # template
E_AC = 6.0  # J/m³, and in the closed loop within ± 30 % of it
SEED = 12


def film_of(rate_hz: float, seconds: float, seed: int = SEED, in_view: float = IN_VIEW, energy: float = E_AC) -> Film:
    """What happens in front of the camera."""
    focusing = Focusing(acoustics=Acoustics(energy_density_J_m3=energy))
    fields = {"focusing": focusing, "mean_in_view": in_view, "duration_s": seconds, "frame_rate_hz": rate_hz}
    return Film.seeded(seed, **fields)


def method_of(film: Film, n_sub: int, refine: bool = True) -> Method:
    """How its frames are evaluated."""
    calibration = Calibration.from_stack(*film.stack(size=SIZE_PX), n_sub=n_sub)
    return Method(evaluator=locate, calibration=calibration, settings={"refine": refine})


def peak_mb() -> float:
    """Most memory this process has taken."""
    import resource  # not on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def watched(device: Device, film: Film, evaluate: object, panel: bool = False) -> tuple[Status, float]:
    """Status of a monitor after the film, with or without a panel, and MB by which the peak of memory rose."""
    channel = film.trajectories.focusing.channel
    triggers = [Trigger(name=of, fraction=s, action=str) for of, s in middle_thirds(channel, film.to_channel).items()]
    example, before = film[0], peak_mb()
    device.run(film, ahead=min(AHEAD, len(film)))
    monitor = Monitor(device, evaluate, triggers, example=example, window=10_000)
    if panel:
        with plots.LivePanel(monitor, channel=channel, to_channel=film.to_channel) as drawing:
            drawing.png()
            monitor.start()
            while not monitor.wait(0.2):
                drawing.png()
    else:
        monitor.start()
        monitor.wait()
    monitor.stop()
    return monitor.status(), peak_mb() - before


def main() -> None:
    """Run all, print and write the table."""
    parser = argparse.ArgumentParser(description="Time the monitor on a quiet machine.")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each camera")
    parser.add_argument("--experiments", type=int, default=24, help="with the loop closed")
    options = parser.parse_args()
    rows = []

    def note(what: str, value: float, unit: str, allowed: str) -> None:
        rows.append((what, round(value, 1), unit, allowed))
        print(*rows[-1], sep=", ", flush=True)

    with Device() as device:
        film = film_of(25.0, options.seconds)
        refined = method_of(film, 9)
        with OwnProcess(refined) as apart:
            for where, evaluate in (("in a thread", refined), ("in a process of its own", apart)):
                status, _ = watched(device, film, evaluate)
                what = f"25 frames/s, {IN_VIEW:g} in view, refined, {where}"
                note(f"{what}: frames", len(film), "", "")
                note(f"{what}: dropped", len(film) - status.evaluated, "", "0")
                note(f"{what}: median latency", status.latency_median_ms, "ms", "30")
                note(f"{what}: 99th percentile", status.latency_p99_ms, "ms", "80")
        calibration = Calibration.from_stack(*film.stack(size=2 * SIZE_PX + 1), n_sub=9)
        for in_view, rate_hz in ((100.0, 25.0), (50.0, 50.0)):
            followed = film_of(rate_hz, options.seconds, in_view=in_view)
            follower = Follower(calibration, interval_s=1 / rate_hz, cheaper=refined, threads=2)
            with OwnProcess(follower) as apart:
                for with_panel in (False, True):
                    status, _ = watched(device, followed, apart, with_panel)
                    what = f"joint fit, {rate_hz:g} frames/s, {in_view:g} in view" + ", with the panel" * with_panel
                    note(f"{what}: frames", len(followed), "", "")
                    note(f"{what}: dropped", len(followed) - status.evaluated, "", "0")
                    note(f"{what}: median latency", status.latency_median_ms, "ms", "")
                    note(f"{what}: 99th percentile", status.latency_p99_ms, "ms", f"{1e3 / rate_hz:g}")
                    note(f"{what}: longest", status.latency_max_ms, "ms", "")
        fast = film_of(100.0, options.seconds)
        status, _ = watched(device, fast, method_of(fast, 4, refine=False))
        what = "100 frames/s, not refined, N_sub = 4"
        note(f"{what}: dropped", 100 * (1 - status.evaluated / len(fast)), "%", "2")
        note(f"{what}: median latency", status.latency_median_ms, "ms", "")
        flood = film_of(250.0, options.seconds)
        status, mb = watched(device, flood, refined)
        what = "250 frames/s, refined"
        note(f"{what}: dropped", 100 * (1 - status.evaluated / len(flood)), "%", "counted")
        note(f"{what}: lost count of", status.grabbed - status.evaluated - status.dropped, "", "0")
        note(f"{what}: memory rose by", mb, "MB", "flat")
        energies = E_AC * np.random.default_rng(SEED).uniform(0.7, 1.3, options.experiments)
        films = [film_of(25.0, 4.0, SEED + k, 25.0, energy) for k, energy in enumerate(energies.tolist())]
        method = method_of(films[0], 9)
        loop = pd.DataFrame([closed_loop(device, film, method) for film in films])
        what = f"loop closed, {options.experiments} samples"
        note(f"{what}: fired", loop["off_s"].notna().sum(), "", f"{options.experiments}")
        note(f"{what}: delivery of the frame to sound off, median", loop["delay_ms"].median(), "ms", "")
        note(f"{what}: the same, longest", loop["delay_ms"].max(), "ms", "100")
        note(f"{what}: from its exposure, longest", loop["exposure_delay_ms"].max(), "ms", "")
    with written_whole(plots.FIGURES / "live_timings.csv") as temporary:
        pd.DataFrame(rows, columns=["what", "measured", "unit", "allowed"]).to_csv(temporary, index=False)


if __name__ == "__main__":  # processes that are started import this file
    main()
