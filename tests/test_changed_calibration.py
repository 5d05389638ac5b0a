"""A calibration made from another: depths in the sample, one side of focus; and from cut-outs of even size."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, batch, locate
from gdptlab.pipeline import report
from gdptlab.pipeline.tables import fingerprint

Z_UM = np.linspace(-20, 20, 21)


def blurred(z_um, x, y, shape):
    """A round spot that looks the same on both sides of its focus at 2 µm."""
    rows, columns = np.indices(shape)
    wide = 2 * np.hypot(1, (z_um - 2) / 6)
    return 9000 / wide**2 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * wide**2))


def stack_of(n, middle):
    stack = np.stack([blurred(z, middle, middle, (n, n)) for z in Z_UM])
    return stack + np.random.default_rng(1).normal(0, 3, stack.shape)


CALIBRATION = Calibration.from_stack(stack_of(35, 17), Z_UM)


def frame_of(z_um):
    """A frame of particles at depths (p,), and their x, y."""
    x, y = (p.ravel() + 0.3 for p in np.meshgrid(np.arange(30, 300, 48), np.arange(30, 160, 48)))
    image = sum(blurred(*p, (170, 300)) for p in zip(z_um, x, y, strict=False))
    return image + np.random.default_rng(2).normal(0, 3, image.shape)


# -------------------- depth in the sample


def test_depths_are_those_in_the_sample(tmp_path) -> None:
    wet = CALIBRATION.with_depth_factor((1.0, 1.333))
    np.testing.assert_allclose(wet.z_um, 1.333 * Z_UM)
    assert wet.depth_factor == 1.333 and CALIBRATION.depth_factor == 1
    np.testing.assert_allclose(wet.with_depth_factor(1.0).z_um, Z_UM)  # the factor, not one more
    frame = frame_of(np.linspace(-18, 0, 18))
    tables = [locate(frame, each) for each in (CALIBRATION, wet)]
    np.testing.assert_allclose(tables[1]["z_um"], 1.333 * tables[0]["z_um"], atol=1e-6)
    wet.save(tmp_path / "a.npz")
    read = Calibration.load(tmp_path / "a.npz")
    assert read.depth_factor == 1.333 and fingerprint(read) == fingerprint(wet) != fingerprint(CALIBRATION)


def test_a_file_with_a_damaged_factor_is_refused(tmp_path) -> None:
    CALIBRATION.save(tmp_path / "a.npz")
    parts = dict(np.load(tmp_path / "a.npz"))
    for factor in (np.nan, -1.0, 50.0, [1.0], 1):
        np.savez(tmp_path / "b.npz", **parts, depth_factor=np.array(factor))
        with pytest.raises(ValueError, match=r"^path: .*depth_factor"):
            Calibration.load(tmp_path / "b.npz")


@pytest.mark.parametrize("factor", [0, -1, np.nan, "water", (1.0,), (0, 1.33), (1.0, 1.33, 1.5), 11, None])
def test_factors_refused(factor) -> None:
    with pytest.raises((TypeError, ValueError), match=r"^factor: "):
        CALIBRATION.with_depth_factor(factor)


# -------------------- one side of focus


@pytest.mark.parametrize(("side", "low", "high"), [("near", -18, 0), ("far", 4, 18)])
@pytest.mark.parametrize("method", ["correlation", "joint"])
def test_only_one_side_is_measured(side, low, high, method) -> None:
    z_um = np.linspace(low, high, 18)
    frame = frame_of(z_um)
    table = locate(frame, CALIBRATION, method=method, side=side).sort_values(["y_px", "x_px"])
    assert len(table) == 18 and table["z_um"].between(*((-20, 2) if side == "near" else (2, 20))).all()
    order = np.lexsort((np.rint(table["x_px"]), np.rint(table["y_px"] / 48)))
    assert np.abs(table["z_um"].to_numpy()[order] - z_um).max() < 1.5
    both = batch([frame], CALIBRATION, method=method, side=side, progress=False)
    np.testing.assert_array_equal(np.sort(both["z_um"]), np.sort(table["z_um"]))


def test_one_side_is_not_ambiguous() -> None:
    assert report(CALIBRATION).loc["ambiguity", "verdict"] == "bad"
    for side in ("near", "far"):
        part = CALIBRATION.one_side(side)
        assert report(part).loc["ambiguity", "verdict"] == "good"
        assert part is CALIBRATION.one_side(side)
    assert CALIBRATION.one_side("near").z_um[-1] == CALIBRATION.one_side("far").z_um[0] == 2


def test_sides_refused() -> None:
    for side in ("left", 1):
        with pytest.raises(ValueError, match=r"^side: "):
            locate(frame_of([0.0]), CALIBRATION, side=side)
    ends = Calibration.from_stack(stack_of(35, 17)[:12], Z_UM[:12])
    assert len(ends.one_side("near")) == 12
    with pytest.raises(ValueError, match=r"^side: got 'far', where the calibration has 1 images"):
        ends.one_side("far")


# -------------------- cut-outs of even size


def test_cut_outs_of_100_px_measure() -> None:
    made = Calibration.from_stack(stack_of(100, 49.5), Z_UM)
    assert made.size == 99
    frame = blurred(7.0, 60.3, 58.8, (120, 120)) + np.random.default_rng(2).normal(0, 3, (120, 120))
    (found,) = locate(frame, made, threshold=0.6, side="far").itertuples()
    assert abs(found.z_um - 7) < 0.5 and np.hypot(found.x_px - 60.3, found.y_px - 58.8) < 0.8


@pytest.mark.parametrize("middle", [16, 16.4, 17, 16.6])
def test_even_cut_outs_are_made_odd(middle) -> None:
    made = Calibration.from_stack(stack_of(34, middle), Z_UM)
    assert made.size == 33
    z_um = np.linspace(-18, 18, 18)
    table = locate(frame_of(z_um), made, threshold=0.6)
    true = pd.DataFrame([(x, y) for y in np.arange(30, 160, 48) for x in np.arange(30, 300, 48)], columns=["x", "y"])
    position = table[["x_px", "y_px"]].to_numpy()
    off = [np.abs(position - (p.x + 0.3, p.y + 0.3)).max(axis=1).min() for p in true.itertuples()]
    assert max(off) < 0.5 + 0.1
