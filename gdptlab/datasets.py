"""Images to start with: small synthetic samples in `data/`, and real beads that others published.

`python -m gdptlab.experiment.samples` makes the samples anew.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tifffile
from numpy.typing import NDArray

from gdptlab._checks import choice

DATA = Path(__file__).parents[1] / "data"
"""Folder of the samples."""

SAMPLES = ("fluorescent", "brightfield", "disturbed")
"""Image types of which there is a sample (the paper, Figure 3)."""


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


@dataclass(frozen=True)
class LabelledFrames:
    """Frames in which every particle is known (Coutinho et al. 2026, see `defocused_particles`).

    Attributes
    ----------
    frames : uint16 array (10, 1024, 1024)
    truth : DataFrame
        `frame`, `x_px`, `y_px`, `z_um` of 68 particles in each.
    """

    frames: NDArray[np.uint16]
    truth: pd.DataFrame


def sample(image_type: str = "fluorescent") -> Sample:
    """Load a synthetic sample (5 µm spheres, 10x/0.3, astigmatic; see `data/README.md`).

    Parameters
    ----------
    image_type : {"fluorescent", "brightfield", "disturbed"}

    Returns
    -------
    Sample
    """
    choice("image_type", image_type, SAMPLES)
    return Sample(
        stack=tifffile.imread(DATA / f"{image_type}-calibration.tif"),
        z_um=pd.read_csv(DATA / "calibration-z.csv")["z_um"].to_numpy(),
        frames=tifffile.imread(DATA / f"{image_type}-frames.tif"),
        truth=pd.read_csv(DATA / "frames-truth.csv"),
    )


def planar_beads() -> PlanarBeads:
    """Load real images of beads at known heights, if they are on this machine.

    They belong to S. Mackenzie, A. Eden, D. E. Huber and S. Pennathur (Meas. Sci. Technol. 36 (2025) 056005,
    doi 10.1088/1361-6501/adcceb; MIT licence) and are not part of this repository. They are looked for in a
    folder `planar_beads` under the environment's GDPTLAB_DATA, then under `data/external/`.

    Raises
    ------
    FileNotFoundError
        If they are in neither folder; the message says how to get them.
    """
    folder = _external(
        "planar_beads",
        "The planar-bead images are not on this machine. Their authors publish them on GitHub in the repository "
        "sean-mackenzie/idpt; put calibration.tif, calibration_z.csv, test.tif, test_frames.csv, beads.csv and "
        "published/ into data/external/planar_beads, or name the folder above it in the variable GDPTLAB_DATA.",
    )
    heights = pd.read_csv(folder / "test_frames.csv")[["frame", "z_plane_um"]].rename(columns={"z_plane_um": "z_um"})
    return PlanarBeads(
        scan=tifffile.imread(folder / "calibration.tif"),
        z_um=pd.read_csv(folder / "calibration_z.csv")["z_um"].to_numpy(),
        frames=tifffile.imread(folder / "test.tif"),
        truth=heights.merge(pd.read_csv(folder / "beads.csv"), how="cross"),
        published={p.stem: pd.read_csv(p) for p in sorted((folder / "published").glob("*.csv"))},
    )


def astigmatic_bead() -> NDArray[np.float32]:
    """Load a real astigmatic bead, if its images are on this machine.

    They belong to python-microscopy (`PYME/localization/Test/psf_astig.tif`, GPL-3.0) and are not part of this
    repository. They are looked for in a folder `psf_astig`, where `planar_beads` looks.

    Returns
    -------
    float32 array (61, 61, 61)
        Slices, rows, columns; without background, scaled to 0 ... 1. The distance between the slices is not known.

    Raises
    ------
    FileNotFoundError
        If it is in neither folder; the message says how to get it.
    """
    folder = _external(
        "psf_astig",
        "The astigmatic bead is not on this machine. It is published on GitHub in the repository "
        "python-microscopy/python-microscopy as PYME/localization/Test/psf_astig.tif; put it into "
        "data/external/psf_astig, or name the folder above it in the variable GDPTLAB_DATA.",
    )
    return tifffile.imread(folder / "psf_astig.tif").astype(np.float32)


def defocused_particles() -> LabelledFrames:
    """Load synthetic frames of other optics, plain defocus, no scan, if they are on this machine.

    They belong to G. Coutinho, A. S. Moita, A. L. N. Moreira and M. Rossi (arXiv 2606.00076; GPL-3.0) and are not part
    of this repository. They are looked for in a folder `defocustracker_ai`, where `planar_beads` looks. Depths, from
    -100 to -15, have no unit there; micrometres are assumed.

    Raises
    ------
    FileNotFoundError
        If they are in neither folder; the message says how to get them.
    """
    folder = _external(
        "defocustracker_ai",
        "The frames with known particles are not on this machine. They are ten frames of DefocusTrackerAI's test set "
        "synthetic_D_min_16px_NS_0100; put frames.tif and truth.csv (frame, x_px, y_px, z_um, counted from 0) into "
        "data/external/defocustracker_ai, or name the folder above it in the variable GDPTLAB_DATA.",
    )
    truth = pd.read_csv(folder / "truth.csv")[["frame", "x_px", "y_px", "z_um"]]
    return LabelledFrames(tifffile.imread(folder / "frames.tif"), truth)


def _external(name: str, missing: str) -> Path:
    """Folder of other people's images; `missing` is said if there is none."""
    folders = [Path(p) / name for p in (os.environ.get("GDPTLAB_DATA"), DATA / "external") if p]
    folder = next((p for p in folders if p.is_dir()), None)
    if folder is None:
        raise FileNotFoundError(missing)
    return folder
