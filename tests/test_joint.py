"""Overlapping particles in whole frames: found, measured, at borders, in other light and calibrations, in films.

Particles lie anywhere in the frame, at any depth; noise is in calibrations and frames; seeds are conftest's and here.
"""

import numpy as np
import pandas as pd
import pytest
from conftest import CALIBRATION_SEED, IMAGE_TYPES, SIZE_PX, Z_UM, on_grid, table

from gdptlab import Calibration, batch, locate, match
from gdptlab.assess import scores
from gdptlab.film import Film
from gdptlab.imagetypes import Camera
from gdptlab.overlap import STAGES, Overlap, _brightness, _continued, _high_passed, _variance, _weight

ERRORS, STD = ["dx_px", "dy_px", "dz_um"], ["x_std_px", "y_std_px", "z_std_um"]
# 50 and 150 in 512 by 512 px.
FOUND = {50: 0.95, 150: 0.93}
SIGMA_XY_PX, SIGMA_Z_UM = 0.15, 1.0
EDGE_BIAS_UM = 0.3  # beside three standard errors: the calibration's own error


def anywhere(rng, n, shape=(512, 512)):
    """Centres in any pixel of the frame."""
    y, x = (rng.uniform(-0.5, side - 0.5, n) for side in shape)
    return table(x, y, rng.uniform(-50, 50, n))


def joint(image, calibration):
    return locate(image, calibration, method="joint")


def assert_found(found, n=50, errors=1.0):
    print(found.round(3).to_dict())
    assert found["recall"] >= FOUND[n] and found["precision"] >= FOUND[n]
    assert max(found["sigma_x_px"], found["sigma_y_px"]) < SIGMA_XY_PX * errors
    assert found["sigma_z_um"] < SIGMA_Z_UM * errors


# -------------------- found and measured


@pytest.mark.parametrize("kind", IMAGE_TYPES)
@pytest.mark.parametrize("n", FOUND)
def test_random_positions(microscope, calibrations, kind, n):
    rng = np.random.default_rng(201 + n)
    frames, tables = [], []
    for frame in range(2):
        true = anywhere(rng, n)
        frames.append(joint(microscope.render(true, image_type=kind, rng=rng), calibrations[kind]).assign(frame=frame))
        tables.append(true.assign(frame=frame))
    measured, true = (pd.concat(t, ignore_index=True) for t in (frames, tables))
    assert_found(scores(measured, true), n)
    assert measured["brightness"].median() == pytest.approx(1, abs=0.02)
    assert 0.8 < measured["chi2"].median() < 1.4
    assert (measured["cm"].groupby(measured["frame"]).diff().dropna() <= 0).all()


@pytest.fixture(scope="module")
def crowd(microscope):
    """Fifty particles, and their frame."""
    rng = np.random.default_rng(203)
    true = anywhere(rng, 50)
    return true, microscope.render(true, rng=rng)


@pytest.mark.parametrize("kind", IMAGE_TYPES)
def test_edges(microscope, calibrations, kind):
    """Particles that the edge cuts, up to half, are found, and z is not drawn to either side."""
    pairs, counts = [], np.zeros(2)
    for seed in range(2):
        rng, along = np.random.default_rng(210 + seed), np.arange(35, 490, 62.0)
        near = rng.uniform(-0.5, 15, (4, len(along)))
        x = np.concatenate([along, along, near[2], 511 - near[3]])
        y = np.concatenate([near[0], 511 - near[1], along, along])
        true = table(x, y, rng.uniform(-50, 50, len(x)))
        measured = joint(microscope.render(true, image_type=kind, rng=rng), calibrations[kind])
        pairs.append(match(measured, true))
        counts += len(true), len(measured)
    pairs = pd.concat(pairs)
    assert len(pairs) >= 0.93 * counts.max()
    dz = pairs["dz_um"]
    assert dz.abs().median() / 0.6745 < SIGMA_Z_UM and dz.std() < 1.5 * SIGMA_Z_UM
    assert abs(dz.mean()) < 3 * dz.std() / np.sqrt(len(dz)) + EDGE_BIAS_UM


