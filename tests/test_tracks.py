"""Tracks against paths that are known; links, velocities and scores against those made by hand."""

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, batch
from gdptlab.experiment.channel import IN_CHANNEL, Channel, Focusing, Trajectories
from gdptlab.experiment.film import Film
from gdptlab.tracking import tracks
from gdptlab.tracking.tracks import identify, link, link_scores, velocities

FPS = 20.0
CHANNEL = Channel(width_um=180, height_um=90, flow_rate_ul_h=40)  # 1.4 mm/s on the axis: 68 µm in a frame
STILL = Channel(width_um=180, height_um=90, flow_rate_ul_h=1e-6)


def carried(x, y, z, frames=12) -> pd.DataFrame:
    """Particles that the flow carries, from where they are at frame 0; `true` is their number."""
    start = pd.DataFrame(dict(zip(IN_CHANNEL.values(), (x, y, z), strict=True)), dtype=float)
    start = start.rename_axis("true").reset_index()
    speed = CHANNEL.velocity(start.y_channel_um, start.z_um)
    parts = [start.assign(frame=k, x_channel_um=start.x_channel_um + speed * k / FPS) for k in range(frames)]
    return pd.concat(parts, ignore_index=True)


def partition(tracks: pd.DataFrame) -> set:
    """Tracks as sets of (frame, true particle)."""
    return {frozenset(zip(t.frame, t.true, strict=True)) for _, t in tracks.groupby("particle")}


def noisy_paths(seed=3, mean_in_view=100, duration_s=2.0, missed=0.03) -> tuple[pd.DataFrame, pd.DataFrame, Focusing]:
    """Paths of the paper's experiment in µm, some frames missed, and with errors whose size is known."""
    rng = np.random.default_rng(seed)
    paths = Trajectories.seeded(Focusing(), rng, mean_in_view=mean_in_view, duration_s=duration_s)
    true = paths.table(np.arange(0, duration_s, 1 / 25))
    table = true[rng.random(len(true)) > missed].reset_index(drop=True)
    for axis, std in zip("xyz", (0.02, 0.03, 0.2), strict=True):
        table[f"{axis}_std_um"] = std * rng.uniform(0.5, 2, len(table))
        table[IN_CHANNEL[axis]] += rng.normal(0, table[f"{axis}_std_um"])
    return table.rename(columns={"particle": "true"}), true, paths.focusing


# -------------------- linking


def test_the_flow_says_where_to_look():
    # Seen at rest, each would be where another was: they follow each other at 10 µm and move by 40 to 70 µm.
    table = carried([0, 10, 20, 5, 15], [3, 3, 3, 60, -60], [-4, -4, -4, 20, 10])
    shuffled = table.sample(frac=1, random_state=1)
    tracks = link(shuffled, predictor=CHANNEL, frame_rate_hz=FPS)
    assert partition(tracks) == {frozenset((k, n) for k in range(12)) for n in range(5)}
    assert tracks.columns.tolist() == [*table.columns, "particle"]
    assert tracks.index.equals(pd.RangeIndex(60)) and tracks.frame.is_monotonic_increasing
    assert tracks.particle[:5].tolist() == [0, 1, 2, 3, 4]
    at_rest = link(table, predictor=STILL, frame_rate_hz=FPS, min_rows=1)
    assert at_rest.particle.nunique() > 30
    with pytest.raises(ValueError, match="table"):
        link(table.drop(columns="frame"), predictor=CHANNEL, frame_rate_hz=FPS)


@pytest.mark.parametrize(("missed", "n"), [((4, 5, 6), 1), ((4, 5, 6, 7), 2)])
def test_gaps_are_bridged_up_to_memory(missed, n):
    table = carried([0], [10], [-20])
    tracks = link(table[~table.frame.isin(missed)], predictor=CHANNEL, frame_rate_hz=FPS, memory=3, min_rows=1)
    assert tracks.particle.nunique() == n
    assert tracks.frame.tolist() == [k for k in range(12) if k not in missed]


