"""From a frame to a table of particles, without segmentation.

By correlation (the paper's section 2):

1. The frame is correlated with the N_sub images of the calibration's subset (Figure 2b).
2. Candidates are local peaks, in any of the maps, above a threshold.
3. A candidate's profile is the highest C_m in each map within two pixels of the peak (Figure 2c), at the top of
   parabolas through the neighbouring pixels: peaks lie between pixels, and those of different maps a pixel apart.
4. z is where the measured profile agrees best with an expected one, by Pearson's correlation, which is blind
   to the noise that lowers the whole profile; a parabola through the best three gives the part of a step.
5. Refinement: the candidate's window is correlated with stack images from the guess onward, uphill along z
   until C_m no longer rises. Between pixels and images, x, y and z are the least-squares displacement of the
   best image within that window.
6. Of candidates nearer to each other than `min_distance_px` the one with the highest C_m stays.

A particle is then measured only if its whole window lies in the frame; nothing is said of a border half a
template wide. Or jointly (`fit`): particles may overlap and be cut by the frame's edge.
"""

from collections.abc import Container, Iterable, Iterator
from itertools import count, islice
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from gdptlab.calibration import Calibration, checked
from gdptlab.check import choice, flag, positive, real_array, whole
from gdptlab.cores import on_one_core
from gdptlab.images import Images
from gdptlab.peaks import peaks, strongest

if TYPE_CHECKING:
    from gdptlab.fit import Explained, Joint

COLUMNS = {"x_px": float, "y_px": float, "z_um": float, "cm": float, "at_end": bool}
"""Columns of the table that `locate` returns, and their types."""

METHODS = ("correlation", "joint")
"""How `locate` can work."""

BLOCK = 25
"""Consecutive frames that `batch` hands to a process: long against what it costs to hand them over."""


