"""The least-squares displacement of a particle within a window."""

import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import shift

from gdptlab import Calibration, datasets, locate
from gdptlab import refinement as displacement
from gdptlab.correlation import normalised
from gdptlab.experiment import WaveMicroscope
from gdptlab.refinement import Displacement

Z_UM = np.linspace(-50, 50, 51)
SIZE_PX = 61
K = np.arange(2, 49)

# What is left of the systematic error for noise-free images, RMS over the depths. It comes from z = 16 to 18 um, where
# the simulated image (without diffraction) has edges sharper than a pixel.
PLACE_PX = 0.02
DEPTH_UM = 0.25


@pytest.fixture(scope="module")
def displacement_of(clean_stack):
    return Displacement(normalised(clean_stack.astype(np.float32)), Z_UM)


@pytest.fixture(scope="module")
def solve(displacement_of):
    """Displacements (m, 3) of windows (m, n, n) from templates k."""

    def solved(windows):
        below = np.arange(len(windows)) * SIZE_PX
        image = windows.reshape(-1, SIZE_PX) - windows.mean(dtype=np.float32)
        return displacement_of(image, np.stack([below, 0 * below], axis=1), K)

    return solved


def windows(microscope, dy, dx, dz):
    tables = [pd.DataFrame({"x_px": [30 + dx], "y_px": [30 + dy], "z_um": [Z_UM[k] + dz]}) for k in K]
    return np.stack([microscope.light(t, (SIZE_PX, SIZE_PX)) for t in tables])


@pytest.mark.parametrize("dz", [-0.8, 0, 0.8])
@pytest.mark.parametrize(("dy", "dx"), [(0, 0), (0.3, 0), (0, -0.3), (0.5, 0.5), (-0.5, 0.25), (-0.1, -0.5)])
def test_displacement_is_found(microscope, solve, dy, dx, dz):
    error = solve(windows(microscope, dy, dx, dz)) - (dy, dx, dz)
    assert (np.sqrt((error**2).mean(axis=0)) <= (PLACE_PX, PLACE_PX, DEPTH_UM)).all()


def test_terms_that_are_not_linear_matter(microscope, solve, monkeypatch):
    """Without them half a pixel reads as 0.4 um of depth."""
    seen = windows(microscope, 0.5, 0.5, 0.0)
    curved = np.sqrt((solve(seen)[:, 2] ** 2).mean())
    monkeypatch.setattr(displacement, "ROUNDS", 0)
    linear = np.sqrt((solve(seen)[:, 2] ** 2).mean())
    assert linear > 0.4
    assert curved < linear / 3


def test_background_level_slope_and_amplitude_do_not_matter(microscope, solve):
    y, x = np.indices((SIZE_PX, SIZE_PX))
    seen = windows(microscope, 0.2, -0.3, 0.4)
    other = (1.7 * seen + (40 - 0.7 * x + 1.1 * y)).astype(np.float32)
    np.testing.assert_allclose(solve(other), solve(seen), atol=2e-3)


def test_nothing_bright_is_not_displaced(microscope, solve, displacement_of):
    seen = windows(microscope, 0.2, -0.3, 0.4)
    assert (solve(-seen) == 0).all()
    assert (solve(np.zeros_like(seen)) == 0).all()
    assert displacement_of(seen[0], np.zeros((0, 2)), K[:0]).shape == (0, 3)


def wrong_slices(stack, rim, off_px=(0.3, -0.2), noise=0.003):
    """Number of odd slices of a stack (N, n, n) that are measured, by its even ones, more than one of these off."""
    rng, level = np.random.default_rng(3), np.median(stack)
    scale, size = np.ptp(stack), stack.shape[1]

    def seen(image):
        return image + noise * scale * rng.standard_normal(image.shape)

    calibration = Calibration.from_stack(seen(stack[::2]), np.arange(0, len(stack), 2.0))
    wrong = 0
    for k in range(1, len(stack) - 1, 2):
        image = shift(np.pad(stack[k], rim, constant_values=level), off_px, mode="nearest")
        table = locate(seen(image), calibration, threshold=0.3)
        true = [(size - 1) / 2 + rim + off for off in off_px[::-1]]
        table = table[np.hypot(table["x_px"] - true[0], table["y_px"] - true[1]) < 3]
        wrong += table.empty or abs(table["z_um"].iloc[0] - k) > 2
    return wrong


def walking(monkeypatch):
    """No stack is compared with all templates."""
    monkeypatch.setattr(displacement, "RISE", 9.0)


def test_slices_of_real_beads_through_focus_are_not_mistaken(monkeypatch):
    try:
        beads = datasets.planar_beads()
    except FileNotFoundError as missing:
        pytest.skip(str(missing))
    stack = Calibration.from_bead(beads.scan, beads.z_um, 244, 230, size=29).stack
    compared = wrong_slices(stack, 20)
    walking(monkeypatch)
    assert compared <= 2 and wrong_slices(stack, 20) > 5 + compared


def test_slices_of_rings_are_not_mistaken(monkeypatch):
    microscope = WaveMicroscope(na=0.6, spherical=0.5)
    stack = np.stack([microscope.image(z, 30, 30, (61, 61)) for z in np.linspace(-6, 6, 51)])
    compared = wrong_slices(stack, 20)
    walking(monkeypatch)
    assert compared == 0 < wrong_slices(stack, 20)


def test_only_stacks_that_resemble_themselves_are_compared(calibrations, clean_stack):
    assert all(c.displacement._singular is None for c in calibrations.values())
    flat = normalised(clean_stack.astype(np.float32)).reshape(len(clean_stack), -1)
    assert displacement.largest_rise(flat) < 0.3 < displacement.largest_rise(np.concatenate([flat, flat]))


@pytest.mark.parametrize("around", [0, 3, 7])
def test_a_template_nearly_as_large_as_the_frame_finds_its_slices(microscope, around):
    size = 97
    calibration = Calibration.from_stack(microscope.stack(Z_UM[::4], size, rng=4), Z_UM[::4])
    for k in range(0, 51, 8):
        middle = (size + around - 1) // 2
        true = pd.DataFrame({"x_px": [middle], "y_px": [middle], "z_um": [Z_UM[k]]})
        found = locate(microscope.render(true, (size + around,) * 2, rng=5), calibration)
        assert len(found) == 1 and abs(found["z_um"][0] - Z_UM[k]) < 4
