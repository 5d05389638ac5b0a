"""Standard deviations of what correlation measures."""

import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import shift

from gdptlab import Calibration, batch, datasets, locate, match
from gdptlab.pipeline import with_errors

Z_UM = np.arange(-30, 31, 2.0)


def spot(z_um, x, y, shape):
    """An astigmatic spot."""
    rows, columns = np.indices(shape)
    wide, high = (2 * np.hypot(1, (z_um + s) / 14) for s in (9, -9))
    return 9000 / wide / high * np.exp(-((columns - x) ** 2) / (2 * wide**2) - (rows - y) ** 2 / (2 * high**2))


def calibrated(noise, rng):
    stack = np.stack([spot(z, 20, 20, (41, 41)) for z in Z_UM])
    return Calibration.from_stack(stack + rng.normal(0, noise, stack.shape), Z_UM)


def measured(calibration, noise, rng, n=6):
    """Table with errors, and truth, of n frames of 36 particles that stand alone."""
    frames, true = [], []
    for k in range(n):
        grid = np.stack(np.meshgrid(*2 * [np.arange(40, 400, 60)]), axis=-1).reshape(-1, 2)
        x, y = (grid + rng.uniform(-5, 5, grid.shape)).T
        true.append(pd.DataFrame({"frame": k, "x_px": x, "y_px": y, "z_um": rng.uniform(-28, 28, len(x))}))
        frame = rng.normal(0, noise, (440, 440))
        for p in true[-1].itertuples():
            top, left = int(p.y_px) - 30, int(p.x_px) - 30
            frame[top : top + 61, left : left + 61] += spot(p.z_um, p.x_px - left, p.y_px - top, (61, 61))
        frames.append(frame)
    return with_errors(batch(frames, calibration, progress=False), calibration), pd.concat(true, ignore_index=True)


@pytest.mark.parametrize("noise", [6, 20, 60])
def test_errors_are_what_is_said(noise) -> None:
    """Of particles alone, at any depth, from 1 to 10 times the noise: RMS error over standard deviation is about 1."""
    rng = np.random.default_rng(1)
    table, true = measured(calibrated(noise / 3, rng), noise, rng)
    pairs = match(table, true)
    assert len(pairs) > 0.98 * len(true)
    for error, stated in (("dx_px", "x_std_px"), ("dy_px", "y_std_px"), ("dz_um", "z_std_um")):
        ratio = pairs[error].to_numpy() / table.loc[pairs["measured"], stated].to_numpy()
        assert 0.8 < np.sqrt((ratio**2).mean()) < 1.25, error
        assert (np.abs(ratio) < 2).mean() > 0.9, error


def of_one_bead(image, calibration, x_px, y_px, z_um):
    """Error of z over its standard deviation, of the bead at a position; NaN if it is off by 5 µm or more."""
    table = with_errors(locate(image, calibration, threshold=0.3), calibration)
    table = table[np.hypot(table["x_px"] - x_px, table["y_px"] - y_px) < 4].nlargest(1, "cm")
    error = table["z_um"] - z_um
    return (error / table["z_std_um"])[error.abs() < 5].sum() if (error.abs() < 5).any() else np.nan


def robust(ratios):
    """Robust standard deviation of ratios (n,), and the fraction that are known."""
    return 1.4826 * np.nanmedian(np.abs(ratios)), np.isfinite(ratios).mean()


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_errors_of_a_real_astigmatic_bead_are_what_is_said(noise) -> None:
    """Odd slices of a bead, moved within a pixel, by the even ones; the noise is added."""
    try:
        stack = datasets.astigmatic_bead()
    except FileNotFoundError as missing:
        pytest.skip(str(missing))
    rng, ratios = np.random.default_rng(3), []
    even = stack[::2] + rng.normal(0, noise / 3, stack[::2].shape)
    calibration = Calibration.from_stack(even, np.arange(0, len(stack), 2.0))
    for k in np.tile(np.arange(5, 56, 2), 4):
        off = rng.uniform(-0.5, 0.5, 2)
        image = shift(np.pad(stack[k], 20), off, mode="nearest") + rng.normal(0, noise, (101, 101))
        ratios.append(of_one_bead(image, calibration, 50 + off[1], 50 + off[0], k))
    std, known = robust(ratios)
    assert 0.75 < std < 1.25 and known > 0.98


def test_errors_of_a_real_bead_beside_those_of_others() -> None:
    """Odd slices by the even ones of the same bead: nearly what is said. With others' images beads differ by more."""
    try:
        beads = datasets.planar_beads()
    except FileNotFoundError as missing:
        pytest.skip(str(missing))
    calibration = Calibration.from_bead(beads.scan[::2], beads.z_um[::2], 244, 230, size=29)
    own, known = robust([of_one_bead(beads.scan[k], calibration, 244, 230, beads.z_um[k]) for k in range(7, 100, 2)])
    assert own < 1.6 and known > 0.95
    table = with_errors(batch(beads.frames, calibration, progress=False), calibration)
    pairs = match(table, beads.truth, within_px=3, within_um=5)
    ratio = pairs["dz_um"].to_numpy() / table["z_std_um"].to_numpy()[pairs["measured"]]
    assert robust(ratio)[0] > 3  # the docstring says so


def test_overlap_makes_them_larger() -> None:
    rng = np.random.default_rng(2)
    calibration = calibrated(5, rng)
    alone = spot(8, 60, 60, (121, 121)) + rng.normal(0, 5, (121, 121))
    tables = [batch([f], calibration, progress=False) for f in (alone, alone + spot(-20, 80, 66, alone.shape))]
    first, second = (with_errors(table, calibration).iloc[0] for table in tables)
    assert second["z_std_um"] > 3 * first["z_std_um"]


@pytest.mark.parametrize(
    ("changes", "error", "name"),
    [
        ({"table": 1}, TypeError, "table"),
        ({"table": pd.DataFrame({"z_um": [0.0]})}, ValueError, "table"),
        ({"table": pd.DataFrame({"x_px": [1.0], "y_px": 1.0, "z_um": 0.0, "cm": 0.0})}, ValueError, "table"),
        ({"calibration": None}, TypeError, "calibration"),
    ],
)
def test_refuses(changes, error, name) -> None:
    table = pd.DataFrame({"x_px": [1.0], "y_px": 1.0, "z_um": 0.0, "cm": 0.9})
    good = {"table": table, "calibration": calibrated(5, np.random.default_rng(3))}
    with pytest.raises(error, match=rf"^{name}: "):
        with_errors(**good | changes)
