"""Smooth backgrounds: recovered under noise and beside particles; sums against dense products."""

import numpy as np
import pytest
from test_renderer import crowd, dense

from gdptlab.fit.background import BOUNDED, Background, suitable
from gdptlab.fit.renderer import Renderer

SHAPE, KNOT_PX, NOISE = (200, 260), 60.0, 10.0
COEFFICIENTS = 6 * 7  # round(side / knot) + 3 in each direction
# Products of every third row are off by a share of what they could be at most (Cauchy and Schwarz). They only steer
# the fit; the worst are those of the derivative by y, of sharp images of which the frame's edge leaves few rows.
PRODUCTS_MEDIAN, PRODUCTS_95, PRODUCTS_WORST = 0.002, 0.04, 0.5


@pytest.fixture(scope="module")
def surface():
    return Background(SHAPE, KNOT_PX)


def smooth(shape=SHAPE):
    """Light that changes over many knots' distances at most."""
    y, x = np.indices(shape)
    return (700 + 0.8 * x - 0.5 * y + 60 * np.sin(2 * np.pi * x / 500 + 1) * np.cos(2 * np.pi * y / 400)).astype("f4")


def noisy(seed, level=NOISE, shape=SHAPE):
    return (smooth(shape) + np.random.default_rng(seed).normal(0, level, shape)).astype(np.float32)


def uniform(level=NOISE, shape=SHAPE):
    return np.full(shape, level**-2, np.float32)


def basis(surface, count=COEFFICIENTS):
    """Splines as a matrix (pixels, B)."""
    return np.stack([surface.surface(unit).ravel() for unit in np.eye(count)], axis=1).astype(float)


# -------------------- the fit


@pytest.mark.parametrize("seed", range(3))
def test_recovered_under_noise(surface, seed):
    """Each coefficient takes its share of the noise, and no more; the shape itself fits to a tenth of it."""
    off = surface.fit(noisy(seed), uniform()) - smooth()
    assert np.sqrt((off**2).mean()) < 1.5 * NOISE * np.sqrt(COEFFICIENTS / off.size) + 0.1 * NOISE
    assert np.abs(off).max() < NOISE


@pytest.mark.parametrize("light", [0.0, 4321.7, -80.0])
def test_a_constant_is_itself(surface, light):
    frame = np.full(SHAPE, light, np.float32)
    np.testing.assert_allclose(surface.fit(frame, uniform()), frame, atol=1e-5 * abs(light) + 1e-6)


@pytest.mark.parametrize("shape", [(61, 61), (61, 700), (7, 9)])
def test_frames_of_any_shape(shape):
    off = Background(shape, 122.0).fit(noisy(1, 1.0, shape), uniform(1.0, shape)) - smooth(shape)
    assert np.abs(off).max() < 4


@pytest.mark.parametrize("sign", [1, -1])
def test_particles_not_yet_found_pull_little(surface, sign):
    """Each pixel of theirs pulls as one that is three standard deviations off, however bright it is."""
    rng, light = np.random.default_rng(4), np.zeros(SHAPE, bool)
    for _ in range(25):
        y, x = (rng.integers(20, side - 20) for side in SHAPE)
        light[y - 5 : y + 6, x - 5 : x + 6] = True
    assert 0.03 < light.mean() < 0.08
    clean = smooth()
    for counts in (300.0, 3000.0):
        bent = surface.fit((noisy(5) + sign * counts * light).astype(np.float32), uniform()) - clean
        assert np.abs(bent).mean() < 2 * BOUNDED * NOISE * light.mean()
        assert np.abs(bent).max() < 2 * BOUNDED * NOISE
    plain = np.linalg.solve(surface.matrix(uniform()), surface.gradient(noisy(5) + sign * 3000 * light, uniform()))
    assert np.abs(bent).mean() < 0.1 * np.abs(surface.surface(plain) - clean).mean()


