"""Frames made ready to be measured, and tables brought back to the film."""

import pickle

import numpy as np
import pandas as pd
import pytest
import tifffile

from gdptlab import Calibration, Preparation, batch
from gdptlab.pipeline import batch_to_parquet, choose_settings, mean_image, open_images
from gdptlab.preparation import Prepared

Z_UM = np.linspace(-20, 20, 11)
PLACES = np.array([[40.2, 41.7], [120.6, 50.1], [60.4, 118.3], [125.0, 122.8]])


def spot(z_um, x, y, shape):
    """An astigmatic spot."""
    rows, columns = np.indices(shape)
    wide, high = (2 * np.hypot(1, (z_um + s) / 14) for s in (9, -9))
    return 4000 / wide / high * np.exp(-((columns - x) ** 2) / (2 * wide**2) - (rows - y) ** 2 / (2 * high**2))


CALIBRATION = Calibration.from_stack(
    np.stack([spot(z, 15, 15, (31, 31)) for z in Z_UM]) + np.random.default_rng(0).normal(0, 2, (11, 31, 31)), Z_UM
)


@pytest.fixture(scope="module")
def lamp():
    """Uneven light (rows, columns), 1 on average, and steep where particles are."""
    y, x = np.indices((160, 170))
    light = 1 + 0.6 * np.sin(x / 4) * np.sin(y / 5)
    return light / light.mean()


@pytest.fixture(scope="module")
def film(lamp):
    """Eight frames of four particles that move right, and one that rests, under the lamp, on dark pixels of 50."""
    rng, frames = np.random.default_rng(1), []
    for k in range(8):
        image = 500 + sum(spot(4 * i - 6, x + 3 * k, y, lamp.shape) for i, (x, y) in enumerate(PLACES))
        frames.append(50 + lamp * (image + spot(0, 90, 85, lamp.shape)) + rng.normal(0, 2, lamp.shape))
    return np.rint(frames).astype(np.uint16)


def true(k):
    return pd.DataFrame({"x_px": PLACES[:, 0] + 3 * k, "y_px": PLACES[:, 1], "z_um": 4.0 * np.arange(4) - 6})


def errors(table, k=0):
    """Differences from the truth in frame k, particle by particle, µm."""
    here, truth = table[table["frame"] == k], true(k)
    near = [(np.hypot(here["x_px"] - t.x_px, here["y_px"] - t.y_px)).idxmin() for t in truth.itertuples()]
    assert np.abs(here.loc[near, "x_px"].to_numpy() - truth["x_px"].to_numpy()).max() < 0.5
    return here.loc[near, "z_um"].to_numpy() - truth["z_um"].to_numpy()


def test_dark_and_flat_images_take_the_lamp_away(film, lamp) -> None:
    exact = Preparation(dark=np.full(lamp.shape, 50.0), flat=50 + 2000 * lamp)
    assert np.abs(errors(batch(film[:1], CALIBRATION, prepare=exact, progress=False))).max() < 0.3
    np.testing.assert_allclose(np.asarray(exact(film[:1]))[0, :10, -10:], 500, atol=40)


def test_what_rests_goes_with_the_background(film) -> None:
    for background in ("median", "minimum", np.median(film, axis=0)):
        table = batch(film, CALIBRATION, prepare=Preparation(background=background), progress=False)
        assert np.hypot(table["x_px"] - 90, table["y_px"] - 85).min() > 10
        assert len(table[table["frame"] == 0]) >= 4


def test_the_table_is_in_the_pixels_and_frames_of_the_film(film, lamp) -> None:
    both = {"dark": np.full(lamp.shape, 50.0), "flat": 50 + 2000 * lamp}
    plain = batch(film, CALIBRATION, prepare=Preparation(**both), progress=False)
    part = Preparation(**both, region=(70, 20, 170, 160), first=1, last=6, every=2)
    table = batch(film, CALIBRATION, prepare=part, progress=False)
    assert sorted(table["frame"].unique()) == [1, 3, 5]
    for row in table.itertuples():
        same = plain[plain["frame"] == row.frame]
        off = np.hypot(same["x_px"] - row.x_px, same["y_px"] - row.y_px)
        assert off.min() < 0.01 and abs(same.loc[off.idxmin(), "z_um"] - row.z_um) < 0.05


def test_a_mask_leaves_particles_out(film, lamp) -> None:
    mask = np.ones(lamp.shape, dtype=bool)
    mask[:, 80:] = False
    table = batch(film[:2], CALIBRATION, prepare=Preparation(mask=mask), progress=False)
    assert len(table) and table["x_px"].max() < 80


