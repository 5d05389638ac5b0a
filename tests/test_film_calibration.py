"""A calibration from a film alone, on a small film of Gaussian images whose width and shape change with depth."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, match

HEIGHT_UM, SHAPE, NOISE = 60.0, (150, 150), 4.0
DEPTHS = np.linspace(-30, 30, 41)


def film(seed, *, frames=60, count=7, apart_um=10.0, focus_um=-8.0, kinds=(1.0,)):
    """Frames (n, rows, columns) of particles whose images have their foci `apart_um` apart, and the truth."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    images, rows = [], []
    for k in range(frames):
        image = rng.normal(100, NOISE, SHAPE)
        for _ in range(count):
            (x_px, y_px), z = rng.uniform(-5, 155, 2), rng.uniform(-30, 30)
            width = [1.8 * rng.choice(kinds) * np.hypot(1, (z - focus_um - s * apart_um) / 11) for s in (1, -1)]
            peak = 4000 * rng.lognormal(0, 0.3) / (width[0] * width[1])
            image += peak * np.exp(-((x - x_px) ** 2) / 2 / width[0] ** 2 - (y - y_px) ** 2 / 2 / width[1] ** 2)
            rows.append((k, x_px, y_px, z))
        images.append(image)
    return np.array(images, np.float32), pd.DataFrame(rows, columns=["frame", "x_px", "y_px", "z_um"])


@pytest.fixture(scope="module")
def made():
    """A film, its truth and the calibration from it."""
    frames, truth = film(1)
    return frames, truth, Calibration.from_film(frames, height_um=HEIGHT_UM, fitted=20)


def test_depths_from_no_depths(made):
    _, truth, calibration = made
    particles = calibration.report.particles
    used = truth[truth["frame"].isin(particles["frame"])]
    found = match(particles, used, radius_px=2, depth_um=60)
    print(found.head())
