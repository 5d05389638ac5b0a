"""Every public function, given a good call of it in which one or two arguments are spoilt: it works, or names one.

A few tries of each function; `GDPTLAB_THOROUGH=1 pytest tests/test_hostile_arguments.py` makes it 2000 each. What is
measured in odd images, read from damaged files and made of odd tables, is in `test_hostile_input.py`.
"""

import inspect
import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import tifffile
from conftest import THOROUGH
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from test_hostile_input import CALIBRATION, ODD, STACK, Z_UM, arrays, disc

import gdptlab
from gdptlab import Calibration, datasets, experiment, fit, live, pipeline, tracking
from gdptlab.experiment import Acoustics, Camera, Channel, Film, Focusing, Method, Microscope, Suspension, Trajectories
from gdptlab.live import Monitor, Switched, Trigger

ROOMS = (gdptlab, datasets, experiment, fit, pipeline, tracking, live)

RNG = np.random.default_rng(3)
SHAPE = (310, 60)
FOCUSING = Focusing()
FILM = Film.seeded(1, mean_in_view=3, duration_s=0.2, shape=SHAPE)
TRAJECTORIES = FILM.trajectories
TRUTH = FILM.to_channel(FILM.truth())
TRACKS = TRUTH.assign(x_std_um=0.02, y_std_um=0.03, z_std_um=0.2, cm=0.9, vx_um_s=1.0)
LONG = Trajectories.seeded(FOCUSING, 1, mean_in_view=4, duration_s=2.0).table(np.arange(0, 2, 0.1))
LONG = LONG.assign(x_std_um=0.02, y_std_um=0.03, z_std_um=0.2)
TABLE = pd.DataFrame(
    {"frame": [0, 0, 1], "x_px": [9.0, 30, 10], "y_px": [8.0, 30, 9], "z_um": [0.0, 1, 0.5], "cm": 0.9}
)
FIELD = tracking.mean_field(TRACKS, {"z_um": [-50, 0, 50]}, ["vx_um_s"])
IMAGE = RNG.normal(0, 0.02, (30, 34))
IMAGE[8:17, 10:19] += disc(1.0)
CENTRES = [(12, 12), (12, 40), (40, 12), (40, 40), (26, 26)]
DEPTHS = np.linspace(-3, 3, 9)
SCAN = RNG.normal(0, 0.005, (9, 53, 53))
for (row, column), (k, z) in itertools.product(CENTRES, enumerate(DEPTHS)):
    SCAN[k, row - 4 : row + 5, column - 4 : column + 5] += disc(z)


LABELS = pd.DataFrame(
    [(k, x, y, RNG.uniform(-3, 3)) for k in range(2) for x in range(12, 110, 20) for y in range(12, 110, 20)],
    columns=["frame", "x_px", "y_px", "z_um"],
)
LABELLED = RNG.normal(0, 0.01, (2, 120, 120))
for label in LABELS.astype({"frame": int, "x_px": int, "y_px": int}).itertuples():
    LABELLED[label.frame, label.y_px - 4 : label.y_px + 5, label.x_px - 4 : label.x_px + 5] += disc(label.z_um)


def spread(count, depth):
    """Frames of discs that stand alone, at depths that follow from the frame and the column of each."""
    frames = RNG.normal(0, 0.01, (count, 120, 120))
    for k, x, y in itertools.product(range(count), range(9, 100, 18), range(9, 100, 18)):
        x, y = x + (5 * k + RNG.integers(-2, 3)) % 13, y + (7 * k) % 11
        frames[k, y - 4 : y + 5, x - 4 : x + 5] += disc(depth(k, x))
    return frames


SLIDE = spread(3, lambda frame, x: (x - 59.5) / 20 + 0.1 * frame)
FLOW = spread(20, lambda frame, x: RNG.uniform(-3, 3))

