"""Two particles that were taken for one: found again, and no single one split."""

import numpy as np
import pytest
from test_renderer import NOISE, drawn

from gdptlab.fit.judgement import Level
from gdptlab.fit.pairs import _Two, split
from gdptlab.fit.renderer import Renderer
from gdptlab.fit.solver import Population, fitted

SHAPE, SIZE = (140, 240), 61
PAIR = np.array([[70.3, 120.2, 26, 1.2], [69.4, 121.6, 33, 0.9]])


@pytest.fixture(scope="module")
def level(clean_stack):
    """Patterns whose error is a tenth of the noise of a pixel."""
    images = (clean_stack - 500.0)[None]
    return Level(Renderer(images, 1, noise=NOISE), np.full(images.shape[1:], NOISE / 10, np.float32), 1, SIZE, None)


def taken_for_one(level, true=PAIR, seed=1):
    """A frame with particles, the fit in which one stands for all of them, the weight and the patterns' error."""
    frame = drawn(level.renderer, true, SHAPE)
    noisy = frame + np.random.default_rng(seed).normal(0, NOISE, SHAPE).astype(np.float32)
    one = np.average(true, axis=0, weights=true[:, 3])[None]
    one[0, 3] = true[:, 3].sum()
    weight = np.full(SHAPE, NOISE**-2, np.float32)
    fit = fitted(level.renderer, noisy, one, weight, Population(1.0, 0.5), steps=8)
    return fit, weight, level.error_variance(fit.places, SHAPE)


@pytest.mark.parametrize("row", [70.3, 3.0])
def test_two_are_found_where_one_stood(level, row):
    """In the frame, and at its edge."""
    true = PAIR + np.array([row - PAIR[0, 0], 0, 0, 0])
    fit, weight, total = taken_for_one(level, true)
    assert np.abs(fit.places[0, 2] - true[:, 2]).min() > 1  # the one is at neither depth
    is_two, places = split(level, fit, np.ones(1, bool), weight, total)
    assert is_two.tolist() == [True]
    np.testing.assert_allclose(places[np.argsort(places[:, 2])], true, atol=0.4)


def test_the_gain_is_that_of_the_frames(level):
    fit, weight, _ = taken_for_one(level)
    two, renderer = _Two(level, fit, 0, weight), level.renderer
    for _ in range(4):
        two.judge(renderer.draw(two.trial, SHAPE), 0)
        two.step(renderer.count - 1)
    population, places = fit.population, two.places
    left = fit.frame - drawn(renderer, places, SHAPE)
    expected = ((fit.residual**2).sum() - (left**2).sum()) / NOISE**2 / 2
    expected += population.penalty(fit.places[:, 3]).sum() - population.penalty(places[:, 3]).sum()
    assert two.gain == pytest.approx(expected, rel=0.01) and two.gain > 100


@pytest.mark.parametrize("seed", range(4))
def test_one_stays_one(level, seed):
    fit, weight, total = taken_for_one(level, PAIR[:1], seed)
    assert not split(level, fit, np.ones(1, bool), weight, total)[0].any()


def test_who_is_not_believed_is_not_tried(level):
    fit, weight, total = taken_for_one(level)
    is_two, places = split(level, fit, np.zeros(1, bool), weight, total)
    assert not is_two.any() and places.shape == (0, 4)


def test_patterns_that_fit_nowhere_split_nobody(level):
    """Images wider than the patterns: two explain each of them better than one, but all of them alike."""
    middle = np.array([[70, 40], [70, 120], [70, 200]])
    true = np.array([[y, x, z, 1.5] for y, x in middle for z in (26, 30)])
    frame = drawn(level.renderer, true, SHAPE)
    frame += np.random.default_rng(3).normal(0, NOISE, SHAPE).astype(np.float32)
    ones = true[::2] + np.array([0, 0, 2, 1.5])
    weight = np.full(SHAPE, NOISE**-2, np.float32)
    fit = fitted(level.renderer, frame, ones, weight, Population(3.0, 0.5), steps=8)
    total = level.error_variance(fit.places, SHAPE)
    assert not split(level, fit, np.ones(3, bool), weight, total)[0].any()
    assert split(level, fit, np.array([True, False, False]), weight, total)[0].tolist() == [True, False, False]
