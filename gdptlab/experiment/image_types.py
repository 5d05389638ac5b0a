"""Types of microscope image.

The paper's three types (its section 3 and Figure 3) are functions of the light that the particles
send to the sensor: `fluorescent` leaves it, `brightfield` inverts it, `disturbed` adds an uneven
illumination to the inverted image. A `Camera` then records the light as counts.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gdptlab._checks import choice, positive

WHITE = 20_000.0
"""Counts of the empty field in a brightfield image. The paper gives none. Chosen: twice the peak of the brightest
particle of the default microscope. Below that peak, images would be cut off at 0; far above, a camera saturates."""

AMPLITUDE = 400.0
"""Amplitude, counts, of the sinusoid in a disturbed image: 2 % of `WHITE`, ten times the default read noise. The paper
gives none. Chosen on 4 frames of 50 particles (seed 5; calibration stack and frames disturbed; periods as `PERIOD_PX`):

    counts    correlation: recall, precision    joint fit: recall, precision, RMS error of z
    80        0.54, 0.93                        1.00, 1.00, 0.33 µm
    400       0.53, 0.92                        1.00, 1.00, 0.94 µm
    600       0.49, 0.88                        1.00, 1.00, 1.34 µm
    1000      0.46, 0.89                        1.00, 0.98, 1.86 µm

80 counts (0.4 %) can hardly be seen; with 1000 (5 %), the dimmest particles are lost in the disturbance."""

PERIOD_PX = (512.0, 384.0)
"""Periods, px, of the sinusoid in a disturbed image along x and y. The paper gives none. Chosen as `AMPLITUDE`: with
periods of 256 and 192 px and 400 counts, the correlation has recall 0.45 and precision 0.84, the joint fit 0.86 and
0.73; much longer periods are the slopes that each template has removed anyway."""


def fluorescent(light: NDArray) -> NDArray:
    """Return bright particles on a dark field: the light itself.

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
    """Return dark particles on a bright field: the fluorescent image inverted (paper, section 3).

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
    amplitude: float = AMPLITUDE,
    period_px: tuple[float, float] = PERIOD_PX,
    phase_rad: tuple[float, float] = (0.0, 0.0),
    white: float = WHITE,
) -> NDArray:
    """Return a brightfield image with uneven illumination: a 2-D sinusoid added (paper, section 3 and Figure 3c).

    Parameters
    ----------
    light : array (rows, columns)
        Counts that the particles alone would give.
    amplitude : float
        Of the sinusoid, counts.
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
"""The paper's three image types by name, each with its default settings."""


def as_image_type(image_type: str | Callable[[NDArray], NDArray]) -> Callable[[NDArray], NDArray]:
    """Return the image type of this name; a function is returned as it is.

    Raises
    ------
    ValueError
        For a name that is not in `IMAGE_TYPES`.
    """
    if callable(image_type):
        return image_type
    return IMAGE_TYPES[choice("image_type", image_type, IMAGE_TYPES)]
