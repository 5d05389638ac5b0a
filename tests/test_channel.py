"""The channel against closed forms, an independent integrator, and what must be conserved."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from gdptlab.experiment.channel import IN_CHANNEL, Acoustics, Channel, Focusing, Suspension, Trajectories

PAPER = Focusing()
RESONANT = Focusing(acoustics=Acoustics(two_half_waves=True))
ODD = Focusing(  # upright, fast, strongly driven
    channel=Channel(width_um=170, height_um=230, flow_rate_ul_h=1.3),
    acoustics=Acoustics(energy_density_J_m3=7, two_half_waves=True),
    suspension=Suspension(radius_um=3.5),
)


def duct_by_double_series(channel, y, z, terms=400):
    """Poiseuille flow by the plain double cosine series: the slow, obvious reference."""
    m = (2 * np.arange(terms) + 1) * np.pi
    sign = (-1.0) ** np.arange(terms)
    laplacian = (m[:, None] / channel.width_um) ** 2 + (m / channel.height_um) ** 2
    weight = sign[:, None] * sign / (m[:, None] * m * laplacian)
    value = np.einsum(
        "mp,mn,np->p",
        np.cos(m[:, None] * y / channel.width_um),
        weight,
        np.cos(m[:, None] * z / channel.height_um),
    )
    mean = np.sum(4 * sign[:, None] * sign * weight / (m[:, None] * m))
    return channel.mean_speed_um_s * value / mean


# -------------------- Poiseuille flow


@pytest.mark.parametrize("channel", [Channel(), ODD.channel, Channel(width_um=1500, height_um=40)])
def test_flow_carries_q(channel):
    node, weight = np.polynomial.legendre.leggauss(60)
    w, h = channel.width_um, channel.height_um
    flow = weight @ channel.velocity(node[:, None] * w / 2, node * h / 2) @ weight * w * h / 4  # um^3/s
    assert flow * 3600 / 1e9 == pytest.approx(channel.flow_rate_ul_h, rel=1e-4)


def test_flow_speeds_of_the_paper():
    assert PAPER.channel.mean_speed_um_s == pytest.approx(5.56, abs=0.005)
    assert PAPER.channel.max_speed_um_s == pytest.approx(11.07, abs=0.005)


@pytest.mark.parametrize(("width", "height"), [(3000, 30), (30, 3000)])
def test_flow_between_far_walls_is_a_parabola(width, height):
    channel = Channel(width_um=width, height_um=height)
    assert channel.max_speed_um_s == pytest.approx(1.5 * channel.mean_speed_um_s / (1 - 0.6302 / 100), rel=1e-5)


@pytest.mark.parametrize("channel", [Channel(), ODD.channel, Channel(width_um=30, height_um=3000)])
def test_flow_stops_at_the_walls_and_is_symmetric(channel):
    w, h = channel.width_um, channel.height_um
    along = np.linspace(-0.5, 0.5, 101)
    for wall in (-0.5, 0.5):
        assert np.abs(channel.velocity(wall * w, along * h)).max() < 1e-5 * channel.max_speed_um_s
        assert np.abs(channel.velocity(along * w, wall * h)).max() < 1e-5 * channel.max_speed_um_s
    inside = channel.velocity(along[1:-1, None] * w, along[1:-1] * h)
    assert inside.shape == (99, 99) and inside.min() > 0 and inside.max() == channel.max_speed_um_s
    np.testing.assert_allclose(inside, inside[::-1], rtol=1e-12)
    np.testing.assert_allclose(inside, inside[:, ::-1], rtol=1e-12)


@pytest.mark.parametrize("channel", [Channel(), ODD.channel])
def test_flow_matches_the_double_series(channel):
    y, z = np.random.default_rng(3).uniform(-0.48, 0.48, (2, 30)) * [[channel.width_um], [channel.height_um]]
    np.testing.assert_allclose(channel.velocity(y, z), duct_by_double_series(channel, y, z), rtol=1e-5)


# -------------------- sound and the path across


def test_amplitude_of_the_paper():
    assert PAPER.suspension.contrast_factor == pytest.approx(0.165, abs=5e-4)
    assert PAPER.amplitude_um_s("y") == pytest.approx(14.6, abs=0.05)
    assert PAPER.amplitude_um_s("z") == PAPER.amplitude_um_s("y") == RESONANT.amplitude_um_s("y")
    assert RESONANT.amplitude_um_s("z") == pytest.approx(2 * RESONANT.amplitude_um_s("y"))


def test_amplitude_is_u0_a2_over_a02_of_the_equations():
    s, e, k = PAPER.suspension, PAPER.acoustics.energy_density_J_m3, np.pi / 200e-6
    u0 = 4 * e / (s.fluid_density_kg_m3 * s.sound_speed_m_s)
    nu, omega = s.viscosity_mPa_s * 1e-3 / s.fluid_density_kg_m3, k * s.sound_speed_m_s
    a0 = np.sqrt(6 * nu / (s.contrast_factor * omega))
    assert PAPER.amplitude_um_s("y") == pytest.approx(u0 * (2.5e-6 / a0) ** 2 * 1e6, rel=1e-12)


@pytest.mark.parametrize("axis", ["y", "z"])
def test_radiation_velocity_points_to_the_centre(axis):
    quarter = PAPER.extent_um(axis) / 4
    u = PAPER.radiation_velocity(axis, [-quarter, 0, quarter])
    np.testing.assert_allclose(u, PAPER.amplitude_um_s(axis) * np.array([1, 0, -1]), atol=1e-12)


@pytest.mark.parametrize("focusing", [PAPER, RESONANT, ODD])
def test_trajectories_match_an_integrator(focusing):
    """x, y and z to 1e-6 of the channel; 12 particles on all sides, two of them as near a wall as can be."""
    free = [focusing.extent_um(axis) / 2 - focusing.suspension.radius_um for axis in "yz"]
    y0, z0 = np.random.default_rng(5).uniform(-1, 1, (2, 12)) * np.array(free)[:, None]
    y0[:2], z0[:2] = [free[0], -free[0]], [-free[1], 0.3 * free[1]]
    x0, name = np.linspace(-50, 80, 12), np.arange(100, 112)
    start = pd.DataFrame({"particle": name, "x_channel_um": x0, "y_channel_um": y0, "z_um": z0})
    times = np.array([0, 0.04, 0.5, 1.7, 4.2, 11.1, 20])

    def velocity(_, state):
        _, y, z = state.reshape(3, 12)
        across = [focusing.radiation_velocity(axis, p) for axis, p in [("y", y), ("z", z)]]
        return np.concatenate([focusing.channel.velocity(y, z), *across])

    accuracy = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11}
    solution = solve_ivp(velocity, (0, 20), np.concatenate([x0, y0, z0]), t_eval=times, **accuracy)
    truth = solution.y.reshape(3, 12, len(times))
    table = Trajectories(focusing=focusing, start=start).table(times, border_um=np.inf)
    assert list(table.columns) == ["frame", "particle", "t_s", "x_channel_um", "y_channel_um", "z_um"]
    assert (table["particle"].to_numpy() == np.tile(start["particle"], len(times))).all()
    w, h = focusing.channel.width_um, focusing.channel.height_um
    for column, expected, extent in zip(IN_CHANNEL.values(), truth, [min(w, h), w, h], strict=True):
        got = table[column].to_numpy().reshape(len(times), 12).T
        assert np.abs(got - expected).max() < 1e-6 * extent, column


def test_instantly_focused_particles_ride_on_the_centre_line():
    loud = Acoustics(energy_density_J_m3=5000, two_half_waves=True)
    film = Trajectories.seeded(Focusing(acoustics=loud), 3)
    x = [film.positions(t, border_um=np.inf)["x_channel_um"] for t in (0.5, 10.1, 19.9)]
    np.testing.assert_allclose(x[1] - x[0], 9.6 * PAPER.channel.max_speed_um_s, rtol=1e-6)
    np.testing.assert_allclose(x[2] - x[1], 9.8 * PAPER.channel.max_speed_um_s, rtol=1e-6)


# -------------------- trigger times


@pytest.mark.parametrize(
    ("focusing", "axis", "gap", "expected"),
    [
        (PAPER, "y", 0, 5.2),
        (PAPER, "z", 0, 2.6),
        (RESONANT, "z", 0, 1.3),
        (PAPER, "y", None, 4.8),
        (PAPER, "z", None, 2.2),
    ],
)
def test_trigger_times_of_the_infinite_population(focusing, axis, gap, expected):
    assert focusing.trigger_time(axis, wall_gap_um=gap) == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("axis", ["y", "z"])
def test_trigger_time_of_many_is_that_of_infinitely_many(axis):
    """20 000 particles followed in time trigger when the closed form says for the same start, to 2 %."""
    half = ODD.extent_um(axis) / 2 - ODD.suspension.radius_um
    start = np.random.default_rng(11).uniform(-half, half, 20_000)
    exact = ODD.trigger_time(axis, start_um=start)
    assert exact == pytest.approx(ODD.trigger_time(axis), rel=0.03)  # four standard errors

    times = np.arange(0, 2 * exact, exact / 200)
    focused = np.array([np.mean(np.abs(ODD.path(axis, start, t)) <= ODD.extent_um(axis) / 6) for t in times])
    assert times[np.argmax(focused >= 0.9)] == pytest.approx(exact, rel=0.02)


def test_film_of_20000_particles_triggers_at_the_closed_form():
    """A perfect camera, with particles entering and leaving its view: to 2 %, five standard errors."""
    film = Trajectories.seeded(PAPER, 4, mean_in_view=16_500, duration_s=5)
    assert len(film.start) > 20_000
    for axis in "yz":
        exact = film.trigger_time(axis)
        times = exact * np.array([0.98, 1.02])
        seen = film.table(times)
        focused = (seen[IN_CHANNEL[axis]].abs() <= PAPER.extent_um(axis) / 6).groupby(seen["frame"]).mean()
        assert focused[0] < 0.9 <= focused[1]


def test_trigger_time_is_the_arrival_of_the_last_particle_needed():
    start = np.array([-90.0, 10, 50, -60, 70, -20, 30, -40, 80, 0])
    for fraction, last in [(1e-12, 0), (0.1, 0), (0.7, 60), (0.71, 70), (0.9, 80), (1.0, 90)]:
        t = PAPER.trigger_time("y", fraction, start_um=start)
        assert t == PAPER.arrival_time("y", last)
        inside = np.abs(PAPER.path("y", start, t * (1 + 1e-9))) <= 200 / 6
        assert inside.mean() >= fraction
    assert PAPER.arrival_time("y", [0, -33, 33, 100, -100]).tolist() == [0, 0, 0, np.inf, np.inf]
    assert PAPER.path("z", -49, PAPER.arrival_time("z", -49)) == pytest.approx(-100 / 6)
    assert PAPER.trigger_time("z", 1, wall_gap_um=0) == np.inf


# -------------------- population


def test_same_seed_same_table_bit_for_bit():
    one, two = (Trajectories.seeded(PAPER, rng) for rng in (8, np.random.default_rng(8)))
    times = np.arange(0, 20, 0.04)
    pd.testing.assert_frame_equal(one.table(times), two.table(times), check_exact=True)
    assert not one.start.equals(Trajectories.seeded(PAPER, 9).start)


@pytest.mark.parametrize("duration_s", [0.3, 8.0, 10.0, 19.9])
def test_a_longer_film_begins_with_the_particles_of_a_shorter_one(duration_s):
    short, long = (Trajectories.seeded(PAPER, 8, duration_s=t) for t in (duration_s, 20.0))
    for t in (0.0, duration_s):
        one, other = (film.positions(t, border_um=30.0) for film in (short, long))
        assert one["particle"].tolist() == other["particle"].tolist()
        np.testing.assert_allclose(one["x_channel_um"], other["x_channel_um"], rtol=0, atol=1e-5)
        pd.testing.assert_frame_equal(one[["y_channel_um", "z_um"]], other[["y_channel_um", "z_um"]], check_exact=True)


def test_positions_is_a_row_of_the_table():
    film = Trajectories.seeded(ODD, 2)
    table = film.table([0, 3.3, 7], border_um=12)
    at = table[table["frame"] == 1].drop(columns="frame").reset_index(drop=True)
    pd.testing.assert_frame_equal(film.positions(3.3, border_um=12), at, rtol=1e-12)
    assert at["x_channel_um"].min() < 0 and at["x_channel_um"].max() > film.view_length_um
    assert film.positions(3.3)["x_channel_um"].between(0, film.view_length_um).all()
    assert len(film.positions(3.3, border_um=np.inf)) == len(film.start)


@pytest.mark.parametrize("focusing", [PAPER, ODD])
def test_start_is_even_and_off_the_walls(focusing):
    start = Trajectories.seeded(focusing, 1, mean_in_view=5000).start
    for axis in "yz":
        free = focusing.extent_um(axis) / 2 - focusing.suspension.radius_um
        assert start[IN_CHANNEL[axis]].abs().max() <= free
        counts = np.histogram(start[IN_CHANNEL[axis]], bins=10, range=(-free, free))[0]
        assert np.abs(counts / len(start) - 0.1).max() < 4 * np.sqrt(0.09 / len(start))


@pytest.mark.parametrize("focusing", [PAPER, ODD])
def test_density_in_view_does_not_change(focusing):
    """1000 particles in view: each fifth of it holds 200 at any time, to four standard deviations (28 %)."""
    film = Trajectories.seeded(focusing, 6, mean_in_view=1000, view_length_um=250)
    table = film.table([0, 2, 5, 10, 20])
    fifth = (table["x_channel_um"] // 50).clip(upper=4).astype(int)
    counts = table.groupby(["frame", fifth]).size()
    assert len(counts) == 25
    np.testing.assert_allclose(counts, 200, atol=4 * np.sqrt(200))


def test_each_path_is_seeded_from_far_enough_upstream():
    """Particles evenly spaced on one path over the x that `seeded` uses: the number in view stays, ± 1."""
    drawn = Trajectories.seeded(PAPER, 0, mean_in_view=20_000, view_length_um=100, border_um=10).start
    first, last = -10 - 20 * PAPER.channel.max_speed_um_s, 110
    assert drawn["x_channel_um"].min() == pytest.approx(first, abs=0.1)
    assert drawn["x_channel_um"].max() == pytest.approx(last, abs=0.1)
    for y, z in [(0, 0), (97.5, -47.5), (-60, 20)]:
        x = np.arange(first + 0.25, last, 0.5)
        row = pd.DataFrame({"particle": np.arange(x.size), "x_channel_um": x, "y_channel_um": y, "z_um": z})
        film = Trajectories(focusing=PAPER, start=row, view_length_um=100)
        counts = film.table(np.linspace(0, 20, 50), border_um=10).groupby("frame").size()
        assert counts.between(239, 241).all()


def test_start_table_is_copied():
    start = pd.DataFrame({"particle": [0], "x_channel_um": [1.0], "y_channel_um": [-40.0], "z_um": [20.0]})
    film = Trajectories(focusing=PAPER, start=start)
    start.loc[0, "y_channel_um"] = 0
    assert film.positions(0)["y_channel_um"].item() == pytest.approx(-40)


# -------------------- bad input

ONE = pd.DataFrame({"particle": [0], "x_channel_um": [0.0], "y_channel_um": [0.0], "z_um": [0.0]})
NUMBERS = [
    (kind, item.name)
    for kind in (Channel, Suspension, Acoustics)
    for item in dataclasses.fields(kind)
    if item.name != "two_half_waves"
]


@pytest.mark.parametrize("bad", [0, -1.0, np.nan, np.inf, "1", None, True])
@pytest.mark.parametrize(("kind", "name"), NUMBERS)
def test_parameters_must_be_positive_numbers(kind, name, bad):
    error = ValueError if type(bad) in (int, float) else TypeError
    with pytest.raises(error, match=name):
        kind(**{name: bad})


def test_parameters_are_frozen_and_plain_floats():
    assert repr(Channel(width_um=np.float32(200))) == repr(Channel(width_um=200)) == repr(Channel())
    with pytest.raises(dataclasses.FrozenInstanceError):
        PAPER.channel.width_um = 3
    for kind in (Channel, Suspension, Acoustics, Focusing, Trajectories):
        with pytest.raises(TypeError, match="widht_um"):
            kind(widht_um=3)


def seeded(**changes):
    return Trajectories.seeded(**{"focusing": PAPER, "rng": 1, "mean_in_view": 5} | changes)


def given(start):
    return Trajectories(focusing=PAPER, start=start)


VALUE_ERRORS = [
    (lambda: Focusing(suspension=Suspension(radius_um=50)), "radius_um"),
    (lambda: Focusing(suspension=Suspension(compressibility_per_TPa=900)), "contrast_factor"),
    (lambda: PAPER.path("x", 0, 1), "axis"),
    (lambda: PAPER.path("z", [0, -51], 1), "start_um"),
    (lambda: PAPER.channel.velocity(101, 0), "y_channel_um"),
    (lambda: PAPER.channel.velocity(0, np.nan), "z_um"),
    (lambda: PAPER.radiation_velocity("y", 101), "position_um"),
    (lambda: PAPER.trigger_time("y", 0), "fraction"),
    (lambda: PAPER.trigger_time("y", 1.1), "fraction"),
    (lambda: PAPER.trigger_time("y", np.nan), "fraction"),
    (lambda: PAPER.trigger_time("y", start_um=[]), "start_um"),
    (lambda: PAPER.trigger_time("y", start_um=[np.nan]), "start_um"),
    (lambda: PAPER.trigger_time("y", start_um=[1], wall_gap_um=1), "wall_gap_um"),
    (lambda: PAPER.trigger_time("z", wall_gap_um=50), "wall_gap_um"),
    (lambda: PAPER.trigger_time("z", wall_gap_um=-1), "wall_gap_um"),
    (lambda: seeded(rng=-1), "rng"),
    (lambda: seeded(mean_in_view=0), "mean_in_view"),
    (lambda: seeded(mean_in_view=0.1), "mean_in_view"),
    (lambda: seeded(duration_s=-2), "duration_s"),
    (lambda: seeded(view_length_um=np.nan), "view_length_um"),
    (lambda: seeded(border_um=-1), "border_um"),
    (lambda: seeded().positions(20.1), "times_s"),
    (lambda: seeded().positions(np.nan), "times_s"),
    (lambda: seeded().table(3), "times_s"),
    (lambda: seeded().positions(1, border_um=-3), "border_um"),
    (lambda: given(ONE.assign(z_um=48.0)), "start z_um"),
    (lambda: given(ONE.assign(x_channel_um=np.nan)), "start x_channel_um"),
    (lambda: given(ONE.drop(columns="y_channel_um")), "start"),
    (lambda: given(ONE[:0]), "start"),
]
TYPE_ERRORS = [
    (lambda: Focusing(channel=3), "channel"),
    (lambda: Acoustics(two_half_waves="no"), "two_half_waves"),
    (lambda: PAPER.trigger_time("y", "most"), "fraction"),
    (lambda: seeded(rng=None), "rng"),
    (lambda: seeded(rng=True), "rng"),
    (lambda: seeded(focusing=None), "focusing"),
    (lambda: Trajectories(focusing=1, start=ONE), "focusing"),
    (lambda: given([1]), "start"),
]


@pytest.mark.parametrize(("call", "name"), VALUE_ERRORS)
def test_impossible_values_are_named(call, name):
    with pytest.raises(ValueError, match=name):
        call()


@pytest.mark.parametrize(("call", "name"), TYPE_ERRORS)
def test_wrong_kinds_are_named(call, name):
    with pytest.raises(TypeError, match=name):
        call()
