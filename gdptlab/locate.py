"""From a frame, or a film, to a table of particles, without segmentation.

By correlation (the paper's section 2):

1. The frame is correlated with the N_sub images of the calibration's subset (Figure 2b).
2. Candidates are the local maxima above a threshold in any of the maps.
3. The profile of a candidate is the highest C_m of each map within two pixels of the maximum (Figure 2c), taken at the
   vertex of parabolas through the neighbouring pixels: peaks lie between pixels, those of different maps a pixel apart.
4. z is where the measured profile agrees best with an expected one, by Pearson's correlation, since noise lowers
   the whole profile and Pearson's correlation does not depend on its level. A parabola through the best three gives z
   between slices.
5. Refinement: the window of the candidate is correlated with templates from that slice onward, uphill along z until C_m
   no longer rises; with all templates, if the stack resembles itself at distant depths, as rings and plain defocus do.
   Between pixels and slices, x, y and z follow from least squares in that window (`refinement`).
6. Of candidates nearer to each other than `min_distance_px` the one with the highest C_m stays.

A particle is measured only if its whole window lies in the frame, so that a border half a template wide stays empty.
With ``method="joint"`` all particles of a frame are fitted at once (`gdptlab.fit`): they may overlap and be cut by the
frame's edge.
"""

from collections.abc import Container, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import count, islice, product

import cv2
import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from gdptlab._checks import choice, flag, image_array, iterable, positive, processes
from gdptlab._compiled import on_one_core
from gdptlab._workers import leave_with_parent
from gdptlab.calibration import Calibration, checked
from gdptlab.correlation import peaks, standardised, strongest, vertex
from gdptlab.preparation import Preparation, Prepared, preparation

COLUMNS = {"x_px": float, "y_px": float, "z_um": float, "cm": float, "at_end": bool}
"""Columns of the table that `locate` returns by correlation, and their types."""

THRESHOLD = 0.5
"""Lowest C_m of a particle, if none is given (the paper, section 2: normally 0.5)."""

METHODS = ("correlation", "joint")
"""Methods of `locate`."""

TILE_PX = 1024
"""Largest number of rows and columns of a frame that is correlated as a whole; a larger one is cut into tiles that
overlap. Chosen on 8192 x 8192 px of uint16 and 9 templates: the
process takes 0.47 GB, or 0.55 GB where templates are searched for at full resolution; with 2048, 0.55 and 0.84 GB; as a
whole, 2.2 GB and more. The smaller the tiles, the more is computed twice. The table is the same."""

AROUND_PX = 16
"""Width, px, of a tile's border, besides half a template, within which no particle is looked for. Derived: a walk moves
a window by up to `refinement.MOST_WINDOWS` = 8 px, and the search, at half resolution, needs some 8 px about a peak."""

BLOCK = 25
"""Number of consecutive frames that `batch` hands to a process at a time. Chosen: measuring them takes some hundred
times as long as handing them over."""


