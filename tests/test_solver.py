"""All particles at once: two that overlap come back, standard deviations, what explains and what does not."""

import numpy as np
import pytest
from test_renderer import NOISE, crowd, dense, drawn

from gdptlab.fit.background import Background
from gdptlab.fit.renderer import Renderer
from gdptlab.fit.solver import DAMPING, LONGEST_STEP, Population, fitted

SHAPE = (120, 160)
UM_PER_STEP = 2.0
WELL_BELOW_PX, WELL_BELOW_UM = 0.06, 0.3
# Two that overlap: y, x, slice, amplitude.
PAIRS = [
    ((60, 70, 8, 1), (66, 79, 14, 1)),
    ((50.3, 80.6, 22.4, 1), (61.7, 91.2, 12.5, 1)),
    ((58.2, 77.1, 20.3, 1), (52.9, 90.4, 27.7, 1)),
    ((4.4, 80.2, 10.1, 1), (12.8, 88.6, 22.9, 1)),
]


@pytest.fixture(scope="module")
def shapes(clean_stack):
    return Renderer((clean_stack - 500.0)[None], 1, noise=NOISE)


@pytest.fixture(scope="module")
def surface():
    return Background(SHAPE, 90)


WEIGHT = np.full(SHAPE, NOISE**-2, np.float32)


def behind(shape=SHAPE):
    y, x = np.indices(shape)
    return (500 + 60 * np.sin(x / 70) * np.cos(y / 90) + 0.4 * x).astype(np.float32)


def noise(seed, level=NOISE):
    return np.random.default_rng(seed).normal(0, level, SHAPE).astype(np.float32)


def fit(shapes, frame, places, **settings):
    """From `places`, amplitude known to a twentieth."""
    settings = {"steps": 8} | settings
    population = Population(settings.pop("centre", 1.0), settings.pop("sigma", 0.05))
    return fitted(shapes, frame, np.array(places, float), settings.pop("weight", WEIGHT), population, **settings)


# -------------------- back to the truth


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("seed", range(2))
def test_two_that_overlap_come_back(shapes, surface, pair, seed):
    """From 0.8 px, 3 µm and a tenth of amplitude away, over a background that is not known."""
    true = np.array(pair, float)
    rng = np.random.default_rng(seed)
    start = true + rng.choice((-1, 1), true.shape) * (0.8, 0.8, 1.5, 0.1)
    result = fit(shapes, drawn(shapes, true, SHAPE) + behind() + noise(seed), start, surface=surface)
    off = np.abs(result.places - true)
    assert (off[:, :2] < WELL_BELOW_PX).all() and (off[:, 2] * UM_PER_STEP < WELL_BELOW_UM).all()
    assert (off[:, :3] < 4.5 * result.std).all()
    assert (result.gain > 1000).all()
    assert (np.abs(result.chi2 - 1) < 5 * np.sqrt(2 / 600)).all()  # of 600 pixels or more
    assert (result.cm > 0.95).all()


def test_without_noise_exactly(shapes, surface):
    true = np.array(PAIRS[1], float)
    background = surface.surface(np.linspace(400, 600, surface.matrix(WEIGHT).shape[0]))
    frame = drawn(shapes, true, SHAPE) + background
    result = fit(shapes, frame, true + np.array((0.5, -0.5, 1, 0.05)), surface=surface, steps=25)
    np.testing.assert_allclose(result.places, true, atol=2e-3)
    np.testing.assert_allclose(result.background, background, atol=NOISE / 50)
    np.testing.assert_allclose(result.image + result.background + result.residual, frame, atol=0.01)


def test_a_crowd_comes_back(shapes, surface):
    true, rng = crowd(SHAPE, 25, 4), np.random.default_rng(5)
    true[:, 3] = rng.normal(1, 0.05, 25)
    frame = drawn(shapes, true, SHAPE) + behind() + noise(6)
    start = true + rng.uniform(-1, 1, true.shape) * (0.15, 0.15, 0.3, 0.03)
    result = fit(shapes, frame, start, surface=surface)
    pulls = (result.places[:, :3] - true[:, :3]) / result.std
    assert 0.7 < np.sqrt((pulls**2).mean()) < 1.3  # 75 of them
    assert (result.gain > 100).all()


