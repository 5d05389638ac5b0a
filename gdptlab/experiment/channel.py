"""The paper's experiment without its camera: a flow carries spheres while sound pushes them to the middle.

Axes: x points downstream, y across the width w, z across the height h; y = z = 0 is the channel's centre,
and the field of view is 0 ≤ x ≤ `view_length_um`: these are `x_channel_um`, `y_channel_um` and `z_um` of tables.
Lengths are in µm, times in s, speeds in µm/s.

All particles are alike. They move with the fluid along x, and across it at the radiation velocity of
eqs (1a, 1b) of Rossi & Barnkob. As in the paper there is no streaming, no gravity (a 5 µm polystyrene
sphere sinks at about 0.8 µm/s), and no interaction of particles with the walls or with each other. So y and z
have closed forms, and only x needs a quadrature.
"""

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PPoly

from gdptlab._checks import choice, generator, instance, numbers, positive

TERMS = 100
"""Number of terms of the Poiseuille series. Chosen on the paper's channel: the error is 2e-6 of the peak speed on a
wall and 3e-12 one particle radius off it; with 10 terms, 5e-4 and 6e-5. More terms only take time."""

IN_CHANNEL = {"x": "x_channel_um", "y": "y_channel_um", "z": "z_um"}
"""Columns of a position in the channel, by axis."""

FARTHEST_UM = 1e9
"""Largest distance of a particle from the view, µm. Chosen: a kilometre, far beyond any channel; so far away positions
have still seven digits after the point."""

MOST_PARTICLES = 1e7
"""Largest number of particles that are drawn. Chosen: their paths take some gigabytes; the paper's film has 100."""

KNOTS = 10
"""Number of knots of the path integral in one focusing time. Chosen on 20 s in the paper's channel: the error is
2e-6 µm with 10 knots, 6e-5 µm with 5 and 8e-4 µm with 3. More knots only take time."""


def _positive_fields(obj: Any) -> None:
    """Store the float fields of a frozen dataclass as plain floats above 0, or refuse them."""
    for item in fields(obj):
        if item.type is float:
            object.__setattr__(obj, item.name, positive(item.name, getattr(obj, item.name)))


def _within(name: str, value: ArrayLike, limit: float) -> NDArray[np.float64]:
    """Return `value` as an array of its shape if all of it, but for rounding, lies within ± `limit` µm."""
    return np.clip(numbers(name, value, -limit * (1 + 1e-12), limit * (1 + 1e-12)), -limit, limit)


