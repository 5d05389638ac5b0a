"""The strength of the sound, from true paths with errors that are like those of measured films."""

import numpy as np
import pandas as pd
import pytest

from gdptlab.experiment.channel import IN_CHANNEL, Acoustics, Channel, Focusing, Suspension, Trajectories
from gdptlab.experiment.film import Film
from gdptlab.tracking.acoustic_energy import fit_energy, imitate

FPS = 12.5
E_AC = 0.9
SEEDS = 40


def sound(energy=E_AC, two=False) -> Focusing:
    """Sound in a channel that is not the default's."""
    acoustics = Acoustics(energy_density_J_m3=energy, two_half_waves=two)
    return Focusing(channel=Channel(width_um=190, height_um=96), acoustics=acoustics, suspension=Suspension())


def paths(rng, focusing=None, mean_in_view=50.0, duration_s=10.0) -> pd.DataFrame:
    """Error-free tracks, with standard deviations."""
    rng = np.random.default_rng(rng)
    focusing = sound() if focusing is None else focusing
    drawn = Trajectories.seeded(focusing, rng, mean_in_view=mean_in_view, duration_s=duration_s)
    table = drawn.table(np.arange(0, duration_s, 1 / FPS)).drop(columns="t_s")
    return table.assign(y_std_um=0.01, z_std_um=0.12)


def measured(rng) -> pd.DataFrame:
    """Tracks with all that goes wrong in films: see the comments."""
    rng = np.random.default_rng(rng)
    table = paths(rng)
    n, particles = len(table), table["particle"].nunique()
    own = pd.factorize(table["particle"])[0]
    crowd = 1 + (table["frame"] / FPS / 8) ** 2  # closes in, and the errors grow with it
    for axis, std in (("y", 0.009), ("z", 0.12)):
        stated = std * crowd * rng.lognormal(0, 0.3, n)
        error = stated * rng.standard_t(3, n)  # heavier tails than stated,
        error += std * rng.normal(0, 1, particles)[own] * np.cos(table["frame"] / 30 + own)  # and slow parts
        table[IN_CHANNEL[axis]] += error
        table[f"{axis}_std_um"] = stated
    table["z_um"] += 0.3 * np.sin(table["z_um"] / 12 + rng.uniform(0, 6))  # the calibration's, the same for all
    hops = rng.random(particles) < 0.05  # to another particle's path, at some time
    when = rng.integers(0, 125, particles)
    other = np.roll(np.arange(particles), 1)
    numbers = table["particle"].unique()
    table["particle"] = np.where(
        hops[own] & (table["frame"] > when[own]), numbers[other[own]], table["particle"]
    ) + 1000 * (table["frame"] > rng.integers(0, 250, particles)[own])  # broken, half of them
    burst = rng.random(n) < 0.02  # far off, with small standard deviations
    table.loc[burst, "z_um"] += rng.normal(0, 8, burst.sum())
    table.loc[burst, "y_channel_um"] += rng.normal(0, 1, burst.sum())
    return table[rng.random(n) > 0.04]  # missed


@pytest.mark.parametrize("two", [False, True])
@pytest.mark.parametrize("guess", [0.25, 4.0])
def test_without_errors_all_comes_back_from_any_first_guess(two, guess):
    true = sound(two=two)
    fitted = fit_energy(paths(1, true, mean_in_view=8), sound(guess * E_AC, two), FPS)["value"]
    u_y, u_z = true.amplitude_um_s("y"), true.amplitude_um_s("z")
    np.testing.assert_allclose(fitted, [u_y, u_z, E_AC, E_AC, E_AC, u_z / u_y], rtol=1e-5)
    assert fitted.index.tolist() == ["U_y_um_s", "U_z_um_s", "E_y_J_m3", "E_z_J_m3", "E_J_m3", "U_z/U_y"]


def test_the_split_tells_which_waves_there_are():
    fitted = fit_energy(paths(2, sound(two=True), mean_in_view=8), sound(two=False), FPS)["value"]
    assert fitted["U_z/U_y"] == pytest.approx(190 / 96, rel=1e-5)
    assert fitted["E_z_J_m3"] / fitted["E_y_J_m3"] == pytest.approx(190 / 96, rel=1e-5)


def test_intervals_cover_the_truth_and_are_no_wider_than_they_must():
    true = sound()
    rows = [fit_energy(measured(seed), true, FPS).stack() for seed in range(SEEDS)]
    many = pd.DataFrame(rows)
    for name, least in (("E_J_m3", 0.9), ("E_y_J_m3", 0.9), ("E_z_J_m3", 0.85)):
        one = many[name]
        covered = ((one["low"] <= E_AC) & (E_AC <= one["high"])).mean()
        assert covered >= least, (name, covered)
        assert (one["value"] / E_AC - 1).abs().max() < 0.03
        assert 0.5 < one["value"].std() / one["std"].mean() < 1.5, name
    ratio = many["U_z/U_y"]
    assert ((ratio["low"] <= 1) & (ratio["high"] >= 1)).mean() >= 0.85


def test_lower_confidence_is_narrower_about_the_same_value():
    table = measured(7)
    half, most = (fit_energy(table, sound(), FPS, confidence=c) for c in (0.5, 0.99))
    pd.testing.assert_series_equal(half["value"], most["value"])
    assert ((most["low"] < half["low"]) & (half["low"] < half["value"])).all()
    assert ((half["value"] < half["high"]) & (half["high"] < most["high"])).all()


