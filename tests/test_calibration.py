"""Calibration: what it keeps of a stack, its map, centring in a scan, denoising, files, bad input."""

import pickle
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import CALIBRATION_SEED, Z_UM, table
from references import correlate_plainly

from gdptlab import Calibration, locate
from gdptlab._plans import KEPT, planned
from gdptlab.calibration import levelled
from gdptlab.correlation import normalised
from gdptlab.denoising import signal_to_noise
from gdptlab.pipeline.calibration_file import LEARNED, VERSION

CENTRE_PX = 0.1  # mean error of x and y with a calibration cut out of a scan
CENTRE_Z_UM = 1.0  # likewise of z


def distance(images, clean):
    """1 - NCC of each image with its noise-free one."""
    return 1 - np.einsum("kij,kij->k", normalised(images), normalised(clean.astype(float)))


# -------------------- from a stack


@pytest.mark.parametrize(
    ("n", "n_sub", "expected"),
    [
        (51, 9, [4, 9, 15, 20, 26, 32, 37, 43, 48]),
        (51, 51, range(1, 52)),
        (51, 1 + 49, range(2, 52)),
        (51, 2, [14, 39]),
        (11, 3, [3, 6, 9]),
        (11, 5, [2, 4, 6, 8, 10]),
        (3, 2, [2, 3]),
    ],
)
def test_subset_is_the_middle_of_equal_bins(clean_stack, n, n_sub, expected):
    subset = Calibration.from_stack(clean_stack[:n], Z_UM[:n], n_sub=n_sub, denoise=False).subset
    assert (subset + 1).tolist() == list(expected)


def test_another_subset_is_that_of_a_new_calibration(stacks, calibration):
    other = calibration.with_subset(5)
    made = Calibration.from_stack(stacks["fluorescent"], Z_UM, n_sub=5)
    np.testing.assert_array_equal(other.subset, made.subset)
    np.testing.assert_array_equal(other.expected, made.expected)
    assert len(calibration.subset) == 9
    with pytest.raises(ValueError, match="n_sub: got 52, allowed are whole numbers from 2 to 51"):
        calibration.with_subset(52)


def test_attributes(stacks):
    made = Calibration.from_stack(stacks["disturbed"], Z_UM)
    assert len(made) == 51 and made.size == 61
    np.testing.assert_array_equal(made.stack, stacks["disturbed"])
    np.testing.assert_array_equal(made.z_um, Z_UM)
    assert made.stack.dtype == made.templates.dtype == np.float32 and made.z_um.dtype == np.float64
    np.testing.assert_allclose(made.templates.mean(axis=(1, 2)), 0, atol=1e-6)
    np.testing.assert_allclose((made.templates**2).sum(axis=(1, 2)), 1, rtol=1e-5)
    assert np.corrcoef(made.templates[10].ravel(), levelled(made.stack)[10].ravel())[0, 1] > 0.99


def test_depths_keep_their_digits(clean_stack):
    z_um = 12_345.678 + 0.0001 * np.arange(5)
    np.testing.assert_array_equal(Calibration.from_stack(clean_stack[:5], z_um, n_sub=2).z_um, z_um)


@pytest.mark.parametrize("dtype", [np.int32, np.float64, ">u2"])
def test_any_real_type(stacks, dtype):
    stack = stacks["fluorescent"][::5]
    expected = Calibration.from_stack(stack, Z_UM[::5])
    made = Calibration.from_stack(np.asfortranarray(stack.astype(dtype)), list(Z_UM[::5]))
    np.testing.assert_array_equal(made.templates, expected.templates)


def test_stack_is_not_changed(stacks):
    stack = stacks["fluorescent"][::5].astype(np.float32)
    kept = stack.copy()
    stack.flags.writeable = False
    Calibration.from_stack(stack, Z_UM[::5])
    np.testing.assert_array_equal(stack, kept)


