"""From a scan and a film to a folder of results, in one call: notebook 13 is this call taken apart."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from gdptlab._checks import number, positive
from gdptlab._checks import path as check_path
from gdptlab._files import written_whole
from gdptlab.calibration import Calibration
from gdptlab.pipeline.images import Images, open_images, open_scan
from gdptlab.pipeline.page import write_page
from gdptlab.pipeline.quality import report
from gdptlab.pipeline.settings import Settings, choose_settings
from gdptlab.pipeline.stream import batch_to_parquet
from gdptlab.pipeline.tables import about, as_json, in_um, save_points, save_table

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


def measure(
    scan: str | os.PathLike[str],
    frames: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    *,
    z_um: tuple[float, float] | None = None,
    um_per_px: float | None = None,
    frame_rate_hz: float | None = None,
    search_range_um: tuple[float, float, float] | None = None,
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
    n_jobs, progress
        As for `batch`; with the joint fit one process is used.
    **choices
        What is not to be chosen from the images: `beads_px`, `size`, `n_sub` of `Calibration.from_scan`; `method`,
        `threshold`, `refine`, `min_distance_px` of `choose_settings`.

    Returns
    -------
    Measured
        In its folder: `report.html`, a page that shows whether to trust it; `particles.csv` and `points_napari.csv`;
        with a frame rate `tracks.csv` and, for ParaView, `tracks.pvd`; `quality.csv`, `settings.csv`,
        `calibration.npz`; `frames`, the parts of the table; `log.json`: inputs with their hashes, arguments, versions.

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
        positive("frame_rate_hz", frame_rate_hz)
    scanned, depths = _opened_scan(scan, z_um)
    z_um = None if z_um is None else [float(z) for z in z_um]
    film = open_images(frames)
    um_per_px = _um_per_px(um_per_px, film, scanned)
    folder = _folder(folder, frames)
    given = {"z_um": z_um, "um_per_px": um_per_px, "frame_rate_hz": frame_rate_hz, "search_range_um": search_range_um}
    inputs = {name: _hashes(images) for name, images in (("scan", scanned), ("frames", film))}
    _claim(folder, json.loads(as_json({"inputs": inputs, "settings": given | choices})))

    calibration = Calibration.from_scan(scanned, depths, **{k: v for k, v in choices.items() if k in OF_SCAN})
    quality = report(calibration)
    settings = choose_settings(film, calibration, **{k: v for k, v in choices.items() if k in OF_FRAMES})
    n_jobs = 1 if settings.arguments["method"] == "joint" else n_jobs
    parts = batch_to_parquet(
        film, calibration, folder / "frames", n_jobs=n_jobs, progress=progress, **settings.arguments
    )
    particles, tracks = in_um(pd.read_parquet(parts), um_per_px), None
    if frame_rate_hz is not None:
        ranges = search_range_um or _search_range(particles, depths)
        tracks = _tracked(particles, frame_rate_hz, ranges)
        given["search_range_um"] = tuple(ranges)
    measured = Measured(folder, calibration, quality, settings, particles, tracks)
    _write(measured, film, um_per_px, frame_rate_hz, {"inputs": inputs, "arguments": given | choices})
    return measured


def _opened_scan(scan: str | os.PathLike[str], z_um: tuple[float, float] | None) -> tuple[Images, NDArray[np.float64]]:
    """Images of a scan (N, rows, columns) and their depths (N,), by increasing depth."""
    if z_um is None:
        return open_scan(scan)
    if not isinstance(z_um, Sequence | np.ndarray) or np.shape(z_um) != (2,):
        raise TypeError(f"z_um: got {z_um!r}, allowed are two numbers: the first and the last depth")
    z_um = tuple(number("z_um", float(z) if isinstance(z, np.generic) else z) for z in z_um)
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
    """Note in the folder what it is for, or refuse it if it is for something else."""
    note = folder / "call.json"
    if not note.exists():
        others = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
        if others:
            raise ValueError(f"folder: got {str(folder)!r}, which holds {others[0]!r}, allowed is an empty folder")
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


def _tracked(particles: pd.DataFrame, frame_rate_hz: float, search_range: ArrayLike) -> pd.DataFrame:
    """Tracks with velocities."""
    from gdptlab.tracking import link, velocities

    tracks = link(particles, search_range=search_range, predictor="nearest velocity")
    return velocities(tracks, frame_rate_hz)


def _write(
    measured: Measured, film: Images, um_per_px: float, frame_rate_hz: float | None, call: dict[str, object]
) -> None:
    """Write the results into their folder: tables, what other programs open, the page and, at last, the log."""
    folder, calibration, settings = measured.folder, measured.calibration, measured.settings
    notes = settings.arguments | {"um_per_px": um_per_px}
    calibration.save(folder / "calibration.npz")
    save_table(measured.particles, folder / "particles.csv", calibration, **notes)
    save_points(measured.particles, folder / "points_napari.csv", "napari")
    for name, table in (("quality", measured.quality), ("settings", settings.table)):
        with written_whole(folder / f"{name}.csv") as temporary:
            table.to_csv(temporary)
    if measured.tracks is not None:
        from gdptlab.tracking import save_paraview_tracks

        ranges = call["arguments"]["search_range_um"]
        save_table(measured.tracks, folder / "tracks.csv", calibration, **notes, search_range_um=ranges)
        save_paraview_tracks(measured.tracks, folder / "tracks.pvd", frame_rate_hz)
    write_page(folder / "report.html", f"gdptlab: {folder.name}", _page(measured, film))
    with written_whole(folder / "log.json") as temporary:
        temporary.write_text(as_json(call | about(calibration, settings.arguments)), encoding="utf-8")


def _page(measured: Measured, film: Images) -> dict[str, object]:
    """Headings, and what stands under them, of the page of results."""
    from gdptlab import plots

    particles, tracks = measured.particles, measured.tracks
    bad = measured.bad
    verdict = f"Bad: {', '.join(bad)}. Read the advice before you believe what comes." if bad else "Nothing is bad."
    found = particles.groupby("frame").size().reindex(range(len(film)), fill_value=0)
    text = f"{len(particles)} particles in {len(film)} frames, {found.min()} to {found.max()} in a frame."
    if tracks is not None:
        text += f" {tracks['particle'].nunique()} tracks, of {len(tracks)} of them."
    parts = {
        "Is the calibration good?": verdict,
        "What was asked of it": measured.quality,
        "Beads and depths": plots.calibration_page(measured.calibration),
        "Settings": measured.settings.table,
        "What was measured": text,
    }
    k = len(film) // 2
    here = particles[particles["frame"] == k]
    parts[f"Frame {k}"] = plots.measured_page(film[k], here, measured.settings, measured.calibration)
    return parts
