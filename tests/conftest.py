"""Microscope, calibrations and frames that many tests share; each is made once."""

import os
import sys
from functools import partial

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration
from gdptlab.experiment import Microscope, disturbed

THOROUGH = float(os.environ.get("GDPTLAB_THOROUGH") or 0)
"""How much longer tests are made that can be: `GDPTLAB_THOROUGH=1 pytest tests` tries 2000 hostile inputs of each
function, kills 100 streams and 100 monitors, and runs an hour of a monitor; 0.05 does a twentieth, 0 a little."""

Z_UM = np.linspace(-50, 50, 51)
SIZE_PX = 61
IMAGE_TYPES = ("fluorescent", "brightfield", "disturbed")
MILD = 80.0
"""Amplitude (counts) of the disturbance in the tests of accuracy: a fifth of the dimmest peak, which moves no particle.
`test_locate.py` says what the default amplitude, five times as large, does."""


def as_tested(image_type: str):
    """What `Microscope.render` takes for an image type, with the disturbance `MILD`."""
    return partial(disturbed, amplitude=MILD) if image_type == "disturbed" else image_type


CALIBRATION_SEED, FRAME_SEED = 61, 62


def table(x_px, y_px, z_um) -> pd.DataFrame:
    """Particles as a table."""
    return pd.DataFrame({"x_px": np.ravel(x_px), "y_px": np.ravel(y_px), "z_um": np.ravel(z_um)}).astype(float)


def on_grid(rng: np.random.Generator, shape=(512, 700), pitch_px: float = 75, jitter_px: float = 5) -> pd.DataFrame:
    """Isolated particles: a grid with jitter, wholly in the frame, at random depths."""
    rows, columns = shape
    margin = SIZE_PX // 2 + 3 + jitter_px
    x, y = np.meshgrid(*(np.arange(margin, n - margin, pitch_px) for n in (columns, rows)))
    jitter = rng.uniform(-jitter_px, jitter_px, (2, x.size))
    return table(x.ravel() + jitter[0], y.ravel() + jitter[1], rng.uniform(-50, 50, x.size))


@pytest.fixture(autouse=True)
def own_style():
    """The style of pictures that a test, or what it calls, sets ends with the test."""
    yield
    if "matplotlib" in sys.modules:
        sys.modules["matplotlib"].rcdefaults()


@pytest.fixture(scope="session")
def microscope() -> Microscope:
    """The default microscope, its particle images traced."""
    microscope = Microscope()
    microscope.light(table(5, 5, 0), (11, 11))
    return microscope


@pytest.fixture(scope="session")
def clean_stack(microscope):
    """Stack (51, 61, 61) without noise."""
    return microscope.stack(Z_UM, SIZE_PX)


@pytest.fixture(scope="session")
def stacks(microscope):
    """Noisy stack of each image type."""
    return {
        kind: microscope.stack(Z_UM, SIZE_PX, image_type=as_tested(kind), rng=CALIBRATION_SEED + i)
        for i, kind in enumerate(IMAGE_TYPES)
    }


@pytest.fixture(scope="session")
def calibrations(stacks):
    """Calibration with the noisy stack of each image type."""
    return {kind: Calibration.from_stack(stack, Z_UM) for kind, stack in stacks.items()}


@pytest.fixture(scope="session")
def calibration(calibrations):
    """The fluorescent one."""
    return calibrations["fluorescent"]


@pytest.fixture(scope="session")
def few(microscope):
    """One noisy frame of 170 rows and 230 columns with four particles, and their table."""
    particles = table([45.3, 120.8, 190.4, 60.6], [40.7, 52.2, 44.9, 122.1], [-41.0, -17.3, 8.8, 33.5])
    return microscope.render(particles, (170, 230), rng=FRAME_SEED), particles


@pytest.fixture(scope="session")
def isolated(microscope):
    """For each image type ten frames with 540 isolated particles in all, and their table."""
    films = {}
    for i, kind in enumerate(IMAGE_TYPES):
        rng = np.random.default_rng(FRAME_SEED + 10 * i)
        tables = [on_grid(rng).assign(frame=frame) for frame in range(10)]
        frames = [microscope.render(t, (512, 700), image_type=as_tested(kind), rng=rng) for t in tables]
        films[kind] = frames, pd.concat(tables, ignore_index=True)
    return films