def test_errors_are_as_large_as_they_are_said_to_be(shapes, surface):
    true = np.array(PAIRS[2], float)
    clean, pulls = drawn(shapes, true, SHAPE) + behind(), []
    for seed in range(60):
        result = fit(shapes, clean + noise(seed), true, surface=surface, steps=3)
        pulls.append((result.places[:, :3] - true[:, :3]) / result.std)
    pulls = np.array(pulls)
    # Standard errors of 60: 0.13 of a mean, 0.09 of a spread; brightness is known better than it had to be.
    assert (np.abs(pulls.mean(axis=0)) < 0.5).all()
    assert ((pulls.std(axis=0) > 0.65) & (pulls.std(axis=0) < 1.3)).all()


# -------------------- standard deviations


@pytest.mark.parametrize("with_surface", [True, False])
@pytest.mark.parametrize("n", [1, 2, 12])
def test_std_is_that_of_the_dense_inverse(shapes, surface, n, with_surface):
    """Of the normal matrix of particles and background.

    Damping makes deviations slightly smaller than they are.
    """
    places, spread = crowd(SHAPE, n, n + 7), 0.05
    frame = drawn(shapes, places, SHAPE) + (behind() if with_surface else 0) + noise(8)
    result = fit(shapes, frame, places, surface=surface if with_surface else None, sigma=spread, steps=2)
    columns = dense(shapes.draw(result.places, SHAPE), SHAPE)
    if with_surface:
        count = surface.matrix(WEIGHT).shape[0]
        columns = np.hstack([columns, np.stack([surface.surface(u).ravel() for u in np.eye(count)], axis=1)])
    matrix = columns.T.astype(float) @ columns / NOISE**2
    matrix[np.arange(3, 4 * n, 4), np.arange(3, 4 * n, 4)] += (spread * result.places[:, 3]) ** -2
    damped = matrix.copy()
    damped[np.diag_indices(len(matrix))] *= 1 + DAMPING
    expected, largest = (np.sqrt(np.diag(np.linalg.inv(m))[: 4 * n].reshape(-1, 4)[:, :3]) for m in (damped, matrix))
    np.testing.assert_allclose(result.std, expected, rtol=0.03)
    assert (result.std > 0.95 * largest).all()


def test_neighbours_cost_accuracy(shapes):
    """The more two overlap, the less is known of each; far apart, each is as good as alone."""
    alone = fit(shapes, noise(1), [[60, 40, 25, 1]], steps=0).std[0]
    stds = [fit(shapes, noise(1), [[60, 40, 25, 1], [60, 40 + d, 26, 1]], steps=0).std[0] for d in (6, 20, 80)]
    np.testing.assert_allclose(stds[2], alone, rtol=1e-6)
    assert (
        (stds[0] > alone).all()
        and (stds[0] > 1.2 * alone).any()
        and (stds[1] >= alone).all()
        and (stds[0] > stds[1]).all()
    )


# -------------------- what a particle adds


@pytest.mark.parametrize("sigma", [0.02, 0.5])
@pytest.mark.parametrize("pair", PAIRS)
def test_gain_is_what_the_likelihood_loses_without_the_particle(shapes, surface, pair, sigma):
    """No more, as the others adapt; a particle where none is adds nothing."""
    true = np.array(pair, float)
    frame = drawn(shapes, true, SHAPE) + behind() + noise(2)
    result = fit(shapes, frame, true, surface=surface, sigma=sigma)
    for i in range(2):
        without = fit(shapes, frame, np.delete(true, i, axis=0), surface=surface, sigma=sigma, steps=0)
        lost = ((without.residual**2).sum() - (result.residual**2).sum()) / NOISE**2 / 2
        assert 0 < result.gain[i] < 1.1 * lost
    ghost = fit(shapes, frame, [*true, [95, 30, 20, 1]], surface=surface, sigma=sigma, steps=20)
    assert ghost.gain[2] - ghost.population.penalty(ghost.places[2, 3]) < 20 < ghost.gain[:2].min()


def test_gain_of_a_lone_particle(shapes):
    """Half the squares of its image over the variance, but for what position and depth could do as well."""
    true = np.array([[60, 70, 20, 1.0]])
    result = fit(shapes, drawn(shapes, true, SHAPE), true, sigma=1.0)
    energy = (drawn(shapes, true, SHAPE) ** 2).sum() / NOISE**2 / 2
    assert 0.5 * energy < result.gain[0] < energy