def test_falling_depths_are_the_same_stack_reversed(stacks):
    rising = Calibration.from_stack(stacks["fluorescent"], Z_UM)
    falling = Calibration.from_stack(stacks["fluorescent"][::-1], Z_UM[::-1])
    for name in ("stack", "z_um", "subset", "templates"):
        np.testing.assert_array_equal(getattr(falling, name), getattr(rising, name))


@pytest.mark.parametrize(
    ("n", "kept"), [(51, range(51)), (11, range(0, 51, 5)), (6, range(0, 51, 10)), (3, (0, 25, 50))]
)
def test_n_keeps_images_evenly_spread(stacks, n, kept):
    made = Calibration.from_stack(stacks["fluorescent"], Z_UM, n=n, n_sub=3)
    np.testing.assert_array_equal(made.z_um, Z_UM[list(kept)])
    np.testing.assert_array_equal(made.stack, stacks["fluorescent"][list(kept)])
    direct = Calibration.from_stack(stacks["fluorescent"][list(kept)], Z_UM[list(kept)], n_sub=3)
    np.testing.assert_array_equal(made.templates, direct.templates)


# -------------------- denoising


def test_denoise_can_be_left_out(stacks):
    raw = Calibration.from_stack(stacks["fluorescent"], Z_UM, denoise=False)
    np.testing.assert_allclose(raw.templates, normalised(levelled(raw.stack)), atol=1e-7)


def test_levelled_takes_out_any_plane():
    images = np.random.default_rng(2).normal(size=(3, 9, 9))
    y, x = np.indices((9, 9))
    level = levelled(images)
    np.testing.assert_allclose(levelled(images + 5 + 0.3 * x - 2 * y), level, atol=1e-12)
    for basis in (np.ones((9, 9)), x, y):
        np.testing.assert_allclose((level * basis).sum(axis=(1, 2)), 0, atol=1e-10)


# -------------------- the map and quality figures


def test_map_is_the_correlation_of_stack_with_subset(calibrations):
    for made in calibrations.values():
        assert made.expected.shape == (51, 9)
        plain = correlate_plainly(made.stack[20], made.templates[made.subset])[:, 0, 0]
        others = made.subset != 20
        # Searched for at half resolution, with planes taken out: near, not the same.
        np.testing.assert_allclose(made.expected[20, others], plain[others], atol=0.06)


def test_map_of_plain_images_is_plain(clean_stack):
    """Without half resolution and for level images, entries off the diagonal are the definition."""
    stack = levelled(clean_stack[::5].astype(np.float32))
    made = Calibration.from_stack(stack, Z_UM[::5], n_sub=3, denoise=False)
    if made.half_resolution:
        made.__dict__["half_resolution"] = False
    plain = np.stack([correlate_plainly(image, stack[made.subset])[:, 0, 0] for image in stack])
    off = np.arange(11)[:, None] != made.subset
    np.testing.assert_allclose(made.expected[off], plain[off], atol=5e-5)


def test_diagonal_is_the_parabola_of_its_neighbours(calibration):
    for column, k in enumerate(calibration.subset):
        profile, near = calibration.expected[:, column], [k - 2, k - 1, k + 1, k + 2]
        here = np.polyval(np.polyfit(Z_UM[near], profile[near], 2), Z_UM[k])
        assert profile[k] == pytest.approx(min(here, 1), abs=1e-4)


def test_diagonal_has_no_spike(calibration, stacks):
    """An image that meets itself, noise and all, is not in the map: entries keep below 1 where noise is high."""
    raw = Calibration.from_stack(stacks["fluorescent"], Z_UM, denoise=False)
    k, column = raw.subset[-1], len(raw.subset) - 1
    assert raw.expected[k, column] - raw.expected[[k - 1, k + 1], column].mean() < 0.02
    assert raw.expected[k, column] < 0.95
    assert raw.expected.max() <= 1