@on_one_core
def locate(
    image: ArrayLike,
    calibration: Calibration,
    *,
    method: str = "correlation",
    threshold: float = 0.5,
    refine: bool = True,
    min_distance_px: float | None = None,
) -> pd.DataFrame:
    """Measure x, y and z of every particle in a frame.

    Parameters
    ----------
    image : array (rows, columns)
        Any real type, no smaller than a template.
    calibration : Calibration
    method : str
        "correlation", or "joint": all particles fitted at once, for those that overlap. That is slower. It finds
        its own threshold, from the noise, and how far amplitudes differ.
    threshold : float
        Of "correlation", as are the next two. Lowest C_m of a particle, above 0, at most 1.
    refine : bool
        Walk along the whole stack to the best C_m. Without it, z comes from the subset's profile alone.
    min_distance_px : float, optional
        Nearest that two particles can be told apart; a quarter of a template if not given.

    Returns
    -------
    DataFrame
        A row for each particle, highest C_m first. `x_px` to the right and `y_px` down, the first pixel's
        centre at (0, 0); `z_um` in the depths of the calibration; `cm`, the correlation with the best image;
        `at_end`, whether that is the stack's first or last image, so that z may lie beyond it. With
        "joint" there are more columns, and counts of what was left out in `attrs` (see `fit.Joint.table`).

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
    if choice("method", method, METHODS) == "joint":
        if positive("threshold", threshold) != 0.5 or not flag("refine", refine) or min_distance_px is not None:
            raise ValueError("threshold, refine, min_distance_px: got one with method 'joint', which has none of them")
        return _jointly(image, calibration, None)[0]
    image, distance = _checked(image, calibration, threshold, min_distance_px)
    place, step, cm = _candidates(image, calibration, threshold)
    if flag("refine", refine):
        place, step, cm = _refined(image, calibration, place, step)
    kept = strongest(place, np.where(cm >= threshold, cm, 0), distance)
    place, step, cm = place[kept], step[kept], cm[kept]
    if not refine:
        first = _pixels(image, calibration, place)
        shift = calibration.displacement(image, first, np.rint(step))
        place = first + calibration.size // 2 + np.clip(shift[:, :2], -1, 1)
    return _table(place, step, cm, calibration.z_um)


def _checked(
    image: ArrayLike, calibration: Calibration, threshold: float, min_distance_px: float | None
) -> tuple[NDArray[np.float32], float]:
    """Image, less its mean, and distance in px, if all four are what `locate` takes."""
    image = _image(image, calibration)
    if not 0 < positive("threshold", threshold) <= 1:
        raise ValueError(f"threshold: got {threshold}, allowed is above 0 and at most 1")
    distance = (
        calibration.size / 4 if min_distance_px is None else positive("min_distance_px", min_distance_px, zero=True)
    )
    return image - np.float32(cv2.mean(image)[0]), distance


def _image(image: ArrayLike, calibration: Calibration) -> NDArray[np.float32]:
    """Image, if it is one that holds at least a template."""
    size = checked(calibration).size
    image = real_array("image", image, 2)
    if min(image.shape) < size:
        raise ValueError(f"image: got shape {image.shape}, allowed is no smaller than a template, {(size, size)}")
    return image


def _table(place: NDArray, step: NDArray, cm: NDArray, z_um: NDArray) -> pd.DataFrame:
    """What `locate` returns, of places (y, x) (n, 2), z in steps of the stack, C_m, and the depths of the steps."""
    last = len(z_um) - 1
    return pd.DataFrame(
        {
            "x_px": place[:, 1].astype(float),
            "y_px": place[:, 0].astype(float),
            "z_um": np.interp(step, np.arange(last + 1), z_um),
            "cm": np.minimum(cm, 1).astype(float),
            "at_end": (step <= 0) | (step >= last),
        }
    )


def _jointly(
    image: ArrayLike, calibration: Calibration, before: "Explained | None"
) -> tuple[pd.DataFrame, "Explained"]:
    """Table of a frame by the joint fit, and where the next frame may begin."""
    image = _image(image, calibration)
    plan = calibration.plan(_joint, image.shape)
    if before is None or before.fit.residual.shape != image.shape:
        explained = plan.first(image)
    else:
        explained = plan.following(image, before)
    return plan.table(explained), explained


def _joint(calibration: Calibration, shape: tuple[int, int]) -> "Joint":
    from gdptlab.fit import Joint  # the fit's room stands on this module

    return Joint(calibration.model, shape)


def _candidates(
    image: NDArray[np.float32], calibration: Calibration, threshold: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Peaks of the correlation maps: place (y, x) (n, 2), z in steps of the stack, C_m."""
    scale, near = (2, 1) if calibration.half_resolution else (1, 2)
    searched = cv2.pyrDown(image) if scale == 2 else image
    maps = calibration.correlator(searched.shape)(searched)
    place, cm, profile = peaks(maps, threshold, near)
    likeness = _standardised(profile) @ _standardised(calibration.expected).T
    k = np.clip(likeness.argmax(axis=1), 1, len(calibration) - 2)
    step = k + _vertex(likeness[np.arange(len(k))[:, None], k[:, None] + (-1, 0, 1)])
    middle = calibration.search_templates.shape[-1] // 2
    return scale * (place + middle), step, cm


