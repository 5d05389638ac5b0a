"""What went wrong without a word, or with one that did not help: each stays mended."""

import subprocess
import sys
import time
import zipfile

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, batch, locate
from gdptlab.locate import BLOCK, in_blocks

# -------------------- masked pixels, large offsets


def test_masked_pixels_are_refused(few, calibration):
    frame = few[0].astype(float)
    masked = np.ma.masked_greater(frame, np.quantile(frame, 0.99))
    for call in (
        lambda: locate(masked, calibration),
        lambda: batch([frame, masked], calibration, progress=False),
        lambda: batch(np.ma.stack([frame, masked]), calibration, progress=False),
        lambda: Calibration.from_stack([*calibration.stack[:-1], masked[:61, :61]], calibration.z_um),
    ):
        with pytest.raises(ValueError, match=r"^(image|stack): .*masked"):
            call()
    unmasked = np.ma.array(frame)
    pd.testing.assert_frame_equal(locate(unmasked, calibration), locate(frame, calibration))


@pytest.mark.parametrize("offset", [1e9, -3e10, 2**30])
def test_a_large_offset_costs_no_digits(few, calibration, offset):
    kind = type(offset)
    frame, stack = few[0].astype(kind), calibration.stack.astype(np.float64)
    plain = locate(frame, calibration)
    pd.testing.assert_frame_equal(locate(frame + offset, calibration), plain, atol=1e-3)
    made = Calibration.from_stack(stack + offset, calibration.z_um)
    pd.testing.assert_frame_equal(locate(frame, made), plain, atol=1e-3)


# -------------------- processes that outlive who started them

ORPHANS = """
import numpy as np
from gdptlab import Calibration, batch

y, x = np.indices((9, 9)) - 4
stack = [np.exp(-((x / (2 + z)) ** 2) - (y / (4 - z)) ** 2) for z in np.linspace(-1, 1, 7)]

def film():
    for k in range(10**9):
        if k == 250:
            print("runs", flush=True)
        yield np.eye(40)

if __name__ == "__main__":
    batch(film(), Calibration.from_stack(stack, range(7), n_sub=3), n_jobs=2, progress=False)
"""


def test_processes_of_batch_leave_when_their_parent_is_killed(tmp_path):
    (tmp_path / "orphans.py").write_text(ORPHANS)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "orphans.py")], stdout=subprocess.PIPE, text=True)
    try:
        assert parent.stdout.readline() == "runs\n"
    finally:
        parent.kill()
    start = time.monotonic()
    parent.communicate(timeout=60)  # until nobody holds its output open
    assert time.monotonic() - start < 20


# -------------------- files of calibrations


def spoilt(calibration, path, **changes):
    """File of a calibration in which some arrays are others."""
    parts = {name: getattr(calibration, name) for name in ("stack", "z_um", "subset", "templates")}
    np.savez_compressed(path, gdptlab_calibration=1, **parts | changes)
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {"z_um": np.linspace(50, -50, 51)},
        {"z_um": np.full(51, np.nan)},
        {"z_um": np.linspace(-50, 50, 51).reshape(51, 1)},
        {"stack": np.zeros((51, 60, 60), np.float32)},
        {"stack": np.full((51, 61, 61), np.inf, np.float32)},
        {"templates": np.ones((51, 61, 61), np.float32)},
        {"templates": np.zeros((51, 59, 59), np.float32)},
        {"subset": np.array([3, 90])},
        {"subset": np.array([-4, 9])},
        {"subset": np.array([9, 4])},
        {"subset": np.array([0.5, 1.5])},
        {"more": np.zeros(3)},
    ],
)
def test_files_that_are_no_calibration_are_refused(calibration, tmp_path, changes):
    with pytest.raises(ValueError, match=r"^path: got 'made.npz'"):
        Calibration.load(spoilt(calibration, tmp_path / "made.npz", **changes))


def test_sizes_are_looked_at_before_anything_is_unpacked(tmp_path, monkeypatch):
    """A small file may say that it holds a gigabyte."""
    path = tmp_path / "made.npz"
    np.savez_compressed(path, gdptlab_calibration=np.zeros(2**24), stack=1, z_um=1, subset=1, templates=1)
    assert path.stat().st_size < 1e6
    monkeypatch.setattr(np, "load", None)
    with pytest.raises(ValueError, match=r"^path: got 'made.npz'.*shapes"):
        Calibration.load(path)
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("stack.npy", b"no array")
    with pytest.raises(ValueError, match=r"^path: got 'other.npz'"):
        Calibration.load(tmp_path / "other.npz")


# -------------------- films with a frame that is none


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_blocks_before_a_bad_frame_are_kept_and_the_frame_is_named(few, calibration, n_jobs):
    film = [few[0].astype(float)] * (2 * BLOCK + 3)
    film[-2] = np.full_like(film[0], np.nan)
    kept = []
    with pytest.raises(ValueError, match=rf"^image: .*frame {len(film) - 2}\b"):
        for first, n, _ in in_blocks(film, calibration, n_jobs, {"refine": False}):
            kept.append((first, n))
    assert kept == [(0, BLOCK), (BLOCK, BLOCK)]


def test_a_bad_frame_is_named_by_the_joint_fit_too(few, calibration):
    film = np.stack([few[0].astype(float)] * 3)
    film[2] = np.inf
    with pytest.raises(ValueError, match=r"^image: .*frame 2\b"):
        batch(film, calibration, method="joint", progress=False)


def test_a_film_whose_frames_change_their_size_is_refused(few, calibration):
    film = [few[0], few[0], few[0][:-1]]
    with pytest.raises(ValueError, match=r"^frames: .*frame 2\b"):
        batch(film, calibration, refine=False, progress=False)
