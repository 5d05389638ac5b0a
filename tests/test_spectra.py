"""Spectra as OpenCV packs them."""

import cv2
import numpy as np
import pytest

from gdptlab.spectra import good_shape, packed, smooth_power, times_conjugate


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


def test_power_and_factors_have_one_order():
    """A spectrum over its own root of power is white."""
    image = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(96, 128)).astype(np.float32), (0, 0), 0.7)
    spectrum = cv2.dft(image)
    white = cv2.idft(spectrum / np.sqrt(packed(smooth_power(spectrum, 2.0))), flags=cv2.DFT_SCALE)
    beside = [np.corrcoef(a[:, :-1].ravel(), a[:, 1:].ravel())[0, 1] for a in (image, white)]
    assert beside[0] > 0.4 and abs(beside[1]) < 0.1