BEADS = pd.DataFrame({"x_px": [9.0, 30, 50, 10, 28, 52], "y_px": [8.0, 9, 11, 40, 45, 38], "offset_um": 0.1})
REPORT = SimpleNamespace(beads=BEADS.assign(verdict="used"), drift_px=np.zeros((9, 2)), clipped=np.zeros(9), noise=0.1)
TILTED = replace(CALIBRATION, report=REPORT)
RESTING = pd.DataFrame(
    {"frame": [0, 0, 1, 1], "particle": [0, 1, 0, 1], "x_um": [1.0, 7, 1.5, 7.5], "y_um": 0.0, "z_um": [0.0, 4, 2, 6]}
)
MISMATCH = pd.DataFrame({"n": [50, 3], "mismatch": 0.02, "own": 0.01, "significance": 3.0, "z_error_um": 0.4})
JOINT = gdptlab.locate(SCAN[3], CALIBRATION, method="joint").assign(frame=0)


def ten(frame, calibration=None, **settings):
    """Evaluator of a monitor."""
    return TABLE


def at_level(table):
    """Fraction of a trigger."""
    return 0.5


METHOD = Method(evaluator=ten)
SWEPT = experiment.sweep([FILM], [METHOD], every=2, cache=False, progress=False)


@dataclass
class Call:
    """A public function, arguments with which it works, and names besides its own that its errors may begin with."""

    function: Callable
    good: dict[str, object]
    names: tuple[str, ...]


def call(function, *names, **good):
    """A `Call`; what is not given has its default."""
    parameters = inspect.signature(function).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.default not in (p.empty, inspect.Parameter.empty)}
    return Call(
        function, {k: v for k, v in defaults.items() if type(v).__name__ != "_HAS_DEFAULT_FACTORY_CLASS"} | good, names
    )


def watched(source, **arguments):
    """A monitor from its start to its end."""
    with Monitor(source, **arguments) as monitor:
        assert monitor.wait(20)
    return monitor.status()