def _pixels(image: NDArray[np.float32], calibration: Calibration, place: NDArray) -> NDArray[np.int64]:
    """First pixels (n, 2) of the windows around `place` (n, 2), the nearest that lie in the image."""
    first = np.rint(place - calibration.size // 2).astype(int)
    return np.clip(first, 0, np.array(image.shape) - calibration.size)


def _refined(
    image: NDArray[np.float32], calibration: Calibration, place: NDArray, step: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Walk every candidate along the stack and across the pixels to its best C_m (0 if it leaves the frame)."""
    last = len(calibration) - 1
    start = _pixels(image, calibration, place), np.clip(np.rint(step), 0, last)
    first, k, cm, shift = calibration.displacement.walk(image, *start)
    part = np.clip(shift[:, 2] / np.gradient(calibration.z_um)[k], -0.5, 0.5)
    inner = (k > 0) & (k < last)
    return first + calibration.size // 2 + np.clip(shift[:, :2], -1, 1), k + np.where(inner, part, 0), cm


def _vertex(values: NDArray) -> NDArray:
    """Top, within (-1/2, 1/2), of the parabola through three values (n, 3) at -1, 0 and 1."""
    before, here, after = values.T
    bend = before + after - 2 * here
    slope = (after - before) / 2
    return np.clip(np.divide(-slope, bend, out=np.sign(slope) / 2, where=bend < 0), -0.5, 0.5)


def _standardised(profiles: NDArray) -> NDArray:
    """Rows with mean 0 and norm 1."""
    centred = profiles - profiles.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(centred, axis=1, keepdims=True)
    return centred / np.where(norm > 0, norm, 1)


def batch(
    frames: Iterable[ArrayLike],
    calibration: Calibration,
    *,
    n_jobs: int = 1,
    progress: bool = True,
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
    try:
        iter(frames)
    except TypeError as error:
        raise TypeError(f"frames: got a {type(frames).__name__}, allowed is an iterable of arrays") from error
    tables = [blank]
    total = len(frames) if hasattr(frames, "__len__") else None
    with tqdm(total=total, desc="frames", unit="frame", disable=not progress) as bar:
        for _, n, table in in_blocks(frames, calibration, n_jobs, settings):
            tables.append(table)
            bar.update(n)
    return pd.concat(tables, ignore_index=True)[[*blank]]


def blank_table(calibration: Calibration, n_jobs: int, settings: dict[str, object]) -> pd.DataFrame:
    """Table of a blank frame, as from `batch`, if the arguments are what that takes.

    What is wrong with the settings is refused before the film begins, and what a calibration makes only when it
    is needed is made here, not by every process for every block.
    """
    if n_jobs != -1:
        whole("n_jobs", n_jobs, 1, 10_000)
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
    if settings.get("method") == "joint":
        before = None
        for first, block in _blocks(frames, ()):
            tables = []
            for frame in block:
                table, before = on_one_core(_jointly)(frame, calibration, before)
                tables.append(table)
            if first not in done:
                yield first, len(tables), _numbered(tables, first)
        return
    jobs = (delayed(_located)(block, first, calibration, settings) for first, block in _blocks(frames, done))
    # What joblib puts into shared memory stays there until the last frame: of a long film too much.
    yield from Parallel(n_jobs=n_jobs, return_as="generator", pre_dispatch="n_jobs + 1", max_nbytes=None)(jobs)


def _blocks(frames: Iterable[ArrayLike], done: Container[int]) -> Iterator[tuple[int, Iterable[NDArray]]]:
    """Number of the first frame, and frames, of each block not in `done`, to be handed to a process."""
    is_dask = hasattr(frames, "dask")
    if isinstance(frames, Images | np.ndarray) or is_dask:
        blocks = (frames[first : first + BLOCK] for first in range(0, len(frames), BLOCK))  # nothing is read yet
    else:
        copies = map(np.array, frames)  # a camera may show every frame in the same piece of memory
        blocks = iter(lambda: list(islice(copies, BLOCK)), [])
    for first, block in zip(count(0, BLOCK), blocks, strict=False):
        if first not in done:
            # A list goes along with its task; an array a cluster would put on one worker, and lose with it.
            if not isinstance(block, Images):
                block = [np.array(one) for one in (block.compute(scheduler="synchronous") if is_dask else block)]
            yield first, block


def _located(
    block: Iterable[ArrayLike], first: int, calibration: Calibration, settings: dict[str, object]
) -> tuple[int, int, pd.DataFrame]:
    """Number of the first frame of a block, how many there are, and what is in them."""
    tables = [locate(frame, calibration, **settings) for frame in block]
    return first, len(tables), _numbered(tables, first)


def _numbered(tables: list[pd.DataFrame], first: int) -> pd.DataFrame:
    """Tables of consecutive frames as one, with the number of each frame."""
    table = pd.concat([table.assign(frame=i) for i, table in enumerate(tables, first)], ignore_index=True)
    return table[["frame", *table.columns.drop("frame")]]
