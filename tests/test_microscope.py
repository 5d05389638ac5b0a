"""Ray-traced particle images and frames: against direct tracing, optics that must hold, and bad input."""

import os
from functools import cache, partial

import numpy as np
import pandas as pd
import pytest
from conftest import Z_UM, table

from gdptlab.experiment import Camera, Microscope
from gdptlab.experiment import microscope as optics

NCC = 0.995  # sampled image against direct ray tracing
CENTRE_PX = 0.01  # between the centroids of the two
LIGHT = 0.003  # relative difference of their light
CLEAN = Camera(background=0, read_noise=0)


def centroid(image):
    y, x = np.indices(image.shape)
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum()


def widths(image):
    """Standard deviations of the light along x and y, px."""
    y, x = np.indices(image.shape)
    cx, cy = centroid(image)
    return np.sqrt([(image * (x - cx) ** 2).sum() / image.sum(), (image * (y - cy) ** 2).sum() / image.sum()])


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """A microscope whose library is traced in no time, with few rays, into an empty cache."""
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path))
    monkeypatch.setattr(optics, "_traced_library", partial(optics._traced_library, log2_rays=14))
    monkeypatch.setattr(optics, "_library", cache(optics._library.__wrapped__))
    return Microscope(depth_um=8, focus_um=30)


# -------------------- the fast path against direct ray tracing

OFFSETS = [(dx, dy) for dx in (-0.43, -0.11, 0.27, 0.5) for dy in (-0.35, -0.02, 0.19, 0.48)]


@pytest.mark.parametrize("k", range(21))
def test_sampled_image_is_the_traced_one(microscope, k):
    dx, dy = OFFSETS[7 * k % len(OFFSETS)]
    z, x, y = -50 + 5 * k, 50 + dx, 41 + dy
    traced = microscope.trace_image(z, x, y, (83, 101), rng=k, rays=2**19)
    sampled = microscope.light(table(x, y, z), (83, 101))
    assert np.corrcoef(traced.ravel(), sampled.ravel())[0, 1] >= NCC
    np.testing.assert_allclose(centroid(sampled), centroid(traced), atol=CENTRE_PX)
    assert sampled.sum() == pytest.approx(traced.sum(), rel=LIGHT)


@pytest.mark.parametrize("z", [-47.3, 0.2, 31.9])
def test_offsets_of_both_signs_move_the_image(microscope, z):
    for dx, dy in OFFSETS:
        image = microscope.light(table(70 + dx, 52 + dy, z), (107, 139))
        np.testing.assert_allclose(centroid(image), (70 + dx, 52 + dy), atol=CENTRE_PX)


def test_x_is_the_column_and_y_the_row(microscope):
    frame = microscope.render(table(150, 30, -25), (60, 200), camera=CLEAN)
    assert frame.shape == (60, 200)
    np.testing.assert_allclose(centroid(frame.astype(float)), (150, 30), atol=CENTRE_PX)


def test_astigmatism_tells_above_from_below(microscope):
    below, above = (widths(microscope.light(table(60, 60, z), (121, 121))) for z in (-45, 0))
    assert below[0] < 0.7 * below[1]  # narrow along x, by the cylinder
    assert above[0] > 1.2 * above[1]


def test_without_cylinder_images_are_round(microscope):
    plain = Microscope(cylinder_um=None)
    for z in (-40, 30):
        wide = widths(plain.trace_image(z, 60, 60, (121, 121), rng=1, rays=2**17))
        assert wide[0] == pytest.approx(wide[1], rel=0.01)


def test_nearer_particles_are_brighter(microscope):
    light = [microscope.light(table(75, 75, z), (151, 151)).sum() for z in (-50, -20, 0, 20, 50)]
    assert light[2] == pytest.approx(microscope.counts, rel=0.002)
    assert (np.diff(light) < 0).all()


def test_depths_between_those_traced(microscope):
    """Half-way between two depths of the library, the image is nearer to that depth's than those 1 µm away."""
    for z in (-33.25, -10.25):
        traced = microscope.trace_image(z, 60, 60, (121, 121), rng=3)
        middle, *ends = (microscope.light(table(60, 60, z + dz), (121, 121)) for dz in (0, -1, 1))
        assert np.abs(middle - traced).sum() < 0.5 * min(np.abs(end - traced).sum() for end in ends)


