"""Kinds of microscope image, and the camera that records them.

The paper's three kinds (its section 3 and Figure 3) are functions of the light that the particles
send to the sensor: `fluorescent` leaves it, `brightfield` inverts it, `disturbed` adds an uneven
illumination to the inverted image. `Camera` then turns light into counts.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gdptlab.check import choice, positive

WHITE = 20_000.0
"""Counts of the empty field in a brightfield image."""


def fluorescent(light: NDArray) -> NDArray:
    """Bright particles on a dark field: the light itself.

    Parameters
    ----------
    light : array (rows, columns)
        Counts that the particles alone would give.

    Returns
    -------
    array (rows, columns)
    """
    return light


def brightfield(light: NDArray, white: float = WHITE) -> NDArray:
    """Dark particles on a bright field: the fluorescent image inverted (paper, section 3).

    Parameters
    ----------
    light : array (rows, columns)
        Counts that the particles alone would give.
    white : float
        Counts of the empty field.

    Returns
    -------
    array (rows, columns)
    """
    return white - light


def disturbed(
    light: NDArray,
    amplitude: float = 80.0,
    period_px: tuple[float, float] = (512.0, 384.0),
    phase_rad: tuple[float, float] = (0.0, 0.0),
    white: float = WHITE,
) -> NDArray:
    """Brightfield with uneven illumination: a 2-D sinusoid is added (paper, section 3 and Figure 3c).

    Parameters
    ----------
    light : array (rows, columns)
        Counts that the particles alone would give.
    amplitude : float
        Half the swing of the sinusoid, counts.
    period_px : (float, float)
        Period along x and y, px.
    phase_rad : (float, float)
        Phase at pixel (0, 0) along x and y, rad.
    white : float
        Counts of the empty field.

    Returns
    -------
    array (rows, columns)
    """
    rows, columns = light.shape
    along_x = np.sin(2 * np.pi * np.arange(columns) / positive("period_px[0]", period_px[0]) + phase_rad[0])
    along_y = np.sin(2 * np.pi * np.arange(rows) / positive("period_px[1]", period_px[1]) + phase_rad[1])
    return brightfield(light, white) + amplitude * np.outer(along_y, along_x).astype(np.result_type(light, np.float32))


IMAGE_TYPES: dict[str, Callable[[NDArray], NDArray]] = {
    "fluorescent": fluorescent,
    "brightfield": brightfield,
    "disturbed": disturbed,
}
"""The paper's three kinds of image by name, each with its default settings."""


def as_image_type(image_type: str | Callable[[NDArray], NDArray]) -> Callable[[NDArray], NDArray]:
    """Look up an image type by name; a function of an image passes through.

    Raises
    ------
    ValueError
        For a name that is not in `IMAGE_TYPES`.
    """
    if callable(image_type):
        return image_type
    return IMAGE_TYPES[choice("image_type", image_type, IMAGE_TYPES)]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A sensor: offset, read noise, photon noise, bit depth.

    Attributes
    ----------
    background : float
        Counts of a pixel without light.
    read_noise : float
        Standard deviation of the Gaussian noise of a pixel, counts. With the default microscope the
        dimmest particle of the channel (z = +50 µm) peaks ten times as high.
    electrons_per_count : float or None
        Photo-electrons behind one count of light; light then carries Poisson noise. None: no photon noise.
    bit_depth : int
        Counts are rounded and cut off at 2**bit_depth - 1 (at most 16).
    """

    background: float = 500.0
    read_noise: float = 38.0
    electrons_per_count: float | None = None
    bit_depth: int = 16

    def __post_init__(self) -> None:
        positive("background", self.background, zero=True)
        positive("read_noise", self.read_noise, zero=True)
        if self.electrons_per_count is not None:
            positive("electrons_per_count", self.electrons_per_count)
        if self.bit_depth not in range(1, 17):
            raise ValueError(f"bit_depth: got {self.bit_depth!r}, allowed are whole numbers from 1 to 16")

    def record(self, light: NDArray, rng: np.random.Generator | int | None = None) -> NDArray[np.uint16]:
        """Turn light into a frame.

        Parameters
        ----------
        light : array (rows, columns)
            Expected counts above the background; below zero is taken as no light.
        rng : numpy Generator or int, optional
            Source of the noise. Without it the frame is the one a noiseless camera would take.

        Returns
        -------
        uint16 array (rows, columns)
        """
        counts = np.maximum(light, 0, dtype=np.float32)
        if rng is not None:
            rng = np.random.default_rng(rng)
            if self.electrons_per_count is not None:
                gain = self.electrons_per_count
                counts = rng.poisson(counts * gain).astype(np.float32) / np.float32(gain)
            if self.read_noise:
                noise = rng.standard_normal(counts.shape, np.float32)
                noise *= np.float32(self.read_noise)
                counts += noise
        counts += np.float32(self.background)
        np.clip(np.rint(counts, out=counts), 0, 2**self.bit_depth - 1, out=counts)
        return counts.astype(np.uint16)
