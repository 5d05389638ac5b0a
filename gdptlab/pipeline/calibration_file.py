"""The file of a calibration: numpy's .npz, looked at before anything is unpacked, and never unpickled."""

import os
import zipfile

import numpy as np
from numpy.typing import NDArray

from gdptlab._checks import path as check_path
from gdptlab._files import written_whole
from gdptlab.calibration import Calibration

VERSION = 1
"""Of the file format of `Calibration.save`."""

PARTS = {"stack": 3, "z_um": 1, "subset": 1, "templates": 3}
"""Arrays in the file of `Calibration.save`, and how many axes each has."""


def write(calibration: Calibration, path: str | os.PathLike) -> None:
    """Write a calibration, as `Calibration.save` says."""
    path = check_path("path", path, ".npz")
    if calibration.learned is not None:
        raise ValueError("path: got a calibration with `learned` patterns, allowed is one without; learn it again")
    with written_whole(path) as temporary:
        np.savez_compressed(
            temporary,
            gdptlab_calibration=VERSION,
            stack=calibration.stack,
            z_um=calibration.z_um,
            subset=calibration.subset,
            templates=calibration.templates,
        )


def read(path: str | os.PathLike) -> dict[str, NDArray]:
    """Arrays of a calibration by name, as `Calibration.load` says."""
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
        _must_be_sound(data)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"path: got {str(path)!r}, allowed is a file") from error
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise ValueError(f"path: got {name!r}, which cannot be read as a calibration: {error}") from error
    return data


def _shape(archive: zipfile.ZipFile, part: str) -> tuple[int, ...]:
    """Shape of an array in a file of numpy's, from its header alone."""
    with archive.open(part) as opened:
        major = np.lib.format.read_magic(opened)[0]
        header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        return header(opened)[0]


def _must_fit(shapes: dict[str, tuple[int, ...]], sizes: dict[str, int]) -> None:
    """Raise ValueError unless the arrays of a file, by their shapes, are those of a calibration and fit each other."""
    if set(shapes) != {"gdptlab_calibration", *PARTS}:
        raise ValueError(f"it holds {', '.join(shapes)}, needed are gdptlab_calibration, {', '.join(PARTS)}")
    stack, images = shapes["stack"], len(shapes["z_um"]) and shapes["z_um"][0]
    square = len(stack) == 3 and stack[0] == images >= 3 and stack[1] == stack[2] and stack[1] % 2 == 1
    subset = len(shapes["subset"]) == 1 and 2 <= shapes["subset"][0] <= images
    if not (square and subset and len(shapes["z_um"]) == 1 and shapes["templates"] == stack):
        raise ValueError(f"its arrays have shapes that do not fit each other: {shapes}")
    if max(sizes.values()) > 16 * np.prod(stack) + 1000:
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
