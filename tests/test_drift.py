"""Drift from particles that rest."""

import numpy as np
import pandas as pd
import pytest

from gdptlab.tracking import drift as drift_of
from gdptlab.tracking import velocities, without_drift

N, ERROR_UM = 40, 0.1
TRUE_UM = np.stack([0.05 * np.arange(N), np.sin(np.arange(N) / 6), -0.2 * np.arange(N)], axis=1)
COLUMNS = ["x_um", "y_um", "z_um"]


@pytest.fixture(scope="module")
def tracks():
    """Eight particles that rest, some missing at times, and one that moves by 1 µm a frame; all drift together."""
    rng, parts = np.random.default_rng(1), []
    for i in range(9):
        position = rng.uniform(0, 100, 3) + TRUE_UM + rng.normal(0, ERROR_UM, (N, 3))
        position[:, 0] += np.arange(N) if i == 8 else 0
        part = pd.DataFrame(position, columns=COLUMNS).assign(frame=np.arange(N), particle=10 + i)
        parts.append(part[rng.random(N) < 0.8])
    return pd.concat(parts).sort_values(["frame", "particle"], ignore_index=True)


def test_drift_and_its_error(tracks) -> None:
    found = drift_of(tracks, range(10, 18))
    assert found["frame"].tolist() == list(range(N))
    off = found[COLUMNS].to_numpy() - TRUE_UM
    off -= off.mean(axis=0)  # the first frame's own error, and that of the particles
    stated = found[["x_se_um", "y_se_um", "z_se_um"]].to_numpy()
    assert 0.7 < np.sqrt((off**2).mean() / (stated**2).mean()) < 1.4
    assert np.sqrt((stated**2).mean()) < 1.3 * ERROR_UM / np.sqrt(0.8 * 8)


def test_without_drift_what_rests_rests(tracks) -> None:
    still = without_drift(tracks, drift_of(tracks, range(10, 18)))
    fast = velocities(still, 1.0).groupby("particle")[["vx_um_s", "vz_um_s"]].mean()
    assert fast.drop(18).abs().to_numpy().max() < 0.02 and abs(fast.loc[18, "vx_um_s"] - 1) < 0.02
    assert list(still) == list(tracks)


def test_one_particle_has_no_error(tracks) -> None:
    found = drift_of(tracks, [12])
    assert found["z_se_um"].isna().all() and (found["n"] == 1).all()
    np.testing.assert_allclose(
        found["z_um"].iloc[-1], -0.2 * (found["frame"].iloc[-1] - found["frame"].iloc[0]), atol=0.6
    )


def test_positions_may_be_in_px(tracks) -> None:
    px = tracks.rename(columns={"x_um": "x_px", "y_um": "y_px"})
    assert {"x_px", "x_se_px", "z_se_um"} <= set(drift_of(px, [10, 11, 12]))


@pytest.mark.parametrize("particles", [[], [99], [10, 99], "all"])
def test_particles_refused(tracks, particles) -> None:
    with pytest.raises(ValueError, match=r"^particles: "):
        drift_of(tracks, particles)


def test_frames_that_nothing_connects_are_refused(tracks) -> None:
    apart = tracks[
        (tracks["particle"] == 10) & (tracks["frame"] < 20) | (tracks["particle"] == 11) & (tracks["frame"] > 19)
    ]
    with pytest.raises(ValueError, match=r"^particles: got none that are in frame"):
        drift_of(apart, [10, 11])


@pytest.mark.parametrize(
    ("table", "drift", "name"),
    [
        (pd.DataFrame({"frame": [0]}), None, "table"),
        (None, pd.DataFrame({"frame": [0]}), "drift"),
        (None, pd.DataFrame({"frame": [1, 0], "x_um": 0.0, "y_um": 0.0, "z_um": 0.0}), "drift"),
    ],
)
def test_refuses(tracks, table, drift, name) -> None:
    table = tracks if table is None else table
    drift = drift_of(tracks, [10, 11]) if drift is None else drift
    with pytest.raises(ValueError, match=f"^{name}: "):
        without_drift(table, drift)
