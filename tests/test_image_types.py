"""Image types and the camera: formulas, noise, bit depth."""

import numpy as np
import pytest

from gdptlab.experiment import Camera
from gdptlab.experiment.image_types import IMAGE_TYPES, WHITE, as_image_type, brightfield, disturbed, fluorescent

LIGHT = np.random.default_rng(3).uniform(0, 4000, (30, 47)).astype(np.float32)


def test_formulas():
    np.testing.assert_array_equal(fluorescent(LIGHT), LIGHT)
    np.testing.assert_array_equal(brightfield(LIGHT, 7000), 7000 - LIGHT)
    wave = disturbed(LIGHT, 50, (20, 36), (0.3, 1.1), 7000) - brightfield(LIGHT, 7000)
    y, x = np.indices(LIGHT.shape)
    expected = 50 * np.sin(2 * np.pi * x / 20 + 0.3) * np.sin(2 * np.pi * y / 36 + 1.1)
    np.testing.assert_allclose(wave, expected, atol=2e-3)  # of 7000 counts at float32


@pytest.mark.parametrize("image_type", IMAGE_TYPES.values())
@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_any_real_type_of_image(image_type, dtype):
    whole = np.rint(LIGHT)
    np.testing.assert_allclose(image_type(whole.astype(dtype)), image_type(whole), rtol=1e-5, atol=1e-2)
    if dtype == np.float32:
        assert image_type(whole).dtype == np.float32


def test_the_disturbance_can_be_seen():
    """Its amplitude is 2 to 5 % of the empty field, as the illumination of a real condenser varies."""
    field = disturbed(np.zeros((600, 600), np.float32))
    amplitude = (field.max() - field.min()) / 2
    assert 0.02 <= round(amplitude / WHITE, 4) <= 0.05


def test_type_by_name_or_function():
    assert as_image_type("disturbed") is disturbed
    assert as_image_type(np.negative) is np.negative
    with pytest.raises(ValueError, match="image_type"):
        as_image_type("bright")


@pytest.mark.parametrize("axis", [0, 1])
def test_disturbed_refuses_a_period_of_zero(axis):
    period = [100, 100]
    period[axis] = 0
    with pytest.raises(ValueError, match=rf"period_px\[{axis}\]"):
        disturbed(LIGHT, period_px=period)


def test_camera_without_noise_rounds_and_cuts_off():
    light = np.array([[-50, 0, 0.4, 0.6, 254.4, 1e6]])
    assert Camera(background=10, bit_depth=8).record(light).tolist() == [[10, 10, 10, 11, 255, 255]]
    assert Camera(background=10, bit_depth=16).record(light).tolist() == [[10, 10, 10, 11, 264, 65535]]
    assert Camera().record(light).dtype == np.uint16


@pytest.mark.parametrize("read_noise", [0, 5, 38])
def test_read_noise(read_noise):
    dark = Camera(background=500, read_noise=read_noise).record(np.zeros((400, 500)), 4)
    n = dark.size
    assert abs(dark.mean() - 500) <= 4 * read_noise / np.sqrt(n)
    expected = np.sqrt(read_noise**2 + (1 / 12 if read_noise else 0))  # and rounding
    assert dark.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * n))


@pytest.mark.parametrize("gain", [0.25, 3])
@pytest.mark.parametrize("light", [40, 2000])
def test_photon_noise(gain, light):
    """Variance of counts = counts / electrons per count."""
    camera = Camera(background=100, read_noise=0, electrons_per_count=gain)
    counts = camera.record(np.full((400, 500), light), 5)
    n = counts.size
    variance = light / gain + 1 / 12 * (gain > 1)
    assert counts.mean() - 100 == pytest.approx(light, abs=4 * np.sqrt(variance / n))
    # For Poisson the variance of the variance has a term 1 / mean more than for a Gaussian.
    assert counts.var() == pytest.approx(variance, rel=4 * np.sqrt((2 + 1 / (light * gain)) / n) + 1e-3)


def test_noise_is_that_of_its_seed():
    camera = Camera(electrons_per_count=1.0)
    one, same, other = (camera.record(LIGHT, seed) for seed in (1, np.random.default_rng(1), 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.9


def test_saturates_with_noise():
    bright = Camera(bit_depth=10).record(np.full((50, 50), 5000.0), 6)
    assert bright.min() == bright.max() == 1023
    assert Camera(background=0).record(np.zeros((50, 50)), 6).min() == 0


@pytest.mark.parametrize("name", ["background", "read_noise", "electrons_per_count"])
@pytest.mark.parametrize("value", [-1, np.nan, np.inf, "1"])
def test_camera_refuses(name, value):
    with pytest.raises(TypeError if value == "1" else ValueError, match=name):
        Camera(**{name: value})


@pytest.mark.parametrize("bit_depth", [0, 17, 8.5, "8", None])
def test_camera_refuses_bit_depth(bit_depth):
    with pytest.raises(ValueError if isinstance(bit_depth, int) else TypeError, match="bit_depth"):
        Camera(bit_depth=bit_depth)


def test_camera_refuses_unknown_names():
    with pytest.raises(TypeError, match="readnoise"):
        Camera(readnoise=3)
