"""From a scan and a film to a folder of results, in one call: notebook 13 is this call taken apart."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from gdptlab._checks import depth_factor as check_depth_factor
from gdptlab._checks import flag, number, positive, whole
from gdptlab._checks import path as check_path
from gdptlab._files import keep_arrays, kept_arrays, sources_folder, written_whole
from gdptlab.calibration import Calibration
from gdptlab.fit.mismatch import mismatch_error_um, pattern_mismatch
from gdptlab.pipeline.beads import ScanReport
from gdptlab.pipeline.errors import with_errors
from gdptlab.pipeline.images import Images, open_images, open_scan
from gdptlab.pipeline.page import write_page
from gdptlab.pipeline.quality import report
from gdptlab.pipeline.settings import Settings, choose_settings, spread
from gdptlab.pipeline.stream import batch_to_parquet
from gdptlab.pipeline.surface import flattened
from gdptlab.pipeline.tables import about, as_json, in_um, save_points, save_table
from gdptlab.preparation import Preparation, Prepared, preparation

OF_SCAN = ("beads_px", "size", "n_sub")
"""Choices that `Calibration.from_scan` takes."""

OF_FRAMES = ("method", "threshold", "refine", "min_distance_px")
"""Choices that `choose_settings` takes."""

NEIGHBOUR = 0.5
"""Search range in the plane, if none is given, as a fraction of the median distance to the nearest neighbour. Derived:
with half of it, the ranges of neighbours touch but do not overlap."""

DEPTH = 0.1
"""Search range along z, if none is given, as a fraction of the range of depths. As the largest error of z of a pair in
`match`: what is farther off is another particle."""

COMPARED = 5
"""Number of frames whose particles are compared with the calibration's. Convention: with 40 in each, 200 in all."""

CELLS = (8, 8, 3)
"""Cells along x, y and z of the mean velocity field, if none are given. Chosen: of a few thousand rows, each then holds
several."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What `measure` found, as it is in its folder.

    Attributes
    ----------
    folder : Path
    calibration : Calibration
    quality : DataFrame
        What `report` says of the calibration.
    settings : Settings
    particles : DataFrame
        As from `batch`, with positions in µm as well.
    tracks : DataFrame or None
        As from `tracking.velocities`, if the frame rate was given.
    """

    folder: Path
    calibration: Calibration
    quality: pd.DataFrame
    settings: Settings
    particles: pd.DataFrame
    tracks: pd.DataFrame | None

    @property
    def bad(self) -> list[str]:
        """What is bad about the calibration, by the names of the rows of `quality`."""
        return self.quality.index[self.quality["verdict"] == "bad"].tolist()

    def summary(self, frames: Sequence[int] = ()) -> str:
        """How many particles and tracks there are, in words; of these frames, or of those with a particle."""
        found = self.particles.groupby("frame").size()
        found = found.reindex(frames, fill_value=0) if len(frames) else found
        if self.particles.empty:
            return "No particles."
        text = f"{len(self.particles)} particles in {len(found)} frames, {found.min()} to {found.max()} in a frame."
        if self.tracks is not None:
            text += f" {self.tracks['particle'].nunique()} tracks, of {len(self.tracks)} of them."
        return text


