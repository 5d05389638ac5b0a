"""Recall, precision and errors of the fit of a frame, in many kinds of rendered frames; every line beside its target.

    python tests/benchmark_fit.py                          all rows, 8 frames each, 4 calibrations
    python tests/benchmark_fit.py alike debris --frames 4  some rows
    python tests/benchmark_fit.py --method truth           what the images allow: the fit started at the truth

Frames are 512 x 512 px, particles lie anywhere in them and at any depth of 100 µm, the read noise is 38 counts; the
calibration is one noisy exposure of a stack of 51 slices of 63 px, or a scan of full frames. Frame k is measured with
calibration k modulo the number of calibrations, since the noise of one calibration is common to all its frames.
A measured particle is a true one within 2 px in x and in y and 10 µm in z.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import tifffile
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline, make_interp_spline
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from gdptlab import Calibration, datasets, match
from gdptlab.experiment.camera import Camera
from gdptlab.experiment.image_types import as_image_type
from gdptlab.experiment.microscope import Microscope, _library
from gdptlab.fit import Joint, PatternModel
from gdptlab.fit.learning import learned
from gdptlab.fit.noise import Pixels
from gdptlab.fit.solver import Population
from gdptlab.pipeline.beads import find_beads

MICROSCOPE, CAMERA = Microscope(), Camera()
SHAPE, Z_UM, SIZE_PX = (512, 512), np.linspace(-50, 50, 51), 63
DIAMETERS_UM = (5.0 * (1 + 0.05 * np.arange(-5, 6))).tolist()
"""Diameters whose images are traced; the image of one in between is mixed of its two neighbours'."""
CYLINDERS_UM = (4000.0 + 100.0 * np.arange(-2, 3)).tolist()
"""Focal lengths of the cylindrical lens whose images are traced, likewise."""


