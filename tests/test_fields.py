"""Mean fields counted by hand, mean squared displacements of a known walk, files that VTK itself reads."""

import warnings
from base64 import b64decode
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from gdptlab.tracking import (
    link,
    mean_field,
    mean_squared_displacement,
    napari_tracks,
    save_paraview_field,
    save_paraview_tracks,
    velocities,
)

TABLE = pd.DataFrame(
    {
        "particle": [0, 0, 1, 1, 2, 3, 4],
        "frame": [0, 1, 0, 1, 0, 0, 0],
        "x_um": [0.0, 1.0, 2.0, 2.5, 9.0, 10.0, 12.0],
        "y_um": [0.0, 0.0, 0.0, 0.0, 0.0, 6.0, 6.0],
        "z_um": 1.0,
        "vx_um_s": [1.0, 3.0, 6.0, 8.0, 5.0, -2.0, 7.0],
        "vy_um_s": [0.0, 0.0, 0.0, 1.0, 2.0, np.nan, 0.0],
    }
)


def test_profile_by_hand():
    found = mean_field(TABLE, {"x_um": [0, 5, 10]}, ["vx_um_s"])
    assert found["x_um"].tolist() == [2.5, 7.5]
    assert found["n"].tolist() == [4, 2] and found["n_particles"].tolist() == [2, 2]  # the upper edge is in
    assert found["vx_um_s"].tolist() == [4.5, 1.5]
    # Sums of deviations of the two particles: -5 and 5, and 3.5 and -3.5; G / (G - 1) = 2.
    np.testing.assert_allclose(found["vx_se_um_s"], [np.sqrt(2 * 50) / 4, np.sqrt(2 * 24.5) / 2])


def test_grid_of_two_axes_by_hand():
    found = mean_field(TABLE, {"x_um": [0, 5, 10], "y_um": [-3, 3, 9]})
    assert found[["x_um", "y_um"]].to_numpy().tolist() == [[2.5, 0], [2.5, 6], [7.5, 0], [7.5, 6]]
    assert found["n"].tolist() == [4, 0, 1, 0]  # where vy is NaN, the row is left out
    assert found["vy_um_s"].iloc[0] == 0.25 and found["vy_um_s"].isna().tolist() == [False, True, False, True]
    assert found["vx_se_um_s"].notna().tolist() == [True, False, False, False]
    assert len(mean_field(TABLE, {"x_um": 3, "y_um": 2, "z_um": [0, 2]})) == 6
    alone = mean_field(TABLE.drop(columns="particle"), {"x_um": [0, 5, 10]}, ["vx_um_s"])
    np.testing.assert_allclose(alone["vx_se_um_s"].iloc[0], np.std([1, 3, 6, 8], ddof=1) / 2)


def test_standard_errors_hold_for_rows_of_one_particle_that_are_off_together():
    """800 grids: 12 particles of 5 rows, with an error of 1 for the particle and of 0.5 for the row."""
    rng, over = np.random.default_rng(3), []
    for _ in range(800):
        value = np.repeat(rng.normal(0, 1, 12), 5) + rng.normal(0, 0.5, 60)
        table = pd.DataFrame({"particle": np.repeat(range(12), 5), "x_um": rng.random(60), "v": value})
        found = mean_field(table, {"x_um": [0, 1]}, ["v"])
        over.append((found["v"] / found["v_se"]).item())
    # Student's t with 11 degrees of freedom: standard deviation 1.106, known to 2.5 %.
    assert np.std(over) == pytest.approx(1.106, abs=0.09)


@pytest.mark.parametrize(
    ("change", "error", "name"),
    [
        ({"cells": {}}, TypeError, "cells"),
        ({"cells": 3}, TypeError, "cells"),
        ({"cells": {"x_um": 0}}, ValueError, "cells"),
        ({"cells": {"x_um": [1, 1]}}, ValueError, "cells"),
        ({"cells": {"x_um": [2, np.nan]}}, ValueError, "cells"),
        ({"cells": {"z_um": 3}}, ValueError, "cells"),
        ({"cells": {"w_um": 3}}, ValueError, "table"),
        ({"values": ["w"]}, ValueError, "table"),
        ({"values": []}, ValueError, "values"),
        ({"table": 3}, TypeError, "table"),
    ],
)
def test_bad_arguments_of_fields(change, error, name):
    with pytest.raises(error, match=f"^{name}"):
        mean_field(**{"table": TABLE, "cells": {"x_um": 2}} | change)


