"""Peaks of correlation maps."""

import numpy as np
import pytest

from gdptlab.peaks import peaks, strongest


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
