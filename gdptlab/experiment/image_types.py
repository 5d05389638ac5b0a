"""Kinds of microscope image, and the camera that records them.

The paper's three kinds (its section 3 and Figure 3) are functions of the light that the particles
send to the sensor: `fluorescent` leaves it, `brightfield` inverts it, `disturbed` adds an uneven
illumination to the inverted image. `Camera` then turns light into counts.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gdptlab._checks import choice, positive

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
