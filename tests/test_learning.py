"""Learning the pattern model from a scan: positions, amplitudes, focal surface, patterns, modes, errors, refusals."""

import numpy as np
import pytest
from conftest import table
from scipy.spatial import KDTree

from gdptlab.fit.learning import _lags, learned
from gdptlab.fit.model import field_terms

SHAPE = (150, 190)
Z_UM = np.arange(-14.0, 15.0)
SURFACE_UM = np.array([0.0, 0.8, -0.6, 1.0])
NOISE = 3.0


def scan_of(beads, rng, *, surface_um=SURFACE_UM, astigmatism_um=0.0, width_px=1.0, noise=NOISE):
    """Scan of Gaussian beads, wider out of focus; with astigmatism wide in focus, too, and never round but there."""
    y, x = np.indices(SHAPE)
    frames = np.full((len(Z_UM), *SHAPE), 100.0)
    heights = field_terms(beads["x_px"], beads["y_px"], SHAPE) @ surface_um
    for bead, height, larger in zip(beads.itertuples(), heights, beads.get("larger", np.ones(len(beads))), strict=True):
        depth = Z_UM[:, None, None] - height
        across = np.sqrt((width_px * larger) ** 2 + (0.3 * (depth - astigmatism_um)) ** 2)
        down = np.sqrt((width_px * larger) ** 2 + (0.25 * (depth + astigmatism_um)) ** 2)
        near = np.s_[
            :,
            max(round(bead.y_px) - 20, 0) : round(bead.y_px) + 21,
            max(round(bead.x_px) - 20, 0) : round(bead.x_px) + 21,
        ]
        u, v = (x[near[1:]] - bead.x_px) / across, (y[near[1:]] - bead.y_px) / down
        frames[near] += bead.amplitude * 6000 / (across * down) * np.exp(-(u**2 + v**2) / 2)
    return (frames + rng.normal(0, noise, frames.shape)).astype(np.float32)


def beads_of(rng, n, apart_px=16.0):
    """Beads that overlap out of focus, of amplitudes from a third to three."""
    places = []
    while len(places) < n:
        place = rng.uniform((10, 10), (SHAPE[1] - 11, SHAPE[0] - 11))
        if all(np.hypot(*(place - other)) > apart_px for other in places):
            places.append(place)
    return table(*np.array(places).T, 0.0 * np.ones(n)).assign(amplitude=np.exp(rng.uniform(-1.1, 1.1, n)))


def about(beads, rng, px=0.25):
    """Positions that are good to a fraction of an image, as those of spots found in the sharpest slice."""
    return beads[["x_px", "y_px"]].to_numpy() + rng.normal(0, px, (len(beads), 2))


@pytest.fixture(scope="module")
def sharp():
    """Beads two pixels wide in focus, on a focal surface that is not flat: truth, scan, model and table."""
    rng = np.random.default_rng(1)
    beads = beads_of(rng, 45)
    scan = scan_of(beads, rng)
    return beads, scan, *learned(scan, Z_UM, about(beads, rng), field=True, modes=0)


@pytest.fixture(scope="module")
def wide():
    """Astigmatic beads ten pixels wide even in focus, whose sizes scatter by a tenth."""
    rng = np.random.default_rng(2)
    beads = beads_of(rng, 24, 22).assign(larger=rng.normal(1, 0.1, 24))
    scan = scan_of(beads, rng, surface_um=np.zeros(4), astigmatism_um=6, width_px=3.0)
    return beads, scan, *learned(scan, Z_UM, about(beads, rng, 0.7), field=False, modes=1)


@pytest.mark.parametrize("kind", ["sharp", "wide"])
def test_positions_do_not_lock_to_pixels(kind, request):
    """Started a pixel off; a common shift would be the pattern's own."""
    beads, _, _, found = request.getfixturevalue(kind)
    off = found[["x_px", "y_px"]].to_numpy() - beads[["x_px", "y_px"]].to_numpy()
    print(kind, off.mean(axis=0).round(4), off.std(axis=0).round(4))
    assert (off.std(axis=0) < 0.06).all() and (np.abs(off.mean(axis=0)) < 0.05).all()
    fraction = beads[["x_px", "y_px"]].to_numpy() - np.rint(beads[["x_px", "y_px"]].to_numpy())
    slope = (off * fraction).sum() / (fraction**2).sum()
    assert abs(slope) < 0.08  # -1 for positions on whole pixels