def calls(folder: Path) -> dict[str, Call]:
    """All functions, by room and name; those that write do so in `folder`."""
    scan, film, quiet = folder / "scan.tif", folder / "film.tif", {"progress": False}
    sequence = {"films": [FILM], "methods": [METHOD], "every": 2, "cache": False, **quiet}
    fields = {"focusing": FOCUSING, "start": TRAJECTORIES.start, "duration_s": 0.2, "view_length_um": 40.0}
    particles, light, beads = (
        TABLE[["x_px", "y_px", "z_um"]],
        np.ones((4, 5)),
        {"scan": SCAN, "z_um": DEPTHS, "size": 9},
    )
    view, made = {"mean_in_view": 3.0, "duration_s": 0.2}, {"calibration": CALIBRATION}
    optics, linked = FILM.microscope, {"tracks": TRUTH, "true": TRUTH}
    written = {
        "settings",
        "image",
        "path",
        "choices",
        "start_um",
        "step_um",
        "stack",
        "beads_px",
        "table",
        "names",
        "csv",
    }
    return {
        "gdptlab.Calibration.from_stack": call(Calibration.from_stack, stack=STACK, z_um=Z_UM, n_sub=3),
        "gdptlab.Calibration.from_bead": call(Calibration.from_bead, "stack", **beads, x_px=26.0, y_px=26.0, n_sub=3),
        "gdptlab.Calibration.from_scan": call(Calibration.from_scan, **beads, beads_px=CENTRES, n_sub=3),
        "gdptlab.Calibration.from_labelled": call(Calibration.from_labelled, frames=LABELLED, table=LABELS, size=9),
        "gdptlab.Calibration.from_tilt": call(
            Calibration.from_tilt, frames=SLIDE, tilt_deg=5.7, um_per_px=0.5, size=15
        ),
        "gdptlab.Calibration.from_film": call(
            Calibration.from_film, frames=FLOW, height_um=6.0, radius_um=0.1, fitted=20, size=9
        ),
        "gdptlab.Calibration.with_subset": call(CALIBRATION.with_subset, n_sub=3),
        "gdptlab.Calibration.with_depth_factor": call(CALIBRATION.with_depth_factor, factor=1.33),
        "gdptlab.Calibration.with_depth_error": call(CALIBRATION.with_depth_error, std_um=0.5),
        "gdptlab.Calibration.one_side": call(CALIBRATION.one_side, side="near"),
        "gdptlab.Calibration.save": call(CALIBRATION.save, path=folder / "a.npz"),
        "gdptlab.Calibration.load": call(Calibration.load, path=folder / "made.npz"),
        "gdptlab.Preparation": call(
            gdptlab.Preparation, dark=0 * IMAGE, flat=1 + 0 * IMAGE, mask=IMAGE < 9, region=(0, 0, 9, 9)
        ),
        "gdptlab.Preparation.restored": call(gdptlab.Preparation(every=2, region=(1, 1, 9, 9)).restored, table=TABLE),
        "gdptlab.locate": call(gdptlab.locate, image=IMAGE, **made),
        "gdptlab.batch": call(gdptlab.batch, "image", frames=[IMAGE, IMAGE], **made, **quiet, threshold=0.5),
        "gdptlab.match": call(gdptlab.match, measured=TABLE, true=TABLE),
        "gdptlab.scores": call(gdptlab.scores, measured=TABLE, true=TABLE),
        "gdptlab.scores_by_z": call(gdptlab.scores_by_z, measured=TABLE, true=TABLE, edges_um=[-2, 0, 2]),
        "gdptlab.standard_assessment": call(
            gdptlab.standard_assessment, locator=ten, frames=[IMAGE, IMAGE], true=TABLE
        ),
        "datasets.sample": call(datasets.sample),
        "experiment.Acoustics": call(Acoustics),
        "experiment.Camera": call(Camera),
        "experiment.Camera.record": call(Camera().record, light=light),
        "experiment.Channel": call(Channel),
        "experiment.Channel.velocity": call(Channel().velocity, y_channel_um=[0.0, 3.0], z_um=[1.0, 2.0]),
        "experiment.Film": call(Film, trajectories=TRAJECTORIES, microscope=optics, camera=Camera(), shape=SHAPE),
        "experiment.Film.seeded": call(Film.seeded, seed=1, **view, microscope=optics, shape=SHAPE),
        "experiment.Film.to_channel": call(FILM.to_channel, table=TABLE),
        "experiment.Film.stack": call(FILM.stack, n=3, size=5),
        "experiment.Focusing": call(Focusing, channel=Channel(), acoustics=Acoustics(), suspension=Suspension()),
        "experiment.Focusing.radiation_velocity": call(FOCUSING.radiation_velocity, axis="y", position_um=[0.0, 3.0]),
        "experiment.Focusing.path": call(FOCUSING.path, axis="y", start_um=[0.0, 3.0], t_s=[0.0, 1.0]),
        "experiment.Focusing.arrival_time": call(FOCUSING.arrival_time, axis="z", start_um=[0.0, 3.0]),
        "experiment.Focusing.trigger_time": call(FOCUSING.trigger_time, axis="y"),
        "experiment.Method": call(Method, evaluator=ten, **made, settings={"threshold": 0.5}, label={"a": 1}),
        "experiment.Microscope": call(Microscope),
        "experiment.WaveMicroscope": call(experiment.WaveMicroscope),
        "experiment.Microscope.render": call(optics.render, particles=particles, shape=(20, 30)),
        "experiment.Microscope.light": call(optics.light, particles=particles, shape=(20, 30)),
        "experiment.Microscope.stack": call(optics.stack, "particles", z_um=[-1.0, 0.0, 1.0], size=9),
        "experiment.Suspension": call(Suspension),
        "experiment.Trajectories": call(Trajectories, **fields),
        "experiment.Trajectories.seeded": call(Trajectories.seeded, focusing=FOCUSING, rng=1, **view),
        "experiment.Trajectories.table": call(TRAJECTORIES.table, times_s=[0.0, 0.1]),
        "experiment.Trajectories.positions": call(TRAJECTORIES.positions, "times_s", t_s=0.1),
        "experiment.brightfield": call(experiment.brightfield, light=light),
        "experiment.disturbed": call(experiment.disturbed, light=light),
        "experiment.fluorescent": call(experiment.fluorescent, light=light),
        "experiment.durations": call(experiment.durations, film=FILM, methods=[METHOD], count=2, **quiet),
        "experiment.errors": call(experiment.errors, "times_s", table=SWEPT, tau_s=[0.04, 0.1], phases=2),
        "experiment.evaluate": call(experiment.evaluate, film=FILM, methods=[METHOD], cache=False, **quiet),
        "experiment.evaluated_frames": call(experiment.evaluated_frames, film=FILM, every=2),
        "experiment.expected_delay": call(experiment.expected_delay, tau_s=[0.04, 0.1]),
        "experiment.fractions": call(experiment.fractions, table=TRUTH, frames=[0, 1], channel=Channel()),
        "experiment.in_middle_third": call(experiment.in_middle_third, table=TRUTH, of="h", channel=Channel()),
        "experiment.locate_plainly": call(experiment.locate_plainly, image=IMAGE, **made),
        "experiment.grid": call(
            experiment.grid, evaluator=ten, calibrate=calibrated, n=(7,), n_sub=(3,), refine=(True,)
        ),
        "experiment.sample_scan": call(experiment.sample_scan),
        "experiment.summary": call(experiment.summary, table=experiment.errors(SWEPT, [0.1], phases=2), by=["trigger"]),
        "experiment.sweep": call(experiment.sweep, **sequence),
        "experiment.trigger_time": call(experiment.trigger_time, times_s=[0.0, 1.0], fraction=[0.1, 0.95]),
        "experiment.watch": call(experiment.watch, times_s=[0.0, 0.04, 0.08], tau_s=0.05),
        "fit.explained": call(fit.explained, image=IMAGE, **made),
        "fit.learned": call(fit.learned, **beads, beads_px=CENTRES, field=False, modes=0, turns=1),
        "fit.mismatch_error_um": call(fit.mismatch_error_um, mismatch=MISMATCH),
        "fit.pattern_mismatch": call(fit.pattern_mismatch, "image", frames=[IMAGE], **made),
        "fit.own_bias_um": call(fit.own_bias_um, **made),
        "fit.own_error": call(fit.own_error, **made),
        "fit.expected_error": call(fit.expected_error, **made),
        "fit.decided_by_plane": call(fit.decided_by_plane, table=JOINT),
        "fit.particle_light": call(fit.particle_light, **made),
        "fit.field_terms": call(fit.field_terms, x_px=[1.0, 2.0], y_px=[1.0, 2.0], shape=(30, 40)),
        "pipeline.batch_to_parquet": call(
            pipeline.batch_to_parquet,
            "image",
            "path",
            "settings",
            frames=[IMAGE] * 2,
            **made,
            folder=folder / "out",
            **quiet,
        ),
        "pipeline.choose_settings": call(pipeline.choose_settings, "image", frames=[IMAGE], **made, looked_at=1),
        "pipeline.depth_quality": call(pipeline.depth_quality, **made),
        "pipeline.find_beads": call(pipeline.find_beads, scan=SCAN, z_um=DEPTHS),
        "pipeline.in_um": call(pipeline.in_um, table=TABLE, um_per_px=0.65),
        "pipeline.flattened": call(pipeline.flattened, table=TABLE, calibration=TILTED),
        "pipeline.mean_image": call(pipeline.mean_image, path=film),
        "pipeline.measure": call(
            pipeline.measure,
            *written,
            scan=scan,
            frames=film,
            folder=folder / "measured",
            z_um=(-3.0, 3.0),
            um_per_px=0.5,
            **quiet,
            size=9,
            n_sub=3,
            threshold=0.5,
            method="correlation",
        ),
        "pipeline.open_images": call(pipeline.open_images, path=film),
        "pipeline.open_scan": call(pipeline.open_scan, path=scan, start_um=-3.0, step_um=1.0),
        "pipeline.report": call(pipeline.report, **made | {"mismatch": MISMATCH}),
        "pipeline.save_points": call(pipeline.save_points, table=TABLE, path=folder / "points.csv", program="napari"),
        "pipeline.save_table": call(pipeline.save_table, "settings", table=TABLE, path=folder / "table.csv", **made),
        "pipeline.with_errors": call(pipeline.with_errors, table=TABLE, **made),
        "tracking.drift": call(tracking.drift, tracks=RESTING, particles=[0, 1]),
        "tracking.fit_energy": call(tracking.fit_energy, tracks=LONG, focusing=FOCUSING, frame_rate_hz=10.0),
        "tracking.identify": call(tracking.identify, "measured", **linked),
        "tracking.imitate": call(imitated, tracks=TRACKS, film=FILM, others=[FILM], rng=1),
        "tracking.link": call(tracking.link, table=TRUTH, predictor=Channel(), frame_rate_hz=25.0, min_rows=2),
        "tracking.link_scores": call(tracking.link_scores, "measured", **linked),
        "tracking.mean_field": call(
            tracking.mean_field, table=TRACKS, cells={"z_um": [-50, 0, 50]}, values=["vx_um_s"]
        ),
        "tracking.mean_squared_displacement": call(
            tracking.mean_squared_displacement, tracks=TRUTH, frame_rate_hz=25.0, longest=3
        ),
        "tracking.napari_tracks": call(tracking.napari_tracks, tracks=TRUTH, in_um=True),
        "tracking.save_paraview_field": call(tracking.save_paraview_field, field=FIELD, path=folder / "field.vtr"),
        "tracking.save_paraview_tracks": call(tracking.save_paraview_tracks, tracks=TRUTH, path=folder / "tracks.pvd"),
        "tracking.velocities": call(tracking.velocities, tracks=TRACKS, frame_rate_hz=25.0, window=5),
        "tracking.without_drift": call(tracking.without_drift, table=RESTING, drift=tracking.drift(RESTING, [0, 1])),
        "live.FillingFolder": call(live.FillingFolder, folder=folder, pattern="*.tif*", patience_s=1.0),
        "live.Follower": call(followed, calibration=CALIBRATION, threads=2, image=SCAN[3], t_s=0.5),
        "live.Frame": call(live.Frame, image=IMAGE, t_s=0.5),
        "live.MiddleThird": call(live.MiddleThird, of="h", channel=Channel(), to_channel=FILM.to_channel),
        "live.Monitor": call(
            watched, source=[IMAGE] * 2, evaluate=ten, triggers=[], log=folder / "watched", example=IMAGE
        ),
        "live.Trigger": call(Trigger, name="w", fraction=at_level, action=print),
        "live.Logbook": call(closed, path=folder / "book", most=9),
        "live.OwnProcess": call(live.OwnProcess, evaluate=gdptlab.locate),
        "live.Switched": call(Switched, **fields, off_s=0.1),
        "live.Switched.table": call(Switched(**fields, off_s=0.1).table, times_s=[0.0, 0.15]),
        "live.over_http": call(live.over_http, url="http://127.0.0.1:9", data=b"off", timeout_s=0.1),
        "live.at_speed": call(played, frames=[IMAGE], rate_hz=1e3),
        "live.middle_thirds": call(live.middle_thirds, channel=Channel(), to_channel=FILM.to_channel),
        "live.read_log": call(live.read_log, path=folder / "log"),
        "live.switched": call(live.switched, film=FILM, off_s=0.1),
        "live.timed": call(live.timed, "times_s", films=[FILM], timers_s=[0.05, 0.1]),
        "live.true_fractions": call(live.true_fractions, film=FILM, times_s=[0.05, 0.1]),
    }