def measure(
    scan: str | os.PathLike[str],
    frames: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    *,
    z_um: tuple[float, float] | None = None,
    um_per_px: float | None = None,
    frame_rate_hz: float | None = None,
    search_range_um: tuple[float, float, float] | None = None,
    window: int = 11,
    cells: tuple[int, int, int] = CELLS,
    depth_factor: float | tuple[float, float] | None = None,
    side: str | None = None,
    flat_field: bool = False,
    prepare: Preparation | None = None,
    n_jobs: int = 1,
    progress: bool = True,
    **choices: object,
) -> Measured:
    """Calibrate on a scan, measure a film, link, and write all of it into a folder.

    A call that was stopped is taken up again by the same call: frames that were measured are not measured again. A
    folder of another call is refused.

    Parameters
    ----------
    scan, frames : path
        Files or folders, as for `open_images`: beads at known depths, and the film.
    folder : path, optional
        Of the results; made if it does not exist. If not given, beside the film, named after it.
    z_um : (first, last), optional
        Depths of the scan's first and last image, with equal steps between. If not given, they are read from the names
        of its files.
    um_per_px : float, optional
        Size of a pixel in the plane of the particles. If not given, that which the files note.
    frame_rate_hz : float, optional
        If given, particles are linked to tracks, with velocities.
    search_range_um : (x, y, z), optional
        As for `tracking.link`. If not given, `NEIGHBOUR` of the distance between neighbours, and `DEPTH` of the range
        of depths.
    window : int
        Measured frames, odd, from which each velocity is taken, if particles are linked (`tracking.velocities`). The
        longer, the less noise, and the more of a bend is taken for straight.
    cells : (x, y, z)
        How many cells the mean velocity field has along each axis, if particles are linked (`tracking.mean_field`).
    depth_factor : float or (n_immersion, n_sample), optional
        Depth in the sample over travel of the stage, as for `Calibration.with_depth_factor`, if `z_um` is travel.
    side : str, optional
        "near" or "far": only depths on this side of focus, as for `Calibration.one_side`.
    flat_field : bool
        Take tilt and curvature of the focal surface, as the scan's beads show them, from the depths (`flattened`).
    prepare : Preparation, optional
        What is done to the film's frames; its dark and flat image correct the scan, too.
    n_jobs, progress
        As for `batch`; with the joint fit one process is used.
    **choices
        What is not to be chosen from the images: `beads_px`, `size`, `n_sub` of `Calibration.from_scan`; `method`,
        `threshold`, `refine`, `min_distance_px` of `choose_settings`.

    Returns
    -------
    Measured
        In its folder: `report.html`, a page that shows whether to trust it; `particles.csv` and `points_napari.csv`;
        with a frame rate `tracks.csv` and `field.csv`, for ParaView `tracks.pvd` and `field.vtr`; `quality.csv`,
        `settings.csv`, `calibration.npz`; `frames`, the parts of the table; `log.json`: inputs with their hashes,
        arguments, versions.

    Raises
    ------
    TypeError, ValueError, FileNotFoundError
        As the functions named; if the size of a pixel is neither given nor noted; if the folder is that of another
        call.
    """
    unknown = sorted(set(choices) - {*OF_SCAN, *OF_FRAMES})
    if unknown:
        raise TypeError(f"choices: got {', '.join(unknown)}, allowed are {', '.join((*OF_SCAN, *OF_FRAMES))}")
    if frame_rate_hz is not None:
        from gdptlab.tracking.tracks import checked_window

        positive("frame_rate_hz", frame_rate_hz)
        checked_window(window)  # now, not when the film has been measured
    if not isinstance(cells, tuple | list) or len(cells) != 3:
        raise TypeError(f"cells: got {cells!r}, allowed are three whole numbers: along x, y and z")
    cells = tuple(whole("cells", n, 1, 1000) for n in cells)
    scanned, depths = _opened_scan(scan, z_um)
    z_um = None if z_um is None else [float(z) for z in z_um]
    film = open_images(frames)
    um_per_px = _um_per_px(um_per_px, film, scanned)
    folder = _folder(folder, frames)
    if depth_factor is not None:
        depth_factor = check_depth_factor("depth_factor", depth_factor)
    given = {"z_um": z_um, "um_per_px": um_per_px, "frame_rate_hz": frame_rate_hz, "search_range_um": search_range_um}
    given |= {"depth_factor": depth_factor, "side": side, "flat_field": flag("flat_field", flat_field)}
    if prepare is not None:
        given["prepare"] = preparation(prepare).note()
    frames_used = film if prepare is None else prepare(film)
    inputs = {name: _hashes(images) for name, images in (("scan", scanned), ("frames", film))}
    _claim(folder, json.loads(as_json({"inputs": inputs, "settings": given | choices})))

    of_scan = {k: v for k, v in choices.items() if k in OF_SCAN}
    calibration = _calibrated(scanned, depths, list(inputs["scan"].values()), of_scan, prepare)
    if depth_factor is not None:
        calibration = calibration.with_depth_factor(depth_factor)
    if side is not None:
        calibration = calibration.one_side(side)
    settings = choose_settings(frames_used, calibration, **{k: v for k, v in choices.items() if k in OF_FRAMES})
    quality = report(calibration)
    if settings.arguments["method"] == "joint":
        n_jobs, mismatch = 1, pattern_mismatch(spread(frames_used, COMPARED), calibration)
        quality = report(calibration, mismatch)
        if error_um := mismatch_error_um(mismatch):
            calibration = calibration.with_depth_error(error_um)
    parts = batch_to_parquet(
        film,
        calibration,
        folder / "frames",
        n_jobs=n_jobs,
        progress=progress,
        prepare=prepare,
        **settings.arguments,
    )
    particles, tracks = pd.read_parquet(parts), None
    if settings.arguments["method"] == "correlation":
        particles = with_errors(particles, calibration)
    if flat_field:
        particles = flattened(particles, calibration)
    particles = in_um(particles, um_per_px)
    if frame_rate_hz is not None:
        ranges = search_range_um or _search_range(particles, calibration.z_um)
        tracks = _tracked(particles, frame_rate_hz, ranges, window, prepare or Preparation())
        given |= {"search_range_um": tuple(ranges), "window": window, "cells": cells}
    measured = Measured(folder, calibration, quality, settings, particles, tracks)
    _write(measured, frames_used, um_per_px, frame_rate_hz, {"inputs": inputs, "arguments": given | choices})
    return measured