def test_displacements_of_a_random_walk():
    rng, step = np.random.default_rng(5), np.array([0.1, 0.2, 0.3])
    walk = rng.normal(0, step, (60, 80, 3)).cumsum(axis=1)
    tracks = pd.DataFrame(walk.reshape(-1, 3), columns=["x_um", "y_um", "z_um"])
    tracks = tracks.assign(particle=np.repeat(range(60), 80), frame=np.tile(range(80), 60))
    found = mean_squared_displacement(tracks, 25.0, longest=5)
    np.testing.assert_allclose(found["lag_s"], np.arange(1, 6) / 25)
    for axis, each in zip("xyz", step, strict=True):
        np.testing.assert_allclose(found[f"msd_{axis}_um2"], np.arange(1, 6) * each**2, rtol=0.1)
    in_px = tracks.rename(columns={"x_um": "x_px", "y_um": "y_px"})
    assert list(mean_squared_displacement(in_px, 25.0)) == ["lag_s", "msd_x_px2", "msd_y_px2", "msd_z_um2", "n"]
    with pytest.raises(ValueError, match=r"^tracks"):
        mean_squared_displacement(tracks[tracks["frame"] == 0], 25.0)


# -------------------- files


@pytest.fixture(scope="module")
def vtk_reader():
    """VTK's own readers, which are ParaView's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        vtk = pytest.importorskip("vtkmodules.vtkIOXML")
        numpy_support = pytest.importorskip("vtkmodules.util.numpy_support")

    def read(path, reader):
        reader = getattr(vtk, reader)()
        reader.SetFileName(str(path))
        reader.Update()
        data = reader.GetOutput()
        values, points = data.GetPointData(), data.GetNumberOfPoints()
        arrays = {
            values.GetArrayName(i): numpy_support.vtk_to_numpy(values.GetArray(i))
            for i in range(values.GetNumberOfArrays())
        }
        return np.array([data.GetPoint(i) for i in range(points)]), arrays

    return read


def test_vtk_reads_fields(tmp_path, vtk_reader):
    rng = np.random.default_rng(2)
    table = pd.DataFrame(rng.uniform(0, 10, (500, 3)), columns=["x_um", "y_um", "z_um"])
    table = table.assign(vx_um_s=table["y_um"], vy_um_s=-table["x_um"], vz_um_s=1.0)
    for axes in (["x_um"], ["y_um", "x_um"], ["z_um", "x_um", "y_um"]):
        cells = {axis: [0, 2, 5, 10][: 4 - k] for k, axis in enumerate(axes)}
        field = mean_field(table, cells)
        save_paraview_field(field, tmp_path / "field.vtr")
        points, values = vtk_reader(tmp_path / "field.vtr", "vtkXMLRectilinearGridReader")
        expected = field.reindex(columns=["x_um", "y_um", "z_um"], fill_value=0.0)
        order = np.lexsort(expected.to_numpy().T)
        np.testing.assert_allclose(points, expected.to_numpy()[order])
        np.testing.assert_allclose(values["velocity"], field[["vx_um_s", "vy_um_s", "vz_um_s"]].to_numpy()[order])
        np.testing.assert_allclose(values["n"], field["n"].to_numpy()[order])


def test_vtk_reads_tracks(tmp_path, vtk_reader):
    tracks = TABLE.assign(vz_um_s=0.5, word="a")
    save_paraview_tracks(tracks, tmp_path / "tracks.pvd", 25.0)
    points, values = vtk_reader(tmp_path / "tracks" / "000001.vtu", "vtkXMLUnstructuredGridReader")
    part = tracks[tracks["frame"] == 1]
    np.testing.assert_allclose(points, part[["x_um", "y_um", "z_um"]])
    np.testing.assert_allclose(values["particle"], part["particle"])
    np.testing.assert_allclose(values["velocity"], part[["vx_um_s", "vy_um_s", "vz_um_s"]])
    assert "word" not in values


def decoded(path):
    """Arrays of a file of VTK's, by their names, as its documentation says to read them."""
    arrays = {}
    for array in ElementTree.parse(path).iter("DataArray"):
        data = b64decode(array.text)
        assert int.from_bytes(data[:8], "little") == len(data) - 8
        values = np.frombuffer(data[8:], {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}[array.get("type")])
        arrays[array.get("Name")] = values.reshape(-1, int(array.get("NumberOfComponents", 1))).squeeze()
    return arrays


