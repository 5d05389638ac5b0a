"""What a calibration says of the accuracy to come, before anything is measured."""

import numpy as np
import pytest
from conftest import Z_UM

from gdptlab import Calibration, locate, match

STD = ["x_std_px", "y_std_px", "z_std_um"]


def test_bound_follows_the_noise_and_the_brightness(calibration):
    bound, twice = calibration.expected_error(38), calibration.expected_error(76)
    assert list(bound) == ["z_um", *STD] and np.array_equal(bound.z_um, Z_UM)
    assert np.isfinite(bound).all(axis=None) and (bound[STD] > 0).all(axis=None)
    np.testing.assert_allclose(twice[STD], 2 * bound[STD], rtol=1e-6)
    np.testing.assert_allclose(calibration.expected_error(76, brightness=2)[STD], bound[STD], rtol=1e-6)
    assert (calibration.expected_error(38, electrons_per_count=0.5)[STD] > bound[STD]).all(axis=None)


def test_noise_of_the_stack_unless_told(calibration):
    np.testing.assert_allclose(calibration.expected_error()[STD], calibration.expected_error(38)[STD], rtol=0.05)


def test_a_stack_without_noise_has_a_bound(clean_stack):
    assert np.isfinite(Calibration.from_stack(clean_stack, Z_UM, denoise=False).expected_error()).all(axis=None)


def test_joint_fit_comes_near_the_bound_in_the_plane(isolated, calibration):
    frames, true = isolated["fluorescent"]
    bound = calibration.expected_error(38)
    errors, bounds = [], []
    for number in range(4):
        truth = true[true.frame == number].drop(columns="frame").reset_index(drop=True)
        pairs = match(locate(frames[number], calibration, method="joint"), truth)
        assert len(pairs) >= 0.97 * len(truth)
        errors.append(pairs[["dx_px", "dy_px"]])
        bounds.append(np.stack([np.interp(pairs.z_um, Z_UM, bound[c]) for c in STD[:2]], axis=1))
    errors, bounds = np.concatenate(errors), np.concatenate(bounds)
    ratio = np.sqrt((errors**2).mean(axis=0) / (bounds**2).mean(axis=0))
    # 216 particles: the ratio itself is known to 5 %.
    assert (ratio > 0.85).all() and (ratio < 1.25).all(), ratio


@pytest.mark.parametrize("name", ["noise", "electrons_per_count", "brightness"])
@pytest.mark.parametrize("value", [0, -1, np.nan, "1"])
def test_bad_input(calibration, name, value):
    with pytest.raises((TypeError, ValueError), match=name):
        calibration.expected_error(**{name: value})