def calibrated(n, n_sub):
    """What makes the calibrations of a grid."""
    return CALIBRATION


def imitated(**given):
    """All that is imitated."""
    return list(tracking.imitate(**given))


def closed(**given):
    """A log that is opened and closed."""
    live.Logbook(**given).close()


def followed(image, t_s, **given):
    """A frame, by the joint fit in the loop."""
    return live.Follower(**given)(image, t_s)


def played(**given):
    """All frames, at their speed."""
    return list(live.at_speed(**given))


NOT_CALLED = {
    "gdptlab.Calibration": "made by its constructors, which are called",
    "datasets.planar_beads": "takes nothing",
    "datasets.astigmatic_bead": "takes nothing",
    "datasets.defocused_particles": "takes nothing",
    "gdptlab.versions": "takes nothing",
    "experiment.IMAGE_TYPES": "a tuple",
    "experiment.make_samples": "writes the samples of the repository",
    "fit.Explained": "returned, not made by users",
    "fit.Joint": "of the fit, whose door is `explained`",
    "fit.PatternModel": "made by `learned`",
    "pipeline.FilmReport": "returned",
    "pipeline.Images": "made by `open_images`",
    "pipeline.Measured": "returned",
    "pipeline.ScanReport": "returned",
    "pipeline.Settings": "returned",
    "live.Device": "a process; see `test_device.py`",
    "live.Fraction": "returned",
    "live.MicroManagerCamera": "takes what `pymmcore_plus` makes; see `test_sources.py`",
    "live.over_serial": "needs an extra; see `test_sources.py`",
    "live.Result": "returned",
    "live.Status": "returned",
    "live.closed_loop": "a process and a second of its time; see `test_device.py`",
}
"""Public names that are not called here, and why."""


