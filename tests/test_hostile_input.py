"""Whatever comes in: a result without NaN, or an error that names the argument. Never a crash, a warning or silence.

A few tries of each function; `GDPTLAB_THOROUGH=1 pytest tests/test_hostile_input.py` makes it 2000 each.
"""

import re
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import tifffile
from conftest import THOROUGH
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from gdptlab import Calibration, Preparation, batch, locate, match
from gdptlab.assessment import scores, scores_by_z
from gdptlab.datasets import DATA
from gdptlab.pipeline.errors import with_errors
from gdptlab.pipeline.images import open_images, open_scan
from gdptlab.pipeline.quality import report
from gdptlab.pipeline.settings import choose_settings
from gdptlab.pipeline.stream import batch_to_parquet
from gdptlab.pipeline.surface import flattened
from gdptlab.pipeline.tables import in_um, save_points, save_table
from gdptlab.tracking import (
    drift,
    link,
    mean_field,
    mean_squared_displacement,
    napari_tracks,
    save_paraview_field,
    save_paraview_tracks,
    velocities,
    without_drift,
)

tried = settings(
    max_examples=round(2000 * THOROUGH) or 60,
    deadline=None,
    derandomize=not THOROUGH,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)

Z_UM = np.linspace(-3, 3, 7)


def disc(z_um, y_px=0.0, x_px=0.0, shape=(9, 9)):
    """A particle: a spot that grows along z, wider along x below and along y above."""
    y, x = np.indices(shape) - np.reshape(np.array(shape) // 2, (2, 1, 1))
    wide, high = 1 + 0.2 * (z_um - 3) ** 2 / 9, 1 + 0.2 * (z_um + 3) ** 2 / 9
    return np.exp(-(((x - x_px) / wide) ** 2) - ((y - y_px) / high) ** 2)


STACK = np.stack([disc(z) for z in Z_UM]) + np.random.default_rng(1).normal(0, 0.01, (7, 9, 9))
CALIBRATION = Calibration.from_stack(STACK, Z_UM, n_sub=3)


ANY_DIMS, ANY_SIDE = st.integers(0, 4), st.integers(0, 24)
LAYOUTS = ("plain", "read-only", "Fortran", "backwards", "strided", "map", "list")


@st.composite
def arrays(draw, dims=ANY_DIMS, side=ANY_SIDE):
    """Arrays of any shape, type, content and place in memory."""
    shape = tuple(draw(st.lists(side, min_size=(n := draw(dims)), max_size=n)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    kind = draw(st.sampled_from(["noise", "particles", "constant", "zero", "sparse", "ramp"]))
    values = {
        "noise": lambda: rng.normal(size=shape),
        "particles": lambda: particles(rng, shape),
        "constant": lambda: np.full(shape, rng.normal()),
        "zero": lambda: np.zeros(shape),
        "sparse": lambda: (rng.random(shape) < 0.02).astype(float),
        "ramp": lambda: np.arange(np.prod(shape, dtype=int), dtype=float).reshape(shape),
    }[kind]()
    values = values * draw(st.sampled_from([1, 1, 100, 1e-30, 1e-45, 1e15, 1e38, 1e300])) + draw(
        st.sampled_from([0, 0, 1, -1e3, 1e9, 1e38, -1e38])
    )
    for odd in draw(st.lists(st.sampled_from([np.nan, np.inf, -np.inf, 1e308, 3e38, -0.0]), max_size=2)):
        if np.ndim(values) and values.size:
            values.flat[rng.integers(values.size)] = odd
    values = np.asarray(values)
    dtype = draw(st.sampled_from("f8 f8 f4 f2 >f4 u1 u2 >u2 i2 i8 ? c8 O U M8[s]".split()))
    with np.errstate(all="ignore"):
        values = np.nan_to_num(values).astype("i8") if dtype == "M8[s]" else values
        array = values.astype("u8" if dtype in ("u1", "u2", ">u2") else dtype).astype(dtype)
    return placed(array, draw(st.sampled_from(LAYOUTS)))


def particles(rng, shape):
    """Images with particles here and there."""
    if len(shape) < 2:
        return rng.normal(size=shape)
    image = rng.normal(0, 0.02, shape)
    for _ in range(3):
        y, x = rng.uniform(-0.5, 0.5, 2) * shape[-2:]
        image += disc(rng.uniform(-3, 3), y, x, shape[-2:])
    return image


def placed(array, layout):
    if layout == "read-only":
        array = np.array(array)
        array.flags.writeable = False
    elif layout == "Fortran":
        array = np.asfortranarray(array)
    elif layout == "backwards" and array.ndim:
        turn = (slice(None, None, -1),) * array.ndim
        array = array[turn].copy()[turn]
    elif layout == "strided" and array.ndim:
        array = np.repeat(array, 2, axis=-1)[..., ::2]
    elif layout == "map" and array.size and not array.dtype.hasobject:
        with tempfile.TemporaryFile() as file:
            file.write(array.tobytes())
            file.flush()
            array = np.memmap(file, array.dtype, "r", shape=array.shape)
    elif layout == "list":
        array = array.tolist()
    return array


ODD = [None, np.nan, np.inf, -1, 0, 1, 2, 3, 0.5, 1e-320, 1e308, 10**30, "a", True, 1j, [], [1, 2], np.float32(0.5)]
ODD += [np.int8(3), np.array(2.0), np.array([1.0, 2.0]), {}, object, np.datetime64("NaT"), 2.5, 5, 7]
odd = st.sampled_from(ODD)
some_images = arrays(dims=st.sampled_from([2, 2, 2, 1, 3]), side=st.integers(0, 40) | st.integers(9, 40))


def some(*names):
    """A few of the arguments of these names, odd ones."""
    return st.fixed_dictionaries({}, optional=dict.fromkeys(names, odd))


def fails_by_name(call, *names):
    """What a call returns, or None if it raises an error of a promised type that begins with an argument's name."""
    try:
        return call()
    except (TypeError, ValueError, FileNotFoundError) as error:
        assert re.match(rf"({'|'.join(names)})\b", str(error)), f"{type(error).__name__}: {error}"
        return None


def assert_sound(table, frames=None):
    """Numbers in all columns, and places in the frame."""
    assert isinstance(table, pd.DataFrame)
    if "log_ratio" in table:
        only = table["log_ratio"] == np.inf
        assert (table["z_other_um"].isna() == only).all() and not table["ambiguous"][only].any()
        table = table.assign(
            log_ratio=table["log_ratio"].mask(only, 0.0), z_other_um=table["z_other_um"].mask(only, 0.0)
        )
    assert np.isfinite(table.astype(float)).all(axis=None)
    assert (table["cm"] <= 1).all() and table["z_um"].between(-3, 3).all()
    if frames is not None:
        rows, columns = np.shape(frames)[-2:]
        assert table["x_px"].between(-0.5, columns - 0.5).all() and table["y_px"].between(-0.5, rows - 0.5).all()


LOCATE = ("method", "threshold", "refine", "min_distance_px")


@tried
@given(image=some_images, given=some(*LOCATE[1:]))
def test_locate(image, given):
    found = fails_by_name(lambda: locate(image, CALIBRATION, **given), "image", *LOCATE)
    if found is not None:
        assert_sound(found, image)


@tried
@given(image=some_images)
def test_locate_jointly(image):
    found = fails_by_name(lambda: locate(image, CALIBRATION, method="joint"), "image")
    if found is not None:
        assert_sound(found, image)


@tried
@given(calibration=odd, method=odd)
def test_locate_with_odd_calibration_and_method(calibration, method):
    fails_by_name(lambda: locate(np.eye(20), calibration), "calibration")
    fails_by_name(lambda: locate(np.eye(20), CALIBRATION, method=method), "method")


@tried
@given(frames=arrays(side=st.integers(0, 30)) | st.lists(some_images, max_size=3) | odd, given=some("n_jobs", *LOCATE))
def test_batch(frames, given):
    if str(given.get("n_jobs", 1)) in "1 -1 0 nan":  # processes take seconds
        call = lambda: batch(frames, CALIBRATION, progress=False, **given)  # noqa: E731
        found = fails_by_name(call, "image", "frames", "n_jobs", *LOCATE)
        if found is not None:
            assert_sound(found)


stacks = arrays(dims=st.just(3), side=st.sampled_from([3, 5, 7, 7, 7, 9, 8, 0])) | arrays() | st.just(STACK) | odd
depths = arrays(dims=st.just(1), side=st.integers(0, 9)) | st.integers(0, 9).map(np.arange) | st.just(Z_UM) | odd


def assert_sound_calibration(made):
    assert np.isfinite(made.templates).all() and np.isfinite(made.expected).all() and np.isfinite(made.z_um).all()
    if made.size <= 9:
        assert np.isfinite(locate(STACK[3], made).astype(float)).all(axis=None)


@tried
@given(stack=stacks, z_um=depths, given=some("n_sub", "n", "denoise"))
def test_from_stack(stack, z_um, given):
    made = fails_by_name(lambda: Calibration.from_stack(stack, z_um, **given), "stack", "z_um", "n_sub", "n", "denoise")
    if made is not None:
        assert_sound_calibration(made)


@tried
@given(size=st.sampled_from([3, 5, 7, 9]), data=st.data())
def test_from_stacks_that_fit(size, data):
    """More of those that are not refused at once."""
    stack = data.draw(arrays(dims=st.just(3), side=st.just(size)))
    made = fails_by_name(lambda: Calibration.from_stack(stack, range(size), n_sub=2), "stack", "z_um", "n_sub")
    if made is not None:
        assert_sound_calibration(made)


@tried
@given(
    scan=arrays(dims=st.sampled_from([3, 3, 3, 2]), side=st.sampled_from([7, 12, 25, 0])) | odd,
    z_um=depths,
    x_px=st.floats(0, 12) | odd,
    y_px=st.floats(0, 12) | odd,
    given=some("size", "n_sub", "n", "denoise"),
)
def test_from_scan(scan, z_um, x_px, y_px, given):
    names = ("scan", "stack", "z_um", "x_px", "y_px", "size", "n_sub", "n", "denoise")
    fit = isinstance(scan, np.ndarray) and scan.ndim == 3
    z_um = np.arange(len(scan)) if fit and isinstance(z_um, np.ndarray) else z_um
    made = fails_by_name(lambda: Calibration.from_bead(scan, z_um, x_px, y_px, **given), *names)
    if made is not None:
        assert_sound_calibration(made)


@tried
@given(
    scan=arrays(dims=st.sampled_from([3, 3, 3, 2]), side=st.sampled_from([7, 9, 25, 40])) | odd,
    z_um=depths,
    given=some("beads_px", "size", "n_sub"),
)
def test_calibrate(scan, z_um, given):
    fit = isinstance(scan, np.ndarray) and scan.ndim == 3
    z_um = np.arange(len(scan)) if fit and isinstance(z_um, np.ndarray) else z_um
    made = fails_by_name(
        lambda: Calibration.from_scan(scan, z_um, **given), "scan", "stack", "z_um", "beads_px", "size", "n_sub"
    )
    if made is not None:
        assert_sound_calibration(made)
        assert np.isfinite(made.report.drift_px).all() and len(report(made)) == 9


@tried
@given(frames=st.lists(some_images, max_size=2) | odd, given=some("threshold", "method", "refine", "min_distance_px"))
def test_choose_settings(frames, given):
    names = ("frames", "image", "threshold", "method", "refine", "min_distance_px")
    chosen = fails_by_name(lambda: choose_settings(frames, CALIBRATION, **given), *names)
    if chosen is not None:
        assert 0 < chosen.threshold <= 1 and np.isfinite(chosen.side_lobes.astype(float)).all(axis=None)


# -------------------- tables


@st.composite
def tables(draw):
    """Tables of particles, whole or odd."""
    n = draw(st.integers(0, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    columns = {name: rng.uniform(-9, 9, n) for name in ("x_px", "y_px", "z_um")}
    columns["frame"] = rng.integers(0, 3, n)
    for name in draw(st.sets(st.sampled_from([*columns, "x_std_px"]), max_size=2)):
        kind = draw(st.sampled_from(["absent", "nan", "inf", "text", "object", "huge", "bool", "int", "complex"]))
        if kind == "absent":
            columns.pop(name, None)
        elif kind in ("nan", "inf", "huge"):
            columns[name] = rng.choice([1.0, {"nan": np.nan, "inf": np.inf, "huge": 1e308}[kind]], n)
        else:
            value = {"text": "a", "object": None, "bool": True, "int": 3, "complex": 1j}[kind]
            columns[name] = pd.Series([value] * n, dtype=object if kind in ("text", "object") else None)
    table = pd.DataFrame(columns)
    table.index = draw(st.sampled_from([range(n), [0] * n, range(n, 0, -1), [*"abcdef"[:n]]]))
    return draw(st.sampled_from([table] * 9 + [None, columns, 3, table.get("x_px")]))


WITHIN = ("measured", "true", "within_px", "within_um")


@tried
@given(measured=tables(), true=tables(), given=some(*WITHIN[2:]))
def test_match_and_scores(measured, true, given):
    pairs = fails_by_name(lambda: match(measured, true, **given), *WITHIN)
    summary = fails_by_name(lambda: scores(measured, true, **given), *WITHIN)
    assert (pairs is None) == (summary is None)
    if pairs is not None:
        assert np.isfinite(pairs[["dx_px", "dy_px", "dz_um", "z_um"]].astype(float)).all(axis=None)
        assert pairs["measured"].is_unique and pairs["true"].is_unique
        assert summary["n_matched"] == len(pairs)


@tried
@given(measured=tables(), true=tables(), edges_um=arrays(dims=st.just(1), side=st.integers(0, 4)) | odd)
def test_scores_by_z(measured, true, edges_um):
    fails_by_name(lambda: scores_by_z(measured, true, edges_um), *WITHIN, "edges_um")


@tried
@given(table=tables(), um_per_px=odd, program=st.sampled_from(["napari", "imagej"]) | odd, given=some("a", "b"))
def test_tables_out(table, um_per_px, program, given):
    with tempfile.TemporaryDirectory() as folder:
        fails_by_name(lambda: in_um(table, um_per_px), "table", "um_per_px")
        path = Path(folder) / "a.csv"
        call = lambda: save_points(table, path, program, um_per_px=um_per_px)  # noqa: E731
        fails_by_name(call, "table", "program", "um_per_px")
        fails_by_name(lambda: save_table(table, path, CALIBRATION, **given), "table", "settings")
        fails_by_name(
            lambda: save_table(table, path.with_suffix(".parquet"), CALIBRATION, **given), "table", "settings"
        )
        assert {p.name for p in Path(folder).iterdir()} <= {"a.csv", "a.csv.json", "a.parquet", "a.parquet.json"}


LINK = ("search_range", "predictor", "frame_rate_hz", "memory", "min_rows")


@tried
@given(table=tables(), given=some(*LINK), rate=odd, window=odd)
def test_tracks(table, given, rate, window):
    """Linked, with velocities, and on a grid."""
    fails_by_name(lambda: link(table, **given), "table", *LINK)
    numbered = table.assign(particle=np.arange(len(table)) // 3) if isinstance(table, pd.DataFrame) else table
    names = ("tracks", "frame_rate_hz", "window", "longest")
    fails_by_name(lambda: velocities(numbered, rate, window=window), *names)
    fails_by_name(lambda: mean_squared_displacement(numbered, rate, longest=window), *names)
    with tempfile.TemporaryDirectory() as folder:
        fails_by_name(lambda: save_paraview_tracks(numbered, Path(folder) / "a.pvd", rate), "tracks", "frame_rate_hz")
        fails_by_name(lambda: save_paraview_field(table, Path(folder) / "a.vtr"), "field")
        fails_by_name(lambda: napari_tracks(numbered), "tracks")


@tried
@given(table=tables(), particles=odd | st.lists(st.integers(0, 3), max_size=3), other=tables())
def test_drift(table, particles, other):
    numbered = table.assign(particle=np.arange(len(table)) % 2) if isinstance(table, pd.DataFrame) else table
    found = fails_by_name(lambda: drift(numbered, particles), "tracks", "particles")
    if found is not None:
        assert np.isfinite(found[["x_px", "y_px", "z_um"]]).all(axis=None)
    fails_by_name(lambda: without_drift(table, other if found is None else found), "table", "drift")


ROOM = replace(
    CALIBRATION,
    report=SimpleNamespace(
        beads=pd.DataFrame({"x_px": [0, 9, 0, 9, 4, 5.0], "y_px": [0, 0, 9, 9, 4, 2.0], "offset_um": 0.1}).assign(
            verdict="used"
        )
    ),
)


@tried
@given(table=tables(), cm=odd)
def test_errors_and_surface(table, cm):
    with suppress(TypeError, ValueError, AttributeError):
        table = table.assign(cm=cm)
    made = fails_by_name(lambda: with_errors(table, CALIBRATION), "table")
    if made is not None:
        assert (made[["x_std_px", "y_std_px", "z_std_um"]] >= 0).all(axis=None)
    flat = fails_by_name(lambda: flattened(table, ROOM), "table")
    assert flat is None or np.isfinite(flat["z_um"].astype(float)).all()


@tried
@given(factor=odd | st.tuples(odd, odd), side=odd)
def test_calibrations_changed(factor, side):
    made = fails_by_name(lambda: CALIBRATION.with_depth_factor(factor), "factor")
    assert made is None or (np.diff(made.z_um) > 0).all()
    fails_by_name(lambda: CALIBRATION.one_side(side), "side")


PREPARED = ("dark", "flat", "background", "mask", "region", "first", "last", "every")


@tried
@given(frames=arrays(dims=st.sampled_from([3, 3, 3, 2]), side=st.integers(0, 12)) | odd, data=st.data())
def test_preparation(frames, data):
    """Odd arguments, images that fit the frames, and such that do not."""
    shape = np.shape(frames)[1:] if isinstance(frames, np.ndarray) else (9, 9)
    image = odd | some_images | st.sampled_from([np.ones(shape), np.zeros(shape), np.eye(*(shape or (1,))[:2])])
    given = data.draw(
        st.fixed_dictionaries(
            {},
            optional=dict.fromkeys(PREPARED[:4], image)
            | {"region": odd | st.tuples(*4 * [st.integers(0, 9)])}
            | dict.fromkeys(PREPARED[5:], odd | st.integers(0, 4)),
        )
    )
    prepare = fails_by_name(lambda: Preparation(**given), *PREPARED)
    if prepare is not None:
        made = fails_by_name(lambda: np.asarray(prepare(frames)), "frames", "region")
        assert made is None or (made.ndim == 3 and np.isfinite(made).all())


@tried
@given(
    table=tables(),
    cells=st.dictionaries(st.sampled_from(["x_px", "y_px", "z_um", "w"]), odd | st.integers(1, 4), max_size=4) | odd,
    values=st.sampled_from([None, ["x_px"], ["z_um", "frame"], [], ["w"], "x_px", 3]),
)
def test_fields(table, cells, values):
    field = fails_by_name(lambda: mean_field(table, cells, values), "table", "cells", "values")
    if field is not None:
        named = values or []
        assert field["n"].sum() <= len(table) and field[named][field["n"] > 0].notna().all(axis=None)


@tried
@given(path=odd | st.sampled_from(["absent", "*", "a\0b", "[", "a/b/c.tif", "/", "~", "a" * 5000]), csv=odd)
def test_odd_paths(path, csv):
    fails_by_name(lambda: open_images(path), "path")
    fails_by_name(lambda: open_scan(path, csv=csv), "path", "csv")
    scan = DATA / "brightfield-frames.tif"
    fails_by_name(lambda: open_scan(scan, csv=csv, names=path), "path", "csv", "names", "start_um")


# -------------------- files


@st.composite
def files(draw):
    """The bytes of a TIFF, with damage."""
    images = draw(arrays(dims=st.sampled_from([2, 3, 3, 4]), side=st.integers(1, 12)))
    images = np.asarray(images)
    if images.dtype.kind not in "uif":
        images = np.zeros((3, 9, 9), np.uint8)
    options = {"compression": draw(st.sampled_from([None, "zlib", "lzw", "packbits"])), "photometric": "minisblack"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.tif")
        with suppress(Exception):
            tifffile.imwrite(path, images, **options)
        content = bytearray(path.read_bytes()) if path.exists() else bytearray()
    for place, byte in draw(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=3)):
        if content:
            content[int(place * (len(content) - 1))] = byte
    return bytes(content[: int(draw(st.sampled_from([1, 1, 1, 0.9, 0.5, 0.01])) * len(content))])


@tried
@given(content=files(), start=odd, step=odd)
def test_damaged_files(content, start, step):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.tif")
        path.write_bytes(content)
        images = fails_by_name(lambda: open_images(path), "path")
        if images is not None and np.prod(images.shape) < 1e6:
            read = fails_by_name(lambda: np.asarray(images), "path")
            assert read is None or read.shape == images.shape
        fails_by_name(lambda: open_scan(path, start_um=start, step_um=step), "path", "start_um", "step_um", "names")


@tried
@given(frames=arrays(dims=st.sampled_from([3, 3, 2, 4]), side=st.integers(0, 20)) | odd, given=some(*LOCATE))
def test_batch_to_parquet(frames, given):
    with tempfile.TemporaryDirectory() as folder:
        names = ("frames", "path", "image", "settings", *LOCATE)
        call = lambda: batch_to_parquet(frames, CALIBRATION, Path(folder, "out"), progress=False, **given)  # noqa: E731
        if fails_by_name(call, *names) is not None:
            assert_sound(pd.read_parquet(Path(folder, "out")))


@tried
@given(cut=st.floats(0, 1), place=st.floats(0, 1), byte=st.integers(0, 255))
def test_damaged_calibrations(cut, place, byte):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.npz")
        CALIBRATION.save(path)
        content = bytearray(path.read_bytes())
        content[int(place * (len(content) - 1))] = byte
        path.write_bytes(content[: int(cut * len(content))] if byte % 2 else content)
        fails_by_name(lambda: Calibration.load(path), "path")