# -------------------- frames


@pytest.mark.parametrize(
    ("x", "y"),
    [(0, 0), (-12.3, 40.2), (-0.5, -0.5), (79.3, 20), (95.7, 65.1), (30.4, -9.8), (30.4, 68.9), (79.5, 59.5), (40, 30)],
)
@pytest.mark.parametrize("z", [-38.0, 44.4])
def test_image_is_cut_by_the_border(microscope, x, y, z):
    """A frame of 60 rows and 80 columns equals that part of a larger frame, on every border."""
    large = microscope.light(table(x + 60, y + 50, z), (160, 200))
    np.testing.assert_allclose(microscope.light(table(x, y, z), (60, 80)), large[50:110, 60:140], atol=1e-3)


@pytest.mark.parametrize(("x", "y"), [(-500, 20), (20, -500), (900, 20), (20, 900), (-47.6, 20)])
def test_far_outside_gives_nothing(microscope, x, y):
    assert not microscope.light(table(x, y, 30), (50, 70)).any()


@pytest.mark.parametrize("position", [0, -1e-17, -1e-9, 5 - 1e-15, 5 + 1e-15, 0.25, 0.75, 0.9999999])
def test_positions_at_the_edges_of_fine_pixels(microscope, position):
    image = microscope.light(table(40 + position, position, 10), (60, 90))
    near = microscope.light(table(40 + position + 1e-4, position + 1e-4, 10), (60, 90))
    np.testing.assert_allclose(image, near, atol=1)  # of 2400 counts


def test_light_adds_up(microscope):
    one, other = table(20, 25, -20), table(44, 31, 15)
    both = microscope.light(pd.concat([one, other]), (60, 80))
    np.testing.assert_allclose(both, microscope.light(one, (60, 80)) + microscope.light(other, (60, 80)), atol=1e-2)


def test_no_particles(microscope):
    frame = microscope.render(table([], [], []), (20, 31))
    assert frame.shape == (20, 31) and (frame == 500).all()


def test_ends_of_the_library(microscope):
    for z in (-55, 55):
        assert microscope.light(table(50, 50, z), (101, 101)).sum() > 0.7 * microscope.counts
        with pytest.raises(ValueError, match="particles"):
            microscope.light(table([3, 5], [3, 5], [0, z * 1.0002]), (11, 11))


def test_amplitude_and_diameter(quick):
    one = table(40, 30, 1)
    light = quick.light(one, (61, 81))
    np.testing.assert_allclose(quick.light(one.assign(amplitude=2.5), (61, 81)), 2.5 * light, rtol=1e-5)
    np.testing.assert_array_equal(quick.light(one.assign(diameter_um=5.0), (61, 81)), light)
    small = quick.light(one.assign(diameter_um=2.5), (61, 81))
    assert small.sum() == pytest.approx(light.sum() / 4, rel=0.01)  # as the sphere's surface
    assert (widths(small) < widths(light)).all()
    mixed = pd.concat([one.assign(diameter_um=2.5), one.assign(x_px=20, diameter_um=5.0)])
    expected = small + quick.light(one.assign(x_px=20), (61, 81))
    np.testing.assert_allclose(quick.light(mixed, (61, 81)), expected, atol=1e-2)


def test_image_type_and_camera_are_used(microscope):
    particles, camera = table(25, 20, -15), Camera(background=7, read_noise=0)
    light = microscope.light(particles, (40, 50))
    for kind, expected in (("fluorescent", light), ("brightfield", 20_000 - light), (np.sqrt, np.sqrt(light))):
        frame = microscope.render(particles, (40, 50), image_type=kind, camera=camera)
        np.testing.assert_allclose(frame, expected + 7, atol=0.51)


def test_brightfield_does_not_go_black(microscope, clean_stack):
    """The brightest sphere takes away less than the empty field has."""
    assert clean_stack.max() - 500 < 20_000 / 2


def test_seed_decides_the_noise(microscope):
    particles = table(30, 20, 5)
    one, same, other = (microscope.render(particles, (40, 60), rng=s) for s in (3, np.random.default_rng(3), 4))
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.9
    assert np.array_equal(microscope.render(particles, (40, 60)), microscope.render(particles, (40, 60)))


