"""A calibration from beads on a tilted slide."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, locate, match
from gdptlab.pipeline.tilt import _on_plane, _plane, _single

TILT_DEG, UM_PER_PX, SIDE = 13.5, 0.65, 560


def slide(microscope, seed=8, steps=(0.0, 4.0, -4.0, 7.0), apart=62):
    """Frames of one slide that is moved by these steps, µm; its middle lies at z = 0 in the first."""
    rng, places = np.random.default_rng(seed), np.empty((0, 2))
    for _ in range(400):
        place = rng.uniform(15, SIDE - 15, 2)
        if not len(places) or np.hypot(*(places - place).T).min() > apart:
            places = np.vstack([places, place])
    z_um = np.tan(np.deg2rad(TILT_DEG)) * UM_PER_PX * (places[:, 0] - (SIDE - 1) / 2)
    beads = pd.DataFrame({"x_px": places[:, 0], "y_px": places[:, 1]})
    return np.stack([microscope.render(beads.assign(z_um=z_um + s), (SIDE, SIDE), rng=rng) for s in steps])


def calibrated(frames, **changes):
    return Calibration.from_tilt(frames, **{"tilt_deg": TILT_DEG, "um_per_px": UM_PER_PX} | changes)


def test_depths_follow_from_the_tilt(microscope) -> None:
    made = calibrated(slide(microscope), size=63)
    rng = np.random.default_rng(3)
    true = pd.DataFrame(rng.uniform((0, 0, -30), (299, 299, 30), (25, 3)), columns=["x_px", "y_px", "z_um"])
    pairs = match(locate(microscope.render(true, (300, 300), rng=rng), made, method="joint"), true)
    error = pairs["dz_um"] - pairs["dz_um"].median()
    assert len(pairs) >= 24 and abs(pairs["dz_um"].median()) < 1.5
    assert 1.4826 * error.abs().median() < 0.8
    assert abs(np.polyfit(pairs["z_um"], error, 1)[0]) < 0.08


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_plane_rises_along_the_axis(axis) -> None:
    table = pd.DataFrame({"x_px": [0.0, 9.5, 19.0], "y_px": [29.0, 14.5, 0.0]})
    expected = {"x": [-4.75, 0, 4.75], "y": [7.25, 0, -7.25]}[axis]
    np.testing.assert_allclose(_plane(table, axis, 0.5, (30, 20)), expected)


def test_two_beads_that_look_like_one_are_told_by_their_image() -> None:
    rng = np.random.default_rng(4)
    z_um = rng.permutation(np.linspace(-40, 40, 90))
    points = np.column_stack([np.cos(z_um / 40), np.sin(z_um / 40)]) + rng.normal(0, 0.01, (90, 2))
    points[[7, 30]] += 0.4
    one = _single(points, z_um)
    assert not one[[7, 30]].any() and one.mean() > 0.85


def test_beads_beyond_the_slices_are_on_the_plane_if_it_is_beyond() -> None:
    plane = np.linspace(-50, 50, 101)
    found = pd.DataFrame({"frame": 0, "x_px": plane, "y_px": 0.0, "z_um": np.clip(plane, -50, 30)})
    found.loc[40, "z_um"] += 20
    labels, off_um = _on_plane(found, plane, np.linspace(-50, 30, 9))
    np.testing.assert_allclose(off_um, np.where(np.arange(101) == 40, 20, 0), atol=1e-9)
    np.testing.assert_allclose(labels["z_um"], plane)


def test_a_wrong_axis_is_noticed(microscope) -> None:
    with pytest.warns(UserWarning, match="off the plane of this tilt.* check the axis"):
        calibrated(slide(microscope, steps=(0.0, 4.0)), axis="y", size=63)


@pytest.mark.parametrize(
    ("changes", "error", "name"),
    [
        ({"tilt_deg": 0.0}, ValueError, "tilt_deg"),
        ({"tilt_deg": 75.0}, ValueError, "tilt_deg"),
        ({"tilt_deg": "steep"}, TypeError, "tilt_deg"),
        ({"um_per_px": -0.65}, ValueError, "um_per_px"),
        ({"axis": "z"}, ValueError, "axis"),
        ({"size": 40}, ValueError, "size"),
        ({"n_sub": 1}, ValueError, "n_sub"),
        ({"frames": np.zeros((3, 90))}, ValueError, "frames"),
        ({"frames": np.random.default_rng(1).normal(500, 5, (2, 90, 90))}, ValueError, "frames"),
    ],
)
def test_refuses(changes, error, name) -> None:
    frames = changes.pop("frames", np.random.default_rng(2).normal(500, 5, (2, 90, 90)))
    with pytest.raises(error, match=rf"^{name}: "):
        calibrated(frames, **changes)
