"""A long film's table on disk: nothing lost, nothing doubled, whatever stops the run."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import warnings

import numpy as np
import pandas as pd
import pytest
import tifffile
from conftest import THOROUGH, table
from joblib import parallel_config

from gdptlab import Calibration, batch
from gdptlab.pipeline.images import open_images
from gdptlab.pipeline.stream import NOTE, PARTS, batch_to_parquet

SETTINGS = {"correlation": {"refine": False}, "joint": {"method": "joint"}}


@pytest.fixture(scope="module")
def made(microscope):
    """A small calibration, of which 100 frames take a second."""
    z_um = np.linspace(-20, 20, 11)
    return Calibration.from_stack(microscope.stack(z_um, 21, rng=1), z_um, n_sub=5)


@pytest.fixture(scope="module")
def film(microscope):
    """130 frames of two particles that move; in some there is none."""
    x = np.linspace(30, 90, 130)
    pairs = [table([x[k], 120 - x[k]], [40, 63], [-6, 0.2 * (k % 50)]) for k in range(130)]
    return np.stack([microscope.render(pair.iloc[: k % 3], (80, 120), rng=k) for k, pair in enumerate(pairs)])


@pytest.fixture(scope="module")
def expected(film, made):
    return {method: batch(film, made, progress=False, **settings) for method, settings in SETTINGS.items()}


def streamed(frames, made, folder, **settings):
    assert batch_to_parquet(frames, made, folder, **{"progress": False} | settings) == folder
    return pd.read_parquet(folder)


def assert_same(one, other):
    pd.testing.assert_frame_equal(one, other, check_exact=True)


class Stopped(BaseException):
    """As a user's Ctrl-C."""


class Stopping(list):
    """A film in which something happens at one frame."""

    def __iter__(self):
        for k, frame in enumerate(super().__iter__()):
            if k == 70:
                raise Stopped
            yield frame


@pytest.mark.parametrize("method", SETTINGS)
@pytest.mark.parametrize("kind", ["array", "list", "file", "map"])
def test_same_as_batch(film, made, expected, tmp_path, method, kind):
    np.save(tmp_path / "film.npy", film)
    tifffile.imwrite(tmp_path / "film.tif", film, compression="zlib", photometric="minisblack")
    frames = {
        "array": film,
        "list": list(film),
        "file": str(tmp_path / "film.tif"),
        "map": np.load(tmp_path / "film.npy", mmap_mode="r"),
    }[kind]
    assert_same(streamed(frames, made, tmp_path / "out", **SETTINGS[method]), expected[method])
    assert len(expected[method]) > 50


def test_parts_and_note(film, made, expected, tmp_path):
    streamed(film, made, tmp_path / "out", refine=False)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names[:2] == ["000000000-000000024.parquet", "000000025-000000049.parquet"]
    assert names[5:] == ["000000125-000000129.parquet", NOTE, PARTS]
    note = json.loads((tmp_path / "out" / NOTE).read_text())
    assert note["frames"] == 130 and note["settings"]["refine"] is False and note["settings"]["threshold"] == 0.5
    read = pd.read_parquet(tmp_path / "out", filters=[("frame", ">=", 70)])
    assert_same(read, expected["correlation"].query("frame >= 70").reset_index(drop=True))


@pytest.mark.parametrize("method", SETTINGS)
def test_stopped_and_taken_up_again(film, made, expected, tmp_path, method):
    """In joint blocks a frame begins where the last one ended: a part must not depend on the parts before."""
    with pytest.raises(Stopped):
        streamed(Stopping(film), made, tmp_path / "out", **SETTINGS[method])
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.parquet")}
    assert len(before) == 2
    part = pd.read_parquet(tmp_path / "out")
    assert_same(part, expected[method][expected[method]["frame"] < 50])
    (tmp_path / "out" / "000000000-000000024.parquet").unlink()
    (tmp_path / "out" / ".000000050-000000074-0123.part.parquet").write_text("half of it")  # left by a kill
    assert_same(streamed(film, made, tmp_path / "out", **SETTINGS[method]), expected[method])
    kept = "000000025-000000049.parquet"
    assert (tmp_path / "out" / kept).stat().st_mtime_ns == before[kept]


def test_nothing_is_measured_twice(film, made, expected, tmp_path, monkeypatch):
    streamed(film, made, tmp_path / "out", refine=False)
    monkeypatch.setattr(sys.modules["gdptlab.locate"], "_located", None)
    assert_same(streamed(film, made, tmp_path / "out", refine=False, threshold=0.5), expected["correlation"])


