"""The camera: light becomes counts, with offset, read noise, photon noise and bit depth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gdptlab._checks import generator, positive, real_array, whole


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A sensor: offset, read noise, photon noise, bit depth.

    Attributes
    ----------
    background : float
        Counts of a pixel without light.
    read_noise : float
        Standard deviation of the Gaussian noise of a pixel, counts. With the default microscope, the peak of the
        dimmest particle in the channel (z = +50 µm) is ten times as high.
    electrons_per_count : float or None
        Number of photo-electrons in one count of light; light then has Poisson noise. None: no photon noise.
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
        whole("bit_depth", self.bit_depth, 1, 16)

    def record(self, light: NDArray, rng: np.random.Generator | int | None = None) -> NDArray[np.uint16]:
        """Record light as a frame of counts.

        Parameters
        ----------
        light : array (rows, columns)
            Expected counts above the background; counts below 0 are taken as 0.
        rng : numpy Generator or int, optional
            Source of the noise; without it the frame has none.

        Returns
        -------
        uint16 array (rows, columns)
        """
        counts = np.maximum(real_array("light", light, 2), 0)
        if rng is not None:
            rng = generator("rng", rng)
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