def test_global_seed_is_left_alone(microscope):
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    microscope.render(table(30, 20, 5), (40, 60), rng=3)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_default_read_noise_is_a_tenth_of_the_dimmest_peak(clean_stack):
    peaks = clean_stack.max(axis=(1, 2)) - Camera().background
    assert Camera().read_noise == pytest.approx(peaks.min() / 10, rel=0.1)


def test_stack_shows_one_particle_in_the_middle(microscope, clean_stack):
    assert clean_stack.shape == (51, 61, 61) and clean_stack.dtype == np.uint16
    for image, z in zip(clean_stack[::10], Z_UM[::10], strict=True):
        np.testing.assert_array_equal(image, microscope.render(table(30, 30, z), (61, 61)))
    noisy = microscope.stack([0, 0], 21, rng=1)
    assert (noisy[0] != noisy[1]).mean() > 0.9


# -------------------- cache


def test_library_is_kept_on_disk(quick, tmp_path, monkeypatch):
    first = quick.light(table(20, 20, 1), (41, 41))
    files = list(tmp_path.iterdir())
    assert len(files) == 1 and files[0].suffix == ".npz"  # and no half-written one
    optics._library.cache_clear()
    monkeypatch.setattr(optics, "_traced_library", lambda *_: pytest.fail("traced again"))
    np.testing.assert_array_equal(quick.light(table(20, 20, 1), (41, 41)), first)


def test_each_microscope_has_its_own_library(quick, tmp_path):
    quick.light(table(20, 20, 1), (41, 41))
    Microscope(depth_um=8, focus_um=31).light(table(20, 20, 1), (41, 41))
    quick.light(table(20, 20, 1).assign(diameter_um=3), (41, 41))
    assert len(list(tmp_path.iterdir())) == 4  # of 3 µm, the diameters on either side


def test_continuous_diameters_take_a_few_libraries(quick, tmp_path):
    rng = np.random.default_rng(7)
    particles = table(*rng.uniform(0, 60, (2, 200)), rng.uniform(-4, 4, 200))
    quick.light(particles.assign(diameter_um=rng.uniform(4.6, 5.5, 200)), (60, 60))
    assert len(list(tmp_path.iterdir())) == 3


def test_an_image_between_two_diameters(quick):
    """Half-way between two traced diameters, the interpolated image is nearer to the true one than either of them."""
    one, shape, ratio = table(30, 30, 1), (61, 61), optics.DIAMETER_RATIO
    true = Microscope(depth_um=8, focus_um=30, diameter_um=5 * np.sqrt(ratio)).light(one, shape) * ratio
    below, middle, above = (
        quick.light(one.assign(diameter_um=5 * ratio**k), shape) * ratio ** (1 - 2 * k) for k in (0, 0.5, 1)
    )
    assert middle.sum() == pytest.approx(true.sum(), rel=0.01)
    assert np.abs(middle - true).sum() < 0.5 * min(np.abs(image - true).sum() for image in (below, above))


def test_a_damaged_library_is_traced_again(quick, tmp_path):
    first = quick.light(table(20, 20, 1), (41, 41))
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    for damaged in (b"", whole[:-40], b"\0" * len(whole)):
        path.write_bytes(damaged)
        optics._library.cache_clear()
        np.testing.assert_array_equal(quick.light(table(20, 20, 1), (41, 41)), first)
        assert path.stat().st_size > 0.9 * len(whole)


