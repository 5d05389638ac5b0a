"""A laboratory's long film, from a TIFF file to a Parquet table: frames a second, processor time and memory.

python tests/benchmark_lab.py --frames 2000 --particles 100 --jobs 2

By correlation, with the sample's calibration. The film is written before the clock starts, some 0.5 MB a frame, of 50
frames that differ, over and over. Wanted with the numbers above on two quiet cores: 120 frames a second or more, and
1.5 GB or less of all processes together.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from time import perf_counter

import numpy as np
import pandas as pd
import psutil
import tifffile

from gdptlab import Calibration, datasets
from gdptlab.experiment import Microscope
from gdptlab.pipeline import batch_to_parquet

DIFFERENT = 50  # frames that are rendered


def film(path: Path, n: int, n_particles: int) -> None:
    """Write a film of `n` frames of 512 px, each with so many particles, as one TIFF."""
    microscope, rng = Microscope(), np.random.default_rng(1)
    images = []
    for _ in range(min(DIFFERENT, n)):
        x_px, y_px = rng.uniform(0, 511, (2, n_particles))
        particles = pd.DataFrame({"x_px": x_px, "y_px": y_px, "z_um": rng.uniform(-50, 50, n_particles)})
        images.append(microscope.render(particles, rng=rng))
    with tifffile.TiffWriter(path) as tif:
        for k in range(n):
            tif.write(images[k % len(images)], contiguous=True, photometric="minisblack")


class Watch:
    """Largest memory of this process and its children together (bytes, pages that are shared counted once), and their
    processor time (s)."""

    def __enter__(self) -> "Watch":
        self.memory, self.seconds, self._done = 0, {}, Event()
        self._thread = Thread(target=self._look)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        this = psutil.Process()
        before = sum(this.cpu_times()[:2])
        while not self._done.wait(0.2):
            memory = 0
            for process in (this, *this.children(recursive=True)):
                try:
                    memory += process.memory_full_info().pss
                    self.seconds[process.pid] = sum(process.cpu_times()[:2]) - before * (process == this)
                except psutil.Error:  # it has just ended
                    continue
            self.memory = max(self.memory, memory)


def main() -> None:
    """Measure a film, and say how long it took."""
    parser = argparse.ArgumentParser(description="Measure a long film from TIFF to Parquet.")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    sample = datasets.sample()
    calibration = Calibration.from_stack(sample.stack, sample.z_um)
    with TemporaryDirectory() as folder:
        path = Path(folder)
        film(path / "film.tif", options.frames, options.particles)
        with Watch() as watch:
            start = perf_counter()
            table = batch_to_parquet(
                path / "film.tif", calibration, path / "table", n_jobs=options.jobs, progress=False, threshold=0.5
            )
            seconds = perf_counter() - start
        rows = len(pd.read_parquet(table))
    busy = sum(watch.seconds.values())
    print(
        f"{options.frames} frames, {options.jobs} processes: {options.frames / seconds:.0f} frames/s, {seconds:.1f} s; "
        f"processor {busy:.1f} s, {1e3 * busy / options.frames:.1f} ms a frame; {watch.memory / 1e9:.2f} GB; "
        f"{rows / options.frames:.1f} rows a frame"
    )


if __name__ == "__main__":
    main()
