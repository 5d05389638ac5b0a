"""Overlapping particles in whole frames: found, measured, at borders, in other light and calibrations, in films.

Particles lie anywhere in the frame, at any depth; noise is in calibrations and frames; seeds are conftest's and here.
"""

import cv2
import numpy as np
import pandas as pd
import pytest
from conftest import CALIBRATION_SEED, IMAGE_TYPES, SIZE_PX, Z_UM, on_grid, table

from gdptlab import Calibration, batch, locate, match
from gdptlab.assessment import scores
from gdptlab.experiment import Camera, Microscope
from gdptlab.experiment.film import Film
from gdptlab.fit import Joint, decided_by_plane
from gdptlab.fit.joint import high_passed, reduced
from gdptlab.fit.pattern import continued, particle_light

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
    assert measured["amplitude"].median() == pytest.approx(1, abs=0.02)
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


def test_scattered_amplitudes(microscope, calibration, crowd):
    """By ten per cent."""
    true, _ = crowd
    rng = np.random.default_rng(240)
    true = true.assign(amplitude=rng.normal(1, 0.1, len(true)))
    measured = joint(microscope.render(true, rng=rng), calibration)
    assert_found(scores(measured, true))
    pairs = match(measured, true)
    bright = measured.loc[pairs["measured"], "amplitude"].to_numpy()
    assert np.corrcoef(bright, true.loc[pairs["true"], "amplitude"])[0, 1] > 0.7


@pytest.mark.parametrize("illumination", [0.6, 1.5])
def test_other_illumination(microscope, calibration, crowd, illumination):
    true, _ = crowd
    frame = microscope.render(true.assign(amplitude=illumination), rng=241)
    measured = joint(frame, calibration)
    assert_found(scores(measured, true), errors=1 / min(illumination, 1))
    assert measured["amplitude"].median() == pytest.approx(illumination, rel=0.03)


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
    assert not made.model.half_resolution
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
    plan, rng = Joint(calibration.model, (200, 260)), np.random.default_rng(263)
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
    inside = (
        explained.places[:, 0] > 0
    )  # light at the edge may be fitted by a particle outside, which moves as it likes
    np.testing.assert_allclose(np.median(explained.velocity[inside], axis=0), (-1, 2, 0.25), atol=0.15)


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
        with_it.append((error + np.interp(rows["z_um"], Z_UM, made.model.own_bias_um)) / rows["z_std_um"].to_numpy())
    assert np.square(np.concatenate(without)).mean() < np.square(np.concatenate(with_it)).mean()


def test_an_unusual_amplitude_widens_error_bars(microscope, calibration):
    """One that is brighter than all others by three tenths may be two."""
    true = on_grid(np.random.default_rng(284), (300, 400), 90).assign(amplitude=1.0)
    stds = []
    for amplitude in (1.0, 1.3):
        true.loc[4, "amplitude"] = amplitude
        found = joint(microscope.render(true, (300, 400), rng=285), calibration)
        away = np.hypot(found["x_px"] - true["x_px"][4], found["y_px"] - true["y_px"][4])
        assert away.min() < 1
        stds.append(found["z_std_um"][away.idxmin()])
    assert stds[1] > 2 * stds[0]


# -------------------- parts


def test_images_go_on_beyond_their_frame(calibration):
    light = particle_light(calibration)
    images = continued(light)
    more = (images.shape[1] - SIZE_PX) // 2
    assert more > 0 and images.shape[1] % 2 == 1
    np.testing.assert_array_equal(images[:, more:-more, more:-more], light)
    rim = images.copy()
    rim[:, 1:-1, 1:-1] = 0
    assert np.abs(rim).max() < np.abs(light[:, [0, -1]]).max() / 2


def test_light_beyond_the_frame_is_about_what_was_cut_off(microscope):
    """At the far end a tenth of a particle's light falls outside of a template."""
    whole = np.stack([microscope.light(table(60, 60, z), (121, 121)) for z in Z_UM]).astype(np.float32)
    images = continued(whole[:, 30:-30, 30:-30])
    total, cut, drawn = (a.sum(axis=(1, 2)) for a in (whole, whole[:, 30:-30, 30:-30], images))
    assert (total / cut)[-1] > 1.1
    np.testing.assert_allclose(drawn / total, 1, atol=0.02)