@dataclass(frozen=True)
class Target:
    """Least recall and precision, largest RMS error of z (µm), range of the error over its standard deviation."""

    recall: float
    precision: float
    rms_um: float
    ratio: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Row:
    """A kind of frame, and what it is calibrated with.

    Attributes
    ----------
    targets : dict
        Target for each number of particles in a frame.
    microscope, camera, image_type
        Of frames and calibration.
    amplitude_sigma : float
        Standard deviation of the logarithm of the particles' amplitudes, whose median is 1.
    diameter_std : float
        Standard deviation of diameters, as a fraction of their mean.
    cylinder_change : float
        Largest change of the cylindrical lens' focal length over the field, as a fraction.
    beads : int
        Of the scan that calibrates; 0: a stack of one particle does.
    add : callable, optional
        Light (rows, columns) that is no particle's, from a generator.
    spoil : callable, optional
        Turns a recorded frame, with a generator, into the frame that is measured.
    least_peak : float
        Particles whose peak, at the depth where the stack is dimmest, is below so many read noises need not be found.
    """

    targets: dict[int, Target]
    microscope: Microscope = MICROSCOPE
    camera: Camera = CAMERA
    image_type: str = "fluorescent"
    amplitude_sigma: float = 0.0
    diameter_std: float = 0.0
    cylinder_change: float = 0.0
    beads: int = 0
    add: Callable[[np.random.Generator], NDArray] | None = None
    spoil: Callable[[NDArray, np.random.Generator], NDArray] | None = None
    least_peak: float = 0.0

    def frames(self, n: int, seeds: list[tuple[int, ...]]) -> tuple[list[NDArray], list[pd.DataFrame]]:
        """Frames of n particles, one for each seed, and the true particles; `faint` ones need not be found."""
        rngs = [np.random.default_rng(seed) for seed in seeds]
        truths = [self._drawn(rng, *rng.uniform(-0.5, 511.5, (2, n)), rng.uniform(-50, 50, n)) for rng in rngs]
        frames = []
        for rng, light in zip(rngs, self._light(truths), strict=True):
            frame = self._recorded(light if self.add is None else light + self.add(rng), rng)
            frames.append(frame if self.spoil is None else self.spoil(frame, rng))
        dimmest = float(self._clean_stack()[[0, -1]].max(axis=(1, 2)).min())
        least = self.least_peak * self.camera.read_noise / dimmest
        return frames, [truth.assign(faint=truth["amplitude"] < least) for truth in truths]

    def calibration_images(self, seed: tuple[int, ...]) -> tuple[NDArray, NDArray]:
        """Stack of one particle, or scan of beads on a plane, and depths."""
        rng = np.random.default_rng(seed)
        if not self.beads:
            return np.stack([self._recorded(light, rng) for light in self._clean_stack()]), Z_UM
        x, y = _apart(rng, self.beads)
        beads = self._drawn(rng, x, y, 0.0)
        lights = self._light([beads.assign(z_um=z) for z in Z_UM])
        return np.stack([self._recorded(light, rng) for light in lights]), Z_UM

    def _drawn(self, rng: np.random.Generator, x: NDArray, y: NDArray, z_um: NDArray | float) -> pd.DataFrame:
        """Particles there, with amplitudes and diameters drawn from their distributions."""
        particles = pd.DataFrame({"x_px": x, "y_px": y, "z_um": z_um})
        particles["amplitude"] = np.exp(self.amplitude_sigma * rng.standard_normal(len(x)))
        larger = np.clip(1 + self.diameter_std * rng.standard_normal(len(x)), 0.75, 1.25)
        return particles.assign(diameter_um=larger * self.microscope.diameter_um)

    def _light(self, tables: list[pd.DataFrame], shape: tuple[int, int] = SHAPE) -> NDArray[np.float32]:
        """Light of the particles of each table, (tables, rows, columns)."""
        light, particles = np.zeros((len(tables), *shape), np.float32), pd.concat(tables, keys=range(len(tables)))
        across = (particles["x_px"] - (shape[1] - 1) / 2) / (shape[1] / 2)
        cylinders = 4000 * (1 + self.cylinder_change * across) if self.cylinder_change else None
        kinds = _mixed(particles["diameter_um"], DIAMETERS_UM) if cylinders is None else _mixed(cylinders, CYLINDERS_UM)
        for value, fraction in kinds:
            microscope, diameter = self.microscope, value
            if cylinders is not None:
                microscope, diameter = Microscope(cylinder_um=value), microscope.diameter_um
            library = _library(microscope, diameter)
            of_this = fraction > 0
            times = fraction * particles["amplitude"] * (particles["diameter_um"] / microscope.diameter_um) ** 2
            for ((k, _), p), scale in zip(particles[of_this].iterrows(), times[of_this], strict=True):
                library.place(light[k], p["x_px"], p["y_px"], p["z_um"], scale)
        return light

    def _clean_stack(self) -> NDArray[np.float32]:
        """Light of one particle in the middle of small frames."""
        middle = [(SIZE_PX - 1) / 2]
        one = pd.DataFrame({"x_px": middle, "y_px": middle, "amplitude": 1.0, "diameter_um": 5.0})
        return self._light([one.assign(z_um=z) for z in Z_UM], (SIZE_PX, SIZE_PX))

    def _recorded(self, light: NDArray, rng: np.random.Generator) -> NDArray:
        return self.camera.record(as_image_type(self.image_type)(light), rng)


