"""Speed, as a ratio to Y = one cv2.matchTemplate of one template on the same frame, and memory.

Timings run only on demand (`pytest tests/test_benchmarks.py --benchmark-only`) and assert nothing; the memory
test always runs.
"""

import subprocess
import sys
from timeit import repeat

import cv2
import numpy as np
import pytest
from conftest import table

from gdptlab import locate

MEMORY_MB = 200  # of `locate` on 512 by 512 px, above the import


def crowd(n, seed=95):
    rng = np.random.default_rng(seed)
    return table(rng.uniform(0, 511, n), rng.uniform(0, 511, n), rng.uniform(-50, 50, n))


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


def test_render(timed, microscope):
    particles = crowd(100)
    frame = timed(lambda: microscope.render(particles, rng=96), np.zeros((512, 512)))
    assert frame.shape == (512, 512)


PROGRAM = """
import re
import resource
import sys
from pathlib import Path
import numpy as np
import gdptlab
with np.load(sys.argv[1]) as file:
    stack, z_um, frame = file["stack"], file["z_um"], file["frame"]

def peak():
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    # On Linux ru_maxrss begins with that of the process that started this one.
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 2**10

before = peak()
calibration = gdptlab.Calibration.from_stack(stack, z_um)
found = [len(gdptlab.locate(frame, calibration, refine=refine)) for refine in (False, True)]
assert min(found) > 20, found
print(peak() - before)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no resource module")
def test_memory(microscope, stacks, tmp_path):
    frame = microscope.render(crowd(200), rng=96)
    np.savez(tmp_path / "input.npz", stack=stacks["fluorescent"], z_um=np.linspace(-50, 50, 51), frame=frame)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "input.npz")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    print(f"calibration and locate take {float(done.stdout):.0f} MB")
    assert 1 < float(done.stdout) < MEMORY_MB
