"""The light of a calibration's particle, how well it is known, and the accuracy to come."""

import numpy as np
import pytest
from conftest import IMAGE_TYPES, Z_UM, table

from gdptlab import Calibration, locate, match
from gdptlab.correlation import normalised
from gdptlab.experiment.camera import Camera
from gdptlab.fit.bounds import derivatives, expected_error, own_error
from gdptlab.fit.pattern import continued, particle_light

STD = ["x_std_px", "y_std_px", "z_std_um"]


def distance(images, clean):
    """1 - NCC of each image with its noise-free one."""
    return 1 - np.einsum("kij,kij->k", normalised(images), normalised(clean.astype(float)))


LIGHT_COUNTS = {True: 1.0, False: 6.0}  # mean error of the light of an image, without and with noise of 38 counts


@pytest.mark.parametrize("kind", ["clean", *IMAGE_TYPES])
def test_images_are_the_light_without_background(clean_stack, calibrations, kind):
    """Bright on nothing for particles on a dark field, dark on nothing for those on a bright one."""
    made = Calibration.from_stack(clean_stack, Z_UM) if kind == "clean" else calibrations[kind]
    light = (clean_stack - 500.0) * (1 if kind in ("clean", "fluorescent") else -1)
    assert particle_light(made).shape == light.shape and particle_light(made).dtype == np.float32
    off = particle_light(made) - light
    budget = LIGHT_COUNTS[kind == "clean"]
    assert abs(off.mean()) < budget
    assert np.abs(off.mean(axis=(1, 2))).max() < 4 * budget
    assert np.sqrt((off**2).mean()) < 2 * budget + 0.004 * np.abs(light).max()
    assert distance(np.abs(particle_light(made)), np.abs(light)).max() < 0.05


def test_images_do_not_know_the_level(stacks):
    """Nor a slope of the light behind the particle."""
    stack = stacks["fluorescent"].astype(np.float64)
    y, x = np.indices(stack.shape[1:])
    expected = particle_light(Calibration.from_stack(stack, Z_UM))
    np.testing.assert_allclose(particle_light(Calibration.from_stack(stack + 3000, Z_UM)), expected, atol=0.5)
    sloped = particle_light(Calibration.from_stack(stack + 0.4 * x - 0.2 * y, Z_UM))
    assert np.sqrt(((sloped - expected) ** 2).mean()) < 2


@pytest.mark.parametrize("n", [3, 4, 6, 11])
def test_images_of_few(stacks, n):
    made = Calibration.from_stack(stacks["brightfield"], Z_UM, n=n, n_sub=2)
    assert particle_light(made).shape == (n, 61, 61) and np.isfinite(particle_light(made)).all()
    assert own_error(made).shape == (n, 3) and np.isfinite(own_error(made)).all()


def test_own_error_is_that_of_the_noise(microscope, clean_stack, calibration):
    """It shrinks with the noise of the stack, and is the same each time."""
    light, rng = clean_stack - 500.0, np.random.default_rng(95)
    light = light[::2]
    stacks = [light + rng.normal(0, s, light.shape) for s in (3, 12, 48)]
    errors = [own_error(Calibration.from_stack(stack, Z_UM[::2])) for stack in stacks]
    for error in errors:
        assert error.shape == (26, 3) and (error > 0).all()
    sizes = np.sqrt(np.mean(np.square(errors), axis=1))
    assert (sizes[1] > 1.5 * sizes[0]).all() and (sizes[2] > 1.5 * sizes[1]).all()
    again = Calibration.from_stack(calibration.stack, Z_UM)
    np.testing.assert_array_equal(own_error(again), own_error(calibration))


# -------------------- the bound


def test_bound_follows_the_noise_and_the_amplitude(calibration):
    bound, twice = expected_error(calibration, noise=38), expected_error(calibration, noise=76)
    assert list(bound) == ["z_um", *STD] and np.array_equal(bound.z_um, Z_UM)
    assert np.isfinite(bound).all(axis=None) and (bound[STD] > 0).all(axis=None)
    np.testing.assert_allclose(twice[STD], 2 * bound[STD], rtol=1e-6)
    np.testing.assert_allclose(expected_error(calibration, noise=76, amplitude=2)[STD], bound[STD], rtol=1e-6)
    assert (expected_error(calibration, noise=38, electrons_per_count=0.5)[STD] > bound[STD]).all(axis=None)


def test_noise_of_the_stack_unless_told(calibration):
    np.testing.assert_allclose(expected_error(calibration)[STD], expected_error(calibration, noise=38)[STD], rtol=0.05)


def test_a_stack_without_noise_has_a_bound(clean_stack):
    assert np.isfinite(expected_error(Calibration.from_stack(clean_stack, Z_UM, denoise=False))).all(axis=None)


