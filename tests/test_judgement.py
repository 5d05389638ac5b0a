"""Which particles stay: gains beside the errors of bright neighbours' patterns, odd ones, populations."""

import numpy as np
import pytest
from test_renderer import NOISE, drawn

from gdptlab.fit.judgement import NARROWEST, ODD, Level, learned_population
from gdptlab.fit.renderer import Renderer
from gdptlab.fit.solver import Population, fitted

SHAPE, SIZE = (140, 240), 61


@pytest.fixture(scope="module")
def level(clean_stack):
    """Patterns whose error is half the noise of a pixel."""
    images = (clean_stack - 500.0)[None]
    return Level(Renderer(images, 1, noise=NOISE), np.full(images.shape[1:], NOISE / 2, np.float32), 1, SIZE, None)


def fit(level, places, amplitudes=1.0, frame=None):
    rng = np.random.default_rng(1)
    frame = drawn(level.renderer, places, SHAPE) if frame is None else frame
    weight = np.full(SHAPE, NOISE**-2, np.float32)
    noisy = frame + rng.normal(0, NOISE, SHAPE).astype(np.float32)
    result = fitted(level.renderer, noisy, places, weight, Population(amplitudes, 2.0), steps=6)
    return result, weight, level.error_variance(result.places, SHAPE)


def test_a_dim_particle_counts_less_beside_a_bright_one(level):
    """By what the bright one's pattern may be wrong, and not by its own error, however bright it is."""
    places = np.array([[70, 70, 20, 30.0], [74, 82, 25, 0.5], [70, 190, 25, 0.5]])
    result, weight, total = fit(level, places)
    gain = level.gain(result, weight, total) + result.population.penalty(result.places[:, 3])
    assert gain[1] < 0.2 * result.gain[1]
    np.testing.assert_allclose(gain[[0, 2]], result.gain[[0, 2]], rtol=0.1)


def test_of_two_in_one_place_one_goes(level):
    places = np.array([[70, 70.0], [71, 71], [70, 120], [20, 20]])
    stays = level.staying(np.array([5.0, 3.0, 2.0, 300.0]), places, 20.0)
    assert stays.tolist() == [True, False, False, True]
    assert level.staying(np.full(4, 21.0), places, 20.0).all()


def test_what_is_odd_and_what_is_its_neighbour(level):
    places = np.array([[10, 10.0], [10, 200], [130, 10], [70, 120], [70, 70], [75, 80], [130, 230], [70, 200]])
    excess = np.array([1.0, 1.0, 1.0, 1.0, 10 * ODD, 4 * ODD, 1.5 * ODD, 0.9 * ODD])
    assert level.odd(places, excess).tolist() == [False] * 4 + [True, False, True, False]
    np.testing.assert_array_equal(level.odd(places, 7 * excess), level.odd(places, excess))


def test_errors_of_patterns_are_no_excess(level):
    """Of a bright particle chi-square is large where its pattern is wrong by as much as is known."""
    rng, places = np.random.default_rng(2), np.array([[70, 70, 20, 40.0], [70, 190, 20, 1.0]])
    frame = drawn(level.renderer, places, SHAPE)
    seen = frame > 0
    seen[:, 130:] = False
    frame = frame + (seen * rng.normal(0, 0.3**0.5 * 40 * NOISE / 2, SHAPE)).astype(np.float32)
    result, weight, total = fit(level, places, frame=frame)
    assert result.chi2[0] > 50 and result.chi2[1] < 1.2
    np.testing.assert_allclose(level.excess(result, weight, total), 1, atol=0.35)


@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0])
def test_population_is_as_wide_as_the_particles_say(level, sigma):
    rng = np.random.default_rng(3)
    y, x = (a.ravel() for a in np.meshgrid([35, 100], np.arange(10, 240, 12)))
    amplitude = 3 * np.exp(sigma * rng.standard_normal(len(x)))
    places = np.stack([y, x, np.full(len(x), 12.0), amplitude], axis=1).astype(float)
    result, _, _ = fit(level, places, 3.0)
    population = learned_population(result, np.ones(len(x), bool), None)
    assert population.centre == pytest.approx(3, rel=0.05 + sigma / 2)
    assert population.sigma == pytest.approx(max(sigma, NARROWEST), rel=0.5)
    assert learned_population(result, np.zeros(len(x), bool), population) is population