def test_high_pass_takes_out_what_is_smooth():
    x = np.indices((80, 90))[1]
    smooth = (500 + 3 * np.sin(x / 60)).astype(np.float32)
    fine = np.random.default_rng(273).normal(size=(80, 90)).astype(np.float32)
    passed = high_passed(np.stack([smooth, smooth + fine]), 6.0)
    assert np.abs(passed[0, 10:-10, 10:-10]).max() < 0.1
    np.testing.assert_allclose(passed[1] - passed[0], fine, atol=0.5)


@pytest.mark.parametrize("half", [12, 13])
def test_patterns_are_halved_as_frames_are(half):
    """The middle stays in the middle; two nodes a pixel are, at the pixels, what one is."""
    rng, m = np.random.default_rng(274), 2 * half + 1
    fine = np.zeros((1, 2, 2 * m - 1, 2 * m - 1), np.float32)
    fine[..., 8:-8, 8:-8] = cv2.GaussianBlur(rng.normal(size=(2 * m - 17, 2 * m - 17)), (0, 0), 3)
    one = np.ascontiguousarray(fine[..., ::2, ::2])
    small, small_fine = reduced(one, 1), reduced(fine, 2)
    trim = half % 2
    expected = cv2.pyrDown(np.ascontiguousarray(one[0, 0, trim : m - trim, trim : m - trim]))
    np.testing.assert_allclose(small[0, 0, 2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-5)
    middle = small.shape[-1] // 2, small_fine.shape[-1] // 2
    assert small_fine[0, 0, middle[1], middle[1]] == pytest.approx(small[0, 0, middle[0], middle[0]], abs=1e-5)


# -------------------- any amplitude, any unit, any pixel


@pytest.fixture(scope="module")
def tenfold(microscope):
    """Sixty particles whose amplitudes differ tenfold, and their frame."""
    rng = np.random.default_rng(301)
    true = anywhere(rng, 60).assign(amplitude=np.exp(0.6 * rng.standard_normal(60)))
    return true, microscope.render(true, rng=rng)


def test_amplitudes_that_differ_tenfold(calibration, tenfold):
    true, frame = tenfold
    measured = joint(frame, calibration)
    found, pairs = scores(measured, true), match(measured, true)
    assert found["recall"] >= 0.96 and found["precision"] >= 0.96 and found["sigma_z_um"] < SIGMA_Z_UM
    ratio = measured["amplitude"].to_numpy()[pairs["measured"]] / true["amplitude"].to_numpy()[pairs["true"]]
    assert np.median(np.abs(ratio - 1)) < 0.03
    assert (measured["chi2_without"] > measured["chi2"]).all()


@pytest.mark.parametrize("unit", [1 / 20, 1e-3, 1e4])
def test_the_unit_of_counts_does_not_matter(calibration, tenfold, unit):
    """Rounding may change one or two doubtful particles; all others agree to a small fraction of their errors."""
    frame = tenfold[1].astype(np.float32)
    plain, scaled = joint(frame, calibration), joint(frame * np.float32(unit), calibration)
    pairs = match(scaled, plain, within_px=0.03, within_um=0.1)
    assert len(pairs) >= max(len(plain), len(scaled)) - 5
    ratio = scaled["amplitude"].to_numpy()[pairs["measured"]] / plain["amplitude"].to_numpy()[pairs["true"]]
    np.testing.assert_allclose(ratio, unit, rtol=0.02)


def test_threads_do_not_matter(calibration, tenfold):
    frame = tenfold[1].astype(np.float32)
    tables = []
    for threads in (1, 2):
        plan = Joint(calibration.model, frame.shape, threads)
        tables.append(plan.table(plan.first(frame)))
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def test_hot_and_saturated_pixels_are_left_out_and_counted(calibration, tenfold):
    true, frame = tenfold
    spoilt = np.minimum(frame, 3000)
    spoilt.flat[np.random.default_rng(302).choice(spoilt.size, 200, replace=False)] = 65_535
    measured = joint(spoilt, calibration)
    found = scores(measured, true)
    assert found["recall"] >= 0.95 and found["precision"] >= 0.95 and found["sigma_z_um"] < 1.5 * SIGMA_Z_UM
    assert measured.attrs["saturated_px"] > 50 and measured.attrs["defective_px"] >= 190


@pytest.mark.parametrize("counts", [400, 2000])
def test_a_background_that_changes_over_two_templates(microscope, calibration, counts):
    rng, (y, x) = np.random.default_rng(303), np.indices((512, 512))
    true = anywhere(rng, 50)
    wave = counts * (1 + np.sin(2 * np.pi * x / 128) * np.sin(2 * np.pi * y / 128 + 1))
    measured = joint(microscope.render(true, rng=rng) + wave, calibration)
    found = scores(measured, true)
    assert found["recall"] >= 0.88 and found["precision"] >= 0.93 and found["sigma_z_um"] < SIGMA_Z_UM


def test_debris_is_listed_on_request(microscope, calibration):
    """A bright bar among particles: not in the table, unless asked for, and counted."""
    rng, frame_shape = np.random.default_rng(304), (300, 400)
    true = on_grid(rng, frame_shape)
    true = true[(true["x_px"] - 200).abs() > 70].reset_index(drop=True)
    frame = microscope.render(true, frame_shape, rng=rng).astype(np.float32)
    frame[140:150, 170:230] += 2500
    plan = Joint(calibration.model, frame_shape)
    explained = plan.first(frame)
    default, all_rows = plan.table(explained), plan.table(explained, foreign=True)
    assert len(match(default, true)) == len(true)
    assert len(all_rows) > len(default) and default.attrs["foreign"] >= len(all_rows) - len(default)


def test_both_sides_of_focus(microscope):
    """Without astigmatism wide images have a twin beyond focus; the likelihood decides, and says how surely."""
    plain = Microscope(cylinder_um=None)
    made = Calibration.from_stack(plain.stack(Z_UM, SIZE_PX, rng=305), Z_UM)
    true = anywhere(np.random.default_rng(306), 25, (400, 400))
    measured = joint(plain.render(true, (400, 400), rng=307), made)
    found = scores(measured, true)
    assert found["recall"] >= 0.95 and found["precision"] >= 0.95
    has = measured["z_other_um"].notna()
    assert has.any() and ((measured["z_other_um"] - measured["z_um"]).abs()[has] > 4).all()
    assert (measured["ambiguous"] == (measured["log_ratio"] < 20)).all() and (
        measured["log_ratio"][~has] == np.inf
    ).all()


def test_a_plane_decides_between_two_depths():
    """The third particle's other depth lies on the plane of all."""
    rows = pd.DataFrame(
        {"z_um": [5.0, 5.2, -8.0, 4.9], "z_other_um": [-5.0, np.nan, 5.1, -4.0], "log_ratio": [9.0, np.inf, 2.0, 30.0]}
    )
    decided = decided_by_plane(rows)
    assert decided["z_um"].tolist() == [5.0, 5.2, 5.1, 4.9]
    assert decided["z_other_um"].tolist()[2] == -8.0 and decided["log_ratio"].tolist()[2] == -2.0
    with pytest.raises(ValueError, match="log_ratio"):
        decided_by_plane(rows.drop(columns="log_ratio"))


@pytest.fixture(scope="module")
def lined_up(clean_stack):
    """A plan, and a film of particles that have lined up, as sound does: six frames, and the particles of each."""
    rng = np.random.default_rng(3)
    plan = Joint(Calibration.from_stack(clean_stack + rng.normal(0, 38, clean_stack.shape), Z_UM).model, (256, 512))
    x = np.sort(rng.uniform(10, 500, 70))
    y, z = 128 + rng.normal(0, 0.5, len(x)), rng.normal(0, 1.5, len(x))
    true = [pd.DataFrame({"x_px": x + 0.3 * k, "y_px": y, "z_um": z}) for k in range(6)]
    return plan, [Microscope().render(t, (256, 512), rng=rng).astype(np.float32) for t in true], true


def test_particles_that_line_up_are_found_in_a_frame_alone(lined_up):
    plan, frames, true = lined_up
    table = plan.table(plan.first(frames[0]))
    assert len(match(table, true[0])) >= 0.95 * len(true[0])
    assert len(table) <= 1.02 * len(true[0]) and table.attrs["covered_px"] == 0


def test_particles_that_line_up_are_not_covered_in_a_film(lined_up):
    plan, frames, true = lined_up
    found = plan.first(frames[0])
    for frame, there in zip(frames[1:], true[1:], strict=True):
        found = plan.following(frame, found)
        assert not found.covered.any() and len(match(plan.table(found), there)) >= 0.9 * len(there)
