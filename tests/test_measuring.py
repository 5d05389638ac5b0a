"""From files to a folder of results, by one call and by the command line."""

import json
import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import tifffile

from gdptlab import Calibration
from gdptlab.__main__ import ROOT, main
from gdptlab.assessment import match
from gdptlab.pipeline import measure
from gdptlab.pipeline.command import BAD
from gdptlab.pipeline.tables import in_um

UM_PER_PX, RATE = 0.5, 20.0
DEPTHS = np.arange(-30, 31, 4.0)


def bead(z_um, x, y, shape):
    """An astigmatic spot: wider along x below, along y above; of a fixed amount of light."""
    rows, columns = np.indices(shape)
    wide, high = (2.0 * np.hypot(1, (z_um + s) / 14) for s in (9, -9))
    return 9000 / wide / high * np.exp(-((columns - x) ** 2) / (2 * wide**2) - (rows - y) ** 2 / (2 * high**2))


def recorded(rng, image):
    return np.clip(np.rint(100 + image + rng.normal(0, 6, image.shape)), 0, 65535).astype(np.uint16)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Scan and film of a vortex about a vertical axis, as TIFF files, and the film's truth."""
    path, rng = tmp_path_factory.mktemp("images"), np.random.default_rng(1)
    grid = np.stack(np.meshgrid(*2 * [np.arange(40, 200, 60)]), axis=-1).reshape(-1, 2)
    places, shape = grid + rng.uniform(-6, 6, grid.shape), (200, 200)
    (path / "scan").mkdir()
    for z in DEPTHS:
        image = recorded(rng, sum(bead(z, *place, shape) for place in places))
        tifffile.imwrite(path / "scan" / f"z_{z:g}um.tif", image, photometric="minisblack")
    radius, phase, z = np.array([20, 60, 60, 95, 95, 95]), np.array([0, 1, 4, 0.4, 2.4, 4.6]), [-20, -8, 0, 8, 16, 22]
    frames, true = [], []
    for k in range(16):
        angle = phase + 1.5 * k / RATE
        here = pd.DataFrame({"frame": k, "x_px": 120 + radius * np.cos(angle), "y_px": 118 + radius * np.sin(angle)})
        true.append(here.assign(z_um=z))
        frames.append(recorded(rng, sum(bead(p.z_um, p.x_px, p.y_px, (240, 240)) for p in true[-1].itertuples())))
    resolution = {"resolution": (1 / UM_PER_PX,) * 2, "metadata": {"unit": "um", "axes": "TYX"}}
    tifffile.imwrite(path / "film.tif", np.stack(frames), imagej=True, **resolution)
    pd.concat(true, ignore_index=True).to_csv(path / "true.csv", index=False)
    return path


CHOICES = {"size": 31, "method": "correlation", "frame_rate_hz": RATE, "progress": False}


@pytest.fixture(scope="module")
def measured(folder):
    return measure(folder / "scan", folder / "film.tif", folder / "out", **CHOICES)


def test_the_film_is_measured_and_linked(folder, measured):
    true = pd.read_csv(folder / "true.csv")
    pairs = match(measured.particles, true, within_um=5)
    assert len(pairs) > 0.95 * len(true) and np.sqrt((pairs["dz_um"] ** 2).mean()) < 1
    assert measured.tracks["particle"].nunique() == 6
    ends = in_um(true, UM_PER_PX)
    speed = np.hypot(measured.tracks["vx_um_s"], measured.tracks["vy_um_s"])
    radius = np.hypot(measured.tracks["x_um"] - 60, measured.tracks["y_um"] - 59)
    np.testing.assert_allclose(speed.dropna(), 1.5 * radius[speed.notna()], rtol=0.05, atol=1)
    assert ends["x_um"].max() < 120
    assert not measured.bad


def test_errors_of_correlation_are_in_the_tables(measured):
    assert {"x_std_px", "y_std_px", "z_std_um", "x_std_um"} <= set(measured.particles)
    assert {"x_std_um", "y_std_um", "vx_std_um_s"} <= set(measured.tracks)


