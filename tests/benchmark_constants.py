"""What the constants chosen on data do at both ends: ``GDPTLAB_DATA=... python tests/benchmark_constants.py``, an hour.

``python tests/benchmark_constants.py synthetic rim dips thresholds spacing`` does only the synthetic scan, and only
those parts, in some minutes. Each line is a constant with its value, and what becomes of two scans with it: the real
planar beads and the synthetic one. The docstrings of the constants in `gdptlab/pipeline` quote these lines.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import pandas as pd

import gdptlab.fit.pattern as pattern
from gdptlab import Calibration, assessment, batch, datasets
from gdptlab.experiment import Microscope, sample_scan
from gdptlab.pipeline import beads, choose_settings, depth_quality, quality, settings

SCANS = {"planar": 35, "synthetic": 61}
"""Size of the templates, px, with which they are calibrated, so that the search for a size is left out."""

OF_BEADS = {
    "STANDS_OUT": (8.0, 4.0, 16.0),
    "FAINT": (0.1, 0.03, 0.3),
    "MOST_BEADS": (40, 10, 100),
    "LEAST_CORRELATION": (0.9, 0.8, 0.97),
    "COVERED": (0.9, 0.8, 0.97),
    "MOST_APART": (20.0, 10.0, 40.0),
    "SAME": (1.0, 0.5, 2.0),
    "SPOT": (4.0, 2.0, 8.0),
}


@contextmanager
def changed(module: ModuleType, name: str, value: object) -> Iterator[None]:
    """Another value of a constant."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


def images(name: str) -> tuple:
    """Scan, depths, frames, truth, and what counts as found."""
    if name == "planar":
        real = datasets.planar_beads()
        return real.scan, real.z_um, real.frames, real.truth, {"within_px": 3.0, "within_um": 5.0}
    sample = datasets.sample()
    return *sample_scan(), sample.frames, sample.truth, {}


def outcome(name: str) -> str:
    """Beads, subset and scores of a calibration."""
    scan, z_um, frames, truth, within = images(name)
    made = Calibration.from_scan(scan, z_um, size=SCANS[name])
    score = assessment.scores(batch(frames, made, threshold=0.4, progress=False), truth, **within)
    used = (made.report.beads["verdict"] == "used").sum()
    return (
        f"{len(made.report.beads)} beads, {used} used, n_sub {len(made.subset)}, recall {score.recall:.3f}, "
        f"precision {score.precision:.3f}, RMS z {score.sigma_z_um:.3f} um"
    )


def beads_found(scans: dict[str, int]) -> None:
    """Constants by which beads are found and chosen."""
    for constant, values in OF_BEADS.items():
        for value in values:
            with changed(beads, constant, value):
                print(f"beads.{constant} = {value}:", *(f"{name}: {outcome(name)};" for name in scans), flush=True)


def rim(scans: dict[str, int]) -> None:
    """Where an image ends, which decides the size of a template."""
    for name in scans:
        scan, z_um, *_ = images(name)
        found = beads.find_beads(scan, z_um)
        for value in (0.03, 0.06, 0.12):
            with changed(pattern, "RIM", value):
                print(f"pattern.RIM = {value}: {name}: size {beads._size(scan, found)} px", flush=True)


def dips(scans: dict[str, int]) -> None:
    """What separates a depth from an ambiguous one."""
    for name, size in scans.items():
        made = Calibration.from_scan(*images(name)[:2], size=size)
        for value in (0.005, 0.01, 0.02, 0.04, 0.08):
            with changed(quality, "DIP", value):
                other = depth_quality(made)["ambiguous_correlation"]
                said = ", ".join(f"{(other >= least).mean():.2f} at {least}" for least in (0.9, 0.95, 0.99))
                print(f"quality.DIP = {value}: {name}: fraction of ambiguous depths {said}", flush=True)


def thresholds(scans: dict[str, int]) -> None:
    """What the threshold is chosen with."""
    for name, size in scans.items():
        scan, z_um, frames, *_ = images(name)
        made = Calibration.from_scan(scan, z_um, size=size)
        for constant, values in {"LOWEST": (0.1, 0.2, 0.3), "DEPTHS": (10, 25, 51)}.items():
            for value in values:
                with changed(settings, constant, value):
                    threshold = choose_settings(frames, made, method="correlation").threshold
                    print(f"settings.{constant} = {value}: {name}: threshold {threshold:.2f}", flush=True)


def spacing(_: dict[str, int]) -> None:
    """How far the images of a scan may be apart."""
    sample, microscope, rng = datasets.sample(), Microscope(), np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*2 * [np.arange(40, 480, 72)]), axis=-1).reshape(-1, 2)
    true = [
        pd.DataFrame(grid + rng.uniform(-4, 4, grid.shape), columns=["x_px", "y_px"]).assign(
            z_um=rng.uniform(-50, 50, len(grid)), frame=k
        )
        for k in range(6)
    ]
    frames = [microscope.render(part, rng=rng) for part in true]
    for step in range(1, 7):
        stack, z_um = sample.stack[::step], sample.z_um[::step]
        made = Calibration.from_stack(stack, z_um, n_sub=min(9, len(stack)))
        score = assessment.scores(batch(frames, made, progress=False), pd.concat(true, ignore_index=True), within_um=20)
        least = np.diagonal(made.self_similarity(), 1).min()
        print(f"every {step}: correlation {least:.2f} or more, RMS z {score.sigma_z_um:.2f} um", flush=True)


PARTS = {part.__name__: part for part in (beads_found, rim, dips, thresholds, spacing)}


def main() -> None:
    """Do the parts, and use the scans, that are named; all if none is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", choices=[*PARTS, *SCANS, []], help="parts and scans")
    what = parser.parse_args().what
    scans = {name: size for name, size in SCANS.items() if name in what} or SCANS
    for name in [part for part in PARTS if part in what] or PARTS:
        PARTS[name](scans)


if __name__ == "__main__":
    main()