def test_joint_fit_comes_near_the_bound_in_the_plane(isolated, calibration):
    frames, true = isolated["fluorescent"]
    bound = expected_error(calibration, noise=38)
    errors, bounds = [], []
    for number in range(4):
        truth = true[true.frame == number].drop(columns="frame").reset_index(drop=True)
        pairs = match(locate(frames[number], calibration, method="joint"), truth)
        assert len(pairs) >= 0.97 * len(truth)
        errors.append(pairs[["dx_px", "dy_px"]])
        bounds.append(np.stack([np.interp(pairs.z_um, Z_UM, bound[c]) for c in STD[:2]], axis=1))
    errors, bounds = np.concatenate(errors), np.concatenate(bounds)
    ratio = np.sqrt((errors**2).mean(axis=0) / (bounds**2).mean(axis=0))
    # 216 particles: the ratio itself is known to 5 %.
    assert (ratio > 0.85).all() and (ratio < 1.25).all(), ratio


@pytest.mark.parametrize("name", ["noise", "electrons_per_count", "amplitude"])
@pytest.mark.parametrize("value", [0, -1, np.nan, "1"])
def test_bad_input(calibration, name, value):
    with pytest.raises((TypeError, ValueError), match=name):
        expected_error(calibration, **{name: value})


# -------------------- photon noise


@pytest.fixture(scope="module", params=[None, 0.05], ids=["read noise", "photons"])
def photon_noisy(request, clean_stack):
    """True light, variance of its pixels, and two calibrations with the noise of so many photo-electrons a count."""
    electrons, light = request.param, clean_stack - 500.0
    stacks = [
        Camera(electrons_per_count=electrons).record(light.reshape(-1, light.shape[2]), seed) for seed in range(4)
    ]
    variance = 38.0**2 + (light / electrons if electrons else 0 * light)
    return light, variance, [Calibration.from_stack(stack.reshape(light.shape), Z_UM) for stack in stacks]


def test_the_bound_is_never_far_below_the_true_one(photon_noisy):
    """Noise in the images makes a naive bound half the true one where images are dim."""
    light, variance, made = photon_noisy
    columns = derivatives(light, Z_UM)
    fisher = columns.transpose(0, 2, 1) @ (columns / variance.reshape(len(light), -1, 1))
    true = np.sqrt(np.diagonal(np.linalg.inv(fisher), axis1=1, axis2=2))[:, :3]
    ratio = np.array([expected_error(calibration)[STD] / true for calibration in made])
    print(ratio.min(axis=(0, 1)).round(2), np.median(ratio, axis=(0, 1)).round(2), ratio.max(axis=(0, 1)).round(2))
    assert ratio[:, :-2].min() > 0.9 and ratio.min() > 0.75
    assert (np.median(ratio, axis=(0, 1)) < 1.2).all() and ratio.max() < 2.5


def test_own_error_is_the_true_one(photon_noisy):
    """Errors of z that calibrations make are as large as they say."""
    light, _, made = photon_noisy
    rows, ratio = np.linalg.pinv(derivatives(light, Z_UM))[:, 2], []
    for calibration in made:
        error = np.einsum("kp,kp->k", rows, (particle_light(calibration) - light).reshape(len(light), -1))
        ratio.append(error / own_error(calibration)[:, 2])
    print(np.sqrt(np.mean(np.square(ratio))).round(2))
    # Errors of neighbouring slices are alike: some twenty independent ones.
    assert 0.65 < np.sqrt(np.mean(np.square(ratio))) < 1.45


# -------------------- beyond the cut


def test_images_go_on_beyond_their_frame(calibration):
    images = continued(particle_light(calibration))
    more = (images.shape[1] - 61) // 2
    assert more > 0 and images.shape[1] % 2 == 1
    np.testing.assert_array_equal(images[:, more:-more, more:-more], particle_light(calibration))
    rim = images.copy()
    rim[:, 1:-1, 1:-1] = 0
    assert np.abs(rim).max() < np.abs(particle_light(calibration)[:, [0, -1]]).max() / 2


def test_light_beyond_the_frame_is_about_what_was_cut_off(microscope):
    """At the far end a tenth of a particle's light falls outside of a template."""
    whole = np.stack([microscope.light(table(60, 60, z), (121, 121)) for z in Z_UM]).astype(np.float32)
    images = continued(whole[:, 30:-30, 30:-30])
    total, cut, drawn = (a.sum(axis=(1, 2)) for a in (whole, whole[:, 30:-30, 30:-30], images))
    assert (total / cut)[-1] > 1.1
    np.testing.assert_allclose(drawn / total, 1, atol=0.02)


def test_noise_beyond_any_camera_is_refused(calibration):
    with pytest.raises(ValueError, match=r"^noise: "):
        expected_error(calibration, noise=1e308)
