"""Types of microscope image.

The paper's three types (its section 3 and Figure 3) are functions of the light that the particles
send to the sensor: `fluorescent` leaves it, `brightfield` inverts it, `disturbed` adds an uneven
illumination to the inverted image. A `Camera` then records the light as counts.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gdptlab._checks import choice, number, numbers, positive, real_array

WHITE = 20_000.0
"""Counts of the empty field in a brightfield image. The paper gives none. Chosen: twice the peak of the brightest
particle of the default microscope. Below that peak, images would be cut off at 0; far above, a camera saturates."""

AMPLITUDE = 400.0
"""Amplitude, counts, of the sinusoid in a disturbed image: 2 % of `WHITE`, ten times the default read noise. The paper
gives none. Chosen, together with `PERIOD_PX`, on 4 frames of 50 particles anywhere (seed 5) and 6 frames of 54 isolated
particles (seed 72), the calibration stack as disturbed as the frames:

    counts   periods, px    anywhere                                       isolated
                            correlation          joint fit                 correlation
                            recall, precision    recall, RMS error of z    found, RMS error of z
    80       512, 384       0.54, 0.93           1.00, 0.34 µm             324 of 324, 0.4 µm
    400      1024, 768      0.54, 0.93           1.00, 0.28 µm             324 of 324, 0.7 µm
    600      1024, 768                                                     324 of 324, 1.1 µm
    1000     1024, 768      0.54, 0.94           1.00, 0.31 µm             319 of 324, 2.2 µm
    400      512, 384       0.53, 0.92           1.00, 0.69 µm             317 of 324, 2.3 µm
    400      256, 192       0.45, 0.84           0.98, 2.47 µm

80 counts (0.4 %) can hardly be seen. With more counts, or shorter periods, the curved illumination in the stack moves
the correlation's z of the dimmest particles, by 1 µm (400 counts) to 4 µm (1000) at z = 40 µm."""

PERIOD_PX = (1024.0, 768.0)
"""Periods, px, of the sinusoid in a disturbed image along x and y: a frame of 512 x 512 px shows half of one and two
thirds of the other. The paper gives none. Chosen with `AMPLITUDE`: at half of these periods the correlation loses
isolated particles, at a quarter the joint fit is off by 2.5 µm in z; much longer ones are slopes, which the templates
do not see."""


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
    real_array("light", light, 2)
    return float(numbers("white", number("white", white))) - np.asarray(light)


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
    rows, columns = real_array("light", light, 2).shape
    light = np.asarray(light)
    phases = numbers("phase_rad", phase_rad)
    for name, two in (("period_px", period_px), ("phase_rad", phase_rad)):
        if np.shape(two) != (2,):
            raise ValueError(f"{name}: got {two!r}, allowed are two numbers, along x and y")
    along_x = np.sin(2 * np.pi * np.arange(columns) / positive("period_px[0]", period_px[0]) + phases[0])
    along_y = np.sin(2 * np.pi * np.arange(rows) / positive("period_px[1]", period_px[1]) + phases[1])
    wave = np.outer(along_y, along_x).astype(np.result_type(light, np.float32))
    return brightfield(light, white) + float(numbers("amplitude", number("amplitude", amplitude))) * wave


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
