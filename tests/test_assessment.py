"""Matching and scores, by examples computed by hand."""

import numpy as np
import pandas as pd
import pytest
from conftest import table

from gdptlab.assessment import count_valid, match, scores, scores_by_z, standard_assessment


def pairs_of(measured, true, **settings):
    pairs = match(measured, true, **settings)
    return set(zip(pairs["measured"], pairs["true"], strict=True))


def test_differences_are_measured_minus_true():
    pairs = match(table([11, 3], [20.5, 7], [-4, 9]), table([10, 4], [21, 7.25], [1, 8]))
    pairs = pairs.sort_values("true").set_index("true")
    assert pairs["dx_px"].tolist() == [1, -1]
    assert pairs["dy_px"].tolist() == [-0.5, -0.25]
    assert pairs["dz_um"].tolist() == [-5, 1]
    assert pairs["z_um"].tolist() == [1, 8]
    assert list(pairs) == ["measured", "dx_px", "dy_px", "dz_um", "z_um"]


def test_nearest_in_the_plane_first_and_one_to_one():
    true = table([10, 11], [5, 5], [0, 0])
    # The first is nearer to both; it takes the one it is nearest to, the second what is left.
    assert pairs_of(table([10.8, 12.5], [5, 5], [0, 0]), true) == {(0, 1)}
    assert pairs_of(table([10.8, 11.9], [5, 5], [0, 0]), true) == {(0, 1), (1, 0)}
    # Nearer in the plane wins over nearer in z.
    assert pairs_of(table([10.1, 10.2], [5, 5], [9, 0]), table(10, 5, 0)) == {(0, 0)}
    assert pairs_of(table(10.4, 5, 0), table([10, 10.5], [5, 5], [0, 8])) == {(0, 1)}


@pytest.mark.parametrize(
    ("dx", "dy", "dz", "matched"),
    [
        (2, 0, 0, True),
        (2.01, 0, 0, False),
        (0, -2, 0, True),
        (0, -2.01, 0, False),
        (1.9, 1.9, 9.9, True),  # a box, not a ball
        (0, 0, 10, True),
        (0, 0, -10.01, False),
    ],
)
def test_tolerance_is_a_box(dx, dy, dz, matched):
    assert len(match(table(dx, dy, dz), table(0, 0, 0))) == matched


def test_tolerances_can_be_set():
    measured, true = table([3, 50], [0, 50], [0, 56]), table([0, 50], [0, 50], [0, 50])
    assert pairs_of(measured, true, within_px=3, within_um=5) == {(0, 0)}
    assert pairs_of(measured, true, within_px=1, within_um=7) == {(1, 1)}


def test_frames_are_kept_apart():
    measured = table([1, 1, 5], [1, 1, 5], [0, 0, 0]).assign(frame=[0, 7, 3])
    true = table([1, 1, 5], [1, 1, 5], [0, 0, 0]).assign(frame=[7, 0, 2])
    assert pairs_of(measured, true) == {(0, 1), (1, 0)}


def test_row_labels_are_those_of_the_tables():
    measured, true = table([1, 9], [1, 9], [0, 0]), table([9, 1], [9, 1], [0, 0])
    measured.index, true.index = ["a", "b"], [40, 30]
    assert pairs_of(measured, true) == {("a", 30), ("b", 40)}


def test_rows_with_nan_have_no_pair():
    measured = table([1, np.nan, 20], [1, 9, 20], [0, 0, np.nan])
    true = table([1, 9, 20, np.inf], [1, 9, 20, 3], [0, 0, 0, 0])
    assert pairs_of(measured, true) == {(0, 0)}
    found = scores(measured, true)
    assert (found["n_true"], found["n_measured"], found["n_matched"]) == (4, 3, 1)


EMPTY = table([], [], [])
ONE = table(1, 1, 0)


@pytest.mark.parametrize(("measured", "true"), [(EMPTY, ONE), (ONE, EMPTY), (EMPTY, EMPTY)])
@pytest.mark.parametrize("frames", [True, False])
def test_nothing_to_match(measured, true, frames):
    if frames:
        measured, true = measured.assign(frame=0), true.assign(frame=0)
    pairs = match(measured, true)
    assert len(pairs) == 0
    assert list(pairs) == ["measured", "true", "dx_px", "dy_px", "dz_um", "z_um"]
    found = scores(measured, true)
    assert found["n_matched"] == 0 and np.isnan(found["sigma_x_px"])
    assert found["recall"] == 0 if len(true) else np.isnan(found["recall"])
    assert found["precision"] == 0 if len(measured) else np.isnan(found["precision"])