def test_every_public_function_is_called(tmp_path):
    called = set(calls(tmp_path)) | set(NOT_CALLED)
    public = {f"{room.__name__.removeprefix('gdptlab.')}.{name}" for room in ROOMS for name in public_names(room)}
    assert public - called == set()


def public_names(room):
    """What a room offers."""
    if hasattr(room, "__all__"):
        return room.__all__
    return [
        name
        for name, value in vars(room).items()
        if inspect.isfunction(value) and value.__module__ == room.__name__ and not name.startswith("_")
    ]


@st.composite
def spoilt(draw, value):
    """Something else in the place of an argument, often of the same kind."""
    if isinstance(value, pd.DataFrame) and draw(st.integers(0, 5)):
        return spoilt_table(value, draw(st.sampled_from([*value])), draw(st.sampled_from(TABLES)))
    if isinstance(value, np.ndarray | list | tuple) and np.size(value) and draw(st.integers(0, 3)):
        array = np.array(value)
        if array.dtype.kind in "fiu":
            return draw(st.sampled_from(spoilt_arrays(array.astype(float))) | arrays())
    return draw(
        st.sampled_from([odd for odd in ODD if not (callable(odd) and (callable(value) or isinstance(value, str)))])
    )


TABLES = ("absent", "nan", "inf", "huge", "text", "object", "bool", "complex", "negative", "empty", "twice", "labels")