@pytest.mark.parametrize("axis", "xyz")
def test_search_range_is_of_each_axis(axis):
    table = pd.DataFrame({"frame": range(12), "x_channel_um": 3.0, "y_channel_um": 10.0, "z_um": -20.0})
    table.loc[table.frame >= 6, IN_CHANNEL[axis]] += 2.0
    limits = {2.2: 1, 1.8: 2}
    for limit, n in limits.items():
        for others in (0.5, 2.5, 9.0):
            search_range = tuple(limit if a == axis else others for a in "xyz")
            assert (
                link(
                    table, predictor=STILL, frame_rate_hz=FPS, search_range=search_range, min_rows=1
                ).particle.nunique()
                == n
            )


def test_short_tracks_are_left_out_and_numbers_have_no_holes():
    table = pd.concat([carried([0], [50], [0], frames=4), carried([0], [-50], [5])]).assign(particle=99, cm=0.9)
    tracks = link(table, predictor=CHANNEL, frame_rate_hz=FPS, min_rows=5)
    assert len(tracks) == 12 and (tracks.particle == 0).all() and (tracks.y_channel_um == -50).all()
    assert link(table, predictor=CHANNEL, frame_rate_hz=FPS, min_rows=4).particle.unique().tolist() == [0, 1]
    assert (tracks.cm == 0.9).all()  # what else is known of a particle stays


def test_tracks_in_a_crowd_are_the_true_ones_whatever_the_order():
    table, true, focusing = noisy_paths()
    tracks = link(table, predictor=focusing.channel, frame_rate_hz=25)
    purity = tracks.groupby("particle").true.agg(lambda t: t.value_counts(normalize=True).iloc[0])
    assert purity.mean() > 0.995 and tracks.particle.nunique() < 1.1 * true.particle.nunique()
    assert len(tracks) > 0.97 * len(table)
    assert partition(
        link(table.sample(frac=1, random_state=5), predictor=focusing.channel, frame_rate_hz=25)
    ) == partition(tracks)


def test_nothing_is_said_and_the_table_stays_as_it_was(capfd, caplog):
    table = carried([0], [10], [-20])
    before = table.copy()
    assert len(link(table, predictor=CHANNEL, frame_rate_hz=FPS)) == 12
    assert capfd.readouterr() == ("", "") and not caplog.records
    pd.testing.assert_frame_equal(table, before)


def test_outside_the_channel_the_flow_is_that_of_the_wall():
    table = pd.DataFrame({"frame": range(12), "x_channel_um": 5.0, "y_channel_um": 91.0, "z_um": -46.0})
    assert link(table, predictor=CHANNEL, frame_rate_hz=FPS).particle.tolist() == [0] * 12


def test_no_particles_give_no_tracks():
    nothing = link(carried([0], [10], [-20]).iloc[:0], predictor=CHANNEL, frame_rate_hz=FPS)
    assert len(nothing) == 0 and nothing.particle.dtype == np.int64
    assert len(link(carried([0], [10], [-20]), predictor=CHANNEL, frame_rate_hz=FPS, min_rows=13)) == 0


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"predictor": 3}, TypeError, "predictor"),
        ({"frame_rate_hz": 0.0}, ValueError, "frame_rate_hz"),
        ({"search_range": (1.0, 2.0)}, ValueError, "search_range"),
        ({"search_range": (1.0, 2.0, -1.0)}, ValueError, "search_range"),
        ({"memory": -1}, ValueError, "memory"),
        ({"min_rows": 0}, ValueError, "min_rows"),
        ({"table": [1, 2]}, TypeError, "table"),
        ({"table": carried([np.nan], [1], [1])}, ValueError, "table"),
        ({"table": carried([0], [1], [1]).assign(frame=0.5)}, TypeError, "table"),
    ],
)
def test_bad_arguments_of_link(change, error, match):
    arguments = {"table": carried([0], [1], [1]), "predictor": CHANNEL, "frame_rate_hz": FPS} | change
    with pytest.raises(error, match=match):
        link(**arguments)