def test_a_scan_is_calibrated_once(folder, measured, monkeypatch):
    """The second film of a scan takes the calibration, and what is said of the beads, from the cache."""
    monkeypatch.setattr("gdptlab.pipeline.beads.averaged_beads", None)
    again = measure(folder / "scan", folder / "film.tif", folder / "again", **CHOICES)
    pd.testing.assert_frame_equal(again.quality, measured.quality)
    pd.testing.assert_frame_equal(again.calibration.report.beads, measured.calibration.report.beads)
    pd.testing.assert_frame_equal(again.calibration.report.settings, measured.calibration.report.settings)
    pd.testing.assert_frame_equal(again.tracks, measured.tracks)


def test_prepared_frames_depth_factor_and_side(folder, measured, capsys):
    """A dark image, a part of the film and of the frame: the same particles, at 1.33 times the depth."""
    out = folder / "prepared"
    tifffile.imwrite(folder / "dark.tif", np.full((240, 240), 90, np.uint16), photometric="minisblack")
    arguments = ["measure", str(folder / "scan"), str(folder / "film.tif"), "--out", str(out), "--rate", str(RATE)]
    arguments += ["--size", "31", "--method", "correlation", "--indices", "1", "1.33"]
    arguments += ["--background", str(folder / "dark.tif"), "--region", "10", "0", "240", "240", "--frames", "1", "15"]
    assert main([*arguments, "--every", "2"]) in (0, BAD)
    table, before = pd.read_csv(out / "particles.csv"), measured.particles
    assert sorted(table["frame"].unique()) == list(range(1, 16, 2))
    before = before[before["frame"].isin(table["frame"])].assign(z_um=lambda t: 1.33 * t["z_um"])
    pairs = match(table, before.reset_index(drop=True), within_px=0.1, within_um=0.5)
    assert len(pairs) > 0.95 * len(before)
    note = json.loads((out / "particles.csv.json").read_text())
    assert note["depth_factor"] == 1.33 and note["settings"]["prepare"]["region"] == [10, 0, 240, 240]
    assert Calibration.load(out / "calibration.npz").depth_factor == 1.33
    tracks = pd.read_csv(out / "tracks.csv")
    radius = np.hypot(tracks["x_um"] - 60, tracks["y_um"] - 59)
    speed = np.hypot(tracks["vx_um_s"], tracks["vy_um_s"])
    np.testing.assert_allclose(speed.dropna(), 1.5 * radius[speed.notna()], rtol=0.1, atol=2)


def test_a_film_given_as_a_scan_is_refused(folder, capsys):
    with pytest.raises(SystemExit) as leaving:
        main(["measure", str(folder / "film.tif"), str(folder / "film.tif"), "--z", "0", "30", "--size", "31"])
    assert leaving.value.code == 2 and "film of particles that flow" in capsys.readouterr().err


def test_a_call_that_was_refused_leaves_the_folder_to_the_next(folder, tmp_path, capsys):
    """A film taken for the scan, then the right way round: it need not be another folder."""
    asked = ["--um-per-px", str(UM_PER_PX), "--rate", str(RATE), "--size", "31", "--out", str(tmp_path / "results")]
    with pytest.raises(SystemExit):
        main(["measure", str(folder / "film.tif"), str(folder / "film.tif"), "--z", "-30", "30", *asked])
    assert main(["measure", str(folder / "scan"), str(folder / "film.tif"), "--method", "correlation", *asked]) == 0
    assert str(tmp_path / "results" / "field.vtr") in capsys.readouterr().out


def test_depths_that_are_missing_are_asked_for_by_their_name(folder):
    with pytest.raises(ValueError, match=r"^z_um: got none"):
        measure(folder / "film.tif", folder / "film.tif", um_per_px=UM_PER_PX)


