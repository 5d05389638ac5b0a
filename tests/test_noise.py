"""Which pixels are used, and what their variance is."""

import numpy as np
import pytest

from gdptlab.fit.noise import Variance, learned_variance, usable_pixels

SHAPE = (160, 210)


def frame(seed=0, peak=3000.0, width=1.3):
    """Narrow spots, as sharp as a microscope makes them, on a level of 500 with noise of 38."""
    rng, (y, x) = np.random.default_rng(seed), np.indices(SHAPE)
    out = rng.normal(500, 38, SHAPE)
    for _ in range(30):
        b, a = (rng.uniform(-3, side + 3) for side in SHAPE)
        out += peak * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 2 / width**2)
    return out.astype(np.float32)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e4, 1 / 20])
def test_sharp_particles_are_no_defects(unit):
    """In any unit of counts."""
    for seed in range(3):
        pixels = usable_pixels(frame(seed) * np.float32(unit))
        assert pixels.valid.all() and pixels.defective == pixels.saturated == 0
        assert pixels.noise == pytest.approx(38 * unit, rel=0.1)


@pytest.mark.parametrize("sign", [1, -1])
def test_hot_and_dead_pixels_are_left_out(sign):
    """Also at the border, in a corner, two side by side, and absurd ones; what they are replaced with is usual."""
    clean, rng = frame(4, peak=0), np.random.default_rng(5)
    spoilt, where = clean.copy(), np.zeros(SHAPE, bool)
    where.flat[rng.choice(where.size, 30, replace=False)] = True
    where[0, 0] = where[0, 50] = where[70, -1] = where[80, 80] = where[80, 81] = True
    spoilt[where] += sign * rng.uniform(1000, 60_000, where.sum())
    spoilt[20, 20] = sign * 1e9
    where[20, 20] = True
    pixels = usable_pixels(spoilt)
    np.testing.assert_array_equal(pixels.valid, ~where)
    assert pixels.defective == where.sum() and pixels.saturated == 0
    assert np.abs(pixels.filled[where] - 500).max() < 6 * 38
    np.testing.assert_array_equal(pixels.filled[~where], clean[~where])


def test_the_top_of_the_range_is_left_out_with_its_neighbours():
    broad = frame(6, width=6.0)
    top = np.float32(2000)
    pixels = usable_pixels(np.minimum(broad, top))
    assert pixels.saturated > (broad >= top).sum() > 100
    assert not pixels.valid[broad >= top].any()
    assert pixels.valid.mean() > 0.8
    assert usable_pixels(broad).saturated == 0


@pytest.mark.parametrize("level", [0.0, 700.0])
def test_blank_frames(level):
    pixels = usable_pixels(np.full(SHAPE, level, np.float32))
    assert pixels.valid.all() and pixels.noise == 1.0


def test_few_grey_levels_are_no_saturation():
    """Counts of a uint8 camera in the dark: the highest of a handful of values, by chance."""
    dark = np.rint(np.random.default_rng(7).normal(10, 1.5, SHAPE)).astype(np.float32)
    assert usable_pixels(dark).saturated == 0


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_variance_is_learned_from_the_residual(wrong):
    """Read noise and photon noise, and not the patterns' errors, which grow with the square of the light."""
    rng = np.random.default_rng(270)
    light = np.zeros((900, 900), np.float32)
    light[100:820, 50:780] = rng.gamma(2, 300, (720, 730))
    variance = 38.0**2 + 2 * light
    residual = (rng.normal(size=light.shape) * np.sqrt(variance + (wrong * light) ** 2)).astype(np.float32)
    learned = learned_variance(light, residual, 38.0)
    at = np.array([0.0, 300, 1000, 2000])
    np.testing.assert_allclose(learned.level + learned.slope * at, 38.0**2 + 2 * at, rtol=0.25 if wrong == 0 else 0.7)
    valid = np.ones(light.shape, bool)
    valid[:5] = False
    weight = learned.weight(light, valid)
    within = 1.25 if wrong == 0 else 2
    assert 1 / within < np.median((weight * variance)[light > 0]) < within
    assert not weight[:5].any() and (weight[5:] > 0).all()


@pytest.mark.parametrize("lit", [0, 1, 3, 30, 300])
def test_variance_of_a_frame_with_little_light(lit):
    """Too few pixels to learn from; no warning."""
    light = np.zeros((100, 100), np.float32)
    light.flat[:lit] = 500
    residual = np.random.default_rng(271).normal(0, 38, light.shape).astype(np.float32)
    assert learned_variance(light, residual, 38.0).level == pytest.approx(38.0**2, rel=0.2)
    assert Variance(4.0, 0.5).weight(np.full((2, 2), -8, np.float32), np.ones((2, 2), bool)) == pytest.approx(1 / 8)
