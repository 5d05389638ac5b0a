"""Images to start with: small synthetic samples in `data/`, and real beads that others published.

`python -m gdptlab.datasets` makes the samples anew.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tifffile
from IPython import get_ipython
from numpy.typing import NDArray

from gdptlab.check import choice
from gdptlab.files import written_whole
from gdptlab.images import open_images
from gdptlab.imagetypes import IMAGE_TYPES
from gdptlab.optics import Microscope

DATA = Path(__file__).parents[1] / "data"
"""The samples' folder."""

SIZE = 61
"""Rows and columns of the sample calibration images, px."""


@dataclass(frozen=True)
class Sample:
    """A calibration stack, and frames whose particles are known.

    Attributes
    ----------
    stack : uint16 array (51, 61, 61)
        One particle at known depths.
    z_um : array (51,)
        The depths, -50 to 50 µm.
    frames : uint16 array (3, 512, 512)
    truth : DataFrame
        `frame`, `x_px`, `y_px`, `z_um` of every particle.
    """

    stack: NDArray[np.uint16]
    z_um: NDArray[np.float64]
    frames: NDArray[np.uint16]
    truth: pd.DataFrame


@dataclass(frozen=True)
class PlanarBeads:
    """Real 2 µm beads on a flat slide, at known heights (Mackenzie et al. 2025, see `planar_beads`).

    Attributes
    ----------
    scan : uint16 array (106, 512, 512)
        The calibration scan, 1 µm apart.
    z_um : array (106,)
        Its depths.
    frames : uint16 array (11, 512, 512)
        Single exposures at other heights.
    truth : DataFrame
        `frame`, `bead`, `x_px`, `y_px` and `z_um`, the height of the bead plane, for 88 beads in each frame.
    published : dict of DataFrame
        What three published methods measured in these frames: `frame`, `x_px`, `y_px`, `z_um`, `cm`.
    """

    scan: NDArray[np.uint16]
    z_um: NDArray[np.float64]
    frames: NDArray[np.uint16]
    truth: pd.DataFrame
    published: dict[str, pd.DataFrame]


def sample(image_type: str = "fluorescent") -> Sample:
    """Load a synthetic sample (5 µm spheres, 10x/0.3, astigmatic; see `data/README.md`).

    Parameters
    ----------
    image_type : {"fluorescent", "brightfield", "disturbed"}

    Returns
    -------
    Sample
    """
    choice("image_type", image_type, IMAGE_TYPES)
    return Sample(
        stack=np.asarray(open_images(DATA / f"{image_type}-calibration.tif")),
        z_um=pd.read_csv(DATA / "calibration-z.csv")["z_um"].to_numpy(),
        frames=np.asarray(open_images(DATA / f"{image_type}-frames.tif")),
        truth=pd.read_csv(DATA / "frames-truth.csv"),
    )


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
    places = np.stack(np.meshgrid(*2 * [np.arange(56, 512, 100)]), axis=-1).reshape(-1, 2)
    x_px, y_px = (rng.permutation(places)[:14] + rng.uniform(-12, 12, (14, 2))).T
    beads = pd.DataFrame({"x_px": x_px, "y_px": y_px})
    scan = [microscope.render(beads.assign(z_um=z), image_type=image_type, rng=rng) for z in z_um]
    return np.stack(scan), z_um


def planar_beads() -> PlanarBeads:
    """Load real images of beads at known heights, if they are on this machine.

    They belong to S. Mackenzie, A. Eden, D. E. Huber and S. Pennathur (Meas. Sci. Technol. 36 (2025) 056005,
    doi 10.1088/1361-6501/adcceb; MIT licence) and are not part of this repository. They are looked for in a
    folder `planar_beads` under the environment's GDPTLAB_DATA, then under `data/external/`.

    Raises
    ------
    FileNotFoundError
        If they are in neither place; the message says how to get them.
    """
    places = [Path(p) for p in (os.environ.get("GDPTLAB_DATA"), DATA / "external") if p]
    folder = next((p / "planar_beads" for p in places if (p / "planar_beads").is_dir()), None)
    if folder is None:
        raise FileNotFoundError(
            "The planar-bead images are not on this machine. Their authors publish them on GitHub in the repository "
            "sean-mackenzie/idpt; put calibration.tif, calibration_z.csv, test.tif, test_frames.csv, beads.csv and "
            "published/ into data/external/planar_beads, or name the folder above it in the variable GDPTLAB_DATA."
        )
    heights = pd.read_csv(folder / "test_frames.csv")[["frame", "z_plane_um"]].rename(columns={"z_plane_um": "z_um"})
    return PlanarBeads(
        scan=np.asarray(open_images(folder / "calibration.tif")),
        z_um=pd.read_csv(folder / "calibration_z.csv")["z_um"].to_numpy(),
        frames=np.asarray(open_images(folder / "test.tif")),
        truth=heights.merge(pd.read_csv(folder / "beads.csv"), how="cross"),
        published={p.stem: pd.read_csv(p) for p in sorted((folder / "published").glob("*.csv"))},
    )


def end_notebook(reason: str) -> None:
    """Print why a notebook cannot go on, and let its later cells do nothing instead of failing."""
    print(reason)
    shell = get_ipython()
    if shell is not None:
        shell.input_transformers_cleanup.append(lambda lines: [])


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