def test_nodes_follow_the_sharpness(sharp, wide):
    assert sharp[2].nodes_per_px == 2 and wide[2].nodes_per_px == 1
    assert sharp[2].patterns.shape[0] == 4 and wide[2].patterns.shape[0] == 1
    for _, _, model, _ in (sharp, wide):
        m = model.patterns.shape[-1]
        assert m % 2 == 1 and m >= model.nodes_per_px * (model.size - 1) + 1
        assert model.pattern_error.shape == model.patterns.shape[1:] and model.own_error.shape == (len(Z_UM), 3)
        for part in (model.patterns, model.pattern_error, model.own_error):
            assert np.isfinite(part).all()
        assert (model.own_error > 0).all() and (model.pattern_error > 0).all()
        assert model.noise == pytest.approx(NOISE, rel=0.15)


def test_amplitudes_and_heights(sharp):
    beads, _, model, found = sharp
    ratio = found["amplitude"] / beads["amplitude"]
    assert (ratio / ratio.median()).std() < 0.04
    terms = field_terms(beads["x_px"], beads["y_px"], SHAPE)
    off = found["height_um"] - terms @ SURFACE_UM
    assert (off - off.median()).abs().median() < 0.15
    np.testing.assert_allclose(model.surface[1:], SURFACE_UM[1:], atol=0.4)


def test_pattern_is_the_image_of_a_bead(wide):
    """Of the mean size, without noise, on whole pixels."""
    model = wide[2]
    middle = table((SHAPE[1] - 1) // 2, (SHAPE[0] - 1) // 2, 0).assign(amplitude=1.0)
    true = scan_of(middle, np.random.default_rng(0), surface_um=np.zeros(4), astigmatism_um=6, width_px=3.0, noise=0)
    half = 10
    cut = (
        true[:, SHAPE[0] // 2 - 1 - half : SHAPE[0] // 2 + half, SHAPE[1] // 2 - 1 - half : SHAPE[1] // 2 + half] - 100
    )
    m = model.images.shape[-1] // 2
    drawn = model.images[:, m - half : m + half + 1, m - half : m + half + 1]
    alike = np.einsum("kij,kij->k", drawn, cut) / np.linalg.norm(drawn, axis=(1, 2)) / np.linalg.norm(cut, axis=(1, 2))
    assert alike.min() > 0.995


def test_a_mode_tells_the_size(wide):
    """It is largest where a larger bead differs, and small beside the pattern."""
    model = wide[2]
    assert model.modes_count == 1
    fraction = np.abs(model.modes).max() / np.abs(model.patterns).max()
    assert 0.03 < fraction < 0.5


def test_order_of_the_beads_is_kept(sharp):
    beads, _, _, found = sharp
    nearest = KDTree(found[["x_px", "y_px"]]).query(beads[["x_px", "y_px"]])[1]
    np.testing.assert_array_equal(nearest, np.arange(len(beads)))


def test_lags_of_profiles():
    slices, true = np.arange(40), np.array([-3.2, 0.0, 1.5, 2.0, -1.0])
    profiles = np.exp(-((slices - 20 - true[:, None]) ** 2) / 50)
    found = _lags(profiles, 6)
    np.testing.assert_allclose(found - np.median(found), true - np.median(true), atol=0.15)


# -------------------- refusals


def test_a_film_is_no_scan():
    """Particles that move from frame to frame."""
    rng = np.random.default_rng(3)
    beads = beads_of(rng, 14, 25)
    frames = [scan_of(beads.assign(x_px=beads["x_px"] + rng.normal(0, 8, 14).clip(-9, 9)), rng)[14] for _ in Z_UM]
    with pytest.raises(ValueError, match=r"^scan: got frames in which particles are alike"):
        learned(np.stack(frames), Z_UM, about(beads, rng), size=21, turns=1)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"scan": np.zeros((5, 5))}, ValueError, "^scan: got shape"),
        ({"z_um": Z_UM[:-1]}, ValueError, "^z_um: got 28 depths for 29"),
        ({"z_um": Z_UM[::-1]}, ValueError, "^z_um: got steps from"),
        ({"size": 20}, ValueError, "^size: got 20"),
        ({"modes": 12}, ValueError, "^scan: got 45 particles inside it to learn from, needed are 48"),
        ({"learn_from": [True]}, ValueError, "^learn_from: got shape"),
        ({"learn_from": np.arange(45) < 6, "field": True}, ValueError, "^scan: got .* needed are 10"),
    ],
)
def test_refuses(sharp, change, error, message):
    beads, scan, _, _ = sharp
    given = {"scan": scan, "z_um": Z_UM, "beads_px": beads[["x_px", "y_px"]].to_numpy()} | change
    with pytest.raises(error, match=message):
        learned(given.pop("scan"), given.pop("z_um"), given.pop("beads_px"), **given)
