"""Tracks and fields for other programs: ParaView (VTK's XML files) and napari."""

import os
from base64 import b64encode
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gdptlab._checks import flag
from gdptlab._checks import path as check_path
from gdptlab._checks import rate as check_rate
from gdptlab._checks import table as check_table
from gdptlab._files import written_whole
from gdptlab.tracking.tracks import IN_CHANNEL, IN_UM, frames_of, positions_of

VERTEX = 1
"""VTK's number for a cell that is a single point."""


def save_paraview_tracks(tracks: pd.DataFrame, path: str | os.PathLike[str], frame_rate_hz: float = 1.0) -> None:
    """Write tracks as a series in time that ParaView opens: a `.pvd` file, and beside it a `.vtu` file for each frame.

    Parameters
    ----------
    tracks : DataFrame
        `frame`, and `x_channel_um`, `y_channel_um`, `z_um`, or `x_um`, `y_um`, `z_um`; all other columns of numbers
        become values at the points, and those of a velocity, `vx_um_s` and so on, also the vector `velocity`.
    path : str or path-like
        Ends in `.pvd`. The files of the frames are put into a folder of the same name without the ending.
    frame_rate_hz : float
        Times of the series are `frame / frame_rate_hz`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or a column is missing.
    FileNotFoundError
        If there is no such folder.
    """
    path, rate = _path(path, ".pvd"), check_rate("frame_rate_hz", frame_rate_hz)
    frames_of("tracks", tracks)
    position = _position_um(tracks)
    root, collection = _vtk_file("Collection")
    path.with_suffix("").mkdir(exist_ok=True)
    for frame, part in tracks.groupby("frame"):
        name = f"{path.stem}/{int(frame):06d}.vtu"
        _write_points(part, position, path.parent / name)
        SubElement(collection, "DataSet", timestep=repr(float(frame / rate)), part="0", file=name)
    _write(root, path)


def _write_points(part: pd.DataFrame, position: list[str], path: Path) -> None:
    """Write the particles of a frame as an unstructured grid of single points."""
    n = str(len(part))
    root, grid = _vtk_file("UnstructuredGrid")
    piece = SubElement(grid, "Piece", NumberOfPoints=n, NumberOfCells=n)
    _add_values(SubElement(piece, "PointData"), part.drop(columns=position))
    _add_array(SubElement(piece, "Points"), "Points", part[position].to_numpy(dtype=float))
    cells, each = SubElement(piece, "Cells"), np.arange(len(part))
    _add_array(cells, "connectivity", each)
    _add_array(cells, "offsets", each + 1)
    _add_array(cells, "types", np.full(len(part), VERTEX, dtype=np.uint8))
    _write(root, path)


def save_paraview_field(field: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write a field on a grid as a file that ParaView opens, its values at the middles of the cells.

    Parameters
    ----------
    field : DataFrame
        From `mean_field`, with one to three of `x_um`, `y_um`, `z_um` (or of `x_channel_um` and so on) as its axes.
    path : str or path-like
        Ends in `.vtr`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or the rows are not those of a grid.
    FileNotFoundError
        If there is no such folder.
    """
    path = _path(path, ".vtr")
    position = IN_CHANNEL if set(IN_CHANNEL[:2]) & set(check_table("field", field, ())) else IN_UM
    axes = [name for name in position if name in field]
    check_table("field", field, axes)
    middles = {name: np.unique(field[name].astype(float)) for name in axes}
    if not axes or len(field) != np.prod([len(middle) for middle in middles.values()]) or field.duplicated(axes).any():
        raise ValueError("field: got rows that are not the cells of a grid, allowed is a table from `mean_field`")
    field = field.sort_values(axes[::-1])  # VTK's first axis is the fastest
    coordinates = [middles.get(name, np.zeros(1)) for name in position]
    extent = " ".join(f"0 {len(each) - 1}" for each in coordinates)
    root, grid = _vtk_file("RectilinearGrid", WholeExtent=extent)
    piece = SubElement(grid, "Piece", Extent=extent)
    _add_values(SubElement(piece, "PointData"), field.drop(columns=axes))
    parent = SubElement(piece, "Coordinates")
    for name, each in zip(position, coordinates, strict=True):
        _add_array(parent, name, each)
    _write(root, path)


def napari_tracks(
    tracks: pd.DataFrame, *, in_um: bool = False
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Tracks as napari takes them: ``viewer.add_tracks(data, features=features)``.

    Parameters
    ----------
    tracks : DataFrame
        `frame`, `particle`, and `x_px`, `y_px` (or, `in_um`, what `save_paraview_tracks` takes).
    in_um : bool
        Whether tracks lie in space, in µm, or on the frames, in px.

    Returns
    -------
    data : array (n, 4) or (n, 5)
        Number of the track, frame, z (if `in_um`), y and x; sorted by track and frame.
    features : dict of array (n,)
        All other columns of numbers, to colour by.

    Raises
    ------
    TypeError, ValueError
        If `tracks` is no table, or a column is missing.
    """
    axes = ["particle", "frame", *(_position_um(tracks)[::-1] if flag("in_um", in_um) else ["y_px", "x_px"])]
    ordered = check_table("tracks", tracks, axes).sort_values(["particle", "frame"])
    others = [name for name in ordered if name not in axes and ordered[name].dtype.kind in "buif"]
    features = {name: ordered[name].to_numpy(dtype=float) for name in others}
    return ordered[axes].to_numpy(dtype=float), features


def _position_um(tracks: pd.DataFrame) -> list[str]:
    """Columns of positions in µm, in the channel or not, if tracks have them."""
    columns = positions_of("tracks", tracks)
    if columns not in (IN_CHANNEL, IN_UM):
        raise ValueError(f"tracks: got {', '.join(columns)}, needed are {', '.join(IN_UM)} (see pipeline.in_um)")
    return columns


def _path(path: str | os.PathLike[str], suffix: str) -> Path:
    """Path of a file, if it has this suffix."""
    path = check_path("path", path, suffix)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path: got {str(path)!r}, allowed is one in a folder that exists")
    return path


def _vtk_file(kind: str, **attributes: str) -> tuple[Element, Element]:
    """Root of a file of VTK's, and the element that holds what is in it."""
    root = Element("VTKFile", type=kind, version="1.0", byte_order="LittleEndian", header_type="UInt64")
    return root, SubElement(root, kind, **attributes)


def _add_values(parent: Element, table: pd.DataFrame) -> None:
    """Add each column of numbers as an array (n,), and those of a velocity as a vector (n, 3), too."""
    table = table[[name for name in table if table[name].dtype.kind in "buif"]]
    for name in table:
        _add_array(parent, str(name), table[name].to_numpy(dtype=float))
    velocity = [f"v{axis}_um_s" for axis in "xyz"]
    if set(velocity) & set(table):
        _add_array(parent, "velocity", table.reindex(columns=velocity, fill_value=0.0).to_numpy(dtype=float))


def _add_array(parent: Element, name: str, values: NDArray) -> None:
    """Add an array (n,) or (n, k), in base 64 after its number of bytes."""
    kind = {"f": "Float64", "i": "Int64", "u": "UInt8"}[values.dtype.kind]
    components = {"NumberOfComponents": str(values.shape[1])} if values.ndim == 2 else {}
    array = SubElement(parent, "DataArray", type=kind, Name=name, format="binary", **components)
    data = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"))).tobytes()
    array.text = b64encode(len(data).to_bytes(8, "little") + data).decode()


def _write(root: Element, path: Path) -> None:
    """Write a file of VTK's, whole or not at all."""
    indent(root)
    with written_whole(path) as temporary:
        ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