def _calibrated(
    scan: Images, z_um: NDArray, hashes: list[str], choices: dict[str, object], prepare: Preparation | None
) -> Calibration:
    """Calibration from a scan (N, rows, columns), made once for files of these hashes and then kept in the cache."""
    note = {} if prepare is None or prepare.camera is None else prepare.camera.note()
    said = json.dumps([sorted(hashes), z_um.tolist(), choices, note], sort_keys=True, default=methodcaller("tolist"))
    folder = sources_folder("calibrations")
    kept = folder and folder / f"{hashlib.sha256(said.encode()).hexdigest()[:32]}.npz"
    arrays = kept_arrays(kept) if kept else None
    if arrays is not None:
        camera = None if prepare is None else prepare.camera
        made = {name: arrays[name] for name in ("stack", "z_um", "subset", "templates")}
        return Calibration(**made, report=_unpacked(arrays), camera=camera)
    calibration = Calibration.from_scan(np.asarray(scan), z_um, prepare=prepare, **choices)
    if kept:
        made = {name: getattr(calibration, name) for name in ("stack", "z_um", "subset", "templates")}
        keep_arrays(kept, made | _packed(calibration.report))
    return calibration


def _packed(scan: ScanReport) -> dict[str, NDArray]:
    """Arrays, by name, that hold what `from_scan` says of its scan."""
    arrays = {name: np.asarray(getattr(scan, name)) for name in ("drift_px", "clipped", "overview", "noise")}
    tables = {"beads": scan.beads, "settings": scan.settings.reset_index()}
    for name, table in tables.items():
        for column in table:
            values = table[column].to_numpy()
            arrays[f"{name}.{column}"] = values if values.dtype.kind in "fi" else values.astype(str)
    return arrays


def _unpacked(arrays: dict[str, NDArray]) -> ScanReport:
    """What `_packed` packed."""
    beads, settings = (
        pd.DataFrame({key.partition(".")[2]: arrays[key] for key in arrays if key.startswith(f"{name}.")})
        for name in ("beads", "settings")
    )
    arrays = {name: arrays[name] for name in ("drift_px", "clipped", "overview")} | {"noise": float(arrays["noise"])}
    return ScanReport(beads=beads, settings=settings.set_index("setting"), **arrays)