def test_files_hold_what_was_written(tmp_path):
    save_paraview_tracks(TABLE, tmp_path / "tracks.pvd")
    part, arrays = TABLE[TABLE["frame"] == 0], decoded(tmp_path / "tracks" / "000000.vtu")
    np.testing.assert_array_equal(arrays["Points"], part[["x_um", "y_um", "z_um"]])
    np.testing.assert_array_equal(arrays["velocity"][:, :2], part[["vx_um_s", "vy_um_s"]])
    assert arrays["types"].tolist() == [1] * 5 and arrays["offsets"].tolist() == [1, 2, 3, 4, 5]
    field = mean_field(TABLE, {"x_um": [0, 5, 10], "y_um": [-3, 3, 9]})
    save_paraview_field(field, tmp_path / "field.vtr")
    arrays = decoded(tmp_path / "field.vtr")
    assert arrays["x_um"].tolist() == [2.5, 7.5] and arrays["y_um"].tolist() == [0, 6]
    assert arrays["n"].tolist() == [4, 1, 0, 0]  # x is the fastest


def test_positions_in_a_channel_are_written_as_others_are(tmp_path):
    renamed = {"x_um": "x_channel_um", "y_um": "y_channel_um"}
    save_paraview_tracks(TABLE.rename(columns=renamed), tmp_path / "tracks.pvd")
    part, arrays = TABLE[TABLE["frame"] == 0], decoded(tmp_path / "tracks" / "000000.vtu")
    np.testing.assert_array_equal(arrays["Points"], part[["x_um", "y_um", "z_um"]])
    save_paraview_field(mean_field(TABLE, {"y_um": [-3, 3, 9]}).rename(columns=renamed), tmp_path / "field.vtr")
    assert decoded(tmp_path / "field.vtr")["y_channel_um"].tolist() == [0, 6]
    data, _ = napari_tracks(TABLE.rename(columns=renamed), in_um=True)
    np.testing.assert_array_equal(data, napari_tracks(TABLE, in_um=True)[0])
    with pytest.raises(ValueError, match=r"^tracks: "):
        save_paraview_tracks(TABLE.rename(columns={"x_um": "x_px", "y_um": "y_px"}), tmp_path / "px.pvd")


def test_axes_may_be_whole_numbers_or_flags(tmp_path):
    field = pd.DataFrame({"x_um": [0, 1, 0, 1], "z_um": [False, False, True, True], "n": range(4)})
    save_paraview_field(field, tmp_path / "field.vtr")
    assert decoded(tmp_path / "field.vtr")["z_um"].tolist() == [0, 1]


def test_xarray_takes_a_field():
    """As `mean_field` says."""
    pytest.importorskip("xarray")
    table = pd.DataFrame(
        {"x_um": [0.5, 1.5, 1.5, 0.5], "z_um": [5.0, 5.0, 25.0, 26.0], "vx_um_s": [1.0, 2.0, 3.0, 4.0]}
    )
    field = mean_field(table, {"x_um": [0, 1, 2], "z_um": [0, 10, 20, 30]})
    grid = field.set_index(["x_um", "z_um"]).to_xarray()
    assert dict(grid.sizes) == {"x_um": 2, "z_um": 3}
    assert grid["vx_um_s"].sel(x_um=1.5, z_um=25) == 3 and np.isnan(grid["vx_um_s"].sel(x_um=0.5, z_um=15))
    assert grid["n"].to_numpy().tolist() == [[1, 0, 1], [1, 0, 1]]


