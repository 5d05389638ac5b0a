"""What debris covers is left out, and a particle beside it is measured by the rest of its image."""

import numpy as np
import pandas as pd
import pytest
from conftest import Z_UM

from gdptlab import Calibration, match
from gdptlab.fit import Joint
from gdptlab.fit.debris import CLEARLY, covered_pixels

SHAPE, SIZE = (200, 200), 50.0
NOWHERE = np.zeros(SHAPE, bool)


def blob(y=100.0, x=100.0, height=60.0, width=6.0):
    """Light of something that is no particle."""
    rows, columns = np.indices(SHAPE)
    return height * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 2 / width**2)


def residual(*blobs, seed=1):
    return (np.random.default_rng(seed).normal(0, 1, SHAPE) + sum(blobs, np.zeros(SHAPE))).astype(np.float32)


def test_the_whole_of_it_is_covered_and_little_more():
    covered = covered_pixels(residual(blob()), np.array([[104.0, 97]]), NOWHERE, SIZE)
    assert covered[blob() > CLEARLY].all() and not covered[blob() < 0.1].any()


@pytest.mark.parametrize("sign", [1, -1])
def test_only_where_a_row_is_that_no_pattern_explains(sign):
    light = sign * residual(blob(), blob(40, 160))
    covered = covered_pixels(light, np.array([[40.0, 155]]), NOWHERE, SIZE)
    assert covered[40, 160] and not covered[100, 100]
    assert not covered_pixels(light, np.zeros((0, 4)), NOWHERE, SIZE).any()


def test_it_is_followed_from_frame_to_frame():
    before = covered_pixels(residual(blob()), np.array([[100.0, 100]]), NOWHERE, SIZE)
    after = covered_pixels(residual(blob(108, 100), blob(30, 30)), np.zeros((0, 4)), before, SIZE)
    assert after[108, 100] and not after[30, 30]
    assert not covered_pixels(residual(), np.zeros((0, 4)), before, SIZE).any()  # it has left


def test_small_spots_and_faint_ones_are_none():
    at = np.array([[100.0, 100]])
    assert not covered_pixels(residual(blob(width=1.0, height=20)), at, NOWHERE, SIZE).any()
    assert not covered_pixels(residual(blob(height=CLEARLY / 8)), at, NOWHERE, SIZE).any()


@pytest.fixture(scope="module")
def speckled(clean_stack):
    """A plan, a frame with particles and three specks beside some of them, and the particles."""
    rng = np.random.default_rng(5)
    stack = clean_stack + rng.normal(0, 38, clean_stack.shape)
    x, y = (values.ravel() for values in np.meshgrid(np.arange(40, 360, 55.0), np.arange(40, 360, 55.0)))
    true = pd.DataFrame({"x_px": x, "y_px": y, "z_um": rng.uniform(-40, 40, len(x))})
    return Calibration.from_stack(stack, Z_UM), true, rng


def test_a_particle_beside_debris_is_measured(speckled, microscope):
    calibration, true, rng = speckled
    frame = microscope.render(true, (400, 400), rng=rng).astype(np.float32)
    rows, columns = np.indices(frame.shape)
    beside = true.iloc[[8, 17, 26]]
    for p in beside.itertuples():
        away = np.hypot((rows - p.y_px - 14) / 7, (columns - p.x_px - 14) / 5)
        frame += 2500 / (1 + np.exp(6 * (away - 1)))
    plan = Joint(calibration.model, frame.shape)
    found = plan.first(frame)
    table = plan.table(found)
    pairs = match(table, true)
    assert set(beside.index) <= set(pairs["true"]) and len(pairs) >= len(true) - 1
    error = pairs["dz_um"].to_numpy() / table.loc[pairs["measured"], "z_std_um"].to_numpy()
    assert np.sqrt((error**2).mean()) < 1.5
    assert table.attrs["covered_px"] > 100 and table.attrs["foreign"] >= 1
    on_request = plan.table(found, foreign=True)
    assert len(on_request) == len(table) + table.attrs["foreign"]
    later = plan.following(frame, found)
    assert later.covered.any() and len(match(plan.table(later), true)) >= len(true) - 1


def test_a_speck_that_leaves_is_covered_no_more(speckled, microscope):
    calibration, true, rng = speckled
    frame = microscope.render(true, (400, 400), rng=rng).astype(np.float32)
    spoilt = frame.copy()
    spoilt[113:133, 223:243] += 2500
    plan = Joint(calibration.model, frame.shape)
    found = plan.first(spoilt)
    assert found.covered.any()
    assert not plan.following(frame, plan.following(frame, found)).covered.any()


def test_a_frame_without_debris_is_not_covered(speckled, microscope):
    calibration, true, rng = speckled
    plan = Joint(calibration.model, (400, 400))
    found = plan.first(microscope.render(true, (400, 400), rng=rng).astype(np.float32))
    assert not found.covered.any() and plan.table(found).attrs["covered_px"] == 0
