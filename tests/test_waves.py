"""The microscope that images points by diffraction."""

import numpy as np
import pandas as pd
import pytest
from scipy.special import j1

from gdptlab.experiment import WaveMicroscope


def test_focus_is_airys_disc():
    microscope = WaveMicroscope()
    r_um = np.linspace(0.01, 3, 50)
    v = 2 * np.pi * microscope.na * r_um / microscope.wavelength_um
    peak = microscope.profile(0.0, np.zeros(1))
    np.testing.assert_allclose(microscope.profile(0.0, r_um) / peak, (2 * j1(v) / v) ** 2, atol=1e-12)


def test_axis_is_dark_where_theory_says():
    """For a small aperture the axial light is a sinc squared, 0 at 2 n lambda / NA^2 and at its multiples."""
    microscope = WaveMicroscope(na=0.1)
    first_um = 2 * microscope.n_medium * microscope.wavelength_um / microscope.na**2
    dark, focus = (microscope.profile(z, np.zeros(1))[0] for z in (first_um, 0.0))
    assert dark < 1e-4 * focus


@pytest.mark.parametrize("z_um", [-8.0, 0.0, 5.0])
def test_light_is_kept(z_um):
    microscope = WaveMicroscope(spherical=1.0)
    assert microscope.image(z_um, 149.7, 120.2, (241, 301)).sum() == pytest.approx(microscope.counts, rel=0.01)


def test_aberration_alone_tells_the_sides_of_focus():
    def difference(microscope):
        below, above = (microscope.image(z, 30, 30, (61, 61)) for z in (-4.0, 4.0))
        return np.abs(below - above).max() / above.max()

    assert difference(WaveMicroscope()) < 1e-4
    assert difference(WaveMicroscope(spherical=1.0)) > 0.5


def test_x_is_the_column_and_particles_add_up():
    microscope, shape = WaveMicroscope(), (40, 60)
    particles = pd.DataFrame({"x_px": [45.3, 10.0], "y_px": [12.6, 30.0], "z_um": [3.0, -1.0]})
    first, second = (microscope.image(p.z_um, p.x_px, p.y_px, shape) for p in particles.itertuples())
    row, column = np.unravel_index(first.argmax(), shape)
    assert (row, column) == (13, 45)
    np.testing.assert_array_equal(microscope.light(particles, shape), first + second)
    dark = microscope.render(particles, shape, image_type="brightfield", rng=1)
    assert dark.dtype == np.uint16
    assert dark[30, 10] < np.median(dark) / 2


@pytest.mark.parametrize(
    ("name", "value"), [("na", 1.4), ("na", 0), ("wavelength_um", np.nan), ("spherical", np.inf), ("um_per_px", -1)]
)
def test_impossible_optics_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        WaveMicroscope(**{name: value})


def test_bad_arguments_are_refused():
    microscope = WaveMicroscope()
    with pytest.raises(ValueError, match="z_um"):
        microscope.image(np.nan, 1, 1, (5, 5))
    with pytest.raises(ValueError, match="particles"):
        microscope.light(pd.DataFrame({"x_px": [np.nan], "y_px": [1], "z_um": [1]}), (5, 5))
