"""Matched filter: lone particles and their gain, crowds with and without whitening, noise."""

import cv2
import numpy as np
import pytest
from conftest import Z_UM
from test_renderer import crowd, drawn

from gdptlab import Calibration
from gdptlab.fit.matched_filter import MatchedFilter, packed, smooth_power
from gdptlab.fit.renderer import ParticleImages
from gdptlab.fit.search import LEAST_GAIN

SHAPE = (256, 256)  # at half resolution
NOISE = 19.0  # likewise
KEPT = 0.03  # share of an image's energy that the filter's singular images may lose
TRUE_PX = 3.0  # a place found is one of a particle


@pytest.fixture(scope="module")
def images(clean_stack):
    """Light of a particle at each depth, at the resolution of the search."""
    return Calibration.from_stack(clean_stack, Z_UM).at_search_resolution((clean_stack - 500).astype(np.float32))


@pytest.fixture(scope="module")
def search(images):
    """The filter for frames of SHAPE, as the search begins with it."""
    plan = MatchedFilter(images, SHAPE)
    return lambda frame, **settings: plan(
        frame, NOISE, **({"whiten": False, "least": LEAST_GAIN, "share": 0, "apart_px": 5} | settings)
    )


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


@pytest.mark.parametrize("brightness", [0.6, 1.7])
@pytest.mark.parametrize(("y", "x", "k"), LONE)
def test_gain_of_a_lone_particle_is_its_energy(search, images, y, x, k, brightness):
    """Half the squares of what the frame shows of it, over the variance; brightness comes out by itself."""
    frame = brightness * placed(images, y, x, k)
    places, gain = search(frame)
    best = gain.argmax()
    assert gain[best] == pytest.approx((frame.astype(float) ** 2).sum() / (2 * NOISE**2), rel=KEPT)
    np.testing.assert_allclose(places[best], (y, x, k, brightness), rtol=KEPT)


@pytest.mark.parametrize(("y", "x", "k"), LONE)
def test_a_lone_particle_is_found_where_it_is(search, images, y, x, k):
    """At the edge, too; in noise to a pixel, a step of the search and a tenth of its brightness."""
    places, gain = search(placed(images, y, x, k) + noise(k))
    assert (np.abs(places[gain.argmax()] - (y, x, k, 1)) <= (1, 1, 3, 0.1)).all()


@pytest.mark.parametrize("k", range(0, 51, 6))
def test_whitened_for_a_lone_particle(search, images, k):
    """Though it is itself most of what is taken for noise."""
    places, gain = search(placed(images, 90, 140, k) + noise(k), whiten=True)
    assert (np.abs(places[gain.argmax()] - (90, 140, k, 1)) <= (1, 1, 3, 0.25)).all()


@pytest.mark.parametrize("k", [1, 17, 31, 49])
def test_depths_between_are_found_by_their_neighbours(search, images, k):
    places, gain = search(placed(images, 99, 140, k) + noise(1))
    assert abs(places[gain.argmax()] - (99, 140, k, 1))[:3].max() <= 3


@pytest.mark.parametrize(("bright", "pull"), [(1.0, 4.0), (1.05, 1.0), (0.96, 1.0), (1.05, 0.1)])
def test_known_brightness(search, images, bright, pull):
    """What is known of it counts as `pull` times what the frame says, against it where it is another."""
    frame = (bright * placed(images, 100, 120, 24)).astype(np.float32)
    energy = (frame.astype(float) ** 2).sum() / (bright * NOISE) ** 2
    places, gain = search(frame, brightness=1.0, spread=(pull * energy) ** -0.5)
    seen = (bright + pull) / (1 + pull)
    least = (seen - bright) ** 2 + pull * (seen - 1) ** 2
    assert places[gain.argmax(), 3] == pytest.approx(seen, abs=2e-3)
    assert gain.max() == pytest.approx(energy * (bright**2 - least) / 2, rel=KEPT)


