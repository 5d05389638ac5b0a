"""A calibration from a film alone, on a small film of Gaussian images whose widths change with depth."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kendalltau

from gdptlab import Calibration, locate, match
from gdptlab.pipeline import report
from gdptlab.pipeline.depth_scale import depth_scale
from gdptlab.pipeline.image_curve import features, ordered, particles
from gdptlab.pipeline.lone_images import lone_images

HEIGHT_UM, SHAPE, NOISE = 60.0, (150, 150), 4.0
EXTENT_UM = (-HEIGHT_UM / 2, HEIGHT_UM / 2)


def film(seed, *, frames=60, count=7, apart_um=10.0, focus_um=-8.0, kinds=(1.0,)):
    """Frames (n, rows, columns) of particles whose images have foci `apart_um` to either side, and the truth."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    images, rows = [], []
    for k in range(frames):
        image = rng.normal(100, NOISE, SHAPE)
        for _ in range(count):
            (x_px, y_px), z = rng.uniform(-5, 155, 2), rng.uniform(*EXTENT_UM)
            width = [1.8 * rng.choice(kinds) * np.hypot(1, (z - focus_um - s * apart_um) / 11) for s in (1, -1)]
            peak = 4000 * rng.lognormal(0, 0.3) / (width[0] * width[1])
            image += peak * np.exp(-((x - x_px) ** 2) / 2 / width[0] ** 2 - (y - y_px) ** 2 / 2 / width[1] ** 2)
            rows.append((k, x_px, y_px, z))
        images.append(image)
    return np.array(images, np.float32), pd.DataFrame(rows, columns=["frame", "x_px", "y_px", "z_um"])


@pytest.fixture(scope="module")
def made():
    """A film, its truth and the calibration from it."""
    frames, truth = film(1)
    return frames, truth, Calibration.from_film(frames, height_um=HEIGHT_UM, fitted=20)


def test_depths_come_without_any_depth(made):
    _, truth, calibration = made
    measured = calibration.report.particles
    true = truth[truth["frame"].isin(measured["frame"])]
    pairs = match(measured, true, within_um=HEIGHT_UM)
    assert len(pairs) > 0.95 * len(measured)
    assert kendalltau(pairs["z_um"], pairs["z_um"] + pairs["dz_um"])[0] > 0.96
    # No ranks can be nearer to the truth than those of the true depths.
    ranks = EXTENT_UM[0] + HEIGHT_UM * (true["z_um"].rank() - 0.5) / len(true)
    floor = np.sqrt(((ranks - true["z_um"]) ** 2).mean())
    assert np.sqrt((pairs["dz_um"] ** 2).mean()) < 1.5 * floor + 0.02 * HEIGHT_UM
    assert np.sqrt((pairs["dz_um"] ** 2).mean()) < 3 * np.median(calibration.report.z_std_um)


def test_other_frames_are_explained_as_well(made):
    frames, truth, calibration = made
    others = np.setdiff1d(np.arange(len(frames)), calibration.report.particles["frame"])[:6]
    table = pd.concat([locate(frames[k], calibration, method="joint").assign(frame=k) for k in others])
    inside = truth[
        truth["frame"].isin(others) & truth[["x_px", "y_px"]].clip(5, 145).eq(truth[["x_px", "y_px"]]).all(axis=1)
    ]
    pairs = match(table.reset_index(drop=True), inside, within_um=HEIGHT_UM)
    assert len(pairs) >= 0.95 * len(inside) and (table["chi2"] < 2).mean() > 0.95


def test_the_error_of_the_scale_is_in_every_depth(made, tmp_path):
    frames, _, calibration = made
    known = calibration.model.own_error[:, 2]
    assert (known >= calibration.report.z_std_um).all()
    assert (locate(frames[1], calibration, method="joint")["z_std_um"] > 0.9 * calibration.report.z_std_um.min()).all()
    calibration.save(tmp_path / "film.npz")
    np.testing.assert_array_equal(Calibration.load(tmp_path / "film.npz").model.own_error[:, 2], known)
    twice = calibration.with_depth_factor(2.0)
    np.testing.assert_allclose(twice.report.z_std_um, 2 * calibration.report.z_std_um)
    assert len(calibration.one_side("far").report.z_std_um) == len(calibration.one_side("far"))


def test_report_says_what_a_film_cannot_tell(made):
    calibration = made[-1]
    assert calibration.report.focus_inside and calibration.report.misfits < 0.03
    spoilt = replace(calibration, report=replace(calibration.report, misfits=0.4, focus_inside=False))
    table = report(spoilt)
    assert table.loc["one kind", "verdict"] == "bad" and "Two kinds" in table.loc["one kind", "advice"]
    assert table.loc["sides of focus", "verdict"] == "look"


def test_two_kinds_of_particle_are_noticed():
    frames, _ = film(7, kinds=(1.0, 1.6))
    calibration = Calibration.from_film(frames, height_um=HEIGHT_UM, fitted=20)
    assert report(calibration).loc["one kind", "verdict"] == "bad"