def vortex(centre_um, turns_per_s, frames, rate_hz, seed=2, n=25, noise_um=0.05, power=1) -> pd.DataFrame:
    """Particles on circles about a vertical axis, up to 60 µm from it, that rise; `true` is their number."""
    rng = np.random.default_rng(seed)
    radius, phase, z = 60 * np.sqrt(rng.uniform(0.02, 1, n)), rng.uniform(0, 2 * np.pi, n), rng.uniform(-30, 30, n)
    parts = []
    for k in range(frames):
        angle = phase + 2 * np.pi * turns_per_s * (k / rate_hz) ** power
        x, y = centre_um[0] + radius * np.cos(angle), centre_um[1] + radius * np.sin(angle)
        parts.append(pd.DataFrame({"frame": k, "true": range(n), "x_um": x, "y_um": y, "z_um": z + 4.0 * k / rate_hz}))
    table = pd.concat(parts, ignore_index=True)
    return table.assign(**{a: table[a] + rng.normal(0, noise_um, len(table)) for a in ("x_um", "y_um", "z_um")})


def test_nearest_velocity_follows_a_vortex_that_rest_does_not():
    """It turns ever faster: in the end the outermost move by 12 µm in a frame, three times the search range."""
    table = vortex((150, 120), 0.33, 20, 20.0, power=2)
    tracks = link(table, search_range=(4.0, 4.0, 3.0), predictor="nearest velocity", min_rows=1)
    assert partition(tracks) == {frozenset((k, n) for k in range(20)) for n in range(25)}
    at_rest = link(table, search_range=(4.0, 4.0, 3.0), min_rows=1)
    assert at_rest["particle"].nunique() > 50


def test_nearest_velocity_begins_again_after_frames_without_particles():
    table = vortex((150, 120), 0.5, 20, 20.0)
    gap = table[~table["frame"].between(5, 9)]
    tracks = link(gap, search_range=(10.0, 10.0, 3.0), predictor="nearest velocity", memory=2, min_rows=1)
    assert len(tracks) == len(gap) and tracks["frame"].between(5, 9).sum() == 0
    assert not set(tracks[tracks["frame"] < 5]["particle"]) & set(tracks[tracks["frame"] > 9]["particle"])


def test_positions_in_px_are_linked_as_they_are():
    table = vortex((150, 120), 0.05, 20, 20.0)
    in_px = table.rename(columns={"x_um": "x_px", "y_um": "y_px"})
    assert partition(link(in_px)) == partition(link(table))
    found = velocities(link(in_px), 20.0)
    expected = velocities(link(table), 20.0)
    np.testing.assert_array_equal(found["vx_px_s"], expected["vx_um_s"])
    np.testing.assert_array_equal(found["vz_um_s"], expected["vz_um_s"])
    with pytest.raises(ValueError, match=r"^table: "):
        link(in_px, predictor=CHANNEL, frame_rate_hz=FPS)


def test_a_table_that_is_not_of_the_channel_is_refused():
    """Its origin is the first pixel, not the middle of the channel."""
    table = carried([0, 5, 9, 30], [-60, -20, 20, 70], [0, 10, 20, -20])
    tracks = link(table, predictor=CHANNEL, frame_rate_hz=FPS)
    assert len(tracks) == len(table)
    in_um = table.rename(columns={"x_channel_um": "x_um", "y_channel_um": "y_um"})
    with pytest.raises(ValueError, match=r"^table: .*y_channel_um"):
        link(in_um, predictor=CHANNEL, frame_rate_hz=FPS)
    # Who has both is understood: where particles are expected is in the channel, whatever x_um and y_um are.
    both = table.assign(x_um=0.0, y_um=np.arange(len(table)))
    assert partition(link(both, predictor=CHANNEL, frame_rate_hz=FPS)) == partition(tracks)
    with pytest.raises(TypeError, match=r"^frame_rate_hz: "):
        link(table, predictor=CHANNEL)


def test_columns_of_the_channel_are_named_alike_in_both_rooms():
    assert list(IN_CHANNEL.values()) == tracks.IN_CHANNEL
    film = Film.seeded(1, mean_in_view=5, duration_s=0.1, shape=(310, 200))
    assert set(tracks.IN_CHANNEL) <= set(film.to_channel(film.truth()))


# -------------------- velocities


def bent(frames, particle=0) -> pd.DataFrame:
    """A track along parabolas, other ones along each axis, without errors."""
    t = np.array(frames) / FPS
    table = pd.DataFrame({"frame": frames, "particle": particle})
    table["x_um"], table["y_um"], table["z_um"] = 300 + 7 * t, -20 - 4 * t + 3 * t**2, 40 - 9 * t - 2 * t**2
    table["vx_true"], table["vy_true"], table["vz_true"] = 7.0, -4 + 6 * t, -9 - 4 * t
    return table.assign(x_std_um=0.02, y_std_um=0.03, z_std_um=0.2)