@on_one_core
def locate(
    image: ArrayLike,
    calibration: Calibration,
    *,
    method: str = "correlation",
    threshold: float | None = None,
    refine: bool = True,
    min_distance_px: float | None = None,
    side: str | None = None,
) -> pd.DataFrame:
    """Measure x, y and z of every particle in a frame.

    Parameters
    ----------
    image : array (rows, columns)
        Any real type; no smaller than a template.
    calibration : Calibration
    method : str
        "correlation", or "joint": all particles are fitted at once, for particles that overlap. The joint fit is
        slower, and its threshold follows from the noise.
    threshold : float, optional
        Lowest C_m of a particle, above 0, at most 1; `THRESHOLD` if not given. Like the next two, it belongs to
        "correlation" and is refused with "joint".
    refine : bool
        Walk along the whole stack to the best C_m. Without refinement, z comes from the subset's profile alone.
    min_distance_px : float, optional
        Smallest distance of two particles; a quarter of a template if not given.
    side : str, optional
        "near" or "far": only depths on this side of focus, smaller or larger, for optics whose images look alike on
        both (`Calibration.one_side`).

    Returns
    -------
    DataFrame
        A row for each particle, highest C_m first. `x_px` to the right and `y_px` down, the first pixel's
        centre at (0, 0); `z_um` in the depths of the calibration; `cm`, the correlation with the best image;
        `at_end`, whether that is the stack's first or last image, so that z may lie beyond it. With
        "joint" `z_um` is less the calibration's own bias (`fit.own_bias_um`), and there are also `x_std_px`,
        `y_std_px` and `z_std_um`, standard deviations; `amplitude`, 1 for the calibration's particle; `chi2`, the mean
        square of the residual around the particle over its variance, well above 1 for what is no particle of this kind;
        and the columns that `fit.Joint.table` names.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or the image holds NaN or infinity.

    Examples
    --------
    >>> import gdptlab
    >>> from gdptlab import datasets
    >>> sample = datasets.sample("fluorescent")
    >>> calibration = gdptlab.Calibration.from_stack(sample.stack, sample.z_um)
    >>> table = gdptlab.locate(sample.frames[0], calibration)
    >>> list(table)
    ['x_px', 'y_px', 'z_um', 'cm', 'at_end']
    """
    if side is not None:
        calibration = checked(calibration).one_side(side)
    if choice("method", method, METHODS) == "joint":
        if threshold is not None or not flag("refine", refine) or min_distance_px is not None:
            raise ValueError("threshold, refine, min_distance_px: got one with method 'joint', which has none of them")
        from gdptlab.fit.frames import explained

        return explained(image, calibration)[0]
    threshold, found = THRESHOLD if threshold is None else threshold, []
    for tile, corner, limits in _tiles(image, checked(calibration).size):
        tile, distance = checked_frame(tile, calibration, threshold, min_distance_px)
        position, exact, slice_, cm = _found(tile, calibration, threshold, flag("refine", refine), limits - corner)
        found.append((position + corner, exact + corner, slice_, cm))
    position, exact, slice_, cm = map(np.concatenate, zip(*found, strict=True))
    kept = strongest(position, np.where(cm >= threshold, cm, 0), distance)
    return as_table(exact[kept], slice_[kept], cm[kept], calibration.z_um)


def _tiles(image: ArrayLike, size: int) -> Iterator[tuple[ArrayLike, NDArray, NDArray]]:
    """Cut a large frame, for templates of `size` px, into tiles of equal shape that overlap.

    Yields each tile, its first pixel (row, column), and the limits (2, 2) in the frame, lower and upper row and column,
    between which the tile alone counts. A frame that is not large, or no frame, is its own tile.
    """
    whole_ = not isinstance(image, np.ndarray) or image.ndim != 2 or min(image.shape) < size
    sides = [[(0, None, -np.inf, np.inf)]] * 2 if whole_ else [_sides(length, size) for length in image.shape]
    for (top, bottom, low_y, high_y), (left, right, low_x, high_x) in product(*sides):
        tile = image if whole_ else image[top:bottom, left:right]
        yield tile, np.array([top, left]), np.array([[low_y, low_x], [high_y, high_x]])


def _sides(length: int, size: int) -> list[tuple[int, int, float, float]]:
    """First pixel (even, for half resolution), end, and limits of each tile along an axis of a frame."""
    border = size // 2 + AROUND_PX
    edge = max(TILE_PX, 4 * border)
    if length <= edge:
        return [(0, length, -np.inf, np.inf)]
    edge -= (length - edge) % 2
    n = int(np.ceil((length - 2 * border) / (edge - 2 * border - 2)))
    first = 2 * np.rint(np.linspace(0, (length - edge) / 2, n)).astype(int)
    middles = (first[1:] + first[:-1] + edge) / 2  # of the overlaps
    return list(zip(first, first + edge, [-np.inf, *middles], [*middles, np.inf], strict=True))