def test_frames_without_pairs_among_those_with():
    measured = table([1, 1], [1, 1], [0, 0]).assign(frame=[0, 2])
    true = table([1, 90, 1], [1, 90, 1], [0, 0, 0]).assign(frame=[0, 1, 2])
    assert pairs_of(measured, true) == {(0, 0), (1, 2)}


def test_scores_by_hand():
    true = table([10, 30, 50, 70], [10, 30, 50, 70], [0, 10, 20, 30])
    measured = table([10.3, 30, 49.6, 90, 95], [10, 30.6, 50, 90, 95], [1, 8, 21, 0, 0])
    found = scores(measured, true)
    expected = {
        "n_true": 4,
        "n_measured": 5,
        "n_matched": 3,
        "recall": 0.75,
        "precision": 0.6,
        "sigma_x_px": np.sqrt((0.09 + 0 + 0.16) / 3),
        "sigma_y_px": np.sqrt(0.36 / 3),
        "sigma_z_um": np.sqrt((1 + 4 + 1) / 3),
        "bias_z_um": 0,
    }
    assert list(found.index) == list(expected)
    np.testing.assert_allclose(found, list(expected.values()), atol=1e-12)
    assert scores(measured, true, within_um=1.5)["recall"] == 0.5


def test_scores_by_z_by_hand():
    true = table([10, 30, 50, 70], [10, 30, 50, 70], [-30, -1, 5, 30])
    measured = table([10, 30, 50.5, 90], [10, 30, 50, 90], [-28, 2, 5, 50])
    found = scores_by_z(measured, true, [-50, 0, 50])
    assert found["z_um"].tolist() == [-25, 25]
    assert list(found) == ["z_um", *scores(measured, true).index]
    assert found["n_true"].tolist() == [2, 2]
    assert found["n_measured"].tolist() == [1, 3]  # by measured depth; 50 is in the last bin
    assert found["n_matched"].tolist() == [2, 1]
    assert found["recall"].tolist() == [1, 0.5]
    np.testing.assert_allclose(found["sigma_z_um"], [np.sqrt((4 + 9) / 2), 0])
    np.testing.assert_allclose(found["bias_z_um"], [2.5, 0])
    np.testing.assert_allclose(found["sigma_x_px"], [0, 0.5])


def test_precision_by_z_is_a_fraction():
    """A particle that is measured in the next bin does not push a precision above 1."""
    true = table([10, 30], [10, 30], [-1, -20])
    found = scores_by_z(table([10, 30], [10, 30], [1, -20]), true, [-50, 0, 50])
    assert found["precision"].tolist() == [1, 1]


def test_empty_bins_are_nan():
    found = scores_by_z(ONE, ONE, [-10, 10, 20])
    assert found["n_true"].tolist() == [1, 0]
    assert np.isnan(found.loc[1, ["recall", "precision", "sigma_z_um"]].to_numpy(float)).all()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"measured": ONE.drop(columns="z_um")}, ValueError, r"^measured: "),
        ({"true": ONE.drop(columns="x_px")}, ValueError, r"^true: "),
        ({"measured": pd.concat([ONE, ONE])}, ValueError, "^measured: "),
        ({"true": pd.concat([ONE, ONE])}, ValueError, "^true: "),
        ({"true": ONE.assign(frame=0)}, ValueError, "^measured, true: "),
        ({"within_px": 0}, ValueError, "^within_px: "),
        ({"within_um": -1}, ValueError, "^within_um: "),
        ({"within_um": "1"}, TypeError, "^within_um: "),
        ({"within": 1}, TypeError, "within"),
    ],
)
def test_refuses(changes, error, message):
    for function in (match, scores):
        with pytest.raises(error, match=message):
            function(**({"measured": ONE, "true": ONE} | changes))


@pytest.mark.parametrize("edges", [[1], [1, 1], [2, 1], [0, np.nan], [[0, 1]]])
def test_refuses_edges(edges):
    with pytest.raises(ValueError, match=r"^edges_um: "):
        scores_by_z(ONE, ONE, edges)


# -------------------- standard assessment


def imitation(rng, n_frames, count=30, recall=0.8, false=3, sigma=(0.1, 0.1, 0.5)):
    """True particles in frames that are their own numbers, and a locator that measures with such errors."""
    true = pd.DataFrame(rng.uniform((0, 0, -50), (500, 300, 50), (n_frames * count, 3)), columns=NAMES)
    true["frame"] = np.repeat(np.arange(n_frames), count)

    def locator(frame):
        here = true.loc[true["frame"] == frame, NAMES]
        found = here[rng.uniform(size=len(here)) < recall]
        found = found + rng.normal(0, sigma, found.shape)
        return pd.concat([found, pd.DataFrame(rng.uniform(600, 900, (false, 3)), columns=NAMES)], ignore_index=True)

    return locator, true