def test_isolated_particles_and_their_std(microscope, calibrations):
    """Errors are about what they are said to be; the middle half of the pulls tells."""
    pulls = []
    for i, kind in enumerate(IMAGE_TYPES):
        rng = np.random.default_rng(220 + i)
        true = on_grid(rng, (512, 512))
        measured = joint(microscope.render(true, (512, 512), image_type=kind, rng=rng), calibrations[kind])
        pairs = match(measured, true)
        assert len(pairs) == len(measured) == len(true)
        pulls.append(pairs[ERRORS].to_numpy() / measured.loc[pairs["measured"], STD].to_numpy())
        assert (measured[STD] > 0).all(axis=None)
    robust = np.median(np.abs(np.concatenate(pulls)), axis=0) / 0.6745
    print(robust.round(2))
    assert ((robust > 0.7) & (robust < 1.6)).all()


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_few_particles(microscope, calibration, n, seed):
    """All of them, and nothing else, however little light there is to learn the noise from."""
    rng = np.random.default_rng(230 + 10 * n + seed)
    x, y = (a.ravel()[rng.permutation(16)[:n]] for a in np.meshgrid(np.arange(60, 512, 120), np.arange(60, 512, 120)))
    true = table(x + rng.uniform(-20, 20, n), y + rng.uniform(-20, 20, n), rng.uniform(-48, 48, n))
    measured = joint(microscope.render(true, rng=rng), calibration)
    pairs = match(measured, true)
    assert len(pairs) == len(measured) == n
    assert (pairs["dz_um"].abs() < 3).all()
    assert (measured["chi2"] < 2).all()


# -------------------- other light


def test_scattered_brightness(microscope, calibration, crowd):
    """By ten per cent."""
    true, _ = crowd
    rng = np.random.default_rng(240)
    true = true.assign(brightness=rng.normal(1, 0.1, len(true)))
    measured = joint(microscope.render(true, rng=rng), calibration)
    assert_found(scores(measured, true))
    pairs = match(measured, true)
    bright = measured.loc[pairs["measured"], "brightness"].to_numpy()
    assert np.corrcoef(bright, true.loc[pairs["true"], "brightness"])[0, 1] > 0.7


@pytest.mark.parametrize("illumination", [0.6, 1.5])
def test_other_illumination(microscope, calibration, crowd, illumination):
    true, _ = crowd
    frame = microscope.render(true.assign(brightness=illumination), rng=241)
    measured = joint(frame, calibration)
    assert_found(scores(measured, true), errors=1 / min(illumination, 1))
    assert measured["brightness"].median() == pytest.approx(illumination, rel=0.03)


@pytest.mark.parametrize("noisy_stack", [False, True])
def test_photon_noise(microscope, calibration, crowd, noisy_stack):
    """Half an electron per count makes the brightest pixels some 60 counts noisier; in the frame, or in both."""
    true, _ = crowd
    camera = Camera(electrons_per_count=0.5)
    if noisy_stack:
        calibration = Calibration.from_stack(microscope.stack(Z_UM, SIZE_PX, camera=camera, rng=242), Z_UM)
    measured = joint(microscope.render(true, camera=camera, rng=243), calibration)
    assert_found(scores(measured, true), errors=1.5)


