"""The synthetic samples in `data/`, and a scan of beads on a slide that goes with them.

`python -m gdptlab.experiment.samples` makes the samples anew.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import tifffile
from numpy.typing import NDArray

from gdptlab._checks import choice
from gdptlab._files import written_whole
from gdptlab.datasets import DATA
from gdptlab.experiment.image_types import IMAGE_TYPES
from gdptlab.experiment.microscope import Microscope

SIZE = 61
"""Rows and columns of the sample calibration images, px: odd, and as large as the widest image in the channel, 58 x 52
px at z = +50 µm. Smaller templates would cut that image; larger ones would reach into neighbours."""


def sample_scan(image_type: str = "fluorescent") -> tuple[NDArray[np.uint16], NDArray[np.float64]]:
    """Make a scan of beads on a slide, with the microscope and the noise of the samples.

    Parameters
    ----------
    image_type : {"fluorescent", "brightfield", "disturbed"}

    Returns
    -------
    scan : uint16 array (51, 512, 512)
        Frames of 14 beads, all at the same depth, most of them far enough apart.
    z_um : float64 array (51,)
        The depths, -50 to 50 µm.
    """
    choice("image_type", image_type, IMAGE_TYPES)
    microscope, z_um, rng = Microscope(), np.linspace(-50, 50, 51), np.random.default_rng(20250408)
    positions = np.stack(np.meshgrid(*2 * [np.arange(56, 512, 100)]), axis=-1).reshape(-1, 2)
    x_px, y_px = (rng.permutation(positions)[:14] + rng.uniform(-12, 12, (14, 2))).T
    beads = pd.DataFrame({"x_px": x_px, "y_px": y_px})
    scan = [microscope.render(beads.assign(z_um=z), image_type=image_type, rng=rng) for z in z_um]
    return np.stack(scan), z_um


def make_samples(folder: Path = DATA) -> None:
    """Make the synthetic samples: three frames of 50 particles, the same for all image types."""
    microscope = Microscope()
    z_um = np.linspace(-50, 50, 51)
    rng = np.random.default_rng(20190722)
    count, (rows, columns) = 50, (512, 512)
    truth = pd.concat(
        [
            pd.DataFrame(
                {
                    "frame": frame,
                    "x_px": rng.uniform(0, columns - 1, count).round(3),
                    "y_px": rng.uniform(0, rows - 1, count).round(3),
                    "z_um": rng.uniform(-50, 50, count).round(3),
                }
            )
            for frame in range(3)
        ],
        ignore_index=True,
    )
    for name, table in (("frames-truth.csv", truth), ("calibration-z.csv", pd.DataFrame({"z_um": z_um}))):
        with written_whole(folder / name) as path:
            table.to_csv(path, index=False)
    for image_type in IMAGE_TYPES:
        stack = microscope.stack(z_um, SIZE, image_type=image_type, rng=rng)
        frames = [
            microscope.render(particles, (rows, columns), image_type=image_type, rng=rng)
            for _, particles in truth.groupby("frame")
        ]
        for name, images in (("calibration", stack), ("frames", np.stack(frames))):
            with written_whole(folder / f"{image_type}-{name}.tif") as path:
                tifffile.imwrite(path, images, compression="zlib", predictor=True, photometric="minisblack")


if __name__ == "__main__":
    make_samples()
