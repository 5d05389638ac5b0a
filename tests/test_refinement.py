"""The least-squares displacement of a particle within a window."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import refinement as displacement
from gdptlab.correlation import normalised
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
