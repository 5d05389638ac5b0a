"""The fast correlation against its formula, OpenCV and scikit-image."""

import cv2
import numpy as np
import pytest
from references import correlate_plainly
from skimage.feature import match_template

from gdptlab.correlation import Correlator, good_shape, normalised, peaks, strongest, times_conjugate

AGREE = 2e-5  # in C_m, at float32
AGREE_WITH_OFFSET = 2e-3  # in C_m, contrast of 20 on 20000 counts


def example(shape, n, count=3, seed=1):
    """Random image and templates without any symmetry."""
    rng = np.random.default_rng(seed)
    return rng.random(shape, np.float32), rng.random((count, n, n), np.float32) ** 2


SHAPES = [((40, 57), 9), ((57, 40), 9), ((31, 31), 31), ((31, 33), 31), ((33, 31), 31), ((23, 64), 22), ((90, 41), 1)]


@pytest.mark.parametrize(("shape", "n"), SHAPES)
def test_fast_is_plain(shape, n):
    image, templates = example(shape, n)
    fast = Correlator(templates, shape)(image)
    assert fast.dtype == np.float32
    assert fast.shape == (3, shape[0] - n + 1, shape[1] - n + 1)
    np.testing.assert_allclose(fast, correlate_plainly(image, templates), atol=AGREE)


@pytest.mark.parametrize(("shape", "n"), SHAPES[:-1])
def test_plain_is_what_others_compute(shape, n):
    image, templates = example(shape, n)
    for plain, template in zip(correlate_plainly(image, templates), templates, strict=True):
        np.testing.assert_allclose(plain, cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED), atol=AGREE)
        np.testing.assert_allclose(plain, match_template(image, template), atol=AGREE)


def test_entry_belongs_to_the_window_that_starts_there():
    image, _ = example((50, 80), 11)
    maps = Correlator(np.stack([image[7:18, 40:51], -image[30:41, 3:14]]), image.shape)(image)
    assert np.unravel_index(maps[0].argmax(), maps[0].shape) == (7, 40)
    assert np.unravel_index(maps[1].argmin(), maps[1].shape) == (30, 3)
    assert maps[0].max() == pytest.approx(1, abs=AGREE)
    assert maps[1].min() == pytest.approx(-1, abs=AGREE)


@pytest.mark.parametrize("level", [0, 0.1, 1, 1234.567, 65535, -3.3])
def test_constant_image_gives_zero(level):
    _, templates = example((30, 41), 9)
    image = np.full((30, 41), level, np.float32)
    assert not Correlator(templates, image.shape)(image).any()
    assert not correlate_plainly(image, templates).any()


def test_flat_part_of_an_image_gives_zero():
    image, templates = example((40, 60), 9)
    image[:, :30] = 0.25
    maps = Correlator(templates, image.shape)(image)
    assert not maps[:, :, : 30 - 9].any()
    assert maps[:, :, 30:].all()


def test_flat_template_gives_zero():
    image, templates = example((30, 41), 9)
    templates[1] = 7
    maps = Correlator(templates, image.shape)(image)
    assert not maps[1].any() and maps[0].any()


def test_contrast_on_a_high_level_keeps_its_digits():
    image, templates = example((64, 75), 15)
    high = 20_000 + 20 * image
    plain = correlate_plainly(high, 20_000 + 20 * templates.astype(float))
    np.testing.assert_allclose(plain, correlate_plainly(image, templates), atol=AGREE_WITH_OFFSET)
    np.testing.assert_allclose(Correlator(templates, high.shape)(high), plain, atol=AGREE)


def test_gain_and_level_do_not_matter():
    image, templates = example((40, 57), 9)
    one = Correlator(templates, image.shape)(image)
    other = Correlator(5 * templates - 3, image.shape)(7 * image + 2)
    np.testing.assert_allclose(one, other, atol=AGREE)


def test_a_plan_serves_many_frames_and_changes_none():
    first, templates = example((40, 57), 9)
    second, _ = example((40, 57), 9, seed=2)
    plan, kept = Correlator(templates, (40, 57)), first.copy()
    before = plan(first)
    plan(second)
    np.testing.assert_array_equal(plan(first), before)
    np.testing.assert_array_equal(first, kept)


