"""A calibration made from a scan by itself: which beads, how large, and what is said of it."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import KDTree

from gdptlab import Calibration, assessment, batch, locate
from gdptlab.experiment import Camera, Microscope, WaveMicroscope
from gdptlab.pipeline import depth_quality, find_beads, report

Z_UM = np.linspace(-50, 50, 26)
PLACES = np.array([[60.3, 55.8], [180.2, 60.4], [300.7, 52.1], [58.0, 170.9], [182.6, 176.3], [205.0, 190.0]])
SHAPE = (230, 360)
SIGN = {"fluorescent": 1, "brightfield": -1, "disturbed": -1}  # of the beads' light against the background


def scan_of(places, *, kind="fluorescent", seed=0):
    """Scan of beads at places (n, 2) that lie in one plane."""
    beads = pd.DataFrame({"x_px": places[:, 0], "y_px": places[:, 1]})
    microscope, rng = Microscope(), np.random.default_rng(seed)
    return np.stack([microscope.render(beads.assign(z_um=z), SHAPE, image_type=kind, rng=rng) for z in Z_UM])


@pytest.fixture(scope="module")
def scan():
    return scan_of(PLACES)


@pytest.fixture(scope="module")
def made(scan):
    return Calibration.from_scan(scan, Z_UM)


@pytest.mark.parametrize("kind", SIGN)
def test_beads_are_found(kind) -> None:
    beads = find_beads(scan_of(PLACES, kind=kind, seed=3), Z_UM)
    distance, which = KDTree(beads[["x_px", "y_px"]]).query(PLACES)
    assert len(beads) == len(PLACES) and distance.max() < 2
    assert (np.sign(beads["amplitude"]) == SIGN[kind]).all()
    pair = np.hypot(*(PLACES[4] - PLACES[5]))
    np.testing.assert_allclose(beads["room_px"].iloc[which[4:]], pair, atol=2)


def test_only_beads_alone_are_used(made) -> None:
    used = made.report.beads[made.report.beads["verdict"] == "used"]
    assert len(used) == 4
    assert KDTree(PLACES[:4]).query(used[["x_px", "y_px"]])[0].max() < 1
    assert made.size >= 55 and made.report.settings.loc["size", "how"] == "by itself"


def test_average_has_less_noise_than_a_bead(scan, made) -> None:
    one = Calibration.from_bead(scan, Z_UM, *PLACES[0], size=made.size)
    assert made.model.own_error[:, 2].mean() < 0.75 * one.model.own_error[:, 2].mean()


def test_what_is_given_is_used(scan) -> None:
    made = Calibration.from_scan(scan, Z_UM, beads_px=PLACES[:2], size=41, n_sub=7)
    assert made.size == 41 and len(made.subset) == 7
    assert list(made.report.settings["how"]) == ["given"] * 3
    assert list(made.report.beads["verdict"]) == ["used"] * 2


def test_order_of_the_scan_does_not_matter(scan) -> None:
    made = Calibration.from_scan(scan, Z_UM, size=61)
    turned = Calibration.from_scan(scan[::-1], Z_UM[::-1], size=61)
    np.testing.assert_allclose(turned.stack, made.stack)
    np.testing.assert_allclose(turned.report.drift_px, made.report.drift_px)


def test_beads_at_other_heights_are_moved_in_z() -> None:
    places, microscope, rng = PLACES[:3], Microscope(), np.random.default_rng(4)
    higher = np.array([0.0, 0.0, 3.0])
    beads = pd.DataFrame({"x_px": places[:, 0], "y_px": places[:, 1]})
    scan = [microscope.render(beads.assign(z_um=0.9 * z - higher), SHAPE, rng=rng) for z in Z_UM]
    table = Calibration.from_scan(np.stack(scan), Z_UM, size=61).report.beads.sort_values("x_px")
    np.testing.assert_allclose(table["offset_um"], higher / 0.9, atol=0.5)


def test_drift_is_seen(scan) -> None:
    wander = np.rint(np.linspace(-4, 4, len(scan))).astype(int)
    moved = np.stack([np.roll(image, by, axis=1) for image, by in zip(scan, wander, strict=True)])
    made = Calibration.from_scan(moved, Z_UM)
    np.testing.assert_allclose(made.report.drift_px[:, 0], wander, atol=0.7)
    assert report(made).loc["drift", "verdict"] == "look"


def test_clipped_beads_are_left_out_if_others_are_not(microscope) -> None:
    beads = pd.DataFrame({"x_px": PLACES[:4, 0], "y_px": PLACES[:4, 1], "amplitude": [1, 1, 4, 1]})
    camera, rng = Camera(bit_depth=13), np.random.default_rng(5)
    scan = np.stack([microscope.render(beads.assign(z_um=z), SHAPE, camera=camera, rng=rng) for z in Z_UM])
    made = Calibration.from_scan(scan, Z_UM, size=61)
    assert made.report.beads["verdict"].value_counts().to_dict() == {"used": 3, "clipped": 1}
    assert 0 < made.report.clipped.max() <= 0.25
    all_of_them = Calibration.from_scan(np.minimum(scan, 1200), Z_UM, size=61)
    assert report(all_of_them).loc["clipping", "verdict"] == "bad"


def test_ambiguous_depths_are_seen_where_defocus_is_symmetric(made) -> None:
    y, x = np.indices((31, 31)) - 15
    width = np.hypot(2, Z_UM / 10)[:, None, None]
    stack = 1000 * np.exp(-(x**2 + y**2) / (2 * width**2)) / width**2
    flat = Calibration.from_stack(stack + np.random.default_rng(7).normal(0, 0.5, stack.shape), Z_UM)
    mistaken = depth_quality(flat).query("ambiguous_correlation > 0.95")
    assert len(mistaken) > 15
    np.testing.assert_allclose(mistaken["ambiguous_um"], -mistaken["z_um"], atol=9)
    assert not (depth_quality(made)["ambiguous_correlation"] > 0.95).any()


def test_report_of_a_good_calibration(made) -> None:
    table = report(made)
    assert list(table) == ["verdict", "finding", "advice"] and (table["verdict"] != "bad").all()
    assert (table.loc[table["verdict"] == "good", "advice"] == "").all()


def test_better_light_is_less_error(made) -> None:
    dark, bright = (depth_quality(made, noise) for noise in (40, 10))
    np.testing.assert_allclose(dark["z_std_um"], 4 * bright["z_std_um"])
    np.testing.assert_allclose(bright["signal_to_noise"], 4 * dark["signal_to_noise"])
    with pytest.raises(ValueError, match=r"^noise: "):
        depth_quality(made, 0)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"scan": np.ones((26, 40, 40))}, ValueError, "^scan: "),
        ({"scan": np.ones((26, 40))}, ValueError, "^scan: "),
        ({"scan": np.full((26, 40, 40), np.nan)}, ValueError, "^scan: "),
        ({"z_um": Z_UM[:-1]}, ValueError, "^scan, z_um: "),
        ({"size": 40}, ValueError, "^size: "),
        ({"size": 201}, ValueError, "^scan: "),
        ({"n_sub": 1}, ValueError, "^n_sub: "),
        ({"size": 4.5}, TypeError, "^size: "),
        ({"beads_px": [[1, 2, 3]]}, ValueError, "^beads_px: "),
        ({"beads_px": [[-5, 20]]}, ValueError, "^beads_px: "),
    ],
)
def test_refuses(scan, changes, error, message) -> None:
    with pytest.raises(error, match=message):
        Calibration.from_scan(**{"scan": scan, "z_um": Z_UM} | changes)


def test_noise_alone_holds_no_beads() -> None:
    noise = np.random.default_rng(6).normal(100, 5, (20, 60, 60))
    with pytest.raises(ValueError, match=r"^scan: "):
        find_beads(noise, np.arange(20.0))


def test_a_frame_of_the_scan_is_measured_where_it_was_taken(scan, made) -> None:
    table = locate(scan[7], made, threshold=0.5)
    true = pd.DataFrame({"x_px": PLACES[:4, 0], "y_px": PLACES[:4, 1], "z_um": Z_UM[7]})
    assert assessment.scores(table, true).sigma_z_um < 1 and assessment.scores(table, true).recall == 1


def lobed_scan(places, z_um):
    """Beads that are two spots, 18 px apart, wherever they are in focus, and one blur elsewhere."""
    y, x = np.indices((240, 320))
    scan = []
    for z in z_um:
        width = 2 + abs(z) / 5
        spots = [np.exp(-((x - a) ** 2 + (y - b - s) ** 2) / (2 * width**2)) for a, b in places for s in (-9, 9)]
        scan.append(2000 / width**2 * np.sum(spots, axis=0))
    return np.array(scan) + np.random.default_rng(4).normal(0, 4, (len(z_um), *y.shape))


def test_spots_of_one_bead_are_one_bead() -> None:
    z_um, places = np.linspace(-30, 30, 21), np.array([[50, 60], [160, 55], [270, 70], [60, 180], [200, 185.0]])
    found = find_beads(lobed_scan(places, z_um), z_um)
    assert len(found) == 5
    assert KDTree(found[["x_px", "y_px"]]).query(places)[0].max() < 1
    assert found["amplitude"].between(0.5, 1.1 * found["amplitude"].max()).all() and found["amplitude"].min() > 200


def test_a_long_spot_is_found_at_its_middle() -> None:
    """The sharpest slice may be where astigmatism makes a line; less the mean over z, that is two spots."""
    (rows, columns), z_um = np.indices((240, 240)), np.linspace(-40, 40, 41)
    places = np.array([[60.3, 62.8], [180.2, 60.4], [62.7, 178.1], [177.0, 181.6]])
    scan = []
    for z in z_um:
        wide, high = (2.6 * np.hypot(1, (z + s) / 13) for s in (-14, 14))
        spots = [np.exp(-((columns - x) ** 2 / wide**2 + (rows - y) ** 2 / high**2) / 2) for x, y in places]
        scan.append(20000 / wide / high * np.sum(spots, axis=0))
    scan = np.array(scan) + np.random.default_rng(5).normal(0, 8, (41, 240, 240))
    found = find_beads(scan, z_um)
    assert len(found) == 4 and KDTree(places).query(found[["x_px", "y_px"]])[0].max() < 0.5
    assert Calibration.from_scan(scan, z_um).size >= 35  # was 27: none was found where the table said


def test_beads_in_a_regular_array_stay_apart() -> None:
    grid = np.stack(np.meshgrid(np.arange(30, 330, 50), np.arange(30, 220, 50)), axis=-1).reshape(-1, 2)
    assert len(find_beads(scan_of(grid), Z_UM)) == len(grid)


def test_leaps_of_a_bead_are_told_from_drift(made) -> None:
    steady = report(made).loc["drift"]
    drift_px = np.where(np.arange(26)[:, None] < 13, 0.0, [9.0, 0.0])
    leap = replace(made, report=replace(made.report, drift_px=drift_px))
    assert steady["verdict"] == "good"
    assert report(leap).loc["drift", "verdict"] == "bad" and "beads_px" in report(leap).loc["drift", "advice"]


def test_an_outlier_is_left_out(scan) -> None:
    """A bead of another kind among the others."""
    other, (x, y) = scan.astype(float), np.rint(PLACES[2]).astype(int)
    near = np.s_[:, y - 32 : y + 33, x - 32 : x + 33]
    other[near] = other[near].transpose(0, 2, 1)  # turned over, so that its astigmatism is the opposite
    beads = Calibration.from_scan(other, Z_UM, size=61).report.beads
    assert beads["verdict"].value_counts()["used"] == 3
    odd = beads[beads["verdict"] == "an outlier"]
    assert len(odd) == 1 and np.hypot(odd["x_px"] - x, odd["y_px"] - y).item() < 5


@pytest.mark.parametrize(("kind", "counts"), [("fluorescent", 400_000.0), ("brightfield", 160_000.0)])
def test_every_other_slice_of_one_bead_with_rings_measures_the_rest(kind, counts) -> None:
    """A bead that fills most of its frame: light or dark rings, to 0.25 % of the range of depths (RMS)."""
    microscope, z_um = WaveMicroscope(na=0.6, spherical=0.5, counts=counts), np.linspace(-6, 6, 61)
    rng, camera = np.random.default_rng(1), Camera(read_noise=20)
    bead = pd.DataFrame({"x_px": [23.3], "y_px": [22.8]})
    how = {"image_type": kind, "camera": camera, "rng": rng}
    scan = np.stack([microscope.render(bead.assign(z_um=z), (48, 48), **how) for z in z_um])
    made, odd = Calibration.from_scan(scan[::2], z_um[::2]), np.arange(1, 60, 2)
    assert made.size >= 39 and scan.min() > 0 and scan.max() < 2**16 - 1
    true = bead.merge(pd.DataFrame({"frame": range(len(odd)), "z_um": z_um[odd]}), how="cross")
    pairs = assessment.match(batch(scan[odd], made, method="correlation", progress=False), true, within_um=2)
    assert len(pairs) == len(odd) and np.sqrt((pairs["dz_um"] ** 2).mean()) < 0.0025 * 12


def flowing(radius, speed, n=16):
    """A film of astigmatic particles at radii (p,) of a vortex; rad a frame."""
    rows, columns = np.indices((240, 240))
    z, film = np.linspace(-20, 20, len(radius)), []
    for k in range(n):
        angle = 2 * np.arange(len(radius)) + speed * k
        x, y = 120 + radius * np.cos(angle), 118 + radius * np.sin(angle)
        wide, high = (2 * np.hypot(1, (z + s) / 14) for s in (9, -9))
        film.append(
            sum(
                9000 / a / b * np.exp(-((columns - c) ** 2) / (2 * a**2) - (rows - d) ** 2 / (2 * b**2))
                for c, d, a, b in zip(x, y, wide, high, strict=True)
            )
        )
    return np.array(film) + np.random.default_rng(3).normal(0, 6, (n, 240, 240))


@pytest.mark.parametrize("field", [False, True])
@pytest.mark.parametrize(
    ("radius", "speed"),
    [((20, 60, 60, 95, 95), 0.02), ((20, 60, 60, 95, 95), 0.01), ((30, 80, 80, 60), 0.5), ((60,), 0.03)],
)
def test_a_film_is_no_scan(radius, speed, field) -> None:
    film = flowing(np.array(radius, dtype=float), speed)
    with pytest.raises(ValueError, match=r"^scan: .*film of particles that flow"):
        Calibration.from_scan(film, np.arange(len(film)) * 3.0, field=field)


@pytest.mark.parametrize("how", ["stack", "bead", "file"])
def test_every_calibration_is_judged(scan, made, how, tmp_path) -> None:
    """Those that are not made by `from_scan` have no beads to judge."""
    made.save(tmp_path / "a.npz")
    makers = {
        "stack": lambda: Calibration.from_stack(made.stack, Z_UM),
        "bead": lambda: Calibration.from_bead(scan, Z_UM, *PLACES[0]),
        "file": lambda: Calibration.load(tmp_path / "a.npz"),
    }
    table = report(makers[how]())
    assert set(table.index) >= {"signal", "step", "ambiguity", "error of z", "noise of the stack"}
    assert set(table["verdict"]) <= {"good", "look", "bad"} and "beads" not in table.index