def spoilt_table(table, column, how):
    """A table of which a column, or all, is not as it should be."""
    if how == "absent":
        return table.drop(columns=column)
    if how in ("empty", "twice", "labels"):
        return {"empty": table[:0], "twice": pd.concat([table, table]), "labels": table.set_axis([5] * len(table))}[how]
    value = {"nan": np.nan, "inf": np.inf, "huge": 1e308, "text": "a", "object": None, "bool": True, "complex": 1j}
    dtype = object if how in ("text", "object") else None
    return table.assign(**{column: pd.Series([value.get(how, -3)] * len(table), index=table.index, dtype=dtype)})


def spoilt_arrays(array):
    """Arrays that are nearly `array`."""
    nan, infinite = array.copy(), array.copy()
    nan.flat[-1], infinite.flat[0] = np.nan, np.inf
    masked = np.ma.masked_greater(array, np.median(array))
    types = [array.astype(kind) for kind in (object, str, complex, np.int8, ">f4")]
    return [nan, infinite, masked, array[:0], array[:1], array[::-1], array.T, array[..., None], 1e300 * array, *types]


tried = settings(
    max_examples=round(2000 * THOROUGH) or 5,
    deadline=None,
    derandomize=not THOROUGH,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of the files that are read."""
    folder = tmp_path_factory.mktemp("hostile")
    for name, images in (("scan.tif", SCAN), ("film.tif", SCAN[2:4])):
        tifffile.imwrite(folder / name, (1000 * images + 200).astype(np.uint16), photometric="minisblack")
    CALIBRATION.save(folder / "made.npz")
    log = live.Logbook(folder / "log")
    log.append({"frame": 0, "t_s": 0.0})
    log.close()
    return folder


@pytest.mark.parametrize("name", calls(Path("absent")))
def test_works_or_names_an_argument(name, folder, monkeypatch):
    monkeypatch.chdir(folder)  # where what has a spoilt path may be written
    one = calls(folder)[name]
    one.function(**one.good)

    @tried
    @given(data=st.data())
    def attempt(data):
        chosen = data.draw(st.sets(st.sampled_from([*one.good]), min_size=1, max_size=2))
        given = one.good | {argument: data.draw(spoilt(one.good[argument]), argument) for argument in sorted(chosen)}
        assume(not (name == "live.Monitor" and callable(given["source"])))  # a source without end
        try:
            one.function(**given)
        except (TypeError, ValueError, FileNotFoundError, UserWarning) as error:  # warnings are errors here
            words = "|".join([*one.good, *one.names])
            assert re.match(rf"({words})\b", str(error)), f"{sorted(chosen)}: {type(error).__name__}: {error}"

    attempt()