def test_progress_counts_what_is_there(film, made, tmp_path, capsys):
    with pytest.raises(Stopped):
        streamed(Stopping(film), made, tmp_path / "out", refine=False)
    streamed(film, made, tmp_path / "out", refine=False, progress=True)
    assert "130/130" in capsys.readouterr().err


def test_a_damaged_frame_stops_it_until_mended(film, made, expected, tmp_path):
    (tmp_path / "film").mkdir()
    for k, frame in enumerate(film):
        tifffile.imwrite(tmp_path / "film" / f"{k}.tif", frame, photometric="minisblack")
    good = (tmp_path / "film" / "60.tif").read_bytes()
    (tmp_path / "film" / "60.tif").write_bytes(good[:500])
    with pytest.raises(ValueError, match=r"^path: got '60.tif'"):
        streamed(tmp_path / "film", made, tmp_path / "out", refine=False)
    (tmp_path / "film" / "60.tif").write_bytes(good)
    assert_same(streamed(tmp_path / "film", made, tmp_path / "out", refine=False), expected["correlation"])


def test_films_that_begin_alike_are_told_apart(film, made, tmp_path):
    """Both begin with a blank frame, as films do that are started before the light is on."""
    one, other = film.copy(), film.copy()
    one[0] = other[0] = 0
    other[20:] = film[20:, ::-1]
    streamed(one, made, tmp_path / "out", refine=False)
    with pytest.raises(ValueError, match=r"^folder: .*film\b"):
        streamed(other, made, tmp_path / "out", refine=False)


@pytest.mark.parametrize("damage", ["cut", "empty", "not listed", "half a line"])
def test_a_part_that_is_not_whole_is_measured_again(film, made, expected, tmp_path, damage):
    folder = tmp_path / "out"
    streamed(film, made, folder, refine=False)
    part = folder / "000000050-000000074.parquet"
    if damage in ("cut", "empty"):
        part.write_bytes(part.read_bytes()[: 200 if damage == "cut" else 0])
    elif damage == "not listed":
        lines = (folder / PARTS).read_text().splitlines(keepends=True)
        (folder / PARTS).write_text("".join(line for line in lines if not line.startswith("50,")))
        part.write_bytes(b"PAR1")
    else:
        (folder / PARTS).write_text((folder / PARTS).read_text()[:-3])
        (folder / "000000125-000000129.parquet").write_bytes(b"PAR1")
    assert_same(streamed(film, made, folder, refine=False), expected["correlation"])


