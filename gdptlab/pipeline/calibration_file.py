"""The file of a calibration: numpy's .npz, looked at before anything is unpacked, and never unpickled."""

import os
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gdptlab._checks import path as check_path
from gdptlab._files import written_whole
from gdptlab.calibration import Calibration
from gdptlab.fit.model import PatternModel
from gdptlab.preparation import Preparation

VERSION = 1
"""Of the file format of `Calibration.save`."""

PARTS = {"stack": 3, "z_um": 1, "subset": 1, "templates": 3}
"""Arrays in the file of `Calibration.save`, and how many axes each has."""

EXTRAS = {"depth_factor": 0, "dark": 2, "flat": 2}
"""Arrays that the file holds only if there is something to say, and how many axes each has."""

LEARNED = {
    "patterns": 4, "z_um": 1, "nodes_per_px": 0, "noise": 0, "size": 0, "pattern_error": 3, "own_error": 2,
    "own_bias_um": 1, "surface": 1, "modes": 4,
}  # fmt: skip
"""Attributes of the pattern model that was learned from a scan, stored as `learned_...`, and how many axes each has."""

OPTIONAL = EXTRAS | {f"learned_{name}": axes for name, axes in LEARNED.items()}
"""All arrays that a file may lack."""

MOST_PIXELS = 10**9
"""Largest number of pixels of an array that is optional. Derived: cameras have a tenth, memory holds ten times."""


def write(calibration: Calibration, path: str | os.PathLike) -> None:
    """Write a calibration, as `Calibration.save` says."""
    path = check_path("path", path, ".npz")
    parts = {part: getattr(calibration, part) for part in PARTS} | {"gdptlab_calibration": VERSION}
    if calibration.depth_factor != 1:
        parts["depth_factor"] = np.float64(calibration.depth_factor)
    if calibration.camera is not None:
        images = {"dark": calibration.camera.dark, "flat": calibration.camera.flat}
        parts |= {name: image for name, image in images.items() if image is not None}
    if calibration.learned is not None:
        attributes = {name: getattr(calibration.learned, name) for name in LEARNED}
        parts |= {f"learned_{name}": value for name, value in attributes.items() if value is not None}
    with written_whole(path) as temporary:
        np.savez_compressed(temporary, **parts)


def read(path: str | os.PathLike) -> dict[str, Any]:
    """Attributes of a calibration by name, as `Calibration.load` says."""
    name = check_path("path", path).name
    try:
        with zipfile.ZipFile(path) as archive:
            shapes = {part.removesuffix(".npy"): _shape(archive, part) for part in archive.namelist()}
            _must_fit(shapes, {part.filename: part.file_size for part in archive.infolist()})
        with np.load(path, allow_pickle=False) as file:
            version = file["gdptlab_calibration"]
            if not np.array_equal(version, VERSION):
                raise ValueError(f"it is of version {version}, allowed is version {VERSION}")
            data = {part: file[part] for part in PARTS}
            extras = {part: file[part] for part in EXTRAS if part in file}
            learned = {name: file[f"learned_{name}"] for name in LEARNED if f"learned_{name}" in file}
        _must_be_sound(data)
        if learned:
            data["learned"] = _sound_model(learned)
        data["depth_factor"], data["camera"] = _sound_extras(extras)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"path: got {str(path)!r}, allowed is a file") from error
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise ValueError(f"path: got {name!r}, which cannot be read as a calibration: {error}") from error
    return data


def _sound_extras(extras: dict[str, NDArray]) -> tuple[float, Preparation | None]:
    """Depth factor and camera of a file, or ValueError if they are not sound."""
    for part, values in extras.items():
        if values.dtype.kind != "f" or values.ndim != EXTRAS[part] or not np.isfinite(values).all():
            raise ValueError(f"{part} holds what is not finite or not of its type, {values.dtype}")
    factor = float(extras.pop("depth_factor", 1.0))
    if not 0.1 <= factor <= 10:
        raise ValueError(f"depth_factor is {factor:g}, allowed is 0.1 to 10")
    return factor, Preparation(**extras) if extras else None