def test_the_cache_folder_holds_a_bounded_number_of_libraries(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(optics, "LIBRARIES_ON_DISK", 2)
    for k, diameter in enumerate((5.0, 5.5, 5.0, 5.0 * 1.1**2)):
        optics._library.cache_clear()
        quick.light(table(20, 20, 1).assign(diameter_um=diameter), (41, 41))
        for file in tmp_path.iterdir():  # an hour passes
            os.utime(file, (file.stat().st_atime, file.stat().st_mtime - 3600))
        if k == 0:
            (first,) = tmp_path.iterdir()
    assert len(list(tmp_path.iterdir())) == 2 and first.exists()


def test_without_a_cache_folder_libraries_are_traced_in_each_process(quick, monkeypatch):
    first = quick.light(table(20, 20, 1), (41, 41))
    monkeypatch.setattr(optics, "cache_folder", lambda: None)
    optics._library.cache_clear()
    np.testing.assert_array_equal(quick.light(table(20, 20, 1), (41, 41)), first)


def test_tracing_is_reproducible(quick, tmp_path):
    first = quick.light(table(20, 20, 1), (41, 41))
    for file in tmp_path.iterdir():
        file.unlink()
    optics._library.cache_clear()
    np.testing.assert_array_equal(quick.light(table(20, 20, 1), (41, 41)), first)


# -------------------- bad input

POSITIVE = ["magnification", "na", "focal_length_um", "n_medium", "n_lens", "cylinder_um", "pixel_um", "depth_um"]
POSITIVE += ["diameter_um", "counts"]


@pytest.mark.parametrize("name", POSITIVE)
@pytest.mark.parametrize("value", [0, -1, np.nan, np.inf, "1", True])
def test_parameters_must_be_positive_numbers(name, value):
    error = TypeError if isinstance(value, (str, bool)) else ValueError
    with pytest.raises(error, match=name):
        Microscope(**{name: value})


@pytest.mark.parametrize(("value", "error"), [(np.nan, ValueError), (np.inf, ValueError), ("1", TypeError)])
def test_focus_must_be_a_finite_number(value, error):
    with pytest.raises(error, match="focus_um"):
        Microscope(focus_um=value)


@pytest.mark.parametrize(
    ("parameters", "name"),
    [({"na": 1.2}, "na"), ({"na": 0.9}, "na"), ({"n_lens": 1.0}, "n_lens"), ({"depth_um": 900}, "depth_um")],
)
def test_impossible_microscopes(parameters, name):
    with pytest.raises(ValueError, match=f"^{name}"):
        Microscope(**parameters)


def test_numbers_of_little_precision_become_floats():
    assert type(Microscope(na=np.float32(0.25)).na) is float
    with pytest.raises(ValueError, match=r"^n_lens"):
        Microscope(n_lens=np.float32(0.5), n_medium=1e308)


def test_unknown_names_and_changes_are_refused(microscope):
    with pytest.raises(TypeError, match="magnfication"):
        Microscope(magnfication=10)
    with pytest.raises(AttributeError):
        microscope.na = 0.2


GOOD = table([5, 9], [5, 7], [0, 1])


@pytest.mark.parametrize(
    ("particles", "name"),
    [
        (GOOD.drop(columns="y_px"), "y_px"),
        (GOOD.assign(x_px=[np.nan, 1]), "particles"),
        (GOOD.assign(y_px=[np.inf, 1]), "particles"),
        (GOOD.assign(amplitude=[np.nan, 1]), "particles"),
        (GOOD.assign(amplitude=[0, 1]), "amplitude"),
        (GOOD.assign(diameter_um=[5, -5]), "diameter_um"),
        (GOOD.assign(z_um=[0, -70]), "z_um"),
    ],
)
def test_bad_particles(microscope, particles, name):
    with pytest.raises(ValueError, match=name):
        microscope.render(particles, (11, 14))


@pytest.mark.parametrize(
    ("shape", "error", "name"),
    [((0, 9), ValueError, r"shape\[0\]"), ((9, -1), ValueError, r"shape\[1\]"), ((9.5, 9), TypeError, r"shape\[0\]")],
)
def test_bad_shape(microscope, shape, error, name):
    with pytest.raises(error, match=name):
        microscope.render(GOOD, shape)


def test_bad_image_type_and_size(microscope):
    with pytest.raises(ValueError, match="image_type"):
        microscope.render(GOOD, (11, 14), image_type="dark")
    for size, error in ((20, ValueError), (0, ValueError), (21.0, TypeError)):
        with pytest.raises(error, match="size"):
            microscope.stack([0, 1], size)


def test_paraxial_rays_meet_at_the_focus():
    """A check of Snell's law on two spheres that knows nothing of the code: 1/f = 1/object + 1/image."""
    narrow = Microscope(na=0.01, cylinder_um=None)
    points = np.random.default_rng(1).random((4096, 4))
    spread = {z: narrow.trace(z, points, diameter_um=1e-3)[0].std() for z in (-8.0, 22.0, 52.0)}
    assert spread[22.0] < 0.01 * min(spread[-8.0], spread[52.0])  # px
