"""Denoising: nearer to the truth, level kept, nothing taken from what is clean; and the noise of a pixel."""

import numpy as np
import pytest
from conftest import IMAGE_TYPES, SIZE_PX, Z_UM

from gdptlab.correlation import normalised
from gdptlab.denoising import denoised, noise_level

DENOISED_BY = 4  # times smaller 1 - NCC of the worst image against the noise-free stack, at least


def distance(images, clean):
    """1 - NCC of each image with its noise-free one."""
    return 1 - np.einsum("kij,kij->k", normalised(images), normalised(clean.astype(float)))


@pytest.mark.parametrize("seed", [71, 72, 73])
@pytest.mark.parametrize("n", [51, 11, 6])
def test_denoising_brings_images_nearer_to_noise_free_ones(microscope, clean_stack, n, seed):
    keep = np.rint(np.linspace(0, 50, n)).astype(int)
    noisy = microscope.stack(Z_UM[keep], SIZE_PX, rng=seed).astype(np.float32)
    before, after = distance(noisy, clean_stack[keep]), distance(denoised(noisy), clean_stack[keep])
    assert (after < before).all()
    assert after.max() < before.max() / DENOISED_BY
    assert after.mean() < before.mean() / DENOISED_BY


def test_denoising_leaves_a_clean_stack_as_it_is(clean_stack):
    assert distance(denoised(clean_stack.astype(np.float32)), clean_stack).max() < 2e-4


def test_denoising_keeps_levels(stacks):
    for kind in IMAGE_TYPES:
        stack = stacks[kind].astype(np.float32)
        np.testing.assert_allclose(denoised(stack).mean(axis=(1, 2)), stack.mean(axis=(1, 2)), atol=0.1)


def test_denoised_images_are_nearer_to_the_truth_in_every_part(clean_stack, stacks) -> None:
    """Of a particle that is its own mirror image, what is not symmetric is noise, and goes."""
    smooth = denoised(stacks["fluorescent"])
    odd = (smooth - smooth[:, :, ::-1]) / 2
    noise = noise_level(stacks["fluorescent"])
    assert np.sqrt((odd**2).mean()) < 0.03 * noise
    assert np.sqrt(((smooth - clean_stack + clean_stack.mean() - smooth.mean()) ** 2).mean()) < 0.3 * noise


@pytest.mark.parametrize("sigma", [3.0, 38.0])
def test_noise_level(clean_stack, sigma):
    noise = np.random.default_rng(1).normal(0, sigma, clean_stack.shape)
    assert noise_level(noise) == pytest.approx(sigma, rel=0.02)
    assert noise_level(noise[0]) == pytest.approx(sigma, rel=0.1)
    assert noise_level(clean_stack + noise) == pytest.approx(sigma, rel=0.3 if sigma < 10 else 0.05)


@pytest.mark.parametrize("size", [3, 5, 15, 17, 19, 33])
@pytest.mark.parametrize("n", [3, 12])
def test_denoising_of_small_stacks(clean_stack, size, n):
    half, middle = size // 2, SIZE_PX // 2
    small = clean_stack[:: 50 // (n - 1)][:n, middle - half : middle + half + 1, middle - half : middle + half + 1]
    noisy = small + np.random.default_rng(74).normal(0, 20, small.shape)
    smooth = denoised(noisy)
    assert smooth.shape == small.shape and smooth.dtype == np.float32
    assert ((smooth - small) ** 2).mean() < 1.1 * ((noisy - small) ** 2).mean()


def test_sharp_edges_stay(clean_stack):
    """What a filter of noise leaves out is a small part of what noise would have been, in the sharpest images too."""
    rng, noise = np.random.default_rng(75), 38.0
    shared = np.mean([denoised(clean_stack + rng.normal(0, noise, clean_stack.shape)) for _ in range(8)], axis=0)
    assert (((shared - clean_stack) ** 2).sum(axis=(1, 2)) < 0.05 * SIZE_PX**2 * noise**2).all()
