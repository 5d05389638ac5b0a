"""Tables in µm, with a note of how they were made, and as points for other programs."""

import json

import numpy as np
import pandas as pd
import pytest

import gdptlab
from gdptlab import Calibration, locate
from gdptlab.pipeline.tables import fingerprint, in_um, save_points, save_table

PARTICLES = pd.DataFrame(
    {
        "frame": [0, 0, 3],
        "x_px": [0.0, 10.5, 30.0],
        "y_px": [4.0, 0.25, 7.0],
        "z_um": [-5.0, 0.0, 12.5],
        "cm": [0.9, 0.8, 0.7],
        "at_end": [False, False, True],
        "x_std_px": [0.1, 0.2, 0.3],
    },
    index=[7, 3, 5],
)


def test_in_um():
    table = in_um(PARTICLES, 6.5 / 10)
    assert list(table) == [*PARTICLES, "x_um", "y_um", "x_std_um"]
    pd.testing.assert_frame_equal(table[list(PARTICLES)], PARTICLES)
    np.testing.assert_allclose(table[["x_um", "y_um", "x_std_um"]], 0.65 * PARTICLES[["x_px", "y_px", "x_std_px"]])
    pd.testing.assert_frame_equal(in_um(table, 0.65), table)


@pytest.mark.parametrize("um_per_px", [0, -1, np.nan, np.inf, None, "0.65"])
def test_in_um_refuses(um_per_px):
    with pytest.raises((TypeError, ValueError), match=r"^um_per_px: "):
        in_um(PARTICLES, um_per_px)


def test_fingerprint(stacks, calibration, tmp_path):
    """The same for the same calibration, read from a file or made again; another for any other."""
    z_um = calibration.z_um
    calibration.save(tmp_path / "a.npz")
    same = [Calibration.load(tmp_path / "a.npz"), Calibration.from_stack(stacks["fluorescent"], z_um)]
    assert {fingerprint(each) for each in same} == {fingerprint(calibration)}
    others = [{"n_sub": 8}, {"n": 50}, {"denoise": False}]
    made = [Calibration.from_stack(stacks["fluorescent"], z_um, **settings) for settings in others]
    made += [Calibration.from_stack(stacks["fluorescent"], z_um + 1e-9), calibration]
    assert len({fingerprint(each) for each in made}) == 5


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_save_table(calibration, few, tmp_path, suffix):
    table = locate(few[0], calibration, threshold=0.6)
    path = tmp_path / f"a.{suffix}"
    save_table(table, str(path), calibration, threshold=np.float32(0.5), sample="beads")
    read = (pd.read_csv if suffix == "csv" else pd.read_parquet)(path)
    pd.testing.assert_frame_equal(read, table, check_exact=True)
    note = json.loads((tmp_path / f"a.{suffix}.json").read_text())
    assert note["settings"] == {
        "method": "correlation",
        "threshold": 0.5,
        "refine": True,
        "min_distance_px": None,
        "side": None,
        "sample": "beads",
    }
    assert note["calibration"] == fingerprint(calibration) and note["depth_factor"] == 1
    assert note["versions"] == gdptlab.versions()
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"table": [1, 2]}, TypeError, "^table: "),
        ({"path": 3}, TypeError, "^path: "),
        ({"path": "a.xlsx"}, ValueError, "^path: "),
        ({"path": "absent/a.csv"}, FileNotFoundError, "^path"),
        ({"calibration": None}, TypeError, "^calibration: "),
        ({"mask": np.ones(3)}, (TypeError, ValueError), "^settings: got .*mask"),
    ],
)
def test_save_table_refuses(calibration, tmp_path, monkeypatch, changes, error, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        save_table(**{"table": PARTICLES, "path": "a.csv", "calibration": calibration} | changes)
    assert list(tmp_path.iterdir()) == []


def test_points_for_napari(tmp_path):
    """Columns `index` and `axis-0`, ... in the order of the axes of the image; the others are features."""
    save_points(PARTICLES, tmp_path / "a.csv", "napari")
    points = pd.read_csv(tmp_path / "a.csv")
    assert list(points) == ["index", "axis-0", "axis-1", "axis-2", *PARTICLES]
    assert points["index"].tolist() == [0, 1, 2]
    np.testing.assert_array_equal(points[["axis-0", "axis-1", "axis-2"]], PARTICLES[["frame", "y_px", "x_px"]])
    np.testing.assert_array_equal(points["at_end"], [0, 0, 1])
    save_points(PARTICLES.drop(columns="frame"), tmp_path / "a.csv", "napari", um_per_px=2)
    points = pd.read_csv(tmp_path / "a.csv")[[f"axis-{i}" for i in range(4)]]
    np.testing.assert_array_equal(points, PARTICLES.assign(frame=0)[["frame", "z_um", "y_px", "x_px"]] * [1, 1, 2, 2])


def test_points_for_imagej(tmp_path):
    """There the centre of the first pixel is (0.5, 0.5), and slices count from 1."""
    for scale in (None, 0.5):
        save_points(PARTICLES, tmp_path / "a.csv", "imagej", um_per_px=scale)
        points = pd.read_csv(tmp_path / "a.csv")
        assert list(points) == [" ", "X", "Y", "Z", "Slice", "Cm"]
        assert points[" "].tolist() == [1, 2, 3]
        np.testing.assert_allclose(points["X"], (PARTICLES["x_px"] + 0.5) * (scale or 1))
        np.testing.assert_allclose(points["Y"], (PARTICLES["y_px"] + 0.5) * (scale or 1))
        np.testing.assert_allclose(points["Z"], PARTICLES["z_um"])
        assert points["Slice"].tolist() == [1, 1, 4]


@pytest.mark.parametrize("program", ["napari", "imagej"])
def test_no_points(tmp_path, program):
    save_points(PARTICLES.iloc[:0], tmp_path / "a.csv", program)
    assert len(pd.read_csv(tmp_path / "a.csv")) == 0


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"table": None}, TypeError, "^table: "),
        ({"table": PARTICLES.drop(columns="y_px")}, ValueError, r"^table: "),
        ({"path": "a.tsv"}, ValueError, "^path: "),
        ({"program": "excel"}, ValueError, "^program: "),
        ({"um_per_px": 0}, ValueError, "^um_per_px: "),
    ],
)
def test_points_refused(tmp_path, monkeypatch, changes, error, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        save_points(**{"table": PARTICLES, "path": "a.csv", "program": "napari"} | changes)
    assert list(tmp_path.iterdir()) == []