def _opened_scan(scan: str | os.PathLike[str], z_um: tuple[float, float] | None) -> tuple[Images, NDArray[np.float64]]:
    """Images of a scan (N, rows, columns) and their depths (N,), by increasing depth."""
    if z_um is None:
        open_images(scan)  # what is wrong with the files is not wrong with their names
        try:
            return open_scan(scan)
        except ValueError as error:
            raise ValueError(
                f"z_um: got none, needed are the depths of the first and the last image of the scan, µm: {error}"
            ) from error
    if not isinstance(z_um, Sequence | np.ndarray) or np.shape(z_um) != (2,):
        raise TypeError(f"z_um: got {z_um!r}, allowed are two numbers: the first and the last depth")
    z_um = tuple(number("z_um", z.item() if isinstance(z, np.generic) else z) for z in z_um)
    images = open_images(scan)
    if len(images) < 2 or z_um[0] == z_um[1]:
        raise ValueError(f"z_um: got {z_um!r} for {len(images)} images, allowed are two depths for two or more")
    return open_scan(scan, start_um=z_um[0], step_um=(z_um[1] - z_um[0]) / (len(images) - 1))


def _um_per_px(given: float | None, *opened: Images) -> float:
    """Size of a pixel, as it is given or as the first files that note it say."""
    if given is not None:
        return positive("um_per_px", given)
    noted = [images.um_per_px for images in opened if images.um_per_px]
    if not noted:
        raise ValueError("um_per_px: got none, and the files do not note it: give the size of a pixel, µm")
    return noted[0]


def _folder(folder: str | os.PathLike[str] | None, frames: str | os.PathLike[str]) -> Path:
    """Folder of the results, made if need be: as given, or beside the film and named after it."""
    if folder is None:
        film = Path(frames).absolute()
        film = film.parent if any(letter in film.name for letter in "*?[") else film
        folder = film.with_name(film.name.split(".")[0] + "_gdptlab")
    folder = check_path("folder", folder)
    if not folder.parent.is_dir():
        raise FileNotFoundError(f"folder: got {str(folder)!r}, allowed is one in a folder that exists")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"folder: got {str(folder)!r}, which is a file, allowed is a folder")
    folder.mkdir(exist_ok=True)
    return folder


def _hashes(images: Images) -> dict[str, str]:
    """Hexadecimal SHA-256 of each file of images, by its path."""
    digests = {}
    for path in images.paths:
        with open(path, "rb") as file:
            digests[str(path)] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests


def _claim(folder: Path, call: dict[str, object]) -> None:
    """Note in the folder what it is for, or refuse it if it holds something else.

    Of a call that ended before it had results there is only the note, which does not hold.
    """
    note = folder / "call.json"
    others = sorted(path.name for path in folder.iterdir() if not path.name.startswith(".") and path != note)
    if others and not note.exists():
        raise ValueError(f"folder: got {str(folder)!r}, which holds {others[0]!r}, allowed is an empty folder")
    if not others:
        with written_whole(note) as temporary:
            temporary.write_text(json.dumps(call, indent=1), encoding="utf-8")
    try:
        before = json.loads(note.read_text(encoding="utf-8"))
        differ = [name for name in call if before[name] != call[name]]
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"folder: got {str(folder)!r}, whose {note.name} is damaged") from error
    if differ:
        raise ValueError(
            f"folder: got {str(folder)!r}, of a call with other {' and '.join(differ)}: take another folder"
        )


def _search_range(particles: pd.DataFrame, z_um: NDArray) -> tuple[float, float, float]:
    """Search range (x, y, z), µm, from how near to each other particles are in a frame."""
    distances = [
        KDTree(part[["x_um", "y_um"]]).query(part[["x_um", "y_um"]], k=2)[0][:, 1]
        for _, part in particles.groupby("frame")
        if len(part) > 1
    ]
    if not distances:
        raise ValueError("search_range_um: got none, and no frame has two particles to choose it from: give it")
    in_plane = NEIGHBOUR * float(np.median(np.concatenate(distances)))
    return in_plane, in_plane, DEPTH * float(z_um[-1] - z_um[0])


