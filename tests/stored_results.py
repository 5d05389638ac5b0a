"""Tables that guard a rebuild: what the package measured when they were stored (`test_stored_results.py` compares).

``python tests/stored_results.py [NAME ...]`` stores all, or these, anew: only for a change that is meant to alter a
number, in a commit of its own that says why. Beside the tables, ``made_on.json`` names the versions and the processor
that made them.
"""

import json
import platform
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np
import pandas as pd
from llvmlite import binding

from gdptlab import Calibration, batch, datasets
from gdptlab.experiment import Method, errors, sweep
from gdptlab.experiment.channel import Acoustics, Focusing
from gdptlab.experiment.film import Film
from gdptlab.locate import locate
from gdptlab.tracking.tracks import link, velocities

STORED = Path(__file__).parent / "stored"
IMAGE_TYPES = ("fluorescent", "brightfield", "disturbed")


def film(image_type: str = "fluorescent", seconds: float = 1.0) -> Film:
    """A short film in which the sound is strong."""
    focusing = Focusing(acoustics=Acoustics(energy_density_J_m3=6.0))
    return Film.seeded(3, focusing=focusing, mean_in_view=40.0, duration_s=seconds, image_type=image_type)


def sample_calibration(image_type: str) -> Calibration:
    """Calibration with a stack in `data/`."""
    sample = datasets.sample(image_type)
    return Calibration.from_stack(sample.stack, sample.z_um)


def correlation(image_type: str, refine: bool) -> pd.DataFrame:
    """Frames in `data/`, by correlation."""
    frames = datasets.sample(image_type).frames
    return batch(frames[:2], sample_calibration(image_type), refine=refine, progress=False)


def joint(image_type: str) -> pd.DataFrame:
    """Two successive frames: the second begins with the first."""
    frames = film(image_type)
    return batch([frames[10], frames[11]], sample_calibration(image_type), method="joint", progress=False)


def replayed() -> pd.DataFrame:
    """Errors of the trigger times of one film, refined and not."""
    calibration = sample_calibration("fluorescent")
    methods = [
        Method(evaluator=locate, calibration=calibration, settings={"refine": refine}, label={"refine": refine})
        for refine in (True, False)
    ]
    table = sweep([film(seconds=4.0)], methods, every=5, cache=False, progress=False)
    return errors(table, [0.04, 0.3, 1.0], phases=3)


def tracked() -> pd.DataFrame:
    """Velocities of the particles of a film."""
    frames = film()
    table = batch(list(frames), sample_calibration("fluorescent"), method="joint", progress=False)
    channel, rate = frames.trajectories.focusing.channel, frames.frame_rate_hz
    return velocities(link(frames.to_channel(table), predictor=channel, frame_rate_hz=rate), rate)


def beads_correlation() -> pd.DataFrame:
    """Real beads, calibrated with those of a part of the scan that stand alone, by correlation."""
    beads = datasets.planar_beads()
    calibration = Calibration.from_scan(beads.scan[::2, :320, :320], beads.z_um[::2])
    return batch(beads.frames[[2, 8]], calibration, progress=False)


TABLES: dict[str, Callable[[], pd.DataFrame]] = {
    **{f"refined-{t}": lambda t=t: correlation(t, refine=True) for t in IMAGE_TYPES},
    **{f"unrefined-{t}": lambda t=t: correlation(t, refine=False) for t in IMAGE_TYPES},
    **{f"joint-{t}": lambda t=t: joint(t) for t in IMAGE_TYPES},
    "replay-errors": replayed,
    "velocities": tracked,
    "beads-correlation": beads_correlation,
}
"""What is stored, by name; those of the beads need other people's images."""


def made_here() -> dict[str, str]:
    """What the last digits depend on: compilers and libraries, and the processor that they compile for."""
    names = ("numpy", "scipy", "numba", "opencv-python-headless", "scikit-image", "trackpy")
    processor = f"{platform.machine()} {binding.get_host_cpu_name()}"
    return {name: metadata.version(name) for name in names} | {"processor": processor}


def main() -> None:
    """Store the tables that are named, or all."""
    STORED.mkdir(exist_ok=True)
    for name in sys.argv[1:] or TABLES:
        TABLES[name]().to_csv(STORED / f"{name}.csv", index=False, float_format="%.10g")
        print(name, flush=True)
    (STORED / "made_on.json").write_text(json.dumps(made_here(), indent=1) + "\n")


if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    main()
