"""Tilt and curvature of the focal surface in what correlation measures."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, locate
from gdptlab.pipeline import flattened, report

Z_UM, SHAPE = np.linspace(-24, 24, 25), (260, 380)


def spot(z_um, x, y):
    """An astigmatic spot in a frame."""
    wide, high = (2 * np.hypot(1, (z_um + s) / 14) for s in (9, -9))
    down, across = (
        np.exp(-((np.arange(n) - at) ** 2) / (2 * w**2)) / w
        for n, at, w in zip(SHAPE, (y, x), (high, wide), strict=True)
    )
    return 4000 * np.outer(down, across)


def surface(x, y, bend):
    """Height (µm) at which what lies on the slide is in focus."""
    return 0.02 * (x - 190) - 0.01 * (y - 130) + bend * ((x - 190) ** 2 + (y - 130) ** 2)


def made(bend, rng):
    """Calibration with beads on a slide, and the table of particles that lie at -5 µm in the scan's z."""
    grid = np.stack(np.meshgrid(np.arange(40, 350, 75), np.arange(40, 240, 90)), axis=-1).reshape(-1, 2)
    x, y = (grid + rng.uniform(-5, 5, grid.shape)).T
    frames = [sum(spot(z - h, *p) for *p, h in zip(x, y, surface(x, y, bend), strict=True)) for z in (*Z_UM, -5.0)]
    frames = np.array(frames) + rng.normal(0, 3, (len(Z_UM) + 1, *SHAPE))
    calibration = Calibration.from_scan(frames[:-1], Z_UM, size=31)
    return calibration, locate(frames[-1], calibration, threshold=0.7)


def test_depths_on_a_slide_are_the_same_all_over() -> None:
    calibration, table = made(1e-4, np.random.default_rng(4))
    assert table["z_um"].std() > 1 and report(calibration).loc["the plane of beads", "verdict"] != "good"
    flat = flattened(table.assign(z_std_um=0.1), calibration)
    np.testing.assert_allclose(flat["z_um"], -5, atol=0.5)
    assert flat["z_um"].std() < table["z_um"].std() / 8
    assert flat["z_std_um"].between(0.1, 0.3).all() and list(flat) == [*table, "z_std_um"]


def test_beads_are_needed() -> None:
    plain = Calibration.from_stack([spot(z, 17, 15)[:31, 2:33] for z in Z_UM], Z_UM)
    x_px = np.arange(8.0)
    beads = pd.DataFrame({"x_px": x_px, "y_px": 3 + 2 * x_px, "offset_um": 0.0, "verdict": "used"})
    few, line = (replace(plain, report=SimpleNamespace(beads=table)) for table in (beads[:5], beads))
    table = pd.DataFrame({"x_px": [1.0], "y_px": [2.0], "z_um": [3.0]})
    for wrong in (few, line, plain):
        with pytest.raises(ValueError, match=r"^calibration: "):
            flattened(table, wrong)
    with pytest.raises(ValueError, match=r"^table: "):
        flattened(pd.DataFrame({"z_um": [1.0]}), plain)