# -------------------- what is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"threshold": 0.6}, "settings .*0.5.*0.6"),
        ({"method": "joint"}, "settings .*correlation.*joint"),
        ({"frames": 129}, r"frames\b"),
        ({"frames": "other"}, r"film\b"),
        ({"calibration": "other"}, r"calibration\b"),
        ({"version": "gdptlab"}, r"gdptlab 0\.0\.1"),
        ({"version": "numba"}, r"numba 0\.0\.1"),
        ({"sources": "other"}, r"sources\b"),
        ({"note": "{"}, "_about.json"),
        ({"note": "[]"}, "_about.json"),
        ({"note": None}, "holds"),
    ],
)
def test_other_runs_are_refused(film, made, tmp_path, changes, message):
    folder = tmp_path / "out"
    streamed(film, made, folder)
    before = sorted(folder.iterdir())
    frames = {129: film[:129], "other": film[::-1]}.get(changes.pop("frames", None), film)
    if changes.pop("calibration", None):
        made = Calibration.from_stack(made.stack, made.z_um, n_sub=6)
    if {"version", "sources"} & set(changes):
        note = json.loads((folder / NOTE).read_text())
        note["versions"] |= {changes.pop("version", "gdptlab"): "0.0.1"} if "version" in changes else {}
        note |= {"sources": changes.pop("sources")} if "sources" in changes else {}
        (folder / NOTE).write_text(json.dumps(note))
    if "note" in changes:
        note = changes.pop("note")
        (folder / NOTE).write_text(note) if note else (folder / NOTE).unlink()
    with pytest.raises(ValueError, match=f"^folder: .*{message}"):
        streamed(frames, made, folder, **changes)
    assert set(folder.iterdir()) <= set(before)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"frames": []}, ValueError, r"^frames: "),
        ({"frames": None}, TypeError, r"^frames: "),
        ({"frames": iter([])}, TypeError, r"^frames: "),
        ({"frames": {"a": 1}}, TypeError, r"^frames: "),
        ({"frames": np.zeros((3, 80, 90, 3))}, ValueError, r"^frames: "),
        ({"frames": "absent.tif"}, FileNotFoundError, "absent.tif"),
        ({"folder": 3}, TypeError, r"^folder: "),
        ({"folder": "absent/out"}, FileNotFoundError, r"^folder: "),
        ({"folder": "file"}, ValueError, r"^folder: "),
        ({"calibration": 3}, TypeError, r"^calibration: "),
        ({"threshold": 2}, ValueError, r"^threshold: "),
        ({"n_jobs": 0}, ValueError, r"^n_jobs: "),
    ],
)
def test_bad_arguments(film, made, tmp_path, monkeypatch, changes, error, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(error, match=message):
        batch_to_parquet(**{"frames": film, "calibration": made, "folder": "out", "progress": False} | changes)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# -------------------- killed

RUN = """
import sys
import numpy as np
from gdptlab import Calibration
from gdptlab.pipeline.stream import batch_to_parquet
film, made, folder, method, n_jobs = sys.argv[1:]
settings = {"method": "joint"} if method == "joint" else {"refine": False}
batch_to_parquet(film, Calibration.load(made), folder, n_jobs=int(n_jobs), progress=False, **settings)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no groups of processes to kill")
@pytest.mark.parametrize(
    ("method", "n_jobs", "kills", "repeats"),
    [("correlation", 2, round(90 * THOROUGH), 5 + round(120 * THOROUGH)), ("joint", 1, 10, 10)]
    if THOROUGH
    else [("correlation", 1, 2, 6)],
)
def test_killed_at_random(film, made, tmp_path, method, n_jobs, kills, repeats):
    """By kill -9, wherever it is, with the processes it has started."""
    frames = np.concatenate([film] * repeats)
    tifffile.imwrite(tmp_path / "film.tif", frames, photometric="minisblack")
    made.save(tmp_path / "made.npz")
    command = [sys.executable, "-c", RUN, *(str(tmp_path / n) for n in ("film.tif", "made.npz", "out"))]
    command += [method, str(n_jobs)]
    rng, parts = random.Random(1), []
    for _ in range(kills):
        run = subprocess.Popen(command, start_new_session=True)
        count = parts[-1] if parts else 0
        while run.poll() is None and len(list((tmp_path / "out").glob("[0-9]*"))) <= count:
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.2))
        assert run.poll() is None, "it ended before it could be killed"
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        parts.append(len(list((tmp_path / "out").glob("[0-9]*"))))
    assert 0 < parts[0] < parts[-1]
    subprocess.run(command, check=True)
    print(f"killed with {parts} parts of {len(list((tmp_path / 'out').glob('[0-9]*')))}")
    assert_same(pd.read_parquet(tmp_path / "out"), batch(frames, made, progress=False, **SETTINGS[method]))


# -------------------- on a cluster


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster:
            with distributed.Client(cluster) as client:
                yield client


@pytest.mark.parametrize("kind", ["files", "array", "dask array"])
def test_batch_on_a_cluster(film, made, expected, tmp_path, cluster, kind):
    tifffile.imwrite(tmp_path / "film.tif", film, photometric="minisblack")
    da = pytest.importorskip("dask.array")
    frames = {
        "files": open_images(tmp_path / "film.tif"),
        "array": film,
        "dask array": da.from_array(film, chunks=(40, 80, 120)),
    }[kind]
    with parallel_config(backend="dask"):
        assert_same(batch(frames, made, progress=False, refine=False), expected["correlation"])


def test_a_worker_killed_in_mid_run(film, made, expected, tmp_path, cluster):
    repeats = 40 if THOROUGH else 4
    frames = np.concatenate([film] * repeats)
    tifffile.imwrite(tmp_path / "film.tif", frames, photometric="minisblack")
    (folder := tmp_path / "out").mkdir()
    killed = []

    def kill():
        while len(list(folder.glob("[0-9]*"))) < 6:
            time.sleep(0.005)
        killed.append(next(iter(cluster.run(os.getpid).values())))
        os.kill(killed[0], signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with parallel_config(backend="dask"):
        measured = streamed(tmp_path / "film.tif", made, folder, refine=False)
    killer.join()
    assert killed[0] not in cluster.run(os.getpid).values()
    assert_same(measured, batch(frames, made, progress=False, refine=False))