def test_velocities_of_parabolas_are_exact_also_at_ends_and_gaps():
    frames = [3, 4, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 19]
    other = bent(range(0, 30), particle=8).assign(y_um=lambda t: -t.y_um, vy_true=lambda t: -t.vy_true)
    table = pd.concat([bent(frames, particle=5), other]).sample(frac=1, random_state=2)
    found = velocities(table, FPS, window=9)
    for axis in "xyz":
        np.testing.assert_allclose(found[f"v{axis}_um_s"], found[f"v{axis}_true"], atol=1e-6)
    assert found.index.equals(table.index)


def test_velocities_are_those_of_a_weighted_fit():
    rng = np.random.default_rng(4)
    table = bent([2, 3, 4, 6, 7, 8, 11, 12])
    table["z_std_um"] = rng.uniform(0.1, 0.4, len(table))
    table["z_um"] += rng.normal(0, 3 * table.z_std_um)
    found = velocities(table, FPS, window=9).iloc[3]
    near = table[(table.frame - 6).abs() <= 4]
    t = (near.frame - 6) / FPS
    fit, covariance = np.polyfit(t, near.z_um, 2, w=1 / near.z_std_um, cov="unscaled")
    chi2 = (((near.z_um - np.polyval(fit, t)) / near.z_std_um) ** 2).sum() / (len(near) - 3)
    assert chi2 > 1.5  # so the errors are to be enlarged
    np.testing.assert_allclose(found[["vz_um_s", "vz_std_um_s"]], [fit[1], np.sqrt(covariance[1, 1] * chi2)])


def test_standard_deviations_of_velocities_are_true():
    table, true, focusing = noisy_paths(missed=0.1)
    found = velocities(table.rename(columns={"true": "particle"}), 25)
    found = found.merge(true, on=["frame", "particle"], suffixes=("", "_true")).dropna()
    expected = {"x": focusing.channel.velocity(found.y_channel_um_true, found.z_um_true)}
    expected |= {axis: focusing.radiation_velocity(axis, found[f"{IN_CHANNEL[axis]}_true"]) for axis in "yz"}
    for axis, value in expected.items():
        over = (found[f"v{axis}_um_s"] - value) / found[f"v{axis}_std_um_s"]
        assert 0.8 < over.std() < 1.1 and abs(over.mean()) < 0.1  # a little below 1: they are never made smaller
    assert len(found) > 0.95 * len(table)


def test_velocities_without_standard_deviations_have_those_of_their_scatter():
    table = vortex((0, 0), 0.1, 60, 20.0, n=60, noise_um=0.3).rename(columns={"true": "particle"})
    found = velocities(table, 20.0, window=9).dropna()
    turn = 2 * np.pi * 0.1
    exact = vortex((0, 0), 0.1, 60, 20.0, n=60, noise_um=0.0).loc[found.index]
    for axis, true in (("x", -turn * exact["y_um"]), ("y", turn * exact["x_um"]), ("z", 4.0)):
        normal = (found[f"v{axis}_um_s"] - true) / found[f"v{axis}_std_um_s"]
        # Student's t with 6 degrees of freedom has a standard deviation of 1.22, and quartiles at 0.72.
        assert normal.abs().median() == pytest.approx(0.72, abs=0.05)
    with_stds = velocities(table.assign(x_std_um=0.3, y_std_um=0.3, z_std_um=0.3), 20.0, window=9).dropna()
    np.testing.assert_allclose(with_stds["vz_um_s"], found["vz_um_s"], atol=1e-9)


def test_time_stamps_may_be_uneven():
    table = bent(range(12))
    t_s = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.09, 12))
    table = table.assign(t_s=t_s, x_um=300 + 7 * t_s, y_um=-20 - 4 * t_s + 3 * t_s**2)
    found = velocities(table)
    np.testing.assert_allclose(found["vx_um_s"], 7.0, atol=1e-9)
    np.testing.assert_allclose(found["vy_um_s"], -4 + 6 * t_s, atol=1e-9)