def _sound_model(parts: dict[str, NDArray]) -> PatternModel:
    """Pattern model of a file, or ValueError if it is not sound."""
    missing = set(LEARNED) - {"modes"} - set(parts)
    if missing:
        raise ValueError(f"it lacks learned_{', learned_'.join(sorted(missing))}")
    for name, values in parts.items():
        kind = "i" if name in ("nodes_per_px", "size") else "f"
        if values.dtype.kind != kind or values.ndim != LEARNED[name] or not np.isfinite(values).all():
            raise ValueError(f"learned_{name} holds what is not finite or not of its type, {values.dtype}")
    terms, count, m, _ = parts["patterns"].shape
    nodes, modes = int(parts["nodes_per_px"]), parts.get("modes", parts["patterns"])
    shapes = {"patterns": (terms, count, m, m), "pattern_error": (count, m, m), "own_error": (count, 3)}
    shapes |= {"z_um": (count,), "own_bias_um": (count,), "surface": (4,)}
    fits = all(parts[name].shape == shape for name, shape in shapes.items()) and modes.shape[1:] == (count, m, m)
    known = terms in (1, 4) and nodes in (1, 2) and m % (2 * nodes) == 1
    if not (fits and known and (np.diff(parts["z_um"]) > 0).all()):
        raise ValueError("its learned patterns do not fit each other")
    scalars = {"nodes_per_px": nodes, "size": int(parts["size"]), "noise": float(parts["noise"])}
    return PatternModel(**parts | scalars)


def _shape(archive: zipfile.ZipFile, part: str) -> tuple[int, ...]:
    """Shape of an array in a file of numpy's, from its header alone."""
    with archive.open(part) as opened:
        major = np.lib.format.read_magic(opened)[0]
        header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        return header(opened)[0]


def _must_fit(shapes: dict[str, tuple[int, ...]], sizes: dict[str, int]) -> None:
    """Raise ValueError unless the arrays of a file, by their shapes, are those of a calibration and fit each other."""
    if set(shapes) - set(OPTIONAL) != {"gdptlab_calibration", *PARTS}:
        raise ValueError(f"it holds {', '.join(shapes)}, needed are gdptlab_calibration, {', '.join(PARTS)}")
    stack, images = shapes["stack"], len(shapes["z_um"]) and shapes["z_um"][0]
    square = len(stack) == 3 and stack[0] == images >= 3 and stack[1] == stack[2] and stack[1] % 2 == 1
    subset = len(shapes["subset"]) == 1 and 2 <= shapes["subset"][0] <= images
    if not (square and subset and len(shapes["z_um"]) == 1 and shapes["templates"] == stack):
        raise ValueError(f"its arrays have shapes that do not fit each other: {shapes}")
    images = {f"{part}.npy": int(np.prod(shapes[part])) for part in OPTIONAL if part in shapes}
    if any(sizes[name] > 8 * min(n, MOST_PIXELS) + 1000 for name, n in images.items()):
        raise ValueError(f"its images have more bytes than shapes, or more than {MOST_PIXELS} pixels: {sizes}")
    if max(size for name, size in sizes.items() if name not in images) > 16 * np.prod(stack) + 1000:
        raise ValueError(f"its arrays have more bytes than shapes: {sizes}")


def _must_be_sound(data: dict[str, NDArray]) -> None:
    """Raise ValueError unless arrays that fit each other are what `from_stack` would make of them."""
    for part in PARTS:
        if data[part].dtype.kind != ("i" if part == "subset" else "f") or not np.isfinite(data[part]).all():
            raise ValueError(f"{part} holds what is not finite or not of its type, {data[part].dtype}")
    if not (np.diff(data["z_um"]) > 0).all():
        raise ValueError("z_um does not increase")
    subset = data["subset"]
    if subset.min() < 0 or subset.max() >= len(data["stack"]) or not (np.diff(subset) > 0).all():
        raise ValueError(f"subset does not name images in increasing order: {subset}")
    if np.abs(np.linalg.norm(data["templates"], axis=(1, 2)) - 1).max() > 1e-3:
        raise ValueError("templates do not have norm 1")