def test_pixels_without_weight_say_nothing(surface):
    frame, weight = noisy(6), uniform()
    weight[40:90, 100:150] = 0
    spoilt = np.where(weight > 0, frame, 60_000).astype(np.float32)
    np.testing.assert_allclose(surface.fit(spoilt, weight), surface.fit(frame, weight), atol=0.05 * NOISE)


def test_frame_is_not_changed(surface):
    frame, weight = noisy(7), uniform()
    kept = frame.copy(), weight.copy()
    surface.fit(frame, weight)
    np.testing.assert_array_equal((frame, weight), kept)


@pytest.mark.parametrize(("period", "chosen"), [(None, 0), (600, 0), (60, 2)])
def test_knots_suit_the_frame(period, chosen):
    """Coarse ones unless the background changes faster than they follow; particles not found yet change nothing."""
    rng, x = np.random.default_rng(9), np.arange(SHAPE[1])
    frame = noisy(9) + (400 * np.sin(2 * np.pi * x / period) if period else 0)
    for _ in range(12):
        y, x = (rng.integers(10, side - 10) for side in SHAPE)
        frame[y - 6 : y + 7, x - 6 : x + 7] += 800
    surfaces = [Background(SHAPE, knot) for knot in (120.0, 60.0, 15.0)]
    assert suitable(surfaces, frame.astype(np.float32), uniform(), 4.0, 5.0) == chosen


# -------------------- sums


@pytest.fixture(scope="module")
def sums(surface):
    """Splines as a matrix; weights, some 0, that change slowly as the light of particles does; a residual."""
    rng = np.random.default_rng(8)
    y, x = np.indices(SHAPE)
    weight = (1.5 + np.sin(x / 15) * np.cos(y / 20)).astype(np.float32)
    weight[:, 200:210] = 0
    return basis(surface), weight, rng.normal(0, 100, SHAPE).astype(np.float32)


def test_surface_is_a_partition(surface):
    np.testing.assert_allclose(surface.surface(np.ones(COEFFICIENTS)), 1, atol=1e-5)


def test_matrix_and_gradient_are_dense_products(surface, sums):
    splines, weight, residual = sums
    expected = splines.T @ (weight.ravel()[:, None] * splines)
    np.testing.assert_allclose(surface.matrix(weight), expected, atol=2e-5 * expected.max())
    flat = (weight.astype(float) * residual).ravel()
    scale = np.sqrt((splines**2).T @ flat**2)
    np.testing.assert_allclose(surface.gradient(residual, weight) / scale, splines.T @ flat / scale, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_products_with_particles_are_dense_products(surface, sums, clean_stack, seed):
    splines, weight, _ = sums
    columns = Renderer((clean_stack - 500.0)[None], 1, noise=38).draw(crowd(SHAPE, 40, seed, margin=30), SHAPE)
    root = np.sqrt(weight.ravel())[:, None]
    images, splines = root * dense(columns, SHAPE), root * splines
    seen = np.linalg.norm(images, axis=0) > 0
    products = surface.products(columns, weight)
    assert products.shape == (160, COEFFICIENTS) and not products[~seen].any()
    scale = np.outer(np.linalg.norm(images, axis=0), np.linalg.norm(splines, axis=0))[seen]
    exact, off = (images.T @ splines)[seen] / scale, np.abs(products - images.T @ splines)[seen] / scale
    meet = np.abs(exact) > 1e-3
    assert np.abs(exact).max() > 0.4
    assert np.median(off[meet]) < PRODUCTS_MEDIAN
    assert np.percentile(off[meet], 95) < PRODUCTS_95
    assert off.max() < PRODUCTS_WORST


def test_a_frame_of_which_one_pixel_is_seen():
    frame, weight = np.full((36, 40), 7.0, np.float32), np.zeros((36, 40), np.float32)
    for row, column in [(0, 0), (17, 20), (35, 3)]:
        weight[:] = 0
        weight[row, column] = 1
        np.testing.assert_allclose(Background(frame.shape, 4.0).fit(frame, weight), 7.0, atol=1e-3)
