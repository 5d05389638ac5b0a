"""Whether optics that changed since the scan are seen in a film, and are in its error bars; and nothing else is."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import table

from gdptlab import Calibration, match
from gdptlab.fit import mismatch_error_um, pattern_mismatch
from gdptlab.fit.frames import explained
from gdptlab.pipeline import report

SEEDS = (11, 12, 13, 14, 15)


def film(microscope, seed, particles=105):
    """Two frames of 400 px, and the true positions in each."""
    rng = np.random.default_rng(seed)
    truth = [table(*rng.uniform((0, 0, -50), (399, 399, 50), (particles, 3)).T) for _ in range(2)]
    return [microscope.render(each, (400, 400), rng=rng) for each in truth], truth


@pytest.fixture(scope="module")
def stronger(microscope):
    """2 % more magnification."""
    return replace(microscope, magnification=1.02 * microscope.magnification)


@pytest.fixture(scope="module")
def weaker_lens(microscope):
    """A cylindrical lens whose focal length is 5 % longer."""
    return replace(microscope, cylinder_um=1.05 * microscope.cylinder_um)


@pytest.mark.parametrize("seed", SEEDS)
def test_unchanged_optics_are_not_flagged(microscope, calibration, seed):
    mismatch = pattern_mismatch(film(microscope, seed)[0], calibration)
    assert mismatch["n"].sum() >= 180 and mismatch_error_um(mismatch) == 0
    assert (mismatch["mismatch"] < 2 * mismatch["own"]).all()


@pytest.mark.parametrize("changed", ["stronger", "weaker_lens"])
@pytest.mark.parametrize("seed", SEEDS)
def test_changed_optics_are_flagged(request, calibration, changed, seed):
    frames, truth = film(request.getfixturevalue(changed), seed)
    error_um = mismatch_error_um(pattern_mismatch(frames, calibration))
    assert 0.3 < error_um < 1.5
    if seed == SEEDS[0]:
        made = calibration, calibration.with_depth_error(error_um)
        plain, carried = (ratio(frames[:1], truth[:1], each) for each in made)
        assert plain > 2 and carried < 1.6


def ratio(frames, truth, calibration):
    """Robust standard deviation of the error of z over the stated."""
    errors = []
    for frame, true in zip(frames, truth, strict=True):
        found = explained(frame, calibration)[0]
        pairs = match(found, true)
        errors.append(pairs["dz_um"].to_numpy() / found["z_std_um"].to_numpy()[pairs["measured"]])
    return 1.4826 * np.median(np.abs(np.concatenate(errors)))


def mismatch_of(significance):
    return pd.DataFrame(
        {"n": 50, "mismatch": 0.02, "own": 0.01, "significance": significance, "z_error_um": [1.0, 7.0, np.nan]}
    )


def test_the_error_is_the_rms_where_it_is_known_and_certain():
    assert mismatch_error_um(mismatch_of([3.0, 1.0, np.nan])) == pytest.approx(5)
    assert mismatch_error_um(mismatch_of([2.0, 1.0, np.nan])) == 0


def test_the_report_has_a_row_for_it(calibration):
    sure, unsure = (report(calibration, mismatch_of([s, 1.0, np.nan])).loc["the film's images"] for s in (3.0, 0.0))
    assert sure["verdict"] == "look" and "5 µm" in sure["finding"]
    assert unsure["verdict"] == "good" and "focus" in unsure["finding"]


def test_an_error_of_depth_is_added_saved_and_loaded(calibration, tmp_path):
    carried = calibration.with_depth_error(0.7)
    carried.save(tmp_path / "calibration.npz")
    expected = np.hypot(calibration.model.own_error, (0, 0, 0.7))
    for each in (carried, Calibration.load(tmp_path / "calibration.npz")):
        np.testing.assert_allclose(each.model.own_error, expected)
        np.testing.assert_array_equal(each.model.patterns, calibration.model.patterns)


def test_few_particles_tell_nothing(calibration, microscope):
    mismatch = pattern_mismatch(film(microscope, 1, particles=3)[0], calibration)
    assert mismatch["mismatch"].isna().all() and mismatch_error_um(mismatch) == 0
    assert "too few" in report(calibration, mismatch).loc["the film's images", "finding"]


@pytest.mark.parametrize("bad", [None, 3, "film"])
def test_bad_frames(calibration, bad):
    with pytest.raises((TypeError, ValueError), match="frames"):
        pattern_mismatch(bad, calibration)


def test_bad_errors(calibration):
    with pytest.raises(ValueError, match="std_um"):
        calibration.with_depth_error(-1.0)
    with pytest.raises(ValueError, match="mismatch"):
        mismatch_error_um(mismatch_of([3.0, 3.0, 3.0]).assign(z_error_um=1e308))
    with pytest.raises((TypeError, ValueError), match="mismatch"):
        mismatch_error_um(pd.DataFrame({"n": [1]}))