def test_order_follows_depth_and_folds_where_both_sides_look_alike():
    for apart_um, folded in ((10.0, False), (0.0, True)):
        frames, truth = film(2, apart_um=apart_um, frames=90)
        lone = lone_images(frames)
        points = features(lone.images)
        curve = ordered(points, particles(lone.table, points, lone.images.shape[-1]))
        pairs = match(lone.table.assign(z_um=0.0), truth, within_um=HEIGHT_UM)
        z_um = pairs["z_um"] + 8 if not folded else np.abs(pairs["z_um"] + 8)
        used = curve.used[pairs["measured"]]
        assert abs(kendalltau(z_um[used], curve.along[pairs["measured"]][used])[0]) > 0.95


def followed(z_um, seed=3, frames=12):
    """Particles that flow, fast in the middle, at frames in pairs; their places on a bent curve of 41 slices."""
    rng = np.random.default_rng(seed)
    x_px, y_px = rng.uniform(50, 400, (2, len(z_um)))
    slices = 20 + 20 * np.sinh(z_um / HEIGHT_UM * 3) / np.sinh(1.5)
    pair = np.arange(len(z_um)) % frames * 10
    moved = 12 * (1 - (z_um / 30) ** 2)
    parts = [pd.DataFrame({"frame": pair + k, "x_px": x_px + k * moved, "y_px": y_px, "slice": slices}) for k in (0, 1)]
    return pd.concat(parts, ignore_index=True)


def true_depths():
    """Depths of the 41 slices of `followed`."""
    return HEIGHT_UM / 3 * np.arcsinh((np.arange(41) - 20) / 20 * np.sinh(1.5))


def poiseuille(x_px, y_px, z_um):
    """Speed of the flow between two walls."""
    return 1 - (z_um / 30) ** 2


def test_scale_by_the_height_needs_even_seeding_and_by_the_speed_does_not():
    places = np.arange(41.0)
    even = np.random.default_rng(4).permutation(np.linspace(-30, 30, 1201))
    scale = depth_scale(followed(even), places, EXTENT_UM, None)
    np.testing.assert_allclose(scale.z_um, true_depths(), atol=0.3)
    focused = 29.5 * np.sin(np.random.default_rng(5).uniform(-np.pi / 2, np.pi / 2, 600)) ** 3
    by_height = depth_scale(followed(focused), places, EXTENT_UM, None)
    by_speed = depth_scale(followed(focused), places, EXTENT_UM, poiseuille)
    np.testing.assert_allclose(by_speed.z_um, true_depths(), atol=0.5)
    assert np.abs(by_height.z_um - true_depths()).max() > 5


def test_error_of_the_scale_is_that_of_ranks():
    off, std, places = [], [], np.arange(41.0)
    for seed in range(20):
        random = np.random.default_rng(seed).uniform(-30, 30, 300)
        scale = depth_scale(followed(random, seed).query("frame % 10 == 0"), places, EXTENT_UM, None)
        off.append(np.polyfit(true_depths(), scale.z_um, 1)[0] - 1)
        std.append(scale.std)
    assert 0.6 < np.sqrt(np.mean(np.square(off))) / np.mean(std) < 1.4


def test_what_is_too_little_is_refused_by_name():
    frames, _ = film(6, frames=20)
    with pytest.raises(ValueError, match=r"frames: got \d+ particles that stand alone .* about \d+ more frames"):
        Calibration.from_film(frames, height_um=60)
    with pytest.raises(ValueError, match=r"frames: got 0 particles .* other frames"):
        Calibration.from_film(np.zeros_like(frames), height_um=60)
    with pytest.raises(ValueError, match="speed: got 0 particles that can be followed"):
        depth_scale(followed(np.linspace(-30, 30, 99)).query("frame % 10 == 0"), np.arange(41.0), EXTENT_UM, poiseuille)
    with pytest.raises(ValueError, match=r"speed: got values of shape \(\)"):
        depth_scale(followed(np.linspace(-30, 30, 99)), np.arange(41.0), EXTENT_UM, lambda *at: 1.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"height_um": 0}, "height_um"),
        ({"radius_um": 30}, "radius_um: got 30"),
        ({"radius_um": -1}, "radius_um"),
        ({"speed": 3}, "speed"),
        ({"reverse": 1}, "reverse"),
        ({"fitted": 3}, "fitted: got 3"),
        ({"size": 20}, "size: got 20, allowed are odd"),
        ({"frames": np.zeros((30, 30))}, "frames"),
        ({"frames": iter([])}, "frames"),
        ({"frames": np.zeros((3, 30, 30))}, "frames: got 3"),
        ({"frames": np.full((30, 30, 30), np.nan)}, "frames: got NaN"),
    ],
)
def test_wrong_arguments_are_named(wrong, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Calibration.from_film(**({"frames": np.zeros((30, 30, 30)), "height_um": 60} | wrong))