@pytest.mark.parametrize(("share", "found"), [(0.2, True), (0.3, False)])
def test_a_share_of_the_gain_is_asked_for(search, images, share, found):
    """A particle of half the brightness brings a quarter; there is no image fainter than the last."""
    frame = (0.5 * placed(images, 100, 120, 48)).astype(np.float32)
    assert (len(search(frame, brightness=1.0, spread=100.0, share=share)[0]) > 0) == found


@pytest.mark.parametrize("whiten", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_noise_holds_no_particle(search, seed, whiten):
    places, gain = search(noise(seed), whiten=whiten)
    assert places.shape == (0, 4) and gain.shape == (0,)
    assert len(search(np.zeros(SHAPE, np.float32), whiten=whiten)[0]) == 0


def test_nearest_and_outermost_places(search, images):
    """Of near places the best; beyond the frame only if asked for."""
    frame = placed(images, 100, 120, 24) + placed(images, 100, 128, 24) + noise(2)
    near, apart = (search(frame, apart_px=d, least=2000)[0] for d in (3, 20))
    assert len(near) > len(apart) == 1
    outside = placed(images, -4, 100, 40) + noise(3)
    known = {"brightness": 1.0, "spread": 0.05}
    assert search(outside, **known)[0][:, 0].min() >= 0
    places, gain = search(outside, outside_px=8, **known)
    np.testing.assert_allclose(places[gain.argmax(), :3], (-4, 100, 40), atol=4)
    assert places[:, 0].min() >= -8


@pytest.mark.parametrize("seed", range(3))
def test_whitening_finds_particles_in_a_crowd(search, images, seed):
    """400 in 512 by 512 px: of as many best places far more are particles'."""
    true = crowd(SHAPE, 400, seed)
    true[:, 3] = 1
    frame = drawn(ParticleImages(images, NOISE), true, SHAPE) + noise(seed)
    frame -= np.median(frame)
    precision = {}
    for whiten in (False, True):
        places, gain = search(frame, brightness=1.0, spread=0.05, whiten=whiten, share=0)
        best = places[np.argsort(-gain)[:100]]
        away = np.hypot(best[:, None, 0] - true[:, 0], best[:, None, 1] - true[:, 1])
        deep = np.abs(best[:, None, 2] - true[:, 2])
        precision[whiten] = ((away < TRUE_PX) & (deep <= 5)).any(axis=1).mean()
    print(precision)
    assert precision[True] > 0.9
    assert precision[True] > precision[False] + 0.3


def test_frame_is_not_changed_and_memory_does_not_matter(search, images):
    """The plan keeps its working memory between frames."""
    frame = placed(images, 100, 120, 24) + noise(4)
    kept, first = frame.copy(), search(frame, whiten=True)
    search(noise(5))
    again = search(frame, whiten=True)
    np.testing.assert_array_equal(frame, kept)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


@pytest.mark.parametrize("shape", [(31, 31), (63, 200), (97, 64)])
def test_frames_of_any_shape(images, shape):
    """Odd, even, as small as an image; the transform's size is even."""
    half, frame = images.shape[-1] // 2, np.zeros(shape, np.float32)
    y, x = shape[0] // 2, shape[1] // 2
    size = min(half, y, x, shape[0] - 1 - y, shape[1] - 1 - x)
    cut = slice(half - size, half + size + 1)
    frame[y - size : y + size + 1, x - size : x + size + 1] = images[24][cut, cut]
    for whiten in (False, True):
        places, gain = MatchedFilter(images, shape)(
            frame + noise(6, shape), NOISE, whiten=whiten, least=LEAST_GAIN, share=0, apart_px=5
        )
        np.testing.assert_allclose(places[gain.argmax(), :2], (y, x), atol=1)


def test_power_and_factors_have_one_order():
    """A spectrum over its own root of power is white."""
    image = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(96, 128)).astype(np.float32), (0, 0), 0.7)
    spectrum = cv2.dft(image)
    white = cv2.idft(spectrum / np.sqrt(packed(smooth_power(spectrum, 2.0))), flags=cv2.DFT_SCALE)
    beside = [np.corrcoef(a[:, :-1].ravel(), a[:, 1:].ravel())[0, 1] for a in (image, white)]
    assert beside[0] > 0.4 and abs(beside[1]) < 0.1