def test_a_film_is_read_when_it_is_asked_for(film, tmp_path, lamp) -> None:
    """From files, in parts, in other processes, and into Parquet: always the same."""
    tifffile.imwrite(tmp_path / "film.tif", film, photometric="minisblack")
    tifffile.imwrite(tmp_path / "flat.tif", np.stack([50 + 2000 * lamp] * 2).astype(np.float32))
    prepare = Preparation(dark=np.full(lamp.shape, 50.0), flat=mean_image(tmp_path / "flat.tif"), every=3)
    frames = prepare(open_images(tmp_path / "film.tif"))
    assert isinstance(frames, Prepared) and frames.shape == (3, 160, 170)
    np.testing.assert_array_equal(np.asarray(frames), np.asarray(prepare(film)))
    np.testing.assert_array_equal(np.asarray(frames)[1:], np.asarray(pickle.loads(pickle.dumps(frames[1:]))))
    np.testing.assert_array_equal(frames[2], prepare(list(film))[-1])
    assert len(pickle.dumps(prepare(film)[:1])) < film.nbytes
    table = batch(open_images(tmp_path / "film.tif"), CALIBRATION, prepare=prepare, progress=False)
    folder = batch_to_parquet(tmp_path / "film.tif", CALIBRATION, tmp_path / "t", prepare=prepare, progress=False)
    pd.testing.assert_frame_equal(pd.read_parquet(folder), table)
    with pytest.raises(ValueError, match=r"^folder: .*prepared"):
        other = Preparation(dark=prepare.dark, flat=prepare.flat, every=4)
        batch_to_parquet(tmp_path / "film.tif", CALIBRATION, tmp_path / "t", prepare=other, progress=False)
    assert choose_settings(frames, CALIBRATION, method="correlation").arguments["method"] == "correlation"


def test_the_calibration_remembers_the_camera(lamp, film, tmp_path) -> None:
    rng, shape = np.random.default_rng(2), lamp.shape
    scan = [50 + lamp * (500 + sum(spot(z, *place, shape) for place in PLACES)) for z in Z_UM]
    scan = np.rint(scan + rng.normal(0, 2, (len(Z_UM), *shape)))
    prepare = Preparation(dark=np.full(shape, 50.0), flat=50 + 2000 * lamp, region=(0, 0, 20, 20))
    made = Calibration.from_scan(scan, Z_UM, size=31, prepare=prepare)
    assert made.camera.region is None
    made.save(tmp_path / "a.npz")
    read = Calibration.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.camera.flat, prepare.flat)
    table = batch(film[:1], read, progress=False)  # nothing said: corrected as the scan was
    assert np.abs(errors(table)).max() < 0.4
    same = batch(film[:1], read, prepare=Preparation(region=(0, 0, 170, 160)), progress=False)
    pd.testing.assert_frame_equal(same, table)
    pd.testing.assert_frame_equal(batch(read.camera(film[:1]), read, progress=False), table)


@pytest.mark.parametrize(
    ("changes", "error", "name"),
    [
        ({"dark": np.zeros((3, 4)), "flat": np.ones((4, 3))}, ValueError, "dark and flat"),
        ({"dark": np.ones((3, 4)), "flat": np.ones((3, 4))}, ValueError, "flat"),
        ({"flat": np.zeros((3, 4))}, ValueError, "flat"),
        ({"dark": "a.tif"}, TypeError, "dark"),
        ({"dark": np.full((3, 4), np.nan)}, ValueError, "dark"),
        ({"background": "mean"}, ValueError, "background"),
        ({"mask": np.zeros((3, 4), dtype=bool)}, ValueError, "mask"),
        ({"region": (0, 0, 5)}, TypeError, "region"),
        ({"region": (5, 0, 5, 9)}, ValueError, "region"),
        ({"region": (0, 0, 5, 9), "dark": np.zeros((3, 4))}, ValueError, "region"),
        ({"first": -1}, ValueError, "first"),
        ({"first": 5, "last": 4}, ValueError, "last"),
        ({"every": 0}, ValueError, "every"),
        ({"every": 1.5}, TypeError, "every"),
    ],
)
def test_refuses(changes, error, name) -> None:
    with pytest.raises(error, match=rf"^{name}: "):
        Preparation(**changes)


@pytest.mark.parametrize(
    ("changes", "frames", "error", "name"),
    [
        ({}, iter([]), TypeError, "frames"),
        ({"first": 3}, np.zeros((3, 8, 9)), ValueError, "frames"),
        ({"dark": np.zeros((9, 9))}, np.zeros((3, 8, 9)), ValueError, "frames"),
        ({"region": (0, 0, 9, 9)}, np.zeros((3, 8, 9)), ValueError, "region"),
        ({"background": "median"}, [np.zeros((8, 9)), np.zeros((9, 8))], ValueError, "frames"),
    ],
)
def test_refuses_films(changes, frames, error, name) -> None:
    with pytest.raises(error, match=rf"^{name}: "):
        Preparation(**changes)(frames)


def test_frames_are_prepared_once() -> None:
    frames = Preparation()(np.zeros((2, 40, 40)))
    with pytest.raises(ValueError, match=r"^prepare: "):
        batch(frames, CALIBRATION, prepare=Preparation(), progress=False)