def _tracked(
    particles: pd.DataFrame, frame_rate_hz: float, search_range: ArrayLike, window: int, prepare: Preparation
) -> pd.DataFrame:
    """Tracks with velocities; where not every frame was measured, linked from one that was to the next."""
    from gdptlab.tracking import link, velocities

    counted = particles.assign(frame=(particles["frame"] - prepare.first) // prepare.every)
    n = counted["frame"].nunique()
    tracks = link(counted, search_range=search_range, predictor="nearest velocity", min_rows=min(10, (n + 1) // 2))
    tracks = velocities(tracks, frame_rate_hz / prepare.every, window=window)
    return tracks.assign(frame=prepare.first + prepare.every * tracks["frame"])


def _write(
    measured: Measured, film: Images | Prepared, um_per_px: float, frame_rate_hz: float | None, call: dict[str, object]
) -> None:
    """Write the results into their folder: tables, what other programs open, the page and, at last, the log."""
    folder, calibration, settings = measured.folder, measured.calibration, measured.settings
    notes = settings.arguments | {"um_per_px": um_per_px}
    notes |= {
        name: call["arguments"][name] for name in ("side", "flat_field", "prepare") if call["arguments"].get(name)
    }
    calibration.save(folder / "calibration.npz")
    save_table(measured.particles, folder / "particles.csv", calibration, **notes)
    save_points(measured.particles, folder / "points_napari.csv", "napari")
    for name, table in (("quality", measured.quality), ("settings", settings.table)):
        with written_whole(folder / f"{name}.csv") as temporary:
            table.to_csv(temporary)
    if measured.tracks is not None:
        from gdptlab.tracking import mean_field, save_paraview_field, save_paraview_tracks

        ranges = call["arguments"]["search_range_um"]
        save_table(measured.tracks, folder / "tracks.csv", calibration, **notes, search_range_um=ranges)
        save_paraview_tracks(measured.tracks, folder / "tracks.pvd", frame_rate_hz)
        edges = _edges(measured.tracks, call["arguments"]["cells"])
        if edges and measured.tracks["vx_um_s"].notna().any():
            field = mean_field(measured.tracks, edges)
            save_table(field, folder / "field.csv", calibration, **notes, search_range_um=ranges)
            save_paraview_field(field, folder / "field.vtr")
    write_page(folder / "report.html", f"gdptlab: {folder.name}", _page(measured, film))
    with written_whole(folder / "log.json") as temporary:
        temporary.write_text(as_json(call | about(calibration, settings.arguments)), encoding="utf-8")


def _edges(tracks: pd.DataFrame, cells: tuple[int, int, int]) -> dict[str, NDArray]:
    """Edges (n + 1,) of the cells of a grid about all positions, by axis; none if they do not span it."""
    edges = {}
    for axis, n in zip(("x_um", "y_um", "z_um"), cells, strict=True):
        low, high = tracks[axis].min(), tracks[axis].max()
        if not low < high:
            return {}
        edges[axis] = np.linspace(low, high, n + 1)
    return edges


def _page(measured: Measured, film: Images | Prepared) -> dict[str, object]:
    """Headings, and what stands under them, of the page of results."""
    from gdptlab import plots

    particles, bad = measured.particles, measured.bad
    verdict = f"Bad: {', '.join(bad)}. Read the advice before you believe what comes." if bad else "Nothing is bad."
    done = film.preparation if isinstance(film, Prepared) else Preparation()
    numbers = range(done.first, done.first + done.every * len(film), done.every)
    parts = {
        "Is the calibration good?": verdict,
        "What was asked of it": measured.quality,
        "Beads and depths": plots.calibration_page(measured.calibration),
        "Settings": measured.settings.table,
        "What was measured": measured.summary(numbers),
    }
    k = len(film) // 2
    left, top = (0, 0) if done.region is None else done.region[:2]
    here = particles[particles["frame"] == numbers[k]].assign(
        x_px=lambda table: table["x_px"] - left, y_px=lambda table: table["y_px"] - top
    )
    parts[f"Frame {numbers[k]}"] = plots.measured_page(film[k], here, measured.settings, measured.calibration)
    return parts
