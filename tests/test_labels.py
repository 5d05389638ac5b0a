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


def spoilt(table, how):
    """Labels that do not fit the images."""
    return {
        "too few": lambda: table[:30],
        "one depth": lambda: table.assign(z_um=3.0),
        "no frame": lambda: table.drop(columns="frame"),
        "frames from 1": lambda: table.assign(frame=table["frame"] + 1),
        "outside": lambda: table.assign(x_px=table["x_px"] + 300),
        "swapped": lambda: table.rename(columns={"x_px": "y_px", "y_px": "x_px"}),
        "upside down": lambda: table.assign(y_px=255 - table["y_px"]),
        "off by a pixel": lambda: table.assign(x_px=table["x_px"] + 1, y_px=table["y_px"] + 1),
        "nothing": lambda: table.assign(x_px=np.nan),
    }[how]()


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("too few", "40"),
        ("one depth", "z_um"),
        ("no frame", "frame"),
        ("frames from 1", "from 1"),
        ("outside", "outside"),
        ("swapped", "swapped"),
        ("upside down", "lower edge"),
        ("off by a pixel", "off by"),
        ("nothing", "NaN"),
    ],
)
def test_labels_that_do_not_fit_are_named(film, how, said) -> None:
    with pytest.raises(ValueError, match=rf"^table: .*{said}"):
        Calibration.from_labelled(film[0], spoilt(film[1], how), size=61)


def test_a_sign_of_z_turns_the_calibration_over(film, labelled) -> None:
    """No image tells it: the labels say what z is."""
    turned = Calibration.from_labelled(film[0], film[1].assign(z_um=-film[1]["z_um"]), size=61)
    np.testing.assert_allclose(turned.z_um, -labelled.z_um[::-1])
    assert np.corrcoef(turned.stack.ravel(), labelled.stack[::-1].ravel())[0, 1] > 0.98


def test_depths_without_particles_are_named(film) -> None:
    with pytest.warns(UserWarning, match="no particle at depths"):
        Calibration.from_labelled(film[0], film[1][film[1]["z_um"].abs() > 12], size=61)