def _found(
    image: NDArray[np.float32], calibration: Calibration, threshold: float, refine: bool, limits: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Candidates between limits (2, 2): positions (y, x) (n, 2), finer ones if not refined, slices and C_m (n,)."""
    position, slice_, cm = _candidates(image, calibration, threshold)
    here = ((position >= limits[0]) & (position < limits[1])).all(axis=1)
    position, slice_, cm = position[here], slice_[here], cm[here]
    if refine:
        position, slice_, cm = _refined(image, calibration, position, slice_)
        return position, position, slice_, cm
    first = _pixels(image, calibration, position)
    shift = calibration.displacement(image, first, np.rint(slice_))
    return position, first + calibration.size // 2 + np.clip(shift[:, :2], -1, 1), slice_, cm


def checked_frame(
    image: ArrayLike, calibration: Calibration, threshold: float, min_distance_px: float | None
) -> tuple[NDArray[np.float32], float]:
    """Check the arguments of `locate`; the image (rows, columns) less its mean, and the distance in px."""
    image = checked_image(image, calibration)
    if not 0 < positive("threshold", threshold) <= 1:
        raise ValueError(f"threshold: got {threshold}, allowed is above 0 and at most 1")
    distance = (
        calibration.size / 4 if min_distance_px is None else positive("min_distance_px", min_distance_px, zero=True)
    )
    return image - np.float32(cv2.mean(image)[0]), distance


def checked_image(image: ArrayLike, calibration: Calibration) -> NDArray[np.float32]:
    """Check that an image (rows, columns) holds at least a template; the image as float32."""
    size = checked(calibration).size
    image = image_array("image", image, 2)
    if min(image.shape) < size:
        raise ValueError(f"image: got shape {image.shape}, allowed is no smaller than a template, {(size, size)}")
    return image


def as_table(position: NDArray, slice_: NDArray, cm: NDArray, z_um: NDArray) -> pd.DataFrame:
    """Table of `locate`, from positions (y, x) (n, 2), z in slices (n,), C_m (n,) and the depths of the slices (N,)."""
    last = len(z_um) - 1
    return pd.DataFrame(
        {
            "x_px": position[:, 1].astype(float),
            "y_px": position[:, 0].astype(float),
            "z_um": np.interp(slice_, np.arange(last + 1), z_um),
            "cm": np.minimum(cm, 1).astype(float),
            "at_end": (slice_ <= 0) | (slice_ >= last),
        }
    )


def _candidates(
    image: NDArray[np.float32], calibration: Calibration, threshold: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Peaks of the correlation maps: positions (y, x) (n, 2), z in slices (n,), C_m (n,)."""
    scale, near = (2, 1) if calibration.half_resolution else (1, 2)
    margin = AROUND_PX if min(image.shape) < calibration.size + AROUND_PX else 0
    if margin:  # the rim of maps, where no peak is looked for, would be most of them
        image = cv2.copyMakeBorder(image, *(margin,) * 4, cv2.BORDER_REPLICATE)
    searched = cv2.pyrDown(image) if scale == 2 else image
    maps = calibration.correlator(searched.shape)(searched)
    position, cm, profile = peaks(maps, threshold, near)
    agreement = standardised(profile) @ standardised(calibration.expected).T
    k = np.clip(agreement.argmax(axis=1), 1, len(calibration) - 2)
    slice_ = k + vertex(agreement[np.arange(len(k))[:, None], k[:, None] + (-1, 0, 1)])
    middle = calibration.search_templates.shape[-1] // 2
    return scale * (position + middle) - margin, slice_, cm


def _pixels(image: NDArray[np.float32], calibration: Calibration, position: NDArray) -> NDArray[np.int64]:
    """First pixels (n, 2) of the windows nearest to `position` (n, 2) that lie in the image."""
    first = np.rint(position - calibration.size // 2).astype(int)
    return np.clip(first, 0, np.array(image.shape) - calibration.size)


def _refined(
    image: NDArray[np.float32], calibration: Calibration, position: NDArray, slice_: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Bring every candidate to the template and the pixel of its best C_m (0 if that leads out of the frame)."""
    last = len(calibration) - 1
    start = _pixels(image, calibration, position), np.clip(np.rint(slice_), 0, last)
    first, k, cm, shift = calibration.displacement.refine(image, *start)
    part = np.clip(shift[:, 2] / np.gradient(calibration.z_um)[k], -0.5, 0.5)
    inner = (k > 0) & (k < last)
    return first + calibration.size // 2 + np.clip(shift[:, :2], -1, 1), k + np.where(inner, part, 0), cm


def batch(
    frames: Iterable[ArrayLike],
    calibration: Calibration,
    *,
    n_jobs: int = 1,
    progress: bool = True,
    prepare: Preparation | None = None,
    **settings: object,
) -> pd.DataFrame:
    """Measure every particle in every frame.

    Parameters
    ----------
    frames : iterable of arrays (rows, columns)
        A list, a stack, a memory map, a dask array, a generator: read in blocks of `BLOCK` frames and at most
        `n_jobs` + 1 blocks ahead, so that a film need not fit into memory. Images of `open_images` are read by
        the process that measures them.
    calibration : Calibration
    n_jobs : int
        Processes to spread the blocks over; -1 for one per core. The result does not depend on it. They
        take some seconds to start, once, and stay for the next film. Under `joblib.parallel_config(backend="dask")`
        the blocks go to all workers of the dask cluster instead. With method "joint" it is 1.
    progress : bool
        Show a progress bar.
    prepare : Preparation, optional
        Dark and flat image, background, mask, region, frames. The table is in the pixels and by the frames of the film.
        Without a dark and a flat image, frames are corrected as the calibration's scan was (`Calibration.camera`).
    **settings
        Of `locate`. With method "joint" the frames should follow each other: each begins with the particles
        of the last, which keeps them apart where they meet later, and one that appears is in the table from
        the next frame on.

    Returns
    -------
    DataFrame
        As from `locate`, with the number of the frame (from 0) in the first column, `frame`.

    Raises
    ------
    TypeError, ValueError
        As `locate`: for settings at once, for frames at the first that is refused.
    """
    blank = blank_table(calibration, n_jobs, settings)
    if getattr(frames, "ndim", 3) == 2:
        raise ValueError(
            f"frames: got one of shape {frames.shape}, allowed is a film of them; `locate` measures one frame"
        )
    iterable("frames", frames)
    frames, prepare = prepared(frames, calibration, prepare)
    tables = [blank]
    total = len(frames) if hasattr(frames, "__len__") else None
    with tqdm(total=total, desc="frames", unit="frame", disable=not flag("progress", progress)) as bar:
        for _, n, table in in_blocks(frames, calibration, n_jobs, settings):
            tables.append(table)
            bar.update(n)
    table = pd.concat(tables, ignore_index=True)[[*blank]]
    return table if prepare is None else prepare.restored(table)


def prepared(
    frames: Iterable[ArrayLike], calibration: Calibration, prepare: Preparation | None
) -> tuple[Iterable[ArrayLike], Preparation | None]:
    """Frames as they are to be measured, and the preparation by which their table is to be restored, if there is one.

    Frames that are prepared already stay as they are.
    """
    if prepare is None and not isinstance(frames, Prepared):
        prepare = calibration.camera
    if prepare is None:
        return frames, None
    if isinstance(frames, Prepared):
        raise ValueError("prepare: got one for frames that are prepared already, allowed are frames as they come")
    prepare, camera = preparation(prepare), calibration.camera
    if prepare.camera is None and camera is not None:
        prepare = replace(prepare, dark=camera.dark, flat=camera.flat)
    return prepare(frames), prepare


def blank_table(calibration: Calibration, n_jobs: int, settings: dict[str, object]) -> pd.DataFrame:
    """Table of a blank frame, as from `batch`, if the arguments are what that takes.

    What is wrong with the settings is refused before the film begins, and what a calibration makes only when it
    is needed is made here, not by every process for every block.
    """
    n_jobs = processes("n_jobs", n_jobs)
    blank = locate(np.zeros((checked(calibration).size,) * 2), calibration, **settings)
    if settings.get("method") == "joint" and n_jobs != 1:
        raise ValueError(f"n_jobs: got {n_jobs}, allowed with method 'joint' is 1: a frame begins with the last")
    return blank.assign(frame=0)[["frame", *blank]]


def in_blocks(
    frames: Iterable[ArrayLike],
    calibration: Calibration,
    n_jobs: int,
    settings: dict[str, object],
    done: Container[int] = (),
) -> Iterator[tuple[int, int, pd.DataFrame]]:
    """Measure blocks of frames: number of the first frame, how many, and their table, in order.

    Blocks whose first frame is in `done` are left out. A film by the joint fit is one chain, so that what comes
    before a missing block is measured once more; otherwise blocks know nothing of each other.
    """
    if settings.get("side") is not None:
        calibration, settings = calibration.one_side(settings["side"]), settings | {"side": None}
    if settings.get("method") == "joint":
        from gdptlab.fit.frames import explained

        before = None
        for first, block in _blocks(frames, ()):
            tables = []
            for k, frame in enumerate(block, first):
                with _numbered_error(k):
                    table, before = explained(frame, calibration, before)
                tables.append(table)
            if first not in done:
                yield first, len(tables), _numbered(tables, first)
        return
    jobs = (delayed(_located)(block, first, calibration, settings) for first, block in _blocks(frames, done))
    # What joblib puts into shared memory stays there until the last frame: of a long film too much.
    how = {"pre_dispatch": "n_jobs + 1", "max_nbytes": None, "initializer": leave_with_parent}
    with closing(Parallel(n_jobs, return_as="generator", **how)(jobs)) as measured:  # in this thread, not by gc
        for first, n, table in measured:
            if isinstance(table, Exception):
                raise table
            yield first, n, table


def _blocks(frames: Iterable[ArrayLike], done: Container[int]) -> Iterator[tuple[int, Iterable[NDArray]]]:
    """Number of the first frame, and frames, of each block not in `done`, to be handed to a process."""
    if len(getattr(frames, "shape", ())) == 3:  # arrays of numpy, dask and zarr, and `Images`: nothing is read yet
        blocks = (frames[first : first + BLOCK] for first in range(0, len(frames), BLOCK))
    else:
        copies = _copies(frames)
        blocks = iter(lambda: list(islice(copies, BLOCK)), [])
    for first, block in zip(count(0, BLOCK), blocks, strict=False):
        if first not in done:
            # A list goes along with its task; an array a cluster would put on one worker, and lose with it.
            if hasattr(block, "dask"):
                block = block.compute(scheduler="synchronous")
            yield first, list(block.copy()) if isinstance(block, np.ndarray) else block


def _copies(frames: Iterable[ArrayLike]) -> Iterator[NDArray]:
    """Copies of frames (rows, columns), for a camera may show every frame in the same piece of memory."""
    shape = None
    for k, frame in enumerate(frames):
        copy = np.ma.array(frame) if np.ma.is_masked(frame) else np.array(frame)
        shape = shape or copy.shape
        if copy.shape != shape:
            raise ValueError(f"frames: got shape {copy.shape} in frame {k}, allowed is that of frame 0, {shape}")
        yield copy


def _located(
    block: Iterable[ArrayLike], first: int, calibration: Calibration, settings: dict[str, object]
) -> tuple[int, int, pd.DataFrame | Exception]:
    """Number of the first frame of a block, how many there are, and what is in them, or the error of one.

    An error that is raised in another process would stop the blocks before it, too, and they would be lost.
    """
    tables = []
    try:
        for k, frame in enumerate(block, first):
            with _numbered_error(k):
                tables.append(locate(frame, calibration, **settings))
    except Exception as error:
        return first, len(tables), error
    return first, len(tables), _numbered(tables, first)


@contextmanager
def _numbered_error(frame: int) -> Iterator[None]:
    """Add the number of the frame to an error about it."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = ValueError if isinstance(error, ValueError) else TypeError
        raise kind(f"{error} (frame {frame})") from error


def _numbered(tables: list[pd.DataFrame], first: int) -> pd.DataFrame:
    """Tables of consecutive frames as one, with the number of each frame."""
    table = pd.concat([table.assign(frame=i) for i, table in enumerate(tables, first)], ignore_index=True)
    return table[["frame", *table.columns.drop("frame")]]