def test_normalised():
    _, images = example((5, 5), 13, count=4)
    images[2] = 3
    unit = normalised(images)
    np.testing.assert_allclose(unit.mean(axis=(1, 2)), 0, atol=1e-7)
    np.testing.assert_allclose((unit**2).sum(axis=(1, 2)), [1, 1, 0, 1], atol=1e-6)


# -------------------- spectra


@pytest.mark.parametrize("shape", [(2, 2), (2, 8), (12, 2), (30, 36), (54, 20)])
def test_times_conjugate(shape):
    image, template = np.random.default_rng(0).normal(size=(2, *shape)).astype(np.float32)
    one, other = cv2.dft(image), cv2.dft(template)
    product = np.full(shape, np.nan, np.float32)
    times_conjugate(one, other, product)
    expected = cv2.mulSpectrums(one, other, 0, conjB=True)
    np.testing.assert_allclose(product, expected, atol=1e-5 * np.abs(expected).max())


def test_good_shape():
    assert good_shape((1, 2, 31, 257)) == (2, 2, 32, 270)
    for n in range(1, 700, 7):
        (good,) = good_shape([n])
        assert n <= good <= 1.2 * n + 2 and good % 2 == 0


# -------------------- peaks


def hill(shape, row, column, height=1.0, width=3.0):
    y, x = np.indices(shape)
    return (height * np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * width**2))).astype(np.float32)


@pytest.mark.parametrize("near", [1, 2])
def test_between_pixels(near):
    maps = np.stack([hill((40, 50), 20.3, 30.4, 0.6), hill((40, 50), 20.3 + near / 2, 29.7, 0.9)])
    place, cm, profile = peaks(maps, 0.5, near)
    np.testing.assert_allclose(place, [[20.3 + near / 2, 29.7]], atol=0.03)  # of the highest
    np.testing.assert_allclose(profile, [[0.6, 0.9]], atol=0.003)
    np.testing.assert_allclose(cm, 0.9, atol=0.003)


def test_threshold_and_neighbours():
    map_ = np.maximum(hill((60, 60), 20, 20, 0.8), hill((60, 60), 40, 40, 0.45))
    assert len(peaks(map_[None], 0.5, 1)[0]) == 1
    assert len(peaks(map_[None], 0.4, 1)[0]) == 2
    map_[20, 22] = 0.81  # two pixels away, and higher
    assert peaks(map_[None], 0.5, 1)[0].round().tolist() == [[20, 22]]


@pytest.mark.parametrize("near", [1, 2])
def test_no_peak_on_the_rim(near):
    for row in range(near):
        assert len(peaks(hill((20, 20), row, 10)[None], 0.5, near)[0]) == 0
    place, _, profile = peaks(hill((20, 20), near, 10)[None], 0.5, near)
    assert place.round().tolist() == [[near, 10]] and profile.shape == (1, 1)


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3)])
def test_small_maps(shape):
    place, cm, profile = peaks(np.ones((4, *shape), np.float32), 0.5, 2)
    assert place.shape == (0, 2) and cm.shape == (0,) and profile.shape == (0, 4)


def test_the_strongest_of_near_ones():
    place = np.array([[0.0, 0], [3, 4], [3, 5], [20, 0], [20, 1], [40, 0]])
    cm = np.array([0.9, 0.8, 0.7, 0.6, 0.95, 0.0])
    assert strongest(place, cm, 5.0).tolist() == [4, 0, 2]  # the last has none; of equal distance is too near
    assert strongest(place, cm, 0.0).tolist() == [4, 0, 1, 2, 3]
    assert strongest(place[:0], cm[:0], 5.0).tolist() == []


def test_of_a_crowd_all_stay_apart_and_nobody_is_forgotten():
    rng = np.random.default_rng(2)
    place, cm = rng.uniform(0, 100, (300, 2)), rng.uniform(0.1, 1, 300)
    kept = strongest(place, cm, 8.0)
    away = np.linalg.norm(place[:, None] - place[kept], axis=2)
    among = away[kept] + np.diag(np.full(len(kept), np.inf))
    assert among.min() > 8
    others = np.setdiff1d(np.arange(300), kept)
    stronger = cm[kept] >= cm[others, None]
    assert ((away[others] <= 8) & stronger).any(axis=1).all()