def test_expected_profile_peaks_at_its_depth(calibration):
    peaks = calibration.expected.argmax(axis=0)
    assert (np.abs(peaks - calibration.subset) <= 3).all()  # dim noisy ones least sharply


def test_self_similarity(calibration):
    likeness = calibration.self_similarity()
    assert likeness.shape == (51, 51)
    np.testing.assert_allclose(likeness, likeness.T, atol=1e-6)
    np.testing.assert_allclose(np.diag(likeness), 1, atol=1e-5)
    k, m = 12, 30
    plain = correlate_plainly(calibration.templates[k], calibration.templates[m][None])[0, 0, 0]
    assert likeness[k, m] == pytest.approx(plain, abs=1e-5)


def test_signal_to_noise(calibration, clean_stack):
    clean = clean_stack.astype(float)
    expected = (clean - np.median(clean, axis=(1, 2), keepdims=True)).max(axis=(1, 2)) / 38
    assert signal_to_noise(calibration.stack).shape == (51,)
    np.testing.assert_allclose(signal_to_noise(calibration.stack), expected, rtol=0.1)


def test_signal_to_noise_is_that_of_the_contrast(calibrations):
    """Dark particles on a bright field have the contrast of bright ones on a dark field."""
    bright, dark = (signal_to_noise(calibrations[k].stack) for k in ("fluorescent", "brightfield"))
    np.testing.assert_allclose(dark, bright, rtol=0.2)


# -------------------- from a scan of full frames


SCAN_Z_UM = Z_UM[::2]


@pytest.fixture(scope="module", params=["fluorescent", "brightfield"])
def scan(request, microscope):
    """Image type, frames of a bead at (66.37, 51.58) that drifts by (0.9, -0.6) px, another far away; a calibration."""
    rng = np.random.default_rng(CALIBRATION_SEED + 5)
    x, y = np.linspace(66.37, 67.27, 26), np.linspace(51.58, 50.98, 26)
    frames = [
        microscope.render(table([x[k], 158], [y[k], 50], [z, z]), (104, 170), image_type=request.param, rng=rng)
        for k, z in enumerate(SCAN_Z_UM)
    ]
    frames = np.stack(frames)
    return request.param, frames, Calibration.from_bead(frames, SCAN_Z_UM, 68, 50, size=61)  # off by (-1.2, 1.3) px


def measured_errors(microscope, made, kind, seed=91):
    """Errors of 60 particles at random sub-pixel places."""
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(10):
        x, y = np.array([a.ravel() for a in np.meshgrid([50, 140, 230], [50, 140])]) + rng.uniform(-4, 4, (2, 6))
        true = table(x, y, rng.uniform(-45, 45, 6))
        found = locate(microscope.render(true, (190, 280), image_type=kind, rng=rng), made)
        order = [np.hypot(found["x_px"] - p.x_px, found["y_px"] - p.y_px).argmin() for p in true.itertuples()]
        errors.append(found.iloc[order][["x_px", "y_px", "z_um"]].to_numpy() - true.to_numpy())
    return np.concatenate(errors)


def test_scan_is_centred(microscope, scan):
    kind, _, made = scan
    assert made.size == 61
    bias = measured_errors(microscope, made, kind).mean(axis=0)
    assert (np.abs(bias) < (CENTRE_PX, CENTRE_PX, CENTRE_Z_UM)).all(), bias


def test_scan_drift_is_followed(scan, clean_stack):
    """Every slice shows the particle in the middle: it resembles the stack rendered there, and not one shifted."""
    kind, _, made = scan
    clean_stack = clean_stack[::2]
    clean = normalised(clean_stack.astype(float)) * (1 if kind == "fluorescent" else -1)
    right = np.einsum("kij,kij->k", made.templates, clean)
    for axis in (1, 2):
        for shift in (-1, 1):
            assert (right > np.einsum("kij,kij->k", made.templates, np.roll(clean, shift, axis))).all()
    assert right.min() > 0.97


