"""The paper's method written with libraries measures what `locate` measures."""

import numpy as np
import pandas as pd
import pytest
from conftest import table

from gdptlab import locate
from gdptlab.assessment import scores
from gdptlab.experiment.plain import CORRELATE, locate_plainly

CONFIDENCE = 2.58  # standard errors of a difference: 99 % of such intervals hold the truth
SIGMAS = ["sigma_x_px", "sigma_y_px", "sigma_z_um"]


@pytest.fixture(scope="module")
def random(microscope):
    """Eight frames of 50 particles anywhere, and their table."""
    rng = np.random.default_rng(83)
    tables = [table(*rng.uniform((0, 0, -50), (511, 511, 50), (50, 3)).T).assign(frame=k) for k in range(8)]
    return [microscope.render(t, rng=rng) for t in tables], pd.concat(tables, ignore_index=True)


def both(frames, true, calibration, refine):
    """Scores of `locate` and of the plain version."""
    results = []
    for method in (locate, locate_plainly):
        tables = [method(frame, calibration, refine=refine).assign(frame=k) for k, frame in enumerate(frames)]
        results.append(scores(pd.concat(tables, ignore_index=True), true))
    result = pd.DataFrame(results, index=["locate", "plain"])
    print(result.round(3).to_string())
    return result


def fraction_error(result, name):
    """Standard error of the difference of two recalls, or two precisions."""
    count = result["n_true" if name == "recall" else "n_measured"]
    mean = result["n_matched"].sum() / count.sum()
    return np.sqrt(mean * (1 - mean) * (1 / count).sum())


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("kind", ["fluorescent", "disturbed"])
def test_both_libraries_give_the_same_table(isolated, calibrations, kind, refine):
    frame = isolated[kind][0][0][:200, :300]
    one, two = (locate_plainly(frame, calibrations[kind], correlate=name, refine=refine) for name in CORRELATE)
    assert len(one) >= 4
    pd.testing.assert_frame_equal(one, two, rtol=0, atol=2e-3)


@pytest.mark.parametrize("refine", [True, False])
def test_isolated_particles_as_locate(isolated, calibration, refine):
    frames, true = isolated["fluorescent"]
    result = both(frames[:4], true[true["frame"] < 4], calibration, refine)
    assert (result[["recall", "precision"]] == 1).all(axis=None)
    relative = np.log(result[SIGMAS]).diff().iloc[1]  # of normal errors, known to 1 / sqrt(2 n) each
    noise = CONFIDENCE / np.sqrt(result["n_matched"].min())
    assert (relative >= -noise).all()  # locate is no worse
    # and no better in x and y; in z its least squares beat the parabola through three C_m
    assert (relative[SIGMAS[:2]] <= noise).all() and relative[SIGMAS[2]] <= noise + (0.2 if refine else 0)


@pytest.mark.parametrize("refine", [True, False])
def test_overlapping_particles_no_worse_with_locate(random, calibration, refine):
    result = both(*random, calibration, refine)
    for name in ("recall", "precision"):
        assert result.at["locate", name] >= result.at["plain", name] - CONFIDENCE * fraction_error(result, name)
    assert result["recall"].between(0.4, 0.7).all() and (result["precision"] > 0.75).all()
    assert (result["sigma_z_um"] < 3.5).all()


def test_ends_of_the_stack_are_flagged(microscope, calibration):
    true = table([50, 150, 250], [60] * 3, [-54.5, -10.0, 54.5])
    measured = locate_plainly(microscope.render(true, (120, 300), rng=5), calibration).sort_values("x_px")
    assert measured["at_end"].tolist() == [True, False, True]
    assert measured["z_um"].iloc[[0, 2]].tolist() == [-50, 50]


@pytest.mark.parametrize("refine", [True, False])
def test_a_frame_without_particles(calibration, refine):
    for image in (np.zeros((70, 90)), np.random.default_rng(1).normal(100, 5, (70, 90))):
        measured = locate_plainly(image, calibration, refine=refine)
        pd.testing.assert_frame_equal(measured, locate(np.zeros((70, 90)), calibration))


def test_bad_input(few, calibration):
    with pytest.raises(ValueError, match="correlate"):
        locate_plainly(few[0], calibration, correlate="cv2")
    with pytest.raises(ValueError, match="image"):
        locate_plainly(few[0].T[:60], calibration)
    with pytest.raises(TypeError, match="calibration"):
        locate_plainly(few[0], None)
