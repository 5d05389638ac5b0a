"""Calibrations without a scan: particles of known depth."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, locate, match

DEPTHS = np.array([-30.0, 30.0])


def seeded(rng: np.random.Generator, frames: int, count: int, size: int, sigma: float = 0.3) -> pd.DataFrame:
    """Particles anywhere, at depths between DEPTHS, amplitudes lognormal."""
    n = frames * count
    x, y = rng.uniform(0, size - 1, (2, n))
    return pd.DataFrame(
        {
            "frame": np.repeat(np.arange(frames), count),
            "x_px": x,
            "y_px": y,
            "z_um": rng.uniform(*DEPTHS, n),
            "amplitude": np.exp(sigma * rng.normal(size=n)),
        }
    )


@pytest.fixture(scope="module")
def film(microscope):
    """Three crowded frames of 256 px, and their particles."""
    rng = np.random.default_rng(24)
    table = seeded(rng, 3, 30, 256)
    return np.stack([microscope.render(p, (256, 256), rng=rng) for _, p in table.groupby("frame")]), table


@pytest.fixture(scope="module")
def labelled(film):
    return Calibration.from_labelled(*film, size=61)


def test_labelled_particles_calibrate_the_joint_fit(labelled, microscope) -> None:
    rng = np.random.default_rng(25)
    true = seeded(rng, 1, 12, 256)
    found = locate(microscope.render(true, (256, 256), rng=rng), labelled, method="joint")
    pairs = match(found, true.drop(columns="frame"), within_um=6)
    assert len(pairs) >= 11
    assert len(found) <= 13
    assert np.sqrt((pairs["dz_um"] ** 2).mean()) < 0.6
    assert np.sqrt((pairs[["dx_px", "dy_px"]] ** 2).mean(axis=None)) < 0.08
    stated = found.loc[pairs["measured"], "z_std_um"].to_numpy()
    assert np.sqrt(np.mean((pairs["dz_um"] / stated) ** 2)) < 1.6