def test_size_is_found_by_itself(scan, clean_stack):
    _, frames, _ = scan
    made = Calibration.from_bead(frames, SCAN_Z_UM, 67, 51)
    assert made.size % 2 == 1
    assert 55 <= made.size <= 75
    cut = (61 - min(made.size, 61)) // 2
    light = clean_stack - 500.0
    inside = light[:, cut : 61 - cut, cut : 61 - cut].sum(axis=(1, 2))
    assert (inside / light.sum(axis=(1, 2))).min() > 0.9


def test_scan_falling_is_rising(scan):
    _, frames, _ = scan
    rising = Calibration.from_bead(frames, SCAN_Z_UM, 67, 51, size=41, n=11, n_sub=4)
    falling = Calibration.from_bead(frames[::-1], SCAN_Z_UM[::-1], 67, 51, size=41, n=11, n_sub=4)
    np.testing.assert_allclose(falling.stack, rising.stack, rtol=1e-4)
    assert len(rising) == 11 and len(rising.subset) == 4


@pytest.mark.parametrize(
    ("x", "y", "size"),
    [(25, 51, 61), (67, 25, 61), (150, 51, 61), (67, 80, 61), (67, 51, 62), (67, 51, 1)],
)
def test_scan_refuses_a_particle_at_the_border(scan, x, y, size):
    message = "^size:"
    with pytest.raises(ValueError, match=message):
        Calibration.from_bead(scan[1], SCAN_Z_UM, x, y, size=size)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (169, 103), (400, 50), (50, 400), (1, 50)])
def test_scan_refuses_a_particle_on_the_border(scan, x, y):
    with pytest.raises(ValueError, match=r"^x_px, y_px:"):
        Calibration.from_bead(scan[1], SCAN_Z_UM, x, y)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"x_px": np.nan}, ValueError, "^x_px:"),
        ({"y_px": -3}, ValueError, "^y_px:"),
        ({"x_px": "97"}, TypeError, "^x_px:"),
        ({"z_um": SCAN_Z_UM[:-1]}, ValueError, "^z_um:"),
        ({"z_um": np.full(26, 3.0)}, ValueError, "^z_um:"),
        ({"scan": np.zeros((60, 60))}, ValueError, "^scan:"),
        ({"size": 41.0}, TypeError, "^size:"),
        ({"size": "41"}, TypeError, "^size:"),
        ({"n_sub": 52}, ValueError, "^n_sub:"),
        ({"n": 2}, ValueError, "^n:"),
        ({"sizes": 41}, TypeError, "sizes"),
    ],
)
def test_scan_refuses(scan, changes, error, message):
    with pytest.raises(error, match=message):
        Calibration.from_bead(**({"scan": scan[1], "z_um": SCAN_Z_UM, "x_px": 67, "y_px": 51, "size": 21} | changes))


# -------------------- files