@pytest.mark.parametrize(
    ("paths", "name"),
    [({"frames_path": "film.tif"}, "scan_path"), ({"frames_path": "film.tif", "scan_path": "scan"}, "um_per_px")],
)
def test_notebook_13_takes_nothing_of_the_example_for_yours(folder, tmp_path, paths, name):
    """A film without a scan, and files that do not note the size of a pixel."""
    tifffile.imwrite(tmp_path / "film.tif", tifffile.imread(folder / "film.tif"), photometric="minisblack")
    (tmp_path / "scan").symlink_to(folder / "scan")
    cells = json.loads((ROOT / "notebooks" / "13-your-own-images.ipynb").read_text(encoding="utf-8"))["cells"]
    knobs, opens = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"][:2]
    names = {}
    exec(knobs, names)
    names |= {key: str(tmp_path / value) for key, value in paths.items()}
    with pytest.raises(ValueError, match=f"^{name}"):
        exec(opens, names)


def test_what_is_in_the_folder(folder, measured):
    names = {path.name for path in measured.folder.iterdir()}
    assert names == {
        *(
            "report.html",
            "particles.csv",
            "particles.csv.json",
            "tracks.csv",
            "tracks.csv.json",
            "tracks.pvd",
            "tracks",
            "field.csv",
            "field.csv.json",
            "field.vtr",
        ),
        *("points_napari.csv", "quality.csv", "settings.csv", "calibration.npz", "frames", "log.json", "call.json"),
    }
    pd.testing.assert_frame_equal(pd.read_csv(measured.folder / "particles.csv"), measured.particles, atol=1e-9)
    log = json.loads((measured.folder / "log.json").read_text())
    assert list(log["inputs"]["frames"]) == [str(folder / "film.tif")] and len(log["inputs"]["scan"]) == len(DEPTHS)
    assert log["arguments"]["um_per_px"] == UM_PER_PX and log["versions"]["gdptlab"]
    page = (measured.folder / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2 and not re.search(r"src=.(?!data:)", page)


def test_a_second_call_goes_on_where_the_first_was_stopped(folder, measured, monkeypatch):
    times = {path: path.stat().st_mtime_ns for path in (measured.folder / "frames").glob("*.parquet")}
    monkeypatch.setattr(sys.modules["gdptlab.locate"], "_located", None)
    again = measure(folder / "scan", folder / "film.tif", folder / "out", **CHOICES)
    pd.testing.assert_frame_equal(again.tracks, measured.tracks)
    assert {path: path.stat().st_mtime_ns for path in times} == times
    with pytest.raises(ValueError, match=r"^folder: .*settings"):
        measure(folder / "scan", folder / "film.tif", folder / "out", um_per_px=0.4, **CHOICES)
    with pytest.raises(ValueError, match=r"^folder: .*inputs"):
        measure(folder / "scan", folder / "scan", folder / "out", um_per_px=0.5, **CHOICES)


def test_the_command_line(folder, measured, capsys):
    out = folder / "by_command"
    arguments = ["measure", str(folder / "scan"), str(folder / "film.tif"), "--z", "-30", "30", "--out", str(out)]
    assert main([*arguments, "--um-per-px", "0.5", "--method", "correlation", "--size", "31"]) in (0, BAD)
    said = capsys.readouterr().out
    assert "good" in said and str(out / "report.html") in said
    assert pd.read_csv(out / "settings.csv", index_col=0).loc["method", "how"] == "given"
    code = BAD if (pd.read_csv(out / "quality.csv")["verdict"] == "bad").any() else 0
    assert main(["report", str(out)]) == code
    assert "threshold" in capsys.readouterr().out
    bad = pd.read_csv(out / "quality.csv", index_col=0).assign(verdict="bad")
    bad.to_csv(out / "quality.csv")
    assert main(["report", str(out)]) == BAD


def test_images_of_8_bits_are_measured_alike(folder, measured, tmp_path):
    """Scan and film of 8 bits by the command: z within what a grey level in place of seven makes of it."""
    (tmp_path / "scan").mkdir()
    for path in sorted((folder / "scan").iterdir()):
        tifffile.imwrite(tmp_path / "scan" / path.name, eighth(tifffile.imread(path)), photometric="minisblack")
    tifffile.imwrite(tmp_path / "film.tif", eighth(tifffile.imread(folder / "film.tif")), photometric="minisblack")
    asked = ["--um-per-px", str(UM_PER_PX), "--method", "correlation", "--size", "31", "--rate", str(RATE)]
    arguments = ["measure", str(tmp_path / "scan"), str(tmp_path / "film.tif"), "--out", str(tmp_path / "out")]
    assert main([*arguments, *asked, "--window", "7"]) == 0
    true, table = pd.read_csv(folder / "true.csv"), pd.read_csv(tmp_path / "out" / "particles.csv")
    pairs = match(table, true, within_um=5)
    assert len(pairs) > 0.95 * len(true) and np.sqrt((pairs["dz_um"] ** 2).mean()) < 1
    tracks = [pd.read_csv(tmp_path / "out" / "tracks.csv"), measured.tracks]
    assert tracks[0]["particle"].nunique() == 6
    std = [part["vx_std_um_s"].median() for part in tracks]
    assert std[0] < 0.8 * std[1]  # in a shorter window less of a circle is taken for a parabola
    assert json.loads((tmp_path / "out" / "log.json").read_text())["arguments"]["window"] == 7


def eighth(images):
    """Images of 8 bits; the brightest of their pixels are 2400 above the background of 100."""
    return np.clip(np.rint(images / 10), 0, 255).astype(np.uint8)


def test_results_lie_beside_the_film_unless_told(folder):
    (folder / "here").mkdir()
    (folder / "here" / "a.b.tif").write_bytes((folder / "film.tif").read_bytes())
    with pytest.raises(ValueError, match=r"^(threshold|method)"):
        measure(folder / "scan", folder / "here" / "a.b.tif", method="guess", progress=False)
    assert (folder / "here" / "a_gdptlab" / "call.json").exists()


@pytest.mark.parametrize(
    ("changes", "error", "name"),
    [
        ({"scan": "absent.tif"}, FileNotFoundError, "path"),
        ({"frames": "absent.tif"}, FileNotFoundError, "path"),
        ({"z_um": (1, 1)}, ValueError, "z_um"),
        ({"z_um": 3}, TypeError, "z_um"),
        ({"um_per_px": 0}, ValueError, "um_per_px"),
        ({"frame_rate_hz": -1}, ValueError, "frame_rate_hz"),
        ({"folder": "absent/out"}, FileNotFoundError, "folder"),
        ({"folder": "scan"}, ValueError, "folder"),
        ({"folder": "film.tif"}, ValueError, "folder"),
        ({"colour": "red"}, TypeError, "choices"),
        ({"cells": 3}, TypeError, "cells"),
        ({"window": 8, "frame_rate_hz": RATE}, ValueError, "window"),
        ({"prepare": "dark"}, TypeError, "prepare"),
    ],
)
def test_bad_arguments(folder, monkeypatch, changes, error, name):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    with pytest.raises(error, match=f"^{name}: "):
        measure(**{"scan": "scan", "frames": "film.tif", "folder": "new", "progress": False} | changes)
    assert [path for path in sorted(folder.rglob("*")) if path.name != "new"] == before


def test_the_size_of_a_pixel_is_never_guessed(folder, tmp_path):
    film = tifffile.imread(folder / "film.tif")
    tifffile.imwrite(tmp_path / "film.tif", film, photometric="minisblack")
    with pytest.raises(ValueError, match=r"^um_per_px: "):
        measure(folder / "scan", tmp_path / "film.tif", progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["film.tif"]


def test_help_and_errors_of_the_command(capsys):
    for arguments, code in (
        (["measure", "--help"], 0),
        (["--help"], 0),
        (["measure", "a"], 2),
        (["report", "absent"], 2),
    ):
        with pytest.raises(SystemExit) as leaving:
            main(arguments)
        assert leaving.value.code == code
    assert "µm" in capsys.readouterr().out


def test_the_command_is_installed_under_its_name():
    found = subprocess.run([sys.executable, "-m", "gdptlab", "run", "--list", "02"], capture_output=True, text=True)
    assert found.stdout.strip() == "02-calibration-map" and found.returncode == 0
