"""A calibration from a film alone: no stage, no scan, no depth of any particle.

Images of one kind of particle differ by amplitude, which a norm takes off, and by one parameter: they lie on a curve in
the space of images. Those that stand alone (`lone_images`) are ordered along that curve, and averaged at points of it:
a calibration whose depths are lengths along the curve. With it all particles of some frames are fitted (joint fit).
Their places on the curve become depths by what the user knows of the film: how depths are spread, how fast the flow is
where, or how fast particles settle. Which end of the curve is the near one no film can tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import flag, function, positive, whole
from gdptlab._compiled import on_one_core
from gdptlab.calibration import Calibration
from gdptlab.fit.pattern import image_size
from gdptlab.locate import locate
from gdptlab.pipeline.depth_scale import GROUPS, Speed, depth_scale
from gdptlab.pipeline.image_curve import BEYOND, SLICES, features, first_stack, ordered, particles
from gdptlab.pipeline.lone_images import LoneImages, lone_images

LEAST_PARTICLES = 100
"""Least number of particles that stand alone: two or three for each slice."""

HIGHEST_UM = 1e5
"""Largest height of a channel, µm. Convention: no microscope looks 10 cm deep."""

OUTER = 5
"""Slices at either end whose images tell the wide end."""

INSIDE = 2
"""Slices from either end of the curve within which a sharpest image counts as at the end."""


FITTED = 50
"""Number of frames in which all particles are measured, if not given. Derived: of 50 particles a frame, spread evenly,
2500 tell the scale to 0.9 % (0.45 over the root of their number)."""

MISFIT = 2.0
"""Chi-square from which on a particle is not explained by the images. Of one kind of particle 0.4 % have more, of two
kinds whose diameters differ by 40 % have 40 %."""


@dataclass(frozen=True, eq=False)
class FilmReport:
    """How `Calibration.from_film` came to its calibration.

    Attributes
    ----------
    images : DataFrame
        A row for each image that stood alone: `frame`, `x_px`, `y_px`, `particle`, `z_um`, and `used`, whether it lies
        near the curve of the others.
    particles : DataFrame
        All particles of the frames that were fitted, with `frame`.
    z_std_um : float array (N,)
        Standard deviation of the depth of each slice.
    scale_std : float
        Standard deviation of the factor common to all depths.
    scaled_by : str
        What was known: "height" or "speed".
    focus_inside : bool
        Whether the sharpest image lies between the ends of the curve: the two sides of focus are told apart. If not,
        all particles lie on one side, or images of both sides are alike and were taken for one.
    misfits : float
        Fraction of the particles that the images do not explain.
    noise : float
        Standard deviation of the noise of a pixel of the film, counts.
    """

    images: pd.DataFrame
    particles: pd.DataFrame
    z_std_um: NDArray[np.float64]
    scale_std: float
    scaled_by: str
    focus_inside: bool
    misfits: float
    noise: float

    def scaled(self, ratio: float) -> Self:
        """Return the report with depths times a ratio."""
        tables = {name: getattr(self, name) for name in ("images", "particles")}
        tables = {name: table.assign(z_um=table["z_um"] * ratio) for name, table in tables.items()}
        return replace(self, **tables, z_std_um=self.z_std_um * ratio)

    def part(self, part: slice) -> Self:
        """Return the report on some of the slices."""
        return replace(self, z_std_um=self.z_std_um[part])


@on_one_core
def calibrated(
    frames: Sequence[ArrayLike],
    height_um: float,
    *,
    radius_um: float = 0.0,
    speed: Speed | None = None,
    reverse: bool = False,
    size: int | None = None,
    fitted: int = FITTED,
) -> Calibration:
    """Calibrate with a film; see `Calibration.from_film`."""
    if not positive("height_um", height_um) <= HIGHEST_UM:
        raise ValueError(f"height_um: got {height_um:g}, allowed is to {HIGHEST_UM:g}")
    room = height_um / 2 - positive("radius_um", radius_um, zero=True)
    if room <= 0:
        raise ValueError(f"radius_um: got {radius_um:g}, allowed is below half of height_um = {height_um:g}")
    if speed is not None:
        function("speed", speed)
    count = _count(frames)
    flag("reverse", reverse), whole("fitted", fitted, 2 * GROUPS, 100_000)
    if size is not None and whole("size", size, 7, 10_001) % 2 == 0:
        raise ValueError(f"size: got {size}, allowed are odd numbers")
    lone = lone_images(frames, size)
    points = features(lone.images) if len(lone.images) else np.zeros((0, 1))
    particle = particles(lone.table, points, lone.images.shape[-1])
    _must_be_enough(lone, len(np.unique(particle)))
    curve = ordered(points, particle)
    stack = first_stack(lone.images[curve.used], curve.weights)
    pixels = _pixels(stack[BEYOND:-BEYOND])
    if (pixels[:OUTER].mean() > pixels[-OUTER:].mean()) != reverse:
        stack, curve = stack[::-1], replace(curve, along=1 - curve.along)
    if size is None:
        trim = (stack.shape[1] - image_size(stack)) // 2
        stack = stack[:, trim : stack.shape[1] - trim, trim : stack.shape[1] - trim]
    places = np.arange(len(stack), dtype=float)
    rough = Calibration.from_stack(stack, places)
    step = 1 if speed is None else 2
    first = np.unique(np.rint(np.linspace(0, count - step, fitted // step)).astype(int))
    chosen = np.unique(np.concatenate([first, first + step - 1]))
    table = [locate(frames[int(k)], rough, method="joint").assign(frame=k) for k in chosen]
    table = pd.concat(table, ignore_index=True).rename(columns={"z_um": "slice"})
    misfits = float((table["chi2"] > MISFIT).mean())
    kept = (places >= np.floor(table["slice"].min())) & (places <= np.ceil(table["slice"].max()))
    scale = depth_scale(table, places[kept], (-room, room), speed)
    made = Calibration.from_stack(stack[kept], scale.z_um)
    # Along the curve slices are even, in depth they are not: the model is smoothed along the curve.
    model, step_um = Calibration.from_stack(stack[kept], places[kept]).model, np.gradient(scale.z_um)
    error = np.column_stack([model.own_error[:, :2], np.hypot(model.own_error[:, 2] * step_um, scale.z_std_um)])
    model = replace(model, z_um=scale.z_um, own_error=error, own_bias_um=model.own_bias_um * step_um)

    def depth(place: NDArray) -> NDArray:
        return np.interp(place, places[kept], scale.z_um)

    sharpest = int(_pixels(stack).argmin())
    return replace(
        made,
        learned=model,
        report=FilmReport(
            images=lone.table.assign(
                particle=particle, z_um=depth(BEYOND + (SLICES - 1) * curve.along), used=curve.used
            ),
            particles=table.assign(z_um=depth(table["slice"].to_numpy())).drop(columns="slice"),
            z_std_um=scale.z_std_um,
            scale_std=scale.std,
            scaled_by="height" if speed is None else "speed",
            focus_inside=BEYOND + INSIDE < sharpest < len(stack) - 1 - BEYOND - INSIDE,
            misfits=misfits,
            noise=lone.noise,
        ),
    )


def _count(frames: Sequence[ArrayLike]) -> int:
    """Number of frames, if they can be asked for by number."""
    if not hasattr(frames, "__len__") or not hasattr(frames, "__getitem__") or getattr(frames, "ndim", 3) != 3:
        raise TypeError(
            f"frames: got a {type(frames).__name__}, allowed is a film: a list, an array or the like of frames"
        )
    if len(frames) < 2 * GROUPS:
        raise ValueError(f"frames: got {len(frames)} frames, allowed are {2 * GROUPS} or more")
    return len(frames)


def _must_be_enough(lone: LoneImages, count: int) -> None:
    """Raise ValueError if too few particles stand alone, and say how many more frames it takes."""
    if count < LEAST_PARTICLES:
        more = f"about {int(np.ceil((LEAST_PARTICLES / max(count, 1) - 1) * lone.frames))} more" if count else "other"
        raise ValueError(
            f"frames: got {count} particles that stand alone ({len(lone.images)} images) in {lone.frames} frames, "
            f"needed are {LEAST_PARTICLES}: {more} frames with new particles, taken farther apart, or a "
            f"thinner suspension"
        )


def _pixels(images: NDArray) -> NDArray:
    """Number of pixels (n,) over which the light of images (n, s, s) is spread."""
    light = np.abs(images.astype(float))
    return light.sum(axis=(1, 2)) ** 2 / (light**2).sum(axis=(1, 2))