def test_rows_that_share_their_errors_count_once():
    rng = np.random.default_rng(9)
    table = paths(rng, mean_in_view=30)
    lasting = table[table["frame"] % 5 == 0]
    error = pd.DataFrame(
        {"frame": lasting["frame"], "particle": lasting["particle"], "dy": rng.normal(0, 0.02, len(lasting))}
    )
    table["fifth"] = table["frame"] // 5 * 5
    table = table.merge(error.rename(columns={"frame": "fifth"}), on=["fifth", "particle"])
    table["y_channel_um"] += table["dy"]
    all_rows, some = (fit_energy(t, sound(), FPS) for t in (table, table[table["frame"] % 5 == 2]))
    assert all_rows.loc["E_y_J_m3", "std"] > 0.75 * some.loc["E_y_J_m3", "std"]


def test_outliers_hardly_matter():
    rng = np.random.default_rng(11)
    table = paths(rng, mean_in_view=20)
    table["y_channel_um"] += rng.normal(0, table["y_std_um"])
    clean = fit_energy(table, sound(), FPS)
    hit = rng.random(len(table)) < 0.05
    table.loc[hit, "y_channel_um"] = rng.uniform(-90, 90, hit.sum())
    spoilt = fit_energy(table, sound(), FPS)
    assert abs(spoilt.loc["E_y_J_m3", "value"] / clean.loc["E_y_J_m3", "value"] - 1) < 1e-3


def test_contrast_and_radius_change_the_energy_and_not_the_velocity():
    table = measured(12)
    plain = fit_energy(table, sound(), FPS)["value"]
    soft = Focusing(channel=sound().channel, suspension=Suspension(compressibility_per_TPa=330))
    other = fit_energy(table, soft, FPS)["value"]
    np.testing.assert_allclose(other[["U_y_um_s", "U_z_um_s"]], plain[["U_y_um_s", "U_z_um_s"]], rtol=1e-4)
    ratio = Suspension().contrast_factor / soft.suspension.contrast_factor
    assert other["E_J_m3"] / plain["E_J_m3"] == pytest.approx(ratio, rel=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_sound_may_be_weak_but_not_absent(seed):
    rng = np.random.default_rng(seed)
    weak, none = (paths(rng, sound(energy), mean_in_view=15) for energy in (0.01, 1e-9))
    for table in (weak, none):
        for axis, std in (("y", 0.01), ("z", 0.12)):
            table[IN_CHANNEL[axis]] += rng.normal(0, std, len(table))
    assert fit_energy(weak, sound(), FPS).loc["E_J_m3", "value"] == pytest.approx(0.01, rel=0.01)
    with pytest.raises(ValueError, match=r"^tracks: "):
        fit_energy(none, sound(), FPS)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"focusing": None}, TypeError, "focusing"),
        ({"frame_rate_hz": -1.0}, ValueError, "frame_rate_hz"),
        ({"confidence": 1.0}, ValueError, "confidence"),
        ({"tracks": paths(1).drop(columns="z_std_um")}, ValueError, "^tracks: .*z_std_um"),
        ({"tracks": paths(1).assign(y_std_um=0.0)}, ValueError, "^tracks: "),
        ({"tracks": paths(1).assign(z_um=np.nan)}, ValueError, "^tracks: "),
        ({"tracks": paths(1).query("particle == particle.min()")}, ValueError, "^tracks: "),
        ({"tracks": paths(1).groupby("particle").head(1)}, ValueError, "^tracks: "),
    ],
)
def test_bad_arguments_of_fit_energy(change, error, match):
    with pytest.raises(error, match=match):
        fit_energy(**{"tracks": paths(1), "focusing": sound(), "frame_rate_hz": FPS} | change)


# -------------------- films imitated


SHORT = {"mean_in_view": 12, "duration_s": 1.0, "shape": (320, 200)}


def exact(film: Film) -> pd.DataFrame:
    """Tracks of a film without errors."""
    return film.to_channel(film.truth()).assign(x_std_um=0.02, y_std_um=0.03, z_std_um=0.2)


def test_an_imitated_film_has_its_own_paths_and_the_errors_of_the_other():
    film, others = Film.seeded(3, **SHORT), [Film.seeded(k, **SHORT) for k in (4, 5)]
    tracks = exact(film)
    tracks["y_channel_um"] += 0.4
    tracks["z_um"] -= 1.5
    missed = tracks["frame"] == 9
    for other, made in zip(others, imitate(tracks[~missed].reset_index(drop=True), film, others, rng=1), strict=True):
        true = other.to_channel(other.truth())
        assert 9 not in set(made["frame"]) and len(made) > 0.6 * len(true)
        made, true = (table.assign(x=table["x_channel_um"].round(6)) for table in (made, true))
        pairs = made.merge(true, on=["frame", "x"])
        assert len(pairs) == len(made)
        np.testing.assert_allclose(pairs["y_channel_um_x"] - pairs["y_channel_um_y"], 0.4)
        np.testing.assert_allclose(pairs["z_um_x"] - pairs["z_um_y"], -1.5)
        assert (pairs.groupby("particle_x")["particle_y"].nunique() == 1).all()
        assert (made["z_std_um"] == 0.2).all()


def test_tracks_of_nobody_stay_and_the_seed_decides():
    film, other = Film.seeded(3, **SHORT), Film.seeded(4, **SHORT)
    ghost = exact(film).iloc[:1].assign(particle=10**6, x_px=-50.0, x_channel_um=-33.0)
    tracks = pd.concat([exact(film), ghost], ignore_index=True)
    (made,), (again,), (else_,) = (list(imitate(tracks, film, [other], rng=seed)) for seed in (1, 1, 2))
    pd.testing.assert_frame_equal(made, again)
    assert not made.equals(else_)
    assert (made["x_channel_um"] == -33.0).sum() == 1
    with pytest.raises(ValueError, match="x_px"):
        next(imitate(tracks.drop(columns="x_px"), film, [other], rng=1))