def test_series_names_its_files_and_times(tmp_path):
    save_paraview_tracks(TABLE, tmp_path / "tracks.pvd", 25.0)
    text = (tmp_path / "tracks.pvd").read_text()
    assert 'timestep="0.0"' in text and 'timestep="0.04"' in text and 'file="tracks/000001.vtu"' in text
    assert sorted(p.name for p in (tmp_path / "tracks").iterdir()) == ["000000.vtu", "000001.vtu"]


def test_meshio_reads_tracks(tmp_path):
    meshio = pytest.importorskip("meshio")
    save_paraview_tracks(TABLE, tmp_path / "tracks.pvd")
    mesh = meshio.read(tmp_path / "tracks" / "000000.vtu")
    np.testing.assert_allclose(mesh.points, TABLE[TABLE["frame"] == 0][["x_um", "y_um", "z_um"]])


def test_napari_takes_number_frame_and_place():
    data, features = napari_tracks(TABLE.sample(frac=1, random_state=1), in_um=True)
    assert data[:3].tolist() == [[0, 0, 1, 0, 0], [0, 1, 1, 0, 1], [1, 0, 1, 0, 2]]
    assert features["vx_um_s"][:3].tolist() == [1, 3, 6]
    in_px = TABLE.rename(columns={"x_um": "x_px", "y_um": "y_px"})
    assert napari_tracks(in_px)[0].shape == (7, 4)


@pytest.mark.parametrize(
    ("call", "error", "name"),
    [
        (lambda folder: save_paraview_tracks(TABLE, folder / "a.vtu"), ValueError, "path"),
        (lambda folder: save_paraview_tracks(TABLE, folder / "b" / "a.pvd"), FileNotFoundError, "path"),
        (lambda folder: save_paraview_tracks(TABLE, 3), TypeError, "path"),
        (lambda folder: save_paraview_tracks(TABLE.drop(columns="frame"), folder / "a.pvd"), ValueError, "tracks"),
        (lambda folder: save_paraview_field(TABLE, folder / "a.vtr"), ValueError, "field"),
        (lambda folder: save_paraview_field(3, folder / "a.vtr"), TypeError, "field"),
        (lambda folder: napari_tracks(TABLE), ValueError, "tracks"),
    ],
)
def test_bad_arguments_of_export(tmp_path, call, error, name):
    with pytest.raises(error, match=f"^{name}"):
        call(tmp_path)
    assert not list(tmp_path.iterdir())


def test_velocity_field_of_a_vortex():
    """From positions to a field, without a channel: the solid-body rotation comes back."""
    rng, rate, turn = np.random.default_rng(7), 60.0, 2.0  # rad/s
    radius, phase = 80 * np.sqrt(rng.random(150)), rng.uniform(0, 2 * np.pi, 150)
    frames = []
    for k in range(25):
        angle = phase + turn * k / rate
        x, y = 100 + radius * np.cos(angle), 90 + radius * np.sin(angle)
        frames.append(pd.DataFrame({"frame": k, "x_um": x, "y_um": y, "z_um": rng.normal(20 * np.cos(phase), 0.4)}))
    table = pd.concat(frames, ignore_index=True)
    table[["x_um", "y_um"]] += rng.normal(0, 0.05, (len(table), 2))
    tracks = link(table, search_range=(3.0, 3.0, 3.0), predictor="nearest velocity")
    field = mean_field(
        velocities(tracks, rate).dropna(), {"x_um": np.arange(20, 181, 20), "y_um": np.arange(10, 171, 20)}
    )
    full = field[field["n_particles"] >= 5]
    over_x = (full["vx_um_s"] + turn * (full["y_um"] - 90)) / 20 / turn  # in cells
    assert len(full) > 20 and np.abs(over_x).max() < 0.5 and np.abs(over_x).median() < 0.15