def test_saved_and_loaded_is_the_same_to_the_bit(calibration, tmp_path):
    calibration.save(tmp_path / "a.npz")
    loaded = Calibration.load(str(tmp_path / "a.npz"))
    for name in ("stack", "z_um", "subset", "templates", "expected"):
        one, other = getattr(loaded, name), getattr(calibration, name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_saved_under_another_suffix_is_refused(calibration, tmp_path):
    with pytest.raises(ValueError, match=r"^path:"):
        calibration.save(tmp_path / "a.npy")
    assert not list(tmp_path.iterdir())


def test_saving_leaves_the_old_file_or_none_when_it_fails(calibration, tmp_path, monkeypatch):
    def full_disk(path, **_):
        path.write_bytes(b"half")
        raise OSError("no space left")

    (tmp_path / "old.npz").write_bytes(b"old")
    monkeypatch.setattr(np, "savez_compressed", full_disk)
    for name in ("old.npz", "new.npz"):
        with pytest.raises(OSError, match="no space left"):
            calibration.save(tmp_path / name)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


def arrays(made) -> dict:
    return {"stack": made.stack, "z_um": made.z_um, "subset": made.subset, "templates": made.templates}


@pytest.mark.parametrize("version", [None, 0, VERSION + 1, "1", [1, 1]])
def test_other_versions_are_refused(calibration, tmp_path, version):
    extra = {} if version is None else {"gdptlab_calibration": version}
    np.savez(tmp_path / "a.npz", **arrays(calibration), **extra)
    with pytest.raises(ValueError, match=r"^path:"):
        Calibration.load(tmp_path / "a.npz")


@pytest.mark.parametrize("missing", ["stack", "z_um", "subset", "templates"])
def test_missing_parts_are_refused(calibration, tmp_path, missing):
    parts = arrays(calibration)
    del parts[missing]
    np.savez(tmp_path / "a.npz", gdptlab_calibration=VERSION, **parts)
    with pytest.raises(ValueError, match=r"^path:"):
        Calibration.load(tmp_path / "a.npz")


def test_parts_that_do_not_fit_are_refused(calibration, tmp_path):
    for name in ("stack", "z_um", "templates"):
        parts = arrays(calibration) | {name: arrays(calibration)[name][:-1]}
        np.savez(tmp_path / "a.npz", gdptlab_calibration=VERSION, **parts)
        with pytest.raises(ValueError, match=r"^path:"):
            Calibration.load(tmp_path / "a.npz")


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive", b"\x93NUMPY"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"^path:"):
        Calibration.load(tmp_path / "a.npz")


def test_a_single_array_is_refused(calibration, tmp_path):
    np.save(tmp_path / "a.npy", calibration.stack)
    with pytest.raises(ValueError, match=r"^path:"):
        Calibration.load(tmp_path / "a.npy")


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        Calibration.load(tmp_path / "absent.npz")


@pytest.mark.parametrize("fraction", [0.01, 0.5, 0.95, 0.999])
def test_truncated_files_are_refused(calibration, tmp_path, fraction):
    path = tmp_path / "a.npz"
    calibration.save(path)
    path.write_bytes(path.read_bytes()[: int(fraction * path.stat().st_size)])
    with pytest.raises(ValueError, match=r"^path:"):
        Calibration.load(path)


def test_flipped_bytes_are_refused(calibration, tmp_path):
    path = tmp_path / "a.npz"
    calibration.save(path)
    for name in ("stack.npy", "templates.npy"):
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo(name)
        content = bytearray(path.read_bytes())
        content[info.header_offset + 100 + info.compress_size // 2] ^= 0xFF
        damaged = tmp_path / "damaged.npz"
        damaged.write_bytes(content)
        with pytest.raises(ValueError, match=r"^path:"):
            Calibration.load(damaged)


class Bomb:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("inside", [True, False])
def test_pickles_are_refused_and_never_opened(calibration, tmp_path, inside):
    path, trace = tmp_path / "a.npz", tmp_path / "exploded"
    if inside:
        bombs = np.empty(1, dtype=object)
        bombs[0] = Bomb(trace)
        np.savez(path, gdptlab_calibration=VERSION, **(arrays(calibration) | {"subset": bombs}))
    else:
        path.write_bytes(pickle.dumps(Bomb(trace)))
    with pytest.raises(ValueError, match=r"^path:"):
        Calibration.load(path)
    assert not trace.exists()


# -------------------- bad input

STACK = np.random.default_rng(0).random((6, 9, 9))
NAN, INF, FLAT = (STACK.copy() for _ in range(3))
NAN[2, 3, 4], INF[2, 3, 4], FLAT[[1, 4]] = np.nan, np.inf, 7


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"stack": STACK[:, :2, :2]}, ValueError, "^stack:"),
        ({"stack": STACK[:, :7]}, ValueError, "^stack:"),
        ({"stack": STACK[0]}, ValueError, "^stack:"),
        ({"stack": STACK[:2], "z_um": [0, 1]}, ValueError, "^stack:"),
        ({"stack": STACK[:0], "z_um": []}, ValueError, "^stack:"),
        ({"stack": NAN}, ValueError, "^stack:"),
        ({"stack": INF}, ValueError, "^stack:"),
        ({"stack": FLAT}, ValueError, "^stack:"),
        ({"stack": STACK * 1j}, TypeError, "^stack:"),
        ({"stack": STACK.astype(str)}, TypeError, "^stack:"),
        ({"z_um": range(5)}, ValueError, "^z_um:"),
        ({"z_um": [0, 1, 2, 2, 3, 4]}, ValueError, "^z_um:"),
        ({"z_um": [0, 1, 2, 3, 2, 4]}, ValueError, "^z_um:"),
        ({"z_um": [0, 1, 2, 3, 4, np.nan]}, ValueError, "^z_um:"),
        ({"z_um": [range(6)]}, ValueError, "^z_um:"),
        ({"z_um": list("abcdef")}, TypeError, "^z_um:"),
        ({"n_sub": 1}, ValueError, "^n_sub:"),
        ({"n_sub": 7}, ValueError, "^n_sub:"),
        ({"n_sub": 5, "n": 4}, ValueError, "^n_sub:"),
        ({"n_sub": 3.0}, TypeError, "^n_sub:"),
        ({"n": 2}, ValueError, "^n:"),
        ({"n": 7}, ValueError, "^n:"),
        ({"nsub": 3}, TypeError, "nsub"),
    ],
)
def test_stack_refuses(changes, error, message):
    with pytest.raises(error, match=message):
        Calibration.from_stack(**({"stack": STACK, "z_um": range(6), "n_sub": 3} | changes))