NAMES = ["x_px", "y_px", "z_um"]


def test_assessment_agrees_with_the_scores():
    rng = np.random.default_rng(5)
    locator, true = imitation(rng, 12)
    tables = [locator(k).assign(frame=k) for k in range(12)]
    measured = pd.concat(tables, ignore_index=True)
    edges = np.linspace(-50, 50, 6)
    found = standard_assessment(lambda k: tables[k], range(12), true)
    expected = scores(measured, true)
    np.testing.assert_allclose(found[expected.index].iloc[0], expected)
    for name in ("recall", "precision", "sigma_x_px", "sigma_y_px", "sigma_z_um", "bias_z_um"):
        assert found[f"{name}_low"].item() < found[name].item() < found[f"{name}_high"].item()
    found = standard_assessment(lambda k: tables[k], range(12), true, edges_um=edges)
    expected = scores_by_z(measured, true, edges).set_index("z_um")
    pd.testing.assert_frame_equal(found[expected.columns], expected, check_dtype=False)


def test_assessment_intervals_hold_the_truth():
    held, rng = [], np.random.default_rng(6)
    for seed in range(60):
        locator, true = imitation(rng, 10, count=8)
        found = standard_assessment(locator, range(10), true, rng=seed).iloc[0]
        held.append([found[f"{n}_low"] <= v <= found[f"{n}_high"] for n, v in (("recall", 0.8), ("sigma_z_um", 0.5))])
    fraction = np.mean(held, axis=0)
    print(f"95 % intervals hold recall and sigma_z in {fraction} of 60")
    assert ((fraction > 0.8) & (fraction <= 1)).all()


def test_assessment_of_nothing_found():
    _, true = imitation(np.random.default_rng(7), 3)
    nothing = pd.DataFrame({name: np.zeros(0) for name in NAMES})
    found = standard_assessment(lambda frame: nothing, range(3), true, edges_um=[-50, 0, 50, 99])
    assert found["recall"].tolist()[:2] == found["recall_high"].tolist()[:2] == [0, 0]
    assert found.loc[74.5, ["recall", "recall_low", "precision", "sigma_z_um", "bias_z_um_high"]].isna().all()


def test_assessment_is_the_same_with_the_same_seed():
    locator, true = imitation(np.random.default_rng(8), 4)
    tables = [locator(k) for k in range(4)]
    one, two, other = (standard_assessment(lambda k: tables[k], range(4), true, rng=s) for s in (1, 1, 2))
    pd.testing.assert_frame_equal(one, two, check_exact=True)
    assert one["recall_low"].item() != other["recall_low"].item() or one["sigma_x_px_low"].item() != (
        other["sigma_x_px_low"].item()
    )


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"locator": 3}, TypeError, r"^locator: "),
        ({"frames": [0]}, ValueError, r"^frames: "),
        ({"true": pd.DataFrame({"x_px": [1.0], "y_px": [1.0], "z_um": [1.0]})}, ValueError, "^true: "),
        ({"confidence": 1}, ValueError, r"^confidence: "),
        ({"edges_um": [3, 2]}, ValueError, "^edges_um: "),
        ({"within_px": 0}, ValueError, "^within_px: "),
    ],
)
def test_assessment_refuses(changes, error, message):
    locator, true = imitation(np.random.default_rng(9), 2)
    arguments = {"locator": locator, "frames": range(2), "true": true} | changes
    with pytest.raises(error, match=message):
        standard_assessment(**arguments)


def test_valid_particles_match_a_true_one_of_their_own_frame():
    true = pd.DataFrame({"frame": [0, 0, 5, 10, 11], "x_px": [10.0, 50, 10, 10, 10], "y_px": 10.0, "z_um": 0.0})
    measured = true.assign(z_um=[0.0, 30, 1, 0, 0], x_px=[11.0, 50, 10, 400, 10])
    assert count_valid(measured, true, [0, 5, 10]).tolist() == [1, 1, 0]  # frame 11 is not asked for
    assert count_valid(measured, true, [0, 5, 10], within_um=31).tolist() == [2, 1, 0]
    parts = [len(match(measured[measured.frame == k], true[true.frame == k])) for k in (0, 5, 10)]
    assert count_valid(measured, true, [0, 5, 10]).tolist() == parts


@pytest.mark.parametrize("frames", [[5, 0], [[0, 5]], [0.5, 1.0]])
def test_frames_to_count_in_must_be_increasing_whole_numbers(frames):
    one = table(1, 2, 3).assign(frame=0)
    with pytest.raises(ValueError, match="frames"):
        count_valid(one, one, frames)
