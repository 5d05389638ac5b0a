"""Speed, as a ratio to Y = one cv2.matchTemplate of one template on the same frame, and memory.

Timings run only on demand (see the README) and assert nothing; memory is tested always.
"""

import subprocess
import sys
from timeit import repeat

import cv2
import numpy as np
import pytest
from conftest import table

from gdptlab import Calibration, batch, locate
from gdptlab.experiment.film import Film
from gdptlab.experiment.plain import CORRELATE, locate_plainly

MEMORY_MB = 200  # of `locate` on 512 by 512 px, above the import
FILM_MB = 200  # that 1700 frames more may take, in blocks on their way to a process; if held, they would take 570


def crowd(n, seed=95, size=512):
    rng = np.random.default_rng(seed)
    return table(rng.uniform(0, size - 1, n), rng.uniform(0, size - 1, n), rng.uniform(-50, 50, n))


@pytest.fixture
def one_thread():
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.fixture
def timed(benchmark, calibration, one_thread):
    """Time a call in this run's Y, and print it."""

    def run(call, frame):
        frame, template = frame.astype(np.float32), calibration.templates[20]
        unit = np.median(repeat(lambda: cv2.matchTemplate(frame, template, cv2.TM_CCOEFF_NORMED), number=3, repeat=15))
        result = benchmark(call)
        if benchmark.stats is not None:
            ratio = benchmark.stats.stats.median / (unit / 3)
            benchmark.extra_info |= {"Y_ms": 1000 * unit / 3, "ratio_to_Y": ratio}
            print(f"\n{benchmark.name}: {ratio:.1f} Y, Y = {1000 * unit / 3:.2f} ms")
        return result

    return run


@pytest.mark.parametrize("refine", [False, True], ids=["plain", "refined"])
@pytest.mark.parametrize("count", [50, 200])
def test_locate(timed, microscope, calibration, count, refine):
    frame = microscope.render(crowd(count), rng=96)
    assert len(timed(lambda: locate(frame, calibration, refine=refine), frame)) > count / 10


@pytest.mark.parametrize("refine", [False, True], ids=["plain", "refined"])
@pytest.mark.parametrize("correlate", CORRELATE)
def test_locate_plainly(timed, microscope, calibration, correlate, refine):
    """To be divided by `test_locate` of 50 particles: how much faster that is."""
    frame = microscope.render(crowd(50), rng=96)
    assert len(timed(lambda: locate_plainly(frame, calibration, correlate=correlate, refine=refine), frame)) > 5


@pytest.mark.parametrize("size", [256, 512, 1024, 2048])
def test_frame_size(timed, benchmark, microscope, calibration, size):
    """Of one density, so that the time per pixel should grow no faster than the logarithm of their number."""
    frame = microscope.render(crowd(50 * size**2 // 512**2, size=size), (size, size), rng=96)
    assert len(timed(lambda: locate(frame, calibration), frame)) > 1
    if benchmark.stats is not None:
        benchmark.extra_info["ns_per_pixel_and_bit"] = 1e9 * benchmark.stats.stats.median / size**2 / np.log2(size**2)


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_batch(benchmark, microscope, calibration, n_jobs):
    """500 frames; the processes are there already."""
    shown = [microscope.render(crowd(50, seed), rng=seed) for seed in range(20)]

    def run(count):
        return batch((shown[i % 20] for i in range(count)), calibration, n_jobs=n_jobs, progress=False)

    run(100)
    result = benchmark.pedantic(run, (500,), rounds=3)
    if benchmark.stats is not None:
        benchmark.extra_info["frames_per_s"] = 500 / benchmark.stats.stats.median
        assert result["frame"].nunique() == 500


def test_one_second_of_the_camera(benchmark, one_thread):
    """25 frames with 100 particles in view, refined: in real time if this takes less than a second."""
    film = Film.seeded(1, mean_in_view=100, duration_s=1)
    made, frames = Calibration.from_stack(*film.stack()), list(film)
    assert len(benchmark(lambda: [locate(frame, made) for frame in frames])) == 25


def test_render(timed, microscope):
    particles = crowd(100)
    frame = timed(lambda: microscope.render(particles, rng=96), np.zeros((512, 512)))
    assert frame.shape == (512, 512)


PEAK = """
import re
import resource
import sys
from pathlib import Path
import numpy as np
import gdptlab

def peak():
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    # On Linux ru_maxrss begins with that of the process that started this one.
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 2**10

with np.load(sys.argv[1]) as file:
    stack, z_um, frame = file["stack"], file["z_um"], file["frame"]
"""

LOCATE = """
before = peak()
calibration = gdptlab.Calibration.from_stack(stack, z_um)
found = [len(gdptlab.locate(frame, calibration, refine=refine)) for refine in (False, True)]
assert min(found) > 20, found
print(peak() - before)
"""

FILM = """
calibration = gdptlab.Calibration.from_stack(stack, z_um)

def film(count):
    for k in range(count):
        yield frame + k

def evaluate(count):
    table = gdptlab.batch(film(count), calibration, n_jobs=int(sys.argv[2]), refine=False, progress=False)
    assert table["frame"].nunique() == count

evaluate(300)
before = peak()
evaluate(2000)
print(peak() - before)
"""


def taken_mb(program, path, *arguments, **arrays):
    """What a program says of itself, in a process of its own."""
    np.savez(path / "input.npz", **arrays)
    command = [sys.executable, "-c", PEAK + program, str(path / "input.npz"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no resource module")
def test_memory(microscope, stacks, tmp_path):
    frame = microscope.render(crowd(200), rng=96)
    taken = taken_mb(LOCATE, tmp_path, stack=stacks["fluorescent"], z_um=np.linspace(-50, 50, 51), frame=frame)
    print(f"calibration and locate take {taken:.0f} MB")
    assert 1 < taken < MEMORY_MB


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no resource module")
@pytest.mark.parametrize("n_jobs", ["1", "2"])
def test_memory_of_a_long_film(microscope, tmp_path, n_jobs):
    """2000 frames of 0.34 MB each need little more than 300 did."""
    z_um = np.linspace(-20, 20, 11)
    stack = microscope.stack(z_um, 21, rng=97)
    frame = microscope.render(table(70, 71, -6), (206, 203), rng=98).astype(float)
    taken = taken_mb(FILM, tmp_path, n_jobs, stack=stack, z_um=z_um, frame=frame)
    print(f"1700 frames more take {taken:.0f} MB more")
    assert taken < FILM_MB