def _must_fit(name: str, array: NDArray, other: NDArray) -> None:
    """Raise ValueError unless two arrays can be broadcast together."""
    try:
        np.broadcast_shapes(array.shape, other.shape)
    except ValueError as error:
        raise ValueError(f"{name}: got shape {array.shape}, allowed is one that fits {other.shape}") from error


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A straight channel of rectangular cross-section and the flow through it.

    Attributes
    ----------
    width_um, height_um : float
        Extents along y and z (paper, section 4: 200 and 100).
    flow_rate_ul_h : float
        Volume flow rate Q in µl/h (paper: 0.4).

    Raises
    ------
    TypeError, ValueError
        If a value is not a finite number above 0, or a name is unknown.
    """

    width_um: float = 200.0
    height_um: float = 100.0
    flow_rate_ul_h: float = 0.4

    def __post_init__(self) -> None:
        _positive_fields(self)

    @property
    def mean_speed_um_s(self) -> float:
        """Flow rate over cross-section."""
        return self.flow_rate_ul_h * 1e9 / 3600 / (self.width_um * self.height_um)

    @property
    def max_speed_um_s(self) -> float:
        """Speed on the centre line."""
        return float(self.velocity(0.0, 0.0))

    def velocity(self, y_channel_um: ArrayLike, z_um: ArrayLike) -> NDArray[np.float64]:
        """Return the Poiseuille velocity along x, in µm/s, at points in the channel (y and z broadcast together).

        This is the single Fourier series of the rectangular duct (Bruus, Theoretical Microfluidics, 2008,
        section 3.4.4), its plane part summed to the parabola over the shorter side. The other part corrects for
        the two other walls and decays exponentially away from them, where a double series needs thousands
        of terms. The profile is divided by its own mean, which has a closed form, and scaled to Q.

        Raises
        ------
        ValueError
            If a point is outside the channel.
        """
        along = _within("y_channel_um", y_channel_um, self.width_um / 2)
        across = _within("z_um", z_um, self.height_um / 2)
        _must_fit("z_um", across, along)
        long, short = self.width_um, self.height_um
        if long < short:
            along, across, long, short = across, along, short, long
        n = 2 * np.arange(TERMS) + 1
        sign = np.where(n % 4 == 1, 1, -1)
        weight = sign * 32 / (np.pi * n) ** 3 / (1 + np.exp(-n * np.pi * long / short))
        profile = 1 - (2 * across / short) ** 2
        for side in (-1, 1):  # cosh(nπ along / short) cos(nπ across / short) is the real part of two powers
            q = np.exp(np.pi / short * (side * along - long / 2 + 1j * across))
            profile = profile - (q * np.polynomial.polynomial.polyval(q * q, weight)).real
        loss = 192 / (np.pi * n) ** 5 * short / long * np.tanh(n * np.pi * long / (2 * short))
        return self.mean_speed_um_s * profile / (2 / 3 * (1 - loss.sum()))


@dataclass(frozen=True, kw_only=True)
class Suspension:
    """Equal spheres in a liquid; by default the paper's, 5 µm polystyrene in water at 25 °C.

    Attributes
    ----------
    radius_um : float
        a of eqs (1a, 1b) (paper, section 4: 2a = 5 µm).
    density_kg_m3, compressibility_per_TPa : float
        Of the spheres; the paper does not give them. Density 1050, longitudinal sound speed c = 2350 m/s and Poisson's
        ratio s = 0.35 of polystyrene (Muller et al., Lab Chip 12 (2012) 4617) give a compressibility
        3 (1 - s) / (1 + s) / (ρ c²) = 249 per TPa. Published values run from 172 to 330.
    fluid_density_kg_m3, sound_speed_m_s, viscosity_mPa_s : float
        Of the liquid; water at 25 °C.

    Raises
    ------
    TypeError, ValueError
        If a value is not a finite number above 0, or a name is unknown.
    """

    radius_um: float = 2.5
    density_kg_m3: float = 1050.0
    compressibility_per_TPa: float = 249.0
    fluid_density_kg_m3: float = 997.0
    sound_speed_m_s: float = 1497.0
    viscosity_mPa_s: float = 0.890

    def __post_init__(self) -> None:
        _positive_fields(self)

    @property
    def contrast_factor(self) -> float:
        """Acoustic contrast factor Φ, inviscid (Settnes & Bruus, Phys. Rev. E 85 (2012) 016327)."""
        density = self.density_kg_m3 / self.fluid_density_kg_m3
        fluid_modulus = self.fluid_density_kg_m3 * self.sound_speed_m_s**2
        softness = self.compressibility_per_TPa * 1e-12 * fluid_modulus
        return ((5 * density - 2) / (2 * density + 1) - softness) / 3


@dataclass(frozen=True, kw_only=True)
class Acoustics:
    """The two standing half waves, across the width and across the height.

    Attributes
    ----------
    energy_density_J_m3 : float
        E_ac (paper: 1.2).
    two_half_waves : bool
        The paper prints one amplitude for y and z, as if both waves had the width's wavenumber π/w: False,
        U_z = U_y. But a half wave across the height has π/h: True, U_z = U_y w/h, here twice U_y.

    Raises
    ------
    TypeError, ValueError
        If a value is not of its kind, the energy density not above 0, or a name is unknown.
    """

    energy_density_J_m3: float = 1.2
    two_half_waves: bool = False

    def __post_init__(self) -> None:
        _positive_fields(self)
        instance("two_half_waves", self.two_half_waves, bool)


@dataclass(frozen=True, kw_only=True)
class Focusing:
    """Acoustophoresis of a suspension in a channel: velocities, paths across it, trigger times.

    `axis` is 'y' or 'z' in all methods; positions must lie within the channel, else ValueError.

    Raises
    ------
    TypeError
        If an argument is not of its class.
    ValueError
        If the spheres do not fit into the channel, or the contrast factor is not above 0, so that sound
        would push them to the walls.
    """

    channel: Channel = field(default_factory=Channel)
    acoustics: Acoustics = field(default_factory=Acoustics)
    suspension: Suspension = field(default_factory=Suspension)

    def __post_init__(self) -> None:
        for item in fields(self):
            instance(item.name, getattr(self, item.name), item.type)
        side, radius = min(self.channel.width_um, self.channel.height_um), self.suspension.radius_um
        if 2 * radius >= side:
            raise ValueError(f"radius_um: got {radius:g}, allowed is below {side / 2:g}, half the channel")
        contrast = self.suspension.contrast_factor
        if contrast <= 0:
            raise ValueError(f"contrast_factor: got {contrast:.3g}, allowed is above 0: focusing")

    def extent_um(self, axis: str) -> float:
        """Channel extent along the axis: w or h."""
        return {"y": self.channel.width_um, "z": self.channel.height_um}[choice("axis", axis, "yz")]

    def free_um(self, axis: str) -> float:
        """Largest distance of a particle's centre from the middle: half the extent less one radius."""
        return self.extent_um(axis) / 2 - self.suspension.radius_um

    def amplitude_um_s(self, axis: str) -> float:
        """Amplitude of the radiation velocity, U = u_0 a²/a_0² of eq. (1a) for y, (1b) for z, in µm/s.

        With u_0 = 4 E_ac / (ρ c) and a_0² = 6 ν / (Φ ω) (Muller et al., Phys. Rev. E 88 (2013) 023006) and
        ω = k c, this is (2 Φ / 3) (a² / η) k E_ac; k = π / extent for a half wave.
        """
        k_per_m = np.pi / (self.extent_um(axis if self.acoustics.two_half_waves else "y") * 1e-6)
        a2_over_eta = (self.suspension.radius_um * 1e-6) ** 2 / (self.suspension.viscosity_mPa_s * 1e-3)
        energy = self.acoustics.energy_density_J_m3
        return 2 / 3 * self.suspension.contrast_factor * a2_over_eta * k_per_m * energy * 1e6

    def focusing_time_s(self, axis: str) -> float:
        """Time in which tan(πy/w) falls by a factor e: w / (2πU)."""
        return self.extent_um(axis) / (2 * np.pi * self.amplitude_um_s(axis))

    def radiation_velocity(self, axis: str, position_um: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity of eqs (1a, 1b) in µm/s: U sin[π(2y/w + 1)] = -U sin(2πy/w), towards the centre."""
        extent = self.extent_um(axis)
        position = _within("position_um", position_um, extent / 2)
        return self.amplitude_um_s(axis) * np.sin(np.pi * (2 * position / extent + 1))

    def path(self, axis: str, start_um: ArrayLike, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the position in µm at `t_s` of particles that were at `start_um` at t = 0 (broadcast together).

        Solves dy/dt = -U sin(2πy/w): tan(πy/w) = tan(πy_0/w) exp(-2πUt/w).
        """
        extent = self.extent_um(axis)
        start, t = np.tan(np.pi / extent * _within("start_um", start_um, extent / 2)), numbers("t_s", t_s, 0)
        _must_fit("t_s", t, start)
        return extent / np.pi * np.arctan(start * np.exp(-t / self.focusing_time_s(axis)))

    def arrival_time(self, axis: str, start_um: ArrayLike) -> NDArray[np.float64]:
        """Return the time in s to reach the middle third from `start_um`: 0 inside it, inf from the wall itself."""
        extent = self.extent_um(axis)
        start = np.abs(_within("start_um", start_um, extent / 2))
        ratio = np.maximum(np.tan(np.pi * start / extent) / np.tan(np.pi / 6), 1.0)
        return np.where(start < extent / 2, self.focusing_time_s(axis) * np.log(ratio), np.inf)

    def trigger_time(
        self,
        axis: str,
        fraction: float = 0.9,
        *,
        start_um: ArrayLike | None = None,
        wall_gap_um: float | None = None,
    ) -> float:
        """Return when `fraction` of the particles are in the middle third: t_{w/3} for 'y', t_{h/3} for 'z'.

        A particle that starts nearer to the centre arrives earlier, so the particle at that rank of distance from the
        centre decides.

        Parameters
        ----------
        axis : 'y' or 'z'
        fraction : float
            In (0, 1] (paper: 0.9).
        start_um : array_like, optional
            Start of each particle along `axis`. Without it: infinitely many, evenly spread.
        wall_gap_um : float, optional
            Distance that those particles keep from the walls; by default their radius. 0: the whole cross-section.

        Returns
        -------
        float
            Seconds; inf if it never happens (fraction 1 without a gap).

        Raises
        ------
        TypeError, ValueError
            If an argument is out of range, or both `start_um` and `wall_gap_um` are given.
        """
        half = self.extent_um(axis) / 2
        if not 0 < positive("fraction", fraction) <= 1:
            raise ValueError(f"fraction: got {fraction!r}, allowed is above 0 to 1")
        if start_um is None:
            gap = self.suspension.radius_um if wall_gap_um is None else wall_gap_um
            if positive("wall_gap_um", gap, zero=True) >= half:
                raise ValueError(f"wall_gap_um: got {gap!r}, allowed is 0 to below {half:g}")
            return float(self.arrival_time(axis, fraction * (half - gap)))
        if wall_gap_um is not None:
            raise ValueError(f"wall_gap_um: got {wall_gap_um!r}, allowed is None where start_um is given")
        distance = np.sort(np.abs(_within("start_um", start_um, half)), axis=None)
        if distance.size == 0:
            raise ValueError("start_um: got no particle, allowed is one or more")
        rank = max(int(np.ceil(fraction * distance.size - 1e-9)), 1)  # 0.7 * 10 is a little above 7
        return float(self.arrival_time(axis, distance[rank - 1]))


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectories:
    """The paths of one population of particles; `Trajectories.seeded` draws one.

    Attributes
    ----------
    focusing : Focusing
    start : pandas.DataFrame
        `particle, x_channel_um, y_channel_um, z_um` at t = 0, centres one radius or more off the walls. Copied.
    duration_s : float
        Positions are known from 0 to this time (paper: 20).
    view_length_um : float
        Length of the field of view (512 pixels of 0.65 µm).

    Raises
    ------
    TypeError, ValueError
        If a value is out of range, or `start` is empty, lacks a column or has NaN or a particle in a wall.
    """

    focusing: Focusing
    start: pd.DataFrame
    duration_s: float = 20.0
    view_length_um: float = 332.8

    def __post_init__(self) -> None:
        _positive_fields(self)
        instance("focusing", self.focusing, Focusing)
        instance("start", self.start, pd.DataFrame)
        columns = ["particle", *IN_CHANNEL.values()]
        if not set(columns) <= set(self.start.columns):
            raise ValueError(f"start: got columns {list(self.start.columns)}, allowed are {columns}")
        if self.start.empty:
            raise ValueError("start: got no particle, allowed is one or more")
        _within("start x_channel_um", self.start["x_channel_um"], FARTHEST_UM)
        for axis in "yz":
            _within(f"start {IN_CHANNEL[axis]}", self.start[IN_CHANNEL[axis]], self.focusing.free_um(axis))
        object.__setattr__(self, "start", self.start[columns].reset_index(drop=True))

    @classmethod
    def seeded(
        cls,
        focusing: Focusing,
        rng: int | np.random.Generator,
        *,
        mean_in_view: float = 50.0,
        duration_s: float = 20.0,
        view_length_um: float = 332.8,
        border_um: float = 30.0,
    ) -> Self:
        """Draw particles evenly over the cross-section, and along x from far enough upstream.

        Far enough is the peak speed times `duration_s`. How far a particle drifts does not depend on its start along x,
        so the view holds an even draw of all paths at any time: its count varies around `mean_in_view`, and its
        fraction in the middle thirds is that of the whole population. Particles are drawn stretch by stretch, upstream
        from the view, so that a longer film begins with the particles of a shorter one.

        Parameters
        ----------
        focusing : Focusing
        rng : int or numpy.random.Generator
            The same seed gives the same table, bit for bit, and the same first particles for any duration.
        mean_in_view : float
            Expected number of particles in the field of view.
        duration_s, view_length_um : float
            As in the class.
        border_um : float
            The density also holds up to here beyond either end of the view, since a defocused particle just
            outside the frame still lights its edge.

        Raises
        ------
        TypeError, ValueError
            If an argument is out of range, or `mean_in_view` so small that there would be no particle.
        """
        instance("focusing", focusing, Focusing)
        rng = generator("rng", rng)
        border, view = positive("border_um", border_um, zero=True), positive("view_length_um", view_length_um)
        density = positive("mean_in_view", mean_in_view) / view
        drift = focusing.channel.max_speed_um_s * positive("duration_s", duration_s)
        if not view + 2 * border + drift < FARTHEST_UM:
            raise ValueError(
                f"duration_s: got a drift of {drift:g} µm to a view of {view:g}, allowed are {FARTHEST_UM:g}"
            )
        if not density * (view + 2 * border + drift) < MOST_PARTICLES:
            raise ValueError(f"mean_in_view: got {mean_in_view!r}, allowed are {MOST_PARTICLES:g} particles in all")
        if not drift < MOST_PARTICLES * view:
            raise ValueError(f"view_length_um: got {view:g}, allowed is {drift / MOST_PARTICLES:g} or more")
        # Stretches from the downstream end: the view with its borders, then as many views as the drift needs.
        ends = view + 2 * border + view * np.arange(1 + np.ceil(drift / view))
        starts, counts = np.concatenate([[0.0], ends[:-1]]), np.diff(np.rint(density * ends), prepend=0).astype(int)
        half = [focusing.free_um("y"), focusing.free_um("z")]
        xyz = np.concatenate(
            [
                rng.uniform([view + border - b, -half[0], -half[1]], [view + border - a, *half], size=(n, 3))
                for a, b, n in zip(starts, ends, counts, strict=True)
            ]
        )
        start = pd.DataFrame(xyz, columns=list(IN_CHANNEL.values())).assign(particle=np.arange(len(xyz)))
        start = start[start["x_channel_um"] >= -border - drift]
        if start.empty:
            least = view / ends[0]
            raise ValueError(f"mean_in_view: got {mean_in_view!r}, allowed is {least:.2g} or more, one particle in all")
        return cls(focusing=focusing, start=start, duration_s=duration_s, view_length_um=view_length_um)

    @cached_property
    def _drift(self) -> PPoly:
        """Distance of each particle (n,) along x from its start, µm, as a piecewise polynomial of time.

        The flow's velocity is taken along the closed-form path across, splined and integrated. Knots follow
        the faster axis until it is focused to 1e-11, then the slower one; after that nothing changes.
        """
        scale = np.sort([self.focusing.focusing_time_s(axis) for axis in "yz"])
        ends = [0.0, *np.minimum(25 * scale, self.duration_s), self.duration_s]
        steps = [*scale / KNOTS, self.duration_s / KNOTS]
        parts = zip(ends[:-1], ends[1:], steps, strict=True)
        pieces = [np.linspace(a, b, 2 + int((b - a) / step)) for a, b, step in parts]
        t = np.unique(np.concatenate(pieces))
        return CubicSpline(t, self.focusing.channel.velocity(*self._across(t))).antiderivative()

    def _across(self, t_s: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return y and z at these times (k,), each of shape (k, particles)."""
        return [self.focusing.path(axis, self.start[IN_CHANNEL[axis]], t_s[:, None]) for axis in "yz"]

    def table(self, times_s: ArrayLike, *, border_um: float = 0.0) -> pd.DataFrame:
        """Return positions at many times.

        Parameters
        ----------
        times_s : array_like, shape (frames,)
            From 0 to `duration_s`.
        border_um : float
            Largest distance beyond either end of the view of the particles to keep (the density holds up to the border
            given to `seeded`); inf: all particles, wherever they are.

        Returns
        -------
        pandas.DataFrame
            `frame` (index into `times_s`), `particle, t_s, x_channel_um, y_channel_um, z_um`, sorted by frame.

        Raises
        ------
        ValueError
            If a time or the border is out of range.
        """
        t = numbers("times_s", times_s, 0, self.duration_s)
        if t.ndim != 1:
            raise ValueError(f"times_s: got shape {t.shape}, allowed is one axis")
        border = positive("border_um", border_um, zero=True, infinite=True)
        x = self.start["x_channel_um"].to_numpy() + self._drift(t)
        y, z = self._across(t)
        frame, row = np.nonzero((x >= -border) & (x <= self.view_length_um + border))
        columns = {"frame": frame, "particle": self.start["particle"].to_numpy()[row], "t_s": t[frame]}
        xyz = (x[frame, row], y[frame, row], z[frame, row])
        return pd.DataFrame(columns | dict(zip(IN_CHANNEL.values(), xyz, strict=True)))

    def positions(self, t_s: float, *, border_um: float = 0.0) -> pd.DataFrame:
        """Return positions at one time, in about 1 ms: the columns of `table` but for `frame`."""
        return self.table([t_s], border_um=border_um).drop(columns="frame")

    def trigger_time(self, axis: str, fraction: float = 0.9) -> float:
        """Return the exact trigger time in s of all particles, in view or not: see `Focusing.trigger_time`."""
        return self.focusing.trigger_time(axis, fraction, start_um=self.start[IN_CHANNEL[axis]])