def test_a_particle_outside_explains_nothing(shapes):
    result = fit(shapes, noise(3), [[-100, 40, 20, 1], [60, 40, 20, 1]])
    assert result.gain[0] < 1 and result.cm[0] == 0 and result.chi2[0] == 0
    np.testing.assert_allclose(result.places[0], (-100, 40, 20, 1))
    assert np.isfinite(result.std).all()


def test_what_is_no_particle_has_a_large_chi2(shapes, surface):
    frame = drawn(shapes, np.array([[60, 40, 20, 1.0]]), SHAPE) + behind() + noise(4)
    frame[50:70, 110:130] += 1500
    result = fit(shapes, frame, [[60, 40, 20, 1], [60, 120, 20, 1]], surface=surface)
    assert result.chi2[0] < 2 < 20 < result.chi2[1]


# -------------------- amplitude, weights, steps


@pytest.mark.parametrize("pull", [0.1, 1.0, 10.0])
def test_amplitude_is_drawn_to_what_is_known(shapes, pull):
    """In its logarithm, as far as the frame says nothing better."""
    bright, true = 1.05, np.array([[60, 70, 20, 1.05]])
    columns = dense(shapes.draw(true, SHAPE), SHAPE)
    said = 1 / np.linalg.inv(columns.T.astype(float) @ columns / NOISE**2)[3, 3]  # places are free, too
    result = fit(shapes, drawn(shapes, true, SHAPE), true, sigma=(pull * said * bright**2) ** -0.5, steps=30)
    assert np.log(result.places[0, 3]) == pytest.approx(np.log(bright) / (1 + pull), abs=0.1 * np.log(bright))


def test_pixels_without_weight_say_nothing(shapes, surface):
    true = np.array(PAIRS[1], float)
    frame, weight = drawn(shapes, true, SHAPE) + behind() + noise(5), WEIGHT.copy()
    weight[40:50, 70:95] = 0
    frame[weight == 0] = 60_000
    result = fit(shapes, frame, true, surface=surface, weight=weight)
    assert (np.abs(result.places - true)[:, :2] < 2 * WELL_BELOW_PX).all()


def test_steps_are_bounded(shapes):
    """Whatever the frame says, y, x, slice and amplitude change by no more than so much at a time."""
    start = np.array([[60, 70, 20, 1.0]])
    frame = 5 * drawn(shapes, np.array([[67, 61, 12, 1.0]]), SHAPE)
    moved = np.abs(fit(shapes, frame, start, steps=1, sigma=1.0).places - start)[0]
    assert (moved <= LONGEST_STEP + 1e-9).all() and (moved / LONGEST_STEP).max() == pytest.approx(1)


@pytest.mark.parametrize(("start", "end"), [(0.2, 0), (49.8, 50)])
def test_steps_end_with_the_stack(shapes, start, end):
    true = np.array([[60, 70, end, 1.0]])
    result = fit(shapes, drawn(shapes, true, SHAPE) + noise(9), [[60.2, 70.2, start, 1]])
    assert 0 <= result.places[0, 2] <= 50 and abs(result.places[0, 2] - end) < 0.5


@pytest.mark.parametrize("with_surface", [True, False])
def test_no_particles(shapes, surface, with_surface):
    frame = noise(6) + (behind() if with_surface else 0)
    result = fit(shapes, frame, np.zeros((0, 4)), surface=surface if with_surface else None)
    assert result.places.shape == (0, 4) and result.std.shape == (0, 3)
    assert result.gain.shape == result.chi2.shape == result.cm.shape == (0,)
    assert not result.image.any()
    assert result.residual.std() == pytest.approx(NOISE, rel=0.03)


def test_same_input_same_result_in_any_order(shapes, surface):
    true = crowd(SHAPE, 12, 5)
    frame = drawn(shapes, true, SHAPE) + behind() + noise(7)
    kept = true.copy(), frame.copy()
    one, again = (fit(shapes, frame, true, surface=surface, steps=3) for _ in range(2))
    np.testing.assert_array_equal(true, kept[0])
    np.testing.assert_array_equal(frame, kept[1])
    turned = fit(shapes, frame, true[::-1], surface=surface, steps=3)
    for name in ("places", "gain", "chi2", "std", "cm"):
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
        np.testing.assert_allclose(getattr(turned, name)[::-1], getattr(one, name), rtol=2e-3, atol=2e-3)