def test_three_slices_are_enough(clean_stack):
    made = Calibration.from_stack(clean_stack[::25], Z_UM[::25], n_sub=2)
    assert np.isfinite(made.expected).all()
    assert len(locate(np.pad(clean_stack[25], 40, mode="edge"), made)) == 1


def test_a_calibration_cannot_be_changed(calibration):
    with pytest.raises(AttributeError):
        calibration.z_um = pd.Series(Z_UM)


# -------------------- plans


class Planned:
    """A plan that only knows what shape it was made for."""

    def __init__(self, calibration, shape):
        self.shape = shape


def test_a_plan_is_kept_for_its_thread_and_shape(stacks):
    made = Calibration.from_stack(stacks["fluorescent"][::10], Z_UM[::10], n_sub=3)
    plan = planned(made, Planned, (70, 80))
    assert plan.shape == (70, 80)
    assert planned(made, Planned, (70, 80)) is plan
    assert planned(made, Planned, (80, 70)) is not plan
    with ThreadPoolExecutor(1) as threads:
        other = threads.submit(planned, made, Planned, (70, 80)).result()
    assert other is not plan and planned(made, Planned, (70, 80)) is plan


def test_few_plans_are_kept(stacks):
    made = Calibration.from_stack(stacks["fluorescent"][::10], Z_UM[::10], n_sub=3)
    first, last = (planned(made, Planned, (70, side)) for side in (80, 81))
    for side in range(82, 81 + KEPT):
        planned(made, Planned, (70, 81))  # the one in use stays
        planned(made, Planned, (70, side))
    assert planned(made, Planned, (70, 81)) is last and planned(made, Planned, (70, 80)) is not first


def test_plans_stay_behind(stacks):
    """Neither a copy in another process nor one with another subset has the plans, which may hold much memory."""
    made = Calibration.from_stack(stacks["fluorescent"][::10], Z_UM[::10], n_sub=3)
    made.correlator((70, 80))
    plan = planned(made, Planned, (70, 80))
    made.expected  # noqa: B018
    sent = pickle.loads(pickle.dumps(made))
    assert "expected" in sent.__dict__  # what is made only once goes with it
    np.testing.assert_array_equal(sent.templates, made.templates)
    assert planned(sent, Planned, (70, 80)) is not plan
    assert len(made.with_subset(2).correlator((70, 80))(np.ones((70, 80), np.float32))) == 2