@pytest.mark.parametrize("size", [15, 30])
def test_what_is_no_particle(microscope, calibration, size):
    """A bright square among particles is not reported, or with a chi2 far above theirs, and spoils few of them."""
    found = reported = there = 0
    for seed in range(244, 250):
        true = on_grid(np.random.default_rng(seed), (300, 400))
        true = true[(true["x_px"] - 200).abs() + (true["y_px"] - 150).abs() > 60].reset_index(drop=True)
        frame = microscope.render(true, (300, 400), rng=seed).astype(float)
        frame[150 - size // 2 : 150 - size // 2 + size, 200 - size // 2 : 200 - size // 2 + size] += 2000
        measured = joint(frame, calibration)
        beside = ((measured["x_px"] - 200).abs() < size) & ((measured["y_px"] - 150).abs() < size)
        assert (measured.loc[beside, "chi2"] > 3 * measured.loc[~beside, "chi2"].median()).all()
        found += len(match(measured[~beside], true))
        reported, there = reported + (~beside).sum(), there + len(true)
    assert found >= 0.95 * there > 60
    assert found >= 0.95 * reported


@pytest.mark.parametrize("shape", [(61, 75), (64, 301), (173, 90)])
def test_frames_of_any_shape(microscope, calibration, shape):
    true = table(shape[1] / 2 - 1.3, shape[0] / 2 + 0.4, -20)
    measured = joint(microscope.render(true, shape, rng=245), calibration)
    assert len(match(measured, true, within_px=0.3)) == len(measured) == 1


@pytest.mark.parametrize("side", [61, 80, 120])
def test_a_lone_particle_in_a_small_frame_is_one(microscope, calibration, side):
    """Not two of half the light."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        true = table(*(side / 2 + rng.uniform(-5, 5, 2)), rng.uniform(-40, 10))
        measured = joint(microscope.render(true, (side, side), rng=rng), calibration)
        assert len(match(measured, true, within_px=0.5, within_um=3)) == len(measured) == 1


# -------------------- other calibrations


@pytest.fixture(scope="module")
def noisy(stacks):
    return stacks["fluorescent"]


def test_depths_in_falling_order(noisy, calibration, crowd):
    falling = Calibration.from_stack(noisy[::-1], Z_UM[::-1])
    pd.testing.assert_frame_equal(joint(crowd[1], falling), joint(crowd[1], calibration), check_exact=True)


def test_uneven_depths(microscope, crowd):
    """Steps from 0.3 µm at the ends to 3 µm in the middle."""
    z_um = 50 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 53)[1:-1])
    made = Calibration.from_stack(microscope.stack(z_um, SIZE_PX, rng=CALIBRATION_SEED), z_um)
    assert_found(scores(joint(crowd[1], made), crowd[0]))


@pytest.mark.parametrize(("n", "recall", "sigma_um"), [(11, 0.95, 1.5), (6, 0.7, 5), (3, 0, 10)])
def test_few_images(noisy, crowd, n, recall, sigma_um):
    """Eleven will do; with fewer, images between them are not known."""
    made = Calibration.from_stack(noisy, Z_UM, n=n, n_sub=min(n, 9))
    found = scores(joint(crowd[1], made), crowd[0])
    assert found["recall"] >= recall
    assert found["sigma_z_um"] < sigma_um


def sharp(true, shape, rng):
    """Frame of small astigmatic spots that half resolution would not keep."""
    y, x = np.indices(shape)
    frame = 300 + rng.normal(0, 20, shape)
    for p in true.itertuples():
        wide, high = 0.8 + 0.012 * (p.z_um + 50), 0.8 + 0.012 * (50 - p.z_um)
        frame += 1500 / wide / high * np.exp(-((x - p.x_px) ** 2) / 2 / wide**2 - (y - p.y_px) ** 2 / 2 / high**2)
    return frame


@pytest.mark.parametrize("size", [11, 15])
def test_small_sharp_images(size):
    """Searched for at full resolution."""
    rng, z_um = np.random.default_rng(250), np.linspace(-50, 50, 41)
    stack = [sharp(table(size // 2, size // 2, z), (size, size), rng) for z in z_um]
    made = Calibration.from_stack(stack, z_um)
    assert not made.half_resolution
    true = anywhere(rng, 40, (150, 180))
    measured = joint(sharp(true, (150, 180), rng), made)
    found, pairs = scores(measured, true), match(measured, true)
    assert found["recall"] >= 0.9 and found["precision"] >= 0.9
    assert (pairs[ERRORS].abs().median().to_numpy() < (0.05, 0.05, 2)).all()


# -------------------- from frame to frame


@pytest.fixture(scope="module")
def film():
    return Film.seeded(261, duration_s=0.8, mean_in_view=50)


def by_frame(measured, true):
    """Scores of each frame."""
    return [scores(measured[measured["frame"] == k], true[true["frame"] == k]) for k in true["frame"].unique()]


def test_film(film, calibration):
    found = by_frame(batch(film, calibration, method="joint", progress=False), film.truth())
    assert len(found) == 20
    assert found[0]["recall"] >= FOUND[50]
    later = pd.DataFrame(found[3:])
    assert later["n_matched"].sum() / later["n_true"].sum() >= 0.97
    assert later["n_matched"].sum() / later["n_measured"].sum() >= 0.97
    assert later["sigma_z_um"].mean() < SIGMA_Z_UM


def test_frames_that_do_not_follow_each_other(microscope, calibration):
    """A jump begins the search anew, and so does a frame after an empty one."""
    rng = np.random.default_rng(262)
    true = pd.concat([anywhere(rng, n).assign(frame=i) for i, n in enumerate([50, 50, 5, 1, 40])], ignore_index=True)
    frames = [microscope.render(part, rng=rng) for _, part in true.groupby("frame")]
    empty = microscope.render(table([], [], []), rng=rng)
    frames[3:3] = [empty, empty]
    true["frame"] += 2 * (true["frame"] > 2)
    measured = batch(frames, calibration, method="joint", progress=False)
    assert not measured["frame"].isin([3, 4]).any()
    for found in by_frame(measured, true):
        assert found["recall"] >= 0.9 and found["precision"] >= 0.9


def test_following_frames_begin_with_the_last(microscope, calibration):
    """One that appears is in the next table; one that leaves is gone; one that moves is followed."""
    plan, rng = Overlap(calibration, (200, 260)), np.random.default_rng(263)
    x, y, z = np.array([50.0, 120, 200, 100]), np.array([60.0, 140, 60, 60]), np.array([-30.0, 0, 25, 10])
    seen, explained = [], None
    for k in range(6):
        there = {0: [0, 1, 2], 1: [0, 1, 2, 3], 2: [0, 1, 2, 3]}.get(k, [0, 2, 3])
        frame = microscope.render(table(x[there] + 2 * k, y[there] - k, z[there] + 0.5 * k), (200, 260), rng=rng)
        frame = frame.astype(np.float32)
        explained = plan.first(frame) if k == 0 else plan.following(frame, explained)
        places = explained.fit.places[explained.stays]
        away = np.hypot(places[:, 1, None] - x - 2 * k, places[:, 0, None] - y + k)
        seen.append((away < (2 if k == 2 else 0.5)).any(axis=0).tolist())  # one that has just appeared is rough
    assert np.array(seen)[:, [0, 2]].all()
    assert np.array(seen)[:, 1].tolist() == [True] * 3 + [False] * 3
    assert np.array(seen)[:, 3].tolist() == [False, False] + [True] * 4
    np.testing.assert_allclose(np.median(explained.velocity, axis=0), (-1, 2, 0.25), atol=0.1)


def test_depths_are_less_the_bias_of_the_calibration(microscope):
    """With one noisy exposure it is a good part of the error at the ends of the stack, and of all error."""
    with_it, without = [], []
    for seed in (281, 282, 283):
        made = Calibration.from_stack(microscope.stack(Z_UM, 63, rng=seed), Z_UM)
        rng = np.random.default_rng(seed)
        true = pd.concat([on_grid(rng).assign(frame=k) for k in range(3)], ignore_index=True)
        frames = [microscope.render(part, (512, 700), rng=rng) for _, part in true.groupby("frame")]
        found = pd.concat([locate(f, made, method="joint").assign(frame=k) for k, f in enumerate(frames)])
        found = found.reset_index(drop=True)
        pairs = match(found, true)
        rows, error = found.loc[pairs["measured"]], pairs["dz_um"].to_numpy()
        without.append(error / rows["z_std_um"].to_numpy())
        with_it.append((error + np.interp(rows["z_um"], Z_UM, made.own_bias_um)) / rows["z_std_um"].to_numpy())
    assert np.square(np.concatenate(without)).mean() < np.square(np.concatenate(with_it)).mean()


def test_an_odd_brightness_widens_error_bars(microscope, calibration):
    """One that is brighter than all others by three tenths may be two."""
    true = on_grid(np.random.default_rng(284), (300, 400), 90).assign(brightness=1.0)
    stds = []
    for brightness in (1.0, 1.3):
        true.loc[4, "brightness"] = brightness
        found = joint(microscope.render(true, (300, 400), rng=285), calibration)
        away = np.hypot(found["x_px"] - true["x_px"][4], found["y_px"] - true["y_px"][4])
        assert away.min() < 1
        stds.append(found["z_std_um"][away.idxmin()])
    assert stds[1] > 2 * stds[0]


# -------------------- parts


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_noise_is_learnt_from_what_is_left(wrong):
    """Read noise and photon noise, and not what is wrong with the images, which grows with the square of the light."""
    rng = np.random.default_rng(270)
    light = np.zeros((900, 900), np.float32)
    light[100:820, 50:780] = rng.gamma(2, 300, (720, 730))
    variance = 38.0**2 + 2 * light
    residual = (rng.normal(size=light.shape) * np.sqrt(variance + (wrong * light) ** 2)).astype(np.float32)
    learnt = _variance(light, residual, 38.0)
    at = np.array([0.0, 300, 1000, 2000])
    np.testing.assert_allclose(np.polyval(learnt, at), 38.0**2 + 2 * at, rtol=0.25 if wrong == 0 else 0.7)
    weight = _weight(light, learnt)
    within = 1.25 if wrong == 0 else 2
    assert 1 / within < np.median((weight * variance)[light > 0]) < within
    assert (weight > 0).all() and np.isfinite(weight).all()


@pytest.mark.parametrize("lit", [0, 1, 3, 30, 300])
def test_noise_of_a_frame_with_little_light(lit):
    """Too few pixels to learn from; no warning."""
    light = np.zeros((100, 100), np.float32)
    light.flat[:lit] = 500
    residual = np.random.default_rng(271).normal(0, 38, light.shape).astype(np.float32)
    assert _variance(light, residual, 38.0)[-1] == pytest.approx(38.0**2, rel=0.2)
    assert np.isfinite(_weight(light, _variance(light, residual, 38.0))).all()


def test_brightness_of_many_and_few():
    """Median and scatter; of few, the scatter is not known, and of none, nothing new."""
    places = np.ones((400, 4))
    places[:, 3] = np.random.default_rng(272).normal(2, 0.2, 400)
    middle, spread = _brightness(places, 1.0, 0.5)
    assert middle == pytest.approx(2, abs=0.05) and spread == pytest.approx(0.2, rel=0.15)
    assert _brightness(places[:0], 1.0, 0.5) == (1.0, 0.5)
    alike = np.ones((100, 4))
    assert _brightness(alike[:1], 1.0, 0.5)[1] > _brightness(alike, 1.0, 0.5)[1] > 0


def test_images_go_on_beyond_their_frame(calibration):
    images = _continued(calibration.images)
    more = (images.shape[1] - SIZE_PX) // 2
    assert more > 0 and images.shape[1] % 2 == 1
    np.testing.assert_array_equal(images[:, more:-more, more:-more], calibration.images)
    rim = images.copy()
    rim[:, 1:-1, 1:-1] = 0
    assert np.abs(rim).max() < np.abs(calibration.images[:, [0, -1]]).max() / 2


def test_light_beyond_the_frame_is_about_what_was_cut_off(microscope):
    """At the far end a tenth of a particle's light falls outside of a template."""
    whole = np.stack([microscope.light(table(60, 60, z), (121, 121)) for z in Z_UM]).astype(np.float32)
    images = _continued(whole[:, 30:-30, 30:-30])
    total, cut, drawn = (a.sum(axis=(1, 2)) for a in (whole, whole[:, 30:-30, 30:-30], images))
    assert (total / cut)[-1] > 1.1
    np.testing.assert_allclose(drawn / total, 1, atol=0.02)


def test_high_pass_takes_out_what_is_smooth():
    x = np.indices((80, 90))[1]
    smooth = (500 + 3 * np.sin(x / 60)).astype(np.float32)
    fine = np.random.default_rng(273).normal(size=(80, 90)).astype(np.float32)
    passed = _high_passed(np.stack([smooth, smooth + fine]), 6.0)
    assert np.abs(passed[0, 10:-10, 10:-10]).max() < 0.1
    np.testing.assert_allclose(passed[1] - passed[0], fine, atol=0.5)
    np.testing.assert_array_equal(_high_passed(fine[None], 0)[0], fine)
    assert STAGES[-1].blur == 0 and not STAGES[-1].whiten