def test_too_few_neighbours_give_nan():
    found = velocities(bent([0, 1, 2, 3, 20, 21, 22, 23, 24]), FPS, window=9)
    values = found[["vx_um_s", "vx_std_um_s", "vz_um_s"]].notna()
    assert values.all(axis=1).tolist() == [False] * 4 + [True] * 5
    assert not values.iloc[:4].any(axis=None)
    assert velocities(found.iloc[:0], FPS)["vz_std_um_s"].tolist() == []


@pytest.mark.parametrize(
    ("change", "settings", "match"),
    [
        ({}, {"window": 8}, "window"),
        ({}, {"window": 3}, "window"),
        ({"y_std_um": 0.0}, {}, "tracks"),
        ({"z_um": np.nan}, {}, "tracks"),
        ({"frame": 4}, {}, "tracks"),
    ],
)
def test_bad_arguments_of_velocities(change, settings, match):
    with pytest.raises(ValueError, match=match):
        velocities(bent(range(9)).assign(**change), FPS, **settings)
    with pytest.raises(ValueError, match="z_um"):
        velocities(bent(range(9)).drop(columns="z_um"), FPS)
    with pytest.raises(ValueError, match="frame_rate_hz"):
        velocities(bent(range(9)))


# -------------------- scores


def by_hand() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Two true particles over six frames, 7 and 8, and three tracks that are partly theirs."""
    frames = np.arange(6)
    true = pd.concat(
        [
            pd.DataFrame({"frame": frames, "particle": 7, "x_px": 50.0 + frames, "y_px": 20.0, "z_um": -30.0}),
            pd.DataFrame({"frame": frames, "particle": 8, "x_px": 90.0 + frames, "y_px": 60.0, "z_um": 25.0}),
        ],
        ignore_index=True,
    )
    seven, eight = (true[true.particle == n].set_index("frame") for n in (7, 8))
    parts = [
        seven.loc[[0, 1, 3, 4]].assign(particle=0),  # right, a gap, right
        eight.loc[[0, 1]].assign(particle=1),
        seven.loc[[2]].assign(particle=1),  # hops to the other one,
        eight.loc[[3]].assign(particle=1, z_um=40.0),  # and then is 15 µm off: nobody
        eight.loc[[4, 5]].assign(particle=2),
    ]
    return pd.concat(parts).reset_index(), true


def test_scores_counted_by_hand():
    tracks, true = by_hand()
    who = identify(tracks, true)
    assert who.tolist() == [7] * 4 + [8, 8, 7, -1, 8, 8]
    found = link_scores(tracks.sample(frac=1, random_state=3), true)
    expected = {
        "n_tracks": 3, "n_links": 7, "right": 5 / 7, "wrong": 1 / 7, "nobody": 1 / 7, "found": 5 / 10,
        "n_gaps": 1, "gaps_right": 1.0, "n_particles": 2, "broken": 1.0, "pieces": 2.0,
    }  # fmt: skip
    assert found.to_dict() == pytest.approx(expected)
    assert link_scores(tracks, true, within_um=20)["wrong"] == pytest.approx(2 / 7)


def test_scores_of_nothing_and_without_a_column():
    tracks, true = by_hand()
    nothing = link_scores(tracks.iloc[:0], true)
    assert nothing["n_links"] == 0 and nothing["found"] == 0 and np.isnan(nothing["right"])
    with pytest.raises(ValueError, match="particle"):
        link_scores(tracks.drop(columns="particle"), true)
    with pytest.raises(ValueError, match="x_px"):
        identify(tracks, true.drop(columns="x_px"))


def test_links_of_a_film_that_was_rendered_and_measured():
    film = Film.seeded(6, mean_in_view=25, duration_s=1.2, shape=(320, 260))
    calibration = Calibration.from_stack(*film.stack(size=63), n_sub=9)
    measured = film.to_channel(batch(film, calibration, method="joint", progress=False))
    tracks = link(measured, predictor=film.trajectories.focusing.channel, frame_rate_hz=film.frame_rate_hz)
    found = link_scores(tracks, film.truth())
    assert found["right"] >= 0.98 and found["found"] > 0.95 and found["pieces"] < 1.1