@pytest.mark.parametrize("away", [(-9, 0), (6, 8), (0, 0)])
def test_a_rough_place_will_do(scan, away) -> None:
    """The particle is looked for about it, and the template no larger for it."""
    x, y = 67 + away[0], 51 + away[1]
    exact = Calibration.from_bead(scan[1], SCAN_Z_UM, 67, 51, size=61)
    rough = Calibration.from_bead(scan[1], SCAN_Z_UM, x, y, size=61)
    assert np.einsum("kij,kij->k", exact.templates, rough.templates).min() > 0.97


def test_an_empty_place_is_refused() -> None:
    noise = np.random.default_rng(2).normal(400, 20, (15, 90, 90))
    with pytest.raises(ValueError, match=r"x_px, y_px: got a particle at .* nothing stands out by more than"):
        Calibration.from_bead(noise, np.arange(15.0), 44, 45, size=41)
    noise[:, 20:24, 20:24] += 600  # in a corner of the template
    with pytest.raises(ValueError, match="beside it, by"):
        Calibration.from_bead(noise, np.arange(15.0), 40, 40, size=41)


def test_the_smallest_template(scan):
    assert Calibration.from_bead(scan[1], SCAN_Z_UM, 68, 50, size=3).size == 3


def test_a_particle_cut_by_the_border_is_refused(microscope) -> None:
    particle = table([19.0], [60.0], [0.0])
    frames = np.array([microscope.render(particle.assign(z_um=z), (120, 120), rng=3) for z in SCAN_Z_UM])
    with pytest.raises(ValueError, match="whose images reach the border"):
        Calibration.from_bead(frames, SCAN_Z_UM, 19, 60)


def test_a_calibration_says_what_it_is(calibration) -> None:
    assert repr(calibration).startswith("<Calibration: 51 images of 61 by 61 px, z = -50 to 50 µm, 9 in the subset")


def learned_calibration(calibration):
    """A calibration that has learned four terms and two modes, as `from_scan(field=True, modes=2)` makes them."""
    model, rng = calibration.model, np.random.default_rng(12)
    changes, modes = (rng.normal(size=(n, *model.patterns.shape[1:])).astype(np.float32) for n in (3, 2))
    patterns = np.concatenate([model.patterns, changes])
    learned = replace(model, patterns=patterns, modes=modes, surface=np.arange(4.0))
    return replace(calibration, learned=learned)


def test_learned_patterns_are_saved(calibration, tmp_path):
    """With and without modes; what is read is what was written, and of the same types."""
    for made in (learned_calibration(calibration), replace(calibration, learned=calibration.model)):
        made.save(tmp_path / "a.npz")
        loaded = Calibration.load(tmp_path / "a.npz").learned
        for name in LEARNED:
            expected, found = getattr(made.learned, name), getattr(loaded, name)
            assert type(expected) is type(found)
            np.testing.assert_array_equal(expected, found)


@pytest.mark.parametrize(
    "spoilt",
    [
        {"learned_surface": None},
        {"learned_nodes_per_px": np.int64(3)},
        {"learned_patterns": np.zeros((4, 51, 9, 9), np.float32)},
        {"learned_own_error": np.full((51, 3), np.nan)},
        {"learned_z_um": np.zeros(51)},
    ],
)
def test_learned_patterns_that_are_not_sound_are_refused(calibration, tmp_path, spoilt):
    learned_calibration(calibration).save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        parts = dict(file) | spoilt
    np.savez(tmp_path / "b.npz", **{name: value for name, value in parts.items() if value is not None})
    with pytest.raises(ValueError, match=r"^path:.*learned"):
        Calibration.load(tmp_path / "b.npz")
