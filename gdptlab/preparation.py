"""Images as they come, made ready to be measured: dark and flat image, background, mask, region, frames.

`Preparation` says what is to be done, once for the notebook, the command and the report. Called with a film it
gives a sequence whose frames are prepared when they are asked for; `restored` brings a table of what was measured there
back to the pixels and the frames of the film.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import positions, real_array, whole

BACKGROUNDS = ("median", "minimum")
"""Backgrounds that are taken from the film itself."""

LOOKED_AT = 25
"""Number of frames, evenly spread over the film, that a background is taken from. Derived: their median has a quarter
of a frame's noise; that many frames of 2048 by 2048 px take 0.4 GB."""

DARKEST = 0.02
"""Least light of a pixel of the flat image, as a fraction of its mean. Chosen: a pixel of less is dead, or in the dark,
and its noise would be enlarged fifty times."""

MOST = 10**9
"""Largest number of a frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Preparation:
    """What is done to frames before they are measured, in this order.

    Parameters
    ----------
    dark : array (rows, columns), optional
        Image without light; subtracted.
    flat : array (rows, columns), optional
        Image of even light, without particles; frames are divided by it, less the dark image, over its mean.
    background : "median", "minimum" or array (rows, columns), optional
        Subtracted: of each pixel the median, or the least, of `LOOKED_AT` frames from the whole film; or an image.
        Particles that stay in place vanish with it.
    mask : array (rows, columns), optional
        True, or not 0, where particles are measured. The rest is filled with the frame's median, and what is
        measured there left out.
    region : (left, top, right, bottom), optional
        Pixels that are measured: columns left to right - 1 and rows top to bottom - 1, counted from 0.
    first, last : int, optional
        Numbers of the first and the last frame that are measured, from 0; `last` may be beyond the end.
    every : int
        Every how many frames one is measured.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or images differ in shape.

    Examples
    --------
    >>> import numpy as np
    >>> film = np.arange(4 * 6 * 8).reshape(4, 6, 8)
    >>> half = Preparation(region=(4, 0, 8, 6), first=1, every=2)
    >>> half(film).shape
    (2, 6, 4)
    """

    dark: Any = None
    flat: Any = None
    background: Any = None
    mask: Any = None
    region: tuple[int, int, int, int] | None = None
    first: int = 0
    last: int | None = None
    every: int = 1

    def __post_init__(self) -> None:
        images = {name: getattr(self, name) for name in ("dark", "flat", "background", "mask")}
        if isinstance(self.background, str):
            if images.pop("background") not in BACKGROUNDS:
                raise ValueError(f"background: got {self.background!r}, allowed are {BACKGROUNDS} and an image")
        images = {name: real_array(name, image, 2) for name, image in images.items() if image is not None}
        shapes = {image.shape for image in images.values()}
        if len(shapes) > 1:
            said = ", ".join(f"{name} {image.shape}" for name, image in images.items())
            raise ValueError(f"{' and '.join(images)}: got images of different shapes, {said}; allowed is one")
        if "mask" in images:
            images["mask"] = images["mask"] != 0
            if not images["mask"].any():
                raise ValueError("mask: got one that leaves nothing, allowed is one that is True somewhere")
        for name, image in images.items():
            image.flags.writeable = False
            object.__setattr__(self, name, image)
        if self.flat is not None and not self._gain_is_sound():
            raise ValueError(
                f"flat: got pixels that have, less the dark image, under {DARKEST} of its mean light, allowed are more"
            )
        if self.region is not None:
            object.__setattr__(self, "region", _region(self.region))
            if shapes:
                _must_hold(next(iter(shapes)), self.region)
        whole("first", self.first, 0, MOST)
        whole("every", self.every, 1, MOST)
        if self.last is not None and whole("last", self.last, 0, MOST) < self.first:
            raise ValueError(f"last: got {self.last}, allowed is {self.first}, the first, and above")

    @cached_property
    def _gain(self) -> NDArray[np.float32] | None:
        """What frames are divided by: 1 on average."""
        if self.flat is None:
            return None
        light = self.flat.astype(np.float64) - (0 if self.dark is None else self.dark)
        return (light / light.mean()).astype(np.float32) if light.mean() > 0 else np.zeros_like(self.flat)

    def _gain_is_sound(self) -> bool:
        """Whether no pixel of the flat image is dark."""
        return bool(self._gain.min() >= DARKEST)

    @property
    def camera(self) -> Self | None:
        """The part that corrects the camera and the lamp, dark and flat image, and is the same for scan and film."""
        if self.dark is None and self.flat is None:
            return None
        return type(self)(dark=self.dark, flat=self.flat)

    def note(self) -> dict[str, object]:
        """What is done, for a file of notes: images by their SHA-256."""
        said: dict[str, object] = {}
        for name in ("dark", "flat", "background", "mask"):
            image = getattr(self, name)
            if isinstance(image, np.ndarray):
                image = hashlib.sha256(f"{image.shape}".encode() + image.tobytes()).hexdigest()
            said[name] = image
        region = None if self.region is None else list(self.region)
        said |= {"region": region, "first": self.first, "last": self.last, "every": self.every}
        return {name: value for name, value in said.items() if value is not None}

    def __call__(self, frames: Sequence[ArrayLike]) -> "Prepared":
        """Frames of a film as they are to be measured; none is read yet, but for the background.

        Parameters
        ----------
        frames : array (n, rows, columns), `Images`, or sequence of arrays (rows, columns)

        Returns
        -------
        Prepared

        Raises
        ------
        TypeError, ValueError
            If they are not of that form, not as large as the images or the region, or none is chosen.
        """
        return Prepared(self, frames)

    def restored(self, table: pd.DataFrame) -> pd.DataFrame:
        """Table of what was measured in prepared frames, in the pixels and by the frames of the film.

        Parameters
        ----------
        table : DataFrame
            Columns `x_px`, `y_px`, and `frame` if there are several.

        Returns
        -------
        DataFrame
            The same, without rows outside the mask.

        Raises
        ------
        TypeError, ValueError
            If it is not of that form.
        """
        positions("table", table, ("x_px", "y_px"))
        left, top = (0, 0) if self.region is None else self.region[:2]
        table = table.assign(x_px=table["x_px"] + left, y_px=table["y_px"] + top)
        if "frame" in table:
            table["frame"] = self.first + self.every * table["frame"]
        if self.mask is None:
            return table
        rows, columns = self.mask.shape
        at = [np.clip(np.rint(table[name]).astype(int), 0, n - 1) for name, n in (("y_px", rows), ("x_px", columns))]
        return table[self.mask[at[0], at[1]]].reset_index(drop=True)


def preparation(value: object) -> Preparation:
    """Return `value` if it is a Preparation.

    Raises
    ------
    TypeError
        If not.
    """
    if isinstance(value, Preparation):
        return value
    raise TypeError(f"prepare: got a {type(value).__name__}, allowed is a Preparation")


class Prepared(Sequence):
    """Frames of a film, prepared when they are asked for; made by calling a `Preparation`.

    ``np.asarray`` makes an array (n, rows, columns) of them. Slices are `Prepared`, too, and go to other processes
    as the names of files if the film is `Images`.

    Attributes
    ----------
    preparation : Preparation
    shape : tuple
        (n, rows, columns).
    """

    def __init__(self, preparation: Preparation, frames: Sequence[ArrayLike]) -> None:
        sized = hasattr(frames, "__len__") and hasattr(frames, "__getitem__") and getattr(frames, "ndim", 1) > 0
        if not sized or isinstance(frames, dict | str):
            raise TypeError(f"frames: got a {type(frames).__name__}, allowed is a sequence of arrays, of known length")
        last = len(frames) if preparation.last is None else min(preparation.last + 1, len(frames))
        number = range(preparation.first, last, preparation.every)
        if not len(number):
            raise ValueError(
                f"frames: got {len(frames)}, none from frame {preparation.first} on, allowed is one or more"
            )
        sample = real_array("frames", frames[number[0]], 2)
        self._whole = sample.shape
        image = next((i for i in _images(preparation)), None)
        if image is not None and image.shape != sample.shape:
            raise ValueError(
                f"frames: got some of {sample.shape} px, allowed is the shape of the images, {image.shape}"
            )
        region = preparation.region or (0, 0, *sample.shape[::-1])
        _must_hold(sample.shape, region)
        self.preparation, self._frames, self._number = preparation, frames, number
        self.shape = (len(number), region[3] - region[1], region[2] - region[0])
        self.um_per_px = getattr(frames, "um_per_px", None)
        self._background = preparation.background
        if isinstance(self._background, str):
            looked = np.unique(np.rint(np.linspace(0, len(number) - 1, LOOKED_AT)).astype(int))
            images = [self._corrected(frames[number[k]]) for k in looked.tolist()]
            self._background = np.median(images, axis=0) if self._background == "median" else np.min(images, axis=0)

    ndim = 3
    dtype = np.dtype(np.float32)

    def __len__(self) -> int:
        return len(self._number)

    def __getitem__(self, index: Any) -> Any:
        if not isinstance(index, slice):
            return self._made(self._frames[self._number[index]])
        part, number = object.__new__(type(self)), self._number[index]
        part.__dict__ |= self.__dict__ | {"_number": number, "shape": (len(number), *self.shape[1:])}
        if self._sliceable(number):  # so that a part that goes to another process does not take the film along
            part._frames = self._frames[number.start : number.stop : number.step]
            part._number = range(len(number))
        return part

    def _sliceable(self, number: range) -> bool:
        """Whether these of the film's frames can be had at once, of an array or of `Images`."""
        return len(getattr(self._frames, "shape", ())) == 3 and number.step > 0

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        number, frames = self._number, self._frames
        if self._sliceable(number):  # a file is then opened once
            frames = frames[number.start : number.stop : number.step]
            yield from map(self._made, frames)
        else:
            yield from (self._made(frames[k]) for k in number)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        if copy is False:
            raise ValueError("copy: got False, allowed are True and None for images that are still to be prepared")
        return np.stack(list(self)).astype(dtype or self.dtype, copy=False)

    def _corrected(self, frame: ArrayLike) -> NDArray[np.float32]:
        """Frame (rows, columns) with the dark and the flat image taken into account."""
        image = real_array("frames", frame, 2)
        if image.shape != self._whole:
            raise ValueError(f"frames: got one of {image.shape} px, allowed is that of the first, {self._whole}")
        if self.preparation.dark is not None:
            image = image - self.preparation.dark
        return image if self.preparation._gain is None else image / self.preparation._gain

    def _made(self, frame: ArrayLike) -> NDArray[np.float32]:
        """Frame, all done."""
        image, done = self._corrected(frame), self.preparation
        if self._background is not None:
            image = image - self._background
        if done.mask is not None:
            image = np.where(done.mask, image, np.float32(np.median(image[done.mask])))
        if done.region is not None:
            left, top, right, bottom = done.region
            image = np.ascontiguousarray(image[top:bottom, left:right])
        return image.astype(np.float32, copy=False)


def _images(done: Preparation) -> Iterator[NDArray]:
    """Images that frames are to have the shape of."""
    yield from (i for i in (done.dark, done.flat, done.background, done.mask) if isinstance(i, np.ndarray))


def _region(region: object) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of a region, if it is one."""
    if not isinstance(region, tuple | list) or len(region) != 4:
        raise TypeError(f"region: got {region!r}, allowed are four whole numbers: left, top, right, bottom")
    left, top, right, bottom = (whole("region", value, 0, MOST) for value in region)
    if not (left < right and top < bottom):
        raise ValueError(f"region: got {region!r}, allowed is left below right, and top below bottom")
    return left, top, right, bottom


def _must_hold(shape: tuple[int, int], region: tuple[int, int, int, int]) -> None:
    """Refuse a region that is not in a frame of a shape."""
    if region[2] > shape[1] or region[3] > shape[0]:
        raise ValueError(f"region: got {region}, allowed is one in frames of {shape[1]} by {shape[0]} px")
