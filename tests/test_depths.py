"""Particles fitted alone: from the wrong depth to the right one, their modes, the likelihood of each."""

import numpy as np
import pytest
from test_renderer import NOISE, drawn, field_renderer

from gdptlab.fit.depths import Alone
from gdptlab.fit.noise import Variance
from gdptlab.fit.renderer import Renderer
from gdptlab.fit.solver import Population, fitted

SHAPE = (140, 200)


@pytest.fixture(scope="module")
def renderer(clean_stack):
    return Renderer((clean_stack - 500.0)[None], 1, noise=NOISE)


def alone(renderer, places, frame, noise=NOISE, valid=None):
    valid = np.ones(SHAPE, bool) if valid is None else valid
    weight = np.full(SHAPE, noise**-2, np.float32) * valid
    fit = fitted(renderer, frame, places, weight.astype(np.float32), Population(1.0, 1.0), steps=0)
    return fit, Alone(renderer, fit, Variance(noise**2), valid)


def test_another_depth_is_found_and_its_gain_is_that_of_the_frames(renderer):
    """One of two neighbours is at the wrong depth; the other holds still."""
    true = np.array([[60, 60, 12, 1.0], [66, 78, 30, 1.0]])
    rng = np.random.default_rng(1)
    frame = drawn(renderer, true, SHAPE) + rng.normal(0, NOISE, SHAPE).astype(np.float32)
    wrong = true.copy()
    wrong[0, 2] = 33
    _, trials = alone(renderer, wrong, frame)
    own = trials._evaluated(wrong, np.arange(2))[2]
    other = trials.best(np.array([[8.0, 16.0], [np.nan, np.nan]]))
    assert other.gain[0] > own[0] + 100 and other.gain[1] == -np.inf
    np.testing.assert_allclose(other.places[0], true[0], atol=0.2)
    np.testing.assert_array_equal(other.places[1], wrong[1])
    with_it, without = (frame - drawn(renderer, p, SHAPE) for p in (wrong, wrong[1:]))
    lost = ((without**2).sum() - (with_it**2).sum()) / NOISE**2 / 2
    assert own[0] == pytest.approx(lost, rel=1e-3)


def test_a_start_that_climbs_back_is_no_other_depth(renderer):
    true = np.array([[60.0, 60, 12, 1.0]])
    _, trials = alone(renderer, true, drawn(renderer, true, SHAPE))
    assert trials.best(np.array([[14.0]])).gain[0] == -np.inf


def test_pixels_left_out_say_nothing(renderer):
    true, valid = np.array([[60.0, 60, 12, 1.0]]), np.ones(SHAPE, bool)
    valid[55:58, 50:70] = False
    frame = drawn(renderer, true, SHAPE)
    frame[~valid] = 60_000
    _, trials = alone(renderer, true, frame, valid=valid)
    np.testing.assert_allclose(trials.freed(true, np.array([0])).places, true, atol=0.02)


@pytest.mark.parametrize("fine", [1, 2])
def test_modes_are_found(fine):
    """Of noise 0.02 on patterns of height 1 to a few per cent, and what they cost in accuracy is counted."""
    renderer = field_renderer(fine)[0]
    true, rng = np.array([[60.3, 90.6, 4.2, 1.1, 0.8, -0.6]]), np.random.default_rng(2)
    frame = drawn(renderer, true, SHAPE) + rng.normal(0, 0.02, SHAPE).astype(np.float32)
    start = true.copy()
    start[0, 4:] = 0
    _, trials = alone(renderer, start, frame, noise=0.02)
    found = trials.freed(start, np.array([0]))
    for _ in range(8):
        found = trials.freed(found.places, np.array([0]))
    np.testing.assert_allclose(found.places, true, atol=0.1)
    assert (found.variance_of_modes() > 0).all()