class ForeignRow(Row):
    """Frames of a measured pattern (psf_astig): even slices calibrate, odd ones are drawn. z is in slices."""

    PEAK = 5000.0
    """Counts of the brightest slice."""

    def frames(self, n: int, seeds: list[tuple[int, ...]]) -> tuple[list[NDArray], list[pd.DataFrame]]:
        """As of `Row`."""
        stack, z = self._slices(1)
        along, half, frames, truths = make_interp_spline(z, stack, k=3), stack.shape[1] // 2, [], []
        for seed in seeds:
            rng = np.random.default_rng(seed)
            truth = self._drawn(rng, *rng.uniform(-0.5, 511.5, (2, n)), rng.uniform(z[0], z[-1], n))
            light, away = np.zeros(np.add(SHAPE, 2 * half)), np.arange(-half, half + 1)
            for p in truth.itertuples():
                row, column = round(p.y_px), round(p.x_px)
                image = RectBivariateSpline(away, away, along(p.z_um))(away + row - p.y_px, away + column - p.x_px)
                light[row : row + 2 * half + 1, column : column + 2 * half + 1] += p.amplitude * image
            frames.append(self._recorded(light[half:-half, half:-half], rng))
            truths.append(truth.assign(faint=False))
        return frames, truths

    def calibration_images(self, seed: tuple[int, ...]) -> tuple[NDArray, NDArray]:
        """As of `Row`."""
        stack, z = self._slices(0)
        return np.stack([self._recorded(light, np.random.default_rng((*seed, k))) for k, light in enumerate(stack)]), z

    def _slices(self, first: int) -> tuple[NDArray, NDArray]:
        """Every second slice, in counts, that falls to nothing at its border, and z."""
        stack = _psf_astig()
        fall = np.clip((stack.shape[1] // 2 - np.abs(np.arange(stack.shape[1]) - stack.shape[1] // 2)) / 6, 0, 1)
        z = np.arange(len(stack)) - len(stack) // 2
        return (self.PEAK * stack * fall * fall[:, None])[first::2], z[first::2].astype(float)


def _psf_astig() -> NDArray[np.float64]:
    """Slices (61, 61, 61), scaled to 0 ... 1, from the folder of other people's images (see `datasets`)."""
    return tifffile.imread(Path(os.environ["GDPTLAB_DATA"]) / "psf_astig" / "psf_astig.tif").astype(float)


def _apart(rng: np.random.Generator, n: int, apart_px: float = 45.0) -> tuple[NDArray, NDArray]:
    """Places of n beads of a scan, x and y, no two nearer than that."""
    places: list[NDArray] = []
    while len(places) < n:
        place = rng.uniform(8, 503, 2)
        if all(np.hypot(*(place - other)) > apart_px for other in places):
            places.append(place)
    return np.array(places).T


def _mixed(values: pd.Series, nodes: list[float]) -> list[tuple[float, NDArray]]:
    """Each node, and its fraction in the linear interpolation at every value."""
    return [
        (node, fractions)
        for node, unit in zip(nodes, np.eye(len(nodes)), strict=True)
        if (fractions := np.interp(values, nodes, unit)).any()
    ]


# -------------------- what is no particle


def sinusoid(rng: np.random.Generator, amplitude: float) -> NDArray[np.float64]:
    """Background that changes by `amplitude` counts to either side with a period of 128 px."""
    y, x = (np.sin(2 * np.pi * np.arange(n) / 128 + rng.uniform(0, 2 * np.pi)) for n in SHAPE)
    return amplitude * (1 + np.outer(y, x))


def debris(rng: np.random.Generator) -> NDArray[np.float64]:
    """Six bright pieces, each of a few elongated blobs, 10 to 40 px long."""
    y, x = np.indices(SHAPE)
    light = np.zeros(SHAPE)
    for _ in range(6):
        middle, bright = rng.uniform(20, 490, 2), rng.uniform(500, 4000)
        for _ in range(rng.integers(2, 6)):
            (row, column), angle = middle + rng.normal(0, 7, 2), rng.uniform(0, np.pi)
            along, across = rng.uniform(3, 10), rng.uniform(1.5, 4)
            u = (x - column) * np.cos(angle) + (y - row) * np.sin(angle)
            v = (y - row) * np.cos(angle) - (x - column) * np.sin(angle)
            light += bright * rng.uniform(0.3, 1) * np.exp(-((u / along) ** 2 + (v / across) ** 2) / 2)
    return light


def dust(rng: np.random.Generator) -> NDArray[np.float64]:
    """Eight specks, 8 to 25 px wide, with irregular, rather sharp borders, that take 1000 to 5000 counts of light."""
    y, x = np.indices((41, 41)) - 20
    light = np.zeros(SHAPE)
    for _ in range(8):
        row, column = rng.integers(25, 480, 2)
        rough = gaussian_filter(rng.standard_normal(x.shape), 3) * 7
        inside = np.hypot(x, y) < rng.uniform(4, 10) * (1 + 0.35 * rough)
        light[row - 20 : row + 21, column - 20 : column + 21] += rng.uniform(1000, 5000) * gaussian_filter(
            1.0 * inside, 0.8
        )
    return light


def clipped(frame: NDArray, _: np.random.Generator) -> NDArray:
    """Cut off at half the height of the brightest image of a particle (3 940 counts above 500)."""
    return np.minimum(frame, 500 + 1970)


def bad_pixels(frame: NDArray, rng: np.random.Generator) -> NDArray:
    """Twenty pixels at the camera's end, and one in a thousand that has 500 to 5 000 counts too many."""
    frame = frame.astype(np.int64)
    hot, full = rng.integers(0, frame.size, frame.size // 1000), rng.integers(0, frame.size, 20)
    frame.flat[hot] += rng.integers(500, 5000, len(hot))
    frame.flat[full] = 65_535
    return np.minimum(frame, 65_535).astype(np.uint16)


def _targets(
    recall: tuple[float, float], precision: tuple[float, float], rms_um: tuple[float, float], low: float, high: float
) -> dict[int, Target]:
    """Of 50 and of 150 particles a frame."""
    return {n: Target(recall[i], precision[i], rms_um[i], (low, high)) for i, n in enumerate((50, 150))}


ROWS = {
    "alike": Row(targets=_targets((0.995, 0.995), (0.995, 0.99), (0.33, 0.40), 0.9, 1.15)),
    "lognormal0.3": Row(targets=_targets((0.99, 0.985), (0.99, 0.985), (0.40, 0.45), 0.85, 1.25), amplitude_sigma=0.3),
    "lognormal0.6": Row(targets=_targets((0.98, 0.97), (0.98, 0.97), (0.50, 0.55), 0.85, 1.3), amplitude_sigma=0.6),
    "lognormal1.0": Row(
        targets=_targets((0.97, 0.95), (0.97, 0.97), (0.80, 0.95), 0.85, 1.3), amplitude_sigma=1.0, least_peak=5.0
    ),
    "diameters-scan": Row(
        targets=_targets((0.985, 0.97), (0.98, 0.97), (0.80, 1.0), 0.8, 1.3), diameter_std=0.1, beads=30
    ),
    "diameters-bead": Row(targets=_targets((0.985, 0.97), (0.97, 0.95), (1.3, 1.6), 0.8, 1.4), diameter_std=0.1),
    "photons": Row(
        targets=_targets((0.985, 0.985), (0.985, 0.98), (0.60, 0.75), 0.85, 1.3),
        camera=Camera(electrons_per_count=0.05),
    ),
    "background400": Row(
        targets=_targets((0.97, 0.95), (0.97, 0.95), (0.60, 0.80), 0, 1.4), add=partial(sinusoid, amplitude=400)
    ),
    "background2000": Row(
        targets=_targets((0.90, 0.85), (0.93, 0.90), (1.0, 1.3), 0, 1.6), add=partial(sinusoid, amplitude=2000)
    ),
    "debris": Row(targets=_targets((0.99, 0.98), (0.96, 0.96), (0.50, 0.60), 0, 1.4), add=debris),
    "dust": Row(targets=_targets((0.99, 0.98), (0.96, 0.96), (0.50, 0.60), 0, 1.4), add=dust, image_type="brightfield"),
    "clipped": Row(targets=_targets((0.98, 0.97), (0.98, 0.97), (0.70, 0.90), 0, 1.4), spoil=clipped),
    "bad-pixels": Row(targets=_targets((0.99, 0.98), (0.99, 0.98), (0.40, 0.50), 0.8, 1.3), spoil=bad_pixels),
    "field": Row(
        targets=_targets((0.99, 0.985), (0.99, 0.98), (0.40, 0.50), 0.85, 1.3), cylinder_change=0.05, beads=60
    ),
    "crowd": Row(targets={400: Target(0.98, 0.99, 0.80, (0, 1.4))}),
    "no-cylinder": Row(
        targets=_targets((0.995, 0.995), (0.99, 0.99), (0.30, 0.30), 0.9, 1.2), microscope=Microscope(cylinder_um=None)
    ),
    "foreign": ForeignRow(
        targets={150: Target(0.97, 0.97, np.inf, (0, 1.3))}, amplitude_sigma=0.3, camera=Camera(electrons_per_count=0.5)
    ),
}
"""Kinds of frames, by name."""


# -------------------- ways to measure


@dataclass(frozen=True)
class Method:
    """A way to measure: makes a calibration of a stack or of a scan, and a table of a frame (and its truth)."""

    of_stack: Callable[[NDArray, NDArray], object]
    of_scan: Callable[[NDArray, NDArray], object]
    measure: Callable[[NDArray, object, pd.DataFrame], pd.DataFrame]


def model_of_stack(stack: NDArray, z_um: NDArray) -> PatternModel:
    """Model of one particle."""
    return Calibration.from_stack(stack, z_um).model


def model_of_scan(scan: NDArray, z_um: NDArray) -> PatternModel:
    """Model of all beads of a scan, found in it."""
    beads = find_beads(scan, z_um)
    return learned(scan, z_um, beads[["x_px", "y_px"]].to_numpy())[0]


def joint(frame: NDArray, model: PatternModel, _: pd.DataFrame) -> pd.DataFrame:
    """Table by the joint fit."""
    plan = Joint(model, frame.shape)
    return plan.table(plan.first(frame.astype(np.float32)))


class FromTruth(Joint):
    """The joint fit that starts from the true particles instead of a search: what the images allow."""

    truth: pd.DataFrame

    def _search(self, frame: NDArray, pixels: Pixels) -> tuple[NDArray, Population, int]:
        amplitude = self.truth["amplitude"] * float(self.model.peak.max()) / pixels.noise
        step = np.interp(self.truth["z_um"], self.model.z_um, np.arange(self.model.count))
        places = np.stack([self.truth["y_px"], self.truth["x_px"], step, amplitude], axis=1)
        population = Population(float(np.median(amplitude)), max(float(np.log(amplitude).std()), 0.05))
        return np.pad(places, ((0, 0), (0, self.model.modes_count))), population, 1


def from_truth(frame: NDArray, model: PatternModel, truth: pd.DataFrame) -> pd.DataFrame:
    """Table of the joint fit that starts from the true particles."""
    plan = FromTruth(model, frame.shape)
    plan.truth = truth
    return plan.table(plan.first(frame.astype(np.float32)))


METHODS = {
    "joint": Method(model_of_stack, model_of_scan, joint),
    "truth": Method(model_of_stack, model_of_scan, from_truth),
}
"""Ways to measure, by name."""


# -------------------- scores


def compared(measured: pd.DataFrame, truth: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, int]]:
    """Pairs of measured and true particles with `dz_um` and `z_std_um`, and counts.

    A measured row within 3 px of a faint particle, which need not be found, is neither right nor false.
    """
    pairs = match(measured, truth)
    std = measured["z_std_um"] if "z_std_um" in measured else pd.Series(np.nan, measured.index)
    pairs["z_std_um"] = std.loc[pairs["measured"]].to_numpy()
    pairs = pairs[~truth.loc[pairs["true"], "faint"].to_numpy()]
    rest = measured.drop(index=pairs["measured"])
    excused = match(rest, truth[truth["faint"]], within_px=3, within_um=200)
    right, wanted = len(pairs), int((~truth["faint"]).sum())
    return pairs, {"true": wanted, "matched": right, "measured": right + len(rest) - len(excused)}


def scored(row: Row, n: int, method: Method, frames: int, calibrations: int, seed: int) -> dict[str, float]:
    """Scores of one row of the table at n particles a frame."""
    images, truths = row.frames(n, [(seed, n, k) for k in range(frames)])
    make = method.of_scan if row.beads else method.of_stack
    made = [make(*row.calibration_images((seed, 0, c))) for c in range(min(calibrations, frames))]
    pairs, counts, seconds = [], [], []
    for k, (frame, truth) in enumerate(zip(images, truths, strict=True)):
        start = time.perf_counter()
        measured = method.measure(frame, made[k % len(made)], truth)
        seconds.append(time.perf_counter() - start)
        here, count = compared(measured, truth)
        pairs.append(here)
        counts.append(count)
    pairs, total = pd.concat(pairs), pd.DataFrame(counts).sum()
    dz, ratio = pairs["dz_um"], (pairs["dz_um"] / pairs["z_std_um"]).dropna()
    return {
        "true": int(total["true"]),
        "recall": total["matched"] / total["true"],
        "precision": total["matched"] / max(total["measured"], 1),
        "rms_um": float(np.sqrt((dz**2).mean())),
        "robust_um": _robust(dz),
        "ratio_robust": _robust(ratio),
        "ratio_rms": float(np.sqrt((ratio**2).mean())),
        "s": float(np.median(seconds)),
    }


def _robust(errors: pd.Series) -> float:
    """Standard deviation of errors about 0 that outliers do not move."""
    return float(errors.abs().median() / norm.ppf(0.75))


def line(name: str, n: int, found: dict[str, float], target: Target) -> str:
    """One row of the table; a * marks what falls short of the target in brackets."""
    low, high = target.ratio
    ratios = found["ratio_robust"], found["ratio_rms"]
    mark = " " if all(low <= ratio <= high for ratio in ratios) else "*"
    parts = [
        f"{name:15s} {n:3d} {found['true']:5d}",
        _figure("recall", found["recall"], target.recall, found["recall"] >= target.recall, 4),
        _figure("precision", found["precision"], target.precision, found["precision"] >= target.precision, 4),
        _figure("RMS z", found["rms_um"], target.rms_um, found["rms_um"] <= target.rms_um, 3),
        f"(robust {found['robust_um']:.3f})",
        f"error/std {ratios[0]:.2f} {ratios[1]:.2f}{mark}[{low}-{high}]",
        f"{found['s']:.2f} s",
    ]
    return "  ".join(parts)


def _figure(name: str, value: float, target: float, reached: bool, digits: int) -> str:
    return f"{name} {value:.{digits}f}{' ' if reached else '*'}[{target:g}]"


def planar_beads(method: Method) -> str:
    """Found, scatter about each frame's own plane, error over standard deviation, and rows that are no listed bead."""
    beads = datasets.planar_beads()
    calibration, pairs, rows, seconds = method.of_scan(beads.scan, beads.z_um), [], 0, []
    for k, frame in enumerate(beads.frames):
        truth = beads.truth[beads.truth["frame"] == k].drop(columns="frame")
        start = time.perf_counter()
        table = method.measure(frame, calibration, truth)
        seconds.append(time.perf_counter() - start)
        rows += len(table)
        here = match(table, truth, within_px=3, within_um=5)
        plane = np.stack([np.ones(len(here)), *table.loc[here["measured"], ["x_px", "y_px"]].to_numpy().T], axis=1)
        z = table.loc[here["measured"], "z_um"].to_numpy()
        trust = np.ones(len(z))
        for _ in range(10):  # least absolute deviations, so that no outlier tilts the plane
            off = z - plane @ np.linalg.lstsq(plane * trust[:, None], z * trust, rcond=None)[0]
            trust = 1 / np.sqrt(np.maximum(np.abs(off), 0.05))
        pairs.append(here.assign(off=off, std=table.loc[here["measured"], "z_std_um"].to_numpy()))
    pairs = pd.concat(pairs)
    ratio = pairs["off"] / pairs["std"]
    return (
        f"planar beads    {len(beads.truth)} found {len(pairs) / len(beads.truth):.3f} [0.96]  "
        f"RMSE to z_plane {np.sqrt((pairs['dz_um'] ** 2).mean()):.3f}  "
        f"scatter {np.sqrt((pairs['off'] ** 2).mean()):.3f} (robust {_robust(pairs['off']):.3f}) [0.38]  "
        f"error/std {_robust(ratio):.2f} {np.sqrt((ratio**2).mean()):.2f} [0.85-1.3]  "
        f"rows that are no listed bead {1 - len(pairs) / rows:.3f}  {np.median(seconds):.2f} s"
    )


def main() -> None:
    """Measure the rows that were asked for, and print a line for each."""
    parser = argparse.ArgumentParser(description="Scores of the fit of a frame, beside their targets.")
    parser.add_argument("rows", nargs="*", help=f"of {', '.join([*ROWS, 'planar'])}; all if none is named")
    parser.add_argument("--frames", type=int, default=8, help="of each row")
    parser.add_argument("--calibrations", type=int, default=4, help="of each row, each with noise of its own")
    parser.add_argument("--seed", type=int, default=1000, help="of frames and calibrations")
    parser.add_argument("--n", type=int, nargs="*", help="particles a frame, of those that have a target")
    parser.add_argument("--method", choices=METHODS, default="joint")
    options = parser.parse_args()
    print(f"{options.method}, {options.frames} frames, {options.calibrations} calibrations, seed {options.seed}")
    for name in options.rows or [*ROWS, "planar"]:
        method = METHODS[options.method]
        if name == "planar":
            print(planar_beads(method), flush=True)
            continue
        row = ROWS[name]
        for n, target in row.targets.items():
            if options.n and n not in options.n:
                continue
            found = scored(row, n, method, options.frames, options.calibrations, options.seed)
            print(line(name, n, found, target), flush=True)


if __name__ == "__main__":
    main()
