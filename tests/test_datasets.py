"""Samples and real beads: what loads, that it can be made again, and what is said where it is absent."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, batch, datasets, locate, match
from gdptlab.experiment import IMAGE_TYPES
from gdptlab.experiment.samples import make_samples
from gdptlab.pipeline.images import open_images

# Found and RMSE of z in µm of published methods on the planar beads, by the score of `score`.
PUBLISHED = {"gdpt": (0.36, 1.66, -0.63), "defocustracker": (0.50, 1.78, -0.47), "idpt": (0.95, 0.67, 0.05)}
# Of ours, with one calibration bead: fraction found, at least, and RMSE of z in µm, at most.
FOUND, RMSE_UM = 0.6, 1.7


@pytest.mark.parametrize("image_type", IMAGE_TYPES)
def test_samples(image_type):
    sample = datasets.sample(image_type)
    assert sample.stack.shape == (51, 61, 61) and sample.frames.shape == (3, 512, 512)
    assert sample.stack.dtype == sample.frames.dtype == np.uint16
    np.testing.assert_allclose(sample.z_um, np.linspace(-50, 50, 51))
    assert list(sample.truth) == ["frame", "x_px", "y_px", "z_um"]
    assert sample.truth.groupby("frame").size().tolist() == [50, 50, 50]
    assert sample.truth[["x_px", "y_px"]].stack().between(0, 511).all()


@pytest.mark.parametrize("image_type", IMAGE_TYPES)
def test_samples_fit_their_truth(image_type):
    sample = datasets.sample(image_type)
    made = Calibration.from_stack(sample.stack, sample.z_um)
    for k in range(3):
        measured = locate(sample.frames[k], made)
        true = sample.truth[sample.truth["frame"] == k].drop(columns="frame")
        assert len(measured) >= 15
        assert len(match(measured, true)) > 0.7 * len(measured)
        # By chance, next to none would be within 0.5 px and 3 µm.
        assert len(match(measured, true, within_px=0.5, within_um=3)) > 0.45 * len(measured)


def test_unknown_sample():
    with pytest.raises(ValueError, match=r"^image_type: .*'dark'"):
        datasets.sample("dark")


def test_samples_can_be_made_again(microscope, tmp_path):
    """To a count here and there, since tracing may round differently on another machine."""
    make_samples(tmp_path)
    names = sorted(p.name for p in tmp_path.iterdir())
    here = [p.name for p in datasets.DATA.iterdir() if p.suffix in (".tif", ".csv")]
    assert names == sorted(name for name in here if not name.startswith("figure5"))  # those are no samples
    for name in names:
        if name.endswith(".csv"):
            pd.testing.assert_frame_equal(pd.read_csv(tmp_path / name), pd.read_csv(datasets.DATA / name))
        else:
            one, other = (np.asarray(open_images(folder / name), int) for folder in (tmp_path, datasets.DATA))
            assert one.shape == other.shape
            assert np.abs(one - other).max() <= 1 and (one != other).mean() < 0.01


# -------------------- real beads


def test_absent_beads_say_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setattr(datasets, "DATA", tmp_path)
    for folder in (None, str(tmp_path / "nowhere"), ""):
        if folder is None:
            monkeypatch.delenv("GDPTLAB_DATA", raising=False)
        else:
            monkeypatch.setenv("GDPTLAB_DATA", folder)
        with pytest.raises(FileNotFoundError, match=r"sean-mackenzie/idpt.*data/external/planar_beads.*GDPTLAB_DATA"):
            datasets.planar_beads()


@pytest.fixture(scope="module")
def beads():
    try:
        return datasets.planar_beads()
    except FileNotFoundError as absent:
        pytest.skip(str(absent))


def score(measured: pd.DataFrame, true: pd.DataFrame) -> tuple[float, float, float]:
    """Fraction of beads whose nearest measurement within 3 px is within 5 µm in z, RMSE and mean error of those."""
    errors = []
    for frame, part in true.groupby("frame"):
        found = measured[measured["frame"] == frame]
        for bead in part.itertuples():
            distance = np.hypot(found["x_px"] - bead.x_px, found["y_px"] - bead.y_px)
            if len(found) and distance.min() <= 3:
                errors.append(found.loc[distance.idxmin(), "z_um"] - bead.z_um)
    errors = np.array(errors)
    errors = errors[np.abs(errors) < 5]
    return len(errors) / len(true), np.sqrt((errors**2).mean()), errors.mean()


def test_beads(beads):
    assert beads.scan.shape == (106, 512, 512) and beads.frames.shape == (11, 512, 512)
    np.testing.assert_allclose(np.diff(beads.z_um), 1, atol=0.01)
    assert len(beads.truth) == 11 * 88
    assert set(beads.published) == set(PUBLISHED)


@pytest.mark.parametrize("method", PUBLISHED)
def test_published_scores(beads, method):
    found, rmse, bias = score(beads.published[method], beads.truth)
    assert (found, rmse, bias) == pytest.approx(PUBLISHED[method], abs=0.006)


def test_one_bead_measures_the_others(beads):
    """One isolated bead near the middle of the scan; of four such beads the one with the smallest error."""
    made = Calibration.from_bead(beads.scan, beads.z_um, 244, 230, size=29)
    found, rmse, bias = score(batch(beads.frames, made, progress=False), beads.truth)
    print(f"found {found:.2f}, RMSE z {rmse:.2f} um, bias {bias:.2f} um")
    assert found >= FOUND
    assert rmse <= RMSE_UM


def test_the_particles_of_known_depth_are_there_or_the_message_says_where_to_get_them(monkeypatch, tmp_path):
    try:
        labelled = datasets.defocused_particles()
    except FileNotFoundError as absent:
        assert "DefocusTrackerAI" in str(absent)
        pytest.skip(str(absent))
    assert labelled.frames.shape == (10, 1024, 1024) and labelled.frames.dtype == np.uint16
    assert (labelled.truth.groupby("frame").size() == 68).all() and labelled.truth["z_um"].between(-100, -15).all()
    monkeypatch.setenv("GDPTLAB_DATA", str(tmp_path))
    monkeypatch.setattr(datasets, "DATA", tmp_path)
    with pytest.raises(FileNotFoundError, match="GDPTLAB_DATA"):
        datasets.defocused_particles()


def test_the_astigmatic_bead_is_there_or_the_message_says_where_to_get_it(monkeypatch, tmp_path):
    try:
        bead = datasets.astigmatic_bead()
    except FileNotFoundError as absent:
        assert "python-microscopy" in str(absent)
        pytest.skip(str(absent))
    assert bead.shape == (61, 61, 61) and bead.dtype == np.float32 and bead.max() == 1
    monkeypatch.setenv("GDPTLAB_DATA", str(tmp_path))
    monkeypatch.setattr(datasets, "DATA", tmp_path)
    with pytest.raises(FileNotFoundError, match="GDPTLAB_DATA"):
        datasets.astigmatic_bead()
