"""Matched filter: lone particles and their gain, crowds with and without whitening, noise."""

import cv2
import numpy as np
import pytest
from test_renderer import crowd, drawn

from gdptlab.fit.renderer import Renderer
from gdptlab.fit.search import SIDE_LOBE, MatchedFilter
from gdptlab.fit.solver import Population

SHAPE = (256, 256)  # at half resolution
NOISE = 19.0  # likewise
TRUE_PX = 3.0  # a place found is one of a particle


@pytest.fixture(scope="module")
def images(clean_stack):
    """Light of a particle at each depth, at the resolution of the search."""
    return np.stack([cv2.pyrDown(image) for image in (clean_stack - 500).astype(np.float32)])


@pytest.fixture(scope="module")
def search(images):
    """The filter for frames of SHAPE."""
    plan = MatchedFilter(images, SHAPE)

    def found(frame, population=None, **settings):
        return plan(frame, NOISE, population, **({"whiten": False, "size": 31} | settings))

    return found


def placed(images, y, x, k):
    """Noiseless frame of image k at whole pixels, cut by the frame's edges."""
    half = images.shape[-1] // 2
    frame = np.zeros([side + 4 * half for side in SHAPE], np.float32)
    frame[y + half : y + 3 * half + 1, x + half : x + 3 * half + 1] = images[k]
    return frame[2 * half : -2 * half, 2 * half : -2 * half]


def noise(seed, shape=SHAPE):
    return np.random.default_rng(seed).normal(0, NOISE, shape).astype(np.float32)


# Depths that are searched (of 51, every third) and places, among them corners and edges.
LONE = [(100, 120, 0), (7, 130, 12), (250, 5, 24), (0, 0, 36), (128, 255, 48), (255, 255, 27), (60, 3, 45)]


@pytest.mark.parametrize("amplitude", [0.6, 1.7])
@pytest.mark.parametrize(
    ("y", "x", "k", "whiten"), [(*p, False) for p in LONE] + [(90, 140, k, True) for k in (0, 24, 48)]
)
def test_a_lone_particle_is_found_where_it_is(search, images, y, x, k, whiten, amplitude):
    """At the edge, too: to a pixel, a slice of the search and, whitened less exactly, its amplitude."""
    best = search(amplitude * placed(images, y, x, k) + noise(k), whiten=whiten)[0]
    assert (np.abs(best - (y, x, k, amplitude)) <= (1, 1, 3, (0.5 if whiten else 0.1) * amplitude)).all()


@pytest.mark.parametrize("k", [1, 17, 31, 49])
def test_depths_between_are_found_by_their_neighbours(search, images, k):
    assert (np.abs(search(placed(images, 99, 140, k) + noise(1))[0] - (99, 140, k, 1))[:3] <= 3).all()


def test_bright_ones_come_first_and_dim_ones_near_them_wait(search, images):
    """A dim particle beside a bright one is left to the next round; far from it, it is found at once."""
    bright, dim = 20 * placed(images, 100, 120, 24), placed(images, 100, 131, 20)
    far = placed(images, 200, 60, 20)
    found = search(bright + dim + far + noise(2))
    assert (np.abs(found[0] - (100, 120, 24, 20)) <= (1, 1, 3, 2)).all()
    away = np.hypot(found[1:, 0] - 100, found[1:, 1] - 120)
    assert (away > 15).all()
    assert (np.hypot(found[:, 0] - 200, found[:, 1] - 60) < 2).any()
    left = search(dim + far + noise(2))
    assert (np.hypot(left[:, 0] - 100, left[:, 1] - 131) < 2).any()
    equals = search(placed(images, 100, 120, 24) + placed(images, 100, 131, 24) + noise(2))
    assert (np.hypot(equals[:, 0] - 100, equals[:, 1] - 131) < 2).any() and SIDE_LOBE > 1


def test_known_amplitudes_refuse_others(search, images):
    """Of known amplitude 3 a particle of a tenth of it brings nothing; amplitudes found stay within the population."""
    frame = 0.3 * placed(images, 100, 120, 24) + noise(4)
    assert len(search(frame)) and not len(search(frame, Population(3.0, 0.02)))
    found = search(1.3 * placed(images, 100, 120, 24) + noise(4), Population(1.0, 0.1))
    assert found[0, 3] <= np.exp(0.2) + 1e-6


def test_outermost_places(search, images):
    """Beyond the frame only if asked for."""
    outside, known = placed(images, -4, 100, 40) + noise(3), Population(1.0, 0.05)
    assert search(outside, known)[:, 0].min() >= 0
    found = search(outside, known, outside_px=8)
    np.testing.assert_allclose(found[0, :3], (-4, 100, 40), atol=4)
    assert found[:, 0].min() >= -8


@pytest.mark.parametrize("whiten", [False, True])
def test_noise_alone(search, whiten):
    for seed in range(5):
        assert search(noise(seed), whiten=whiten).shape == (0, 4)
    assert len(search(np.zeros(SHAPE, np.float32), whiten=whiten)) == 0


@pytest.mark.parametrize("seed", range(3))
def test_whitening_finds_particles_in_a_crowd(search, images, seed):
    """400 in 512 by 512 px: of as many best places far more are particles'."""
    true = crowd(SHAPE, 400, seed)
    true[:, 3] = 1
    frame = drawn(Renderer(images[None], 1, noise=NOISE), true, SHAPE) + noise(seed)
    frame -= np.median(frame)
    precision = {}
    for whiten in (False, True):
        best = search(frame, Population(1.0, 0.05), whiten=whiten, size=30)[:100]
        away = np.hypot(best[:, None, 0] - true[:, 0], best[:, None, 1] - true[:, 1])
        deep = np.abs(best[:, None, 2] - true[:, 2])
        precision[whiten] = ((away < TRUE_PX) & (deep <= 5)).any(axis=1).mean()
    print(precision)
    assert precision[True] > 0.85
    assert precision[True] > precision[False] + 0.3


def test_frame_is_not_changed_and_memory_does_not_matter(search, images):
    """The plan keeps its working memory between frames."""
    frame = placed(images, 100, 120, 24) + noise(4)
    kept, first = frame.copy(), search(frame, whiten=True)
    search(noise(5))
    np.testing.assert_array_equal(first, search(frame, whiten=True))
    np.testing.assert_array_equal(frame, kept)


@pytest.mark.parametrize("shape", [(31, 31), (63, 200), (97, 64)])
def test_frames_of_any_shape(images, shape):
    """Odd, even, as small as an image; the transform's size is even."""
    half, frame = images.shape[-1] // 2, np.zeros(shape, np.float32)
    y, x = shape[0] // 2, shape[1] // 2
    size = min(half, y, x, shape[0] - 1 - y, shape[1] - 1 - x)
    cut = slice(half - size, half + size + 1)
    frame[y - size : y + size + 1, x - size : x + size + 1] = images[24][cut, cut]
    for whiten in (False, True):
        found = MatchedFilter(images, shape)(frame + noise(6, shape), NOISE, None, whiten=whiten, size=31)
        np.testing.assert_allclose(found[0, :2], (y, x), atol=1)
