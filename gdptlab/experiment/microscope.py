"""How a microscope images a sphere at any depth: ray tracing, and frames of many particles.

The model is that of MicroSIG (M. Rossi, Meas. Sci. Technol. 31 (2020) 017003): points on the half of the
sphere that faces the lens send rays through a thin lens with two spherical faces. Both faces refract the rays
by Snell's law without approximation, so that spherical aberration draws its rings. A weak cylindrical lens
in front of the sensor adds the astigmatism that distinguishes above from below.

Depths are in µm, z = 0 at the middle of the measured volume, larger z farther from the lens.
"""

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.interpolate import make_lsq_spline
from scipy.stats import qmc

from gdptlab._checks import LARGEST, generator, instance, number, pair, positive, real_array, whole
from gdptlab._checks import table as check_table
from gdptlab._compiled import on_one_core
from gdptlab._files import cache_folder, keep_arrays, kept_arrays
from gdptlab.experiment.camera import Camera
from gdptlab.experiment.image_types import as_image_type

OVERSAMPLING = 4
"""Number of fine pixels per pixel, along x and y, of the traced images. Chosen on the default microscope: with 4, a
placed image correlates with one traced directly to 0.995 or more, and their centroids agree to 0.01 px
(tests/test_microscope.py). Its square multiplies the memory of a library; with 1, images between pixels would be
blurred by up to a pixel."""

MARGIN_UM = 5.0
"""Depth, µm, to which particles beyond either end of the measured volume can be rendered. Chosen: one default
diameter, so that tests can show a particle beyond the end of a calibration stack. 0 would allow none; each µm more
takes 2 % more memory."""

DIAMETER_RATIO = 1.1
"""Ratio of two neighbouring diameters of which images are traced; images of diameters between are interpolated
linearly. Chosen at four depths from -35 to 0 µm, half-way between two diameters: the RMS difference from an image
traced directly, over the RMS of that image, rises from 0.8-0.9 % (the noise of 2^20 rays alone) to 0.8-1.0 % with
1.1, 1.6-2.5 % with 1.2 and 2.6-4.7 % with 1.3. Nearer to 1, more diameters are traced, each for some 10 s."""

LIBRARIES_IN_MEMORY = 10
"""Number of traced libraries that stay in memory, some 90 MB each. Chosen: a frame of 50 particles whose diameters
differ by 10 % (standard deviation) needs 6 to 9 (20 draws). With fewer, each frame reads libraries from the disk again,
some seconds each; with more, rare diameters hold memory."""

LIBRARIES_ON_DISK = 16
"""Number of traced libraries that stay in the cache folder, 24 MB each; those unused for longest are removed. Chosen:
400 MB. With fewer than `LIBRARIES_IN_MEMORY`, each process would trace again."""


@dataclass(frozen=True, kw_only=True)
class Microscope:
    """A microscope with one camera, and the particles it looks at.

    The defaults give the paper's images: 5 µm spheres, a 10x/0.3 objective, astigmatism, 0.65 µm per pixel.
    The paper does not give focal lengths, refractive indices and counts; those are chosen here.

    Attributes
    ----------
    magnification : float
    na : float
        Numerical aperture, in air.
    focal_length_um : float
        Focal length of the lens that stands for the objective.
    n_medium, n_lens : float
        Refractive indices around and inside that lens.
    cylinder_um : float or None
        Focal length of the cylindrical lens, one third of the way from lens to sensor; None: no such lens.
    focus_um : float
        Depth of the lens' paraxial object plane, in the z of the measured volume. Rays far from the axis
        cross nearer to the lens, so the sharpest image lies below this plane.
    pixel_um : float
        Size of a camera pixel.
    depth_um : float
        Height of the measured volume: z runs from -depth_um / 2 to depth_um / 2.
    diameter_um : float
        Diameter of the spheres.
    counts : float
        Counts in the whole image of such a sphere at z = 0.

    Raises
    ------
    TypeError, ValueError
        For unknown names and impossible values.
    """

    magnification: float = 10.0
    na: float = 0.3
    focal_length_um: float = 350.0
    n_medium: float = 1.0
    n_lens: float = 1.5
    cylinder_um: float | None = 4000.0
    focus_um: float = 22.0
    pixel_um: float = 6.5
    depth_um: float = 100.0
    diameter_um: float = 5.0
    counts: float = 400_000.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "cylinder_um" or value is not None:
                check = number if field.name == "focus_um" else positive
                object.__setattr__(self, field.name, check(field.name, value))  # float32 would overflow in what follows
        if not self.na < 1:
            raise ValueError(f"na: got {self.na}, allowed is a number between 0 and 1 (a lens in air)")
        if not self.n_lens > self.n_medium:
            raise ValueError(f"n_lens: got {self.n_lens}, allowed is a number above n_medium = {self.n_medium}")
        nearest = -self.depth_um / 2 - MARGIN_UM - self.focus_um - self.diameter_um / 2
        if self.focal_length_um * (1 + 1 / self.magnification) + nearest <= 0:
            raise ValueError(f"depth_um: got {self.depth_um}, allowed is a volume that ends before the lens")
        if self._aperture_um >= self._face_radius_um:
            raise ValueError(f"na: got {self.na}, allowed is an aperture smaller than the lens' curvature")

    @property
    def um_per_px(self) -> float:
        """Size of a pixel in the object plane, µm."""
        return self.pixel_um / self.magnification

    @property
    def _aperture_um(self) -> float:
        """Radius of the lens' aperture, µm."""
        return float(np.tan(np.arcsin(self.na)) * (1 + 1 / self.magnification) * self.focal_length_um)

    @property
    def _face_radius_um(self) -> float:
        """Radius of curvature of the lens' faces, µm, by the lensmaker's equation."""
        return 2 * self.focal_length_um * (self.n_lens / self.n_medium - 1)

    def trace(self, z_um: float, points: NDArray, diameter_um: float | None = None) -> tuple[NDArray, NDArray, NDArray]:
        """Follow rays from a sphere on the optical axis to the sensor.

        Parameters
        ----------
        z_um : float
            Depth of the sphere's centre.
        points : array (n, 4)
            Evenly spread numbers in [0, 1): the first two choose the point on the sphere, the others that on the lens.
        diameter_um : float, optional
            Diameter of the sphere, if not the microscope's own.

        Returns
        -------
        x_px, y_px, weight : arrays (n,)
            Where each ray meets the sensor, from the axis, and how much light the ray carries.
        """
        z_um, radius = float(z_um), (diameter_um or self.diameter_um) / 2
        p = np.asarray(points, dtype=np.float32).T
        # Equal steps of height are equal areas of a sphere, equal steps of r² equal areas of a disc.
        height, azimuth = 1 - p[0], 2 * np.pi * p[1]
        ring = radius * np.sqrt(1 - height**2)
        on_lens, angle = self._aperture_um * np.sqrt(p[2]), 2 * np.pi * p[3]
        u, v = on_lens * np.cos(angle), on_lens * np.sin(angle)
        lens_distance = z_um - self.focus_um + self.focal_length_um * (1 / self.magnification + 1)
        dx, dy = u - ring * np.cos(azimuth), v - ring * np.sin(azimuth)
        dz = lens_distance - radius * height
        length = np.sqrt(dx**2 + dy**2 + dz**2)
        weight = dz / length**3  # solid angle of an equal piece of the lens
        dx, dy, dz = dx / length, dy / length, dz / length

        # Both faces at the same plane (zero thickness), the normals those of the two spheres.
        nx, ny = u / self._face_radius_um, v / self._face_radius_um
        nz = np.sqrt(1 - nx**2 - ny**2)
        for index_ratio, side in ((self.n_medium / self.n_lens, -1), (self.n_lens / self.n_medium, 1)):
            cosine = nx * dx + ny * dy + side * nz * dz
            along = side * np.sqrt(1 - index_ratio**2 * (1 - cosine**2)) - index_ratio * cosine
            dx, dy, dz = (index_ratio * d + along * n for d, n in ((dx, nx), (dy, ny), (dz, side * nz)))

        slope_x, slope_y = dx / dz, dy / dz
        sensor_distance = self.focal_length_um * (self.magnification + 1)
        x = u + slope_x * sensor_distance / 3
        if self.cylinder_um is not None:
            slope_x = slope_x - x / self.cylinder_um
        x = x + slope_x * sensor_distance * 2 / 3
        y = v + slope_y * sensor_distance
        return x / self.pixel_um, y / self.pixel_um, weight

    def trace_image(
        self,
        z_um: float,
        x_px: float,
        y_px: float,
        shape: tuple[int, int],
        rng: np.random.Generator | int,
        rays: int = 2**20,
    ) -> NDArray[np.float32]:
        """Trace the image of one particle directly: slow, with ray noise; the reference of `render`.

        Parameters
        ----------
        z_um : float
            Depth.
        x_px, y_px : float
            Position of the particle; the centre of the first pixel is (0, 0).
        shape : (rows, columns)
        rng : numpy Generator or int
            Shifts the evenly spread rays.
        rays : int
            Number of rays, rounded up to a power of two.

        Returns
        -------
        float32 array (rows, columns)
            Counts, scaled as in `render`.
        """
        x, y, weight = self.trace(z_um, _evenly_spread(rays, np.random.default_rng(rng)))
        edges = [np.arange(n + 1) - 0.5 for n in shape]
        image = np.histogram2d(y + y_px, x + x_px, bins=edges, weights=weight)[0]
        return (image * self.counts / (_light_at_zero(self) * len(weight))).astype(np.float32)

    def render(
        self,
        particles: pd.DataFrame,
        shape: tuple[int, int] = (512, 512),
        *,
        image_type: str = "fluorescent",
        camera: Camera | None = None,
        rng: np.random.Generator | int | None = None,
    ) -> NDArray[np.uint16]:
        """Render a frame of many particles, as the camera records it.

        Parameters
        ----------
        particles : DataFrame
            Columns `x_px`, `y_px` (the first pixel's centre is (0, 0)) and `z_um`; optionally `amplitude`
            (1 is normal) and `diameter_um`. The images of particles outside the frame are cut at its border.
        shape : (rows, columns)
        image_type : str or callable
            A name in `image_types.IMAGE_TYPES`, or a function that turns light into an image.
        camera : Camera, optional
        rng : numpy Generator or int, optional
            Source of the camera's noise; without it the frame has none.

        Returns
        -------
        uint16 array (rows, columns)

        Raises
        ------
        ValueError
            If a column is missing, a number is not finite, or a depth is outside the measured volume
            (with 5 µm to spare).
        """
        camera = Camera() if camera is None else instance("camera", camera, Camera)
        return camera.record(as_image_type(image_type)(self.light(particles, shape)), rng)

    @on_one_core
    def light(self, particles: pd.DataFrame, shape: tuple[int, int] = (512, 512)) -> NDArray[np.float32]:
        """Add up the light of many particles on the sensor, in counts, without camera (see `render`).

        The image of a particle depends on its depth and diameter only. So images are traced once for some diameters
        (`DIAMETER_RATIO` apart, the microscope's own among them) on a fine grid of depths and sub-pixel offsets
        (`Library`), and placed by linear interpolation. Their light grows with the square of the diameter.
        """
        shape = pair("shape", shape)
        positions, amplitude, relative = self._checked(particles)
        node = np.log(relative) / np.log(DIAMETER_RATIO)
        node = np.where(np.abs(node - np.rint(node)) < 1e-9, np.rint(node), node)
        lower = np.floor(node)
        below, above = DIAMETER_RATIO**lower, DIAMETER_RATIO ** (lower + 1)
        fraction = np.where(node > lower, (relative - below) / (above - below), 0.0)
        scale, frame = amplitude * relative**2, np.zeros(shape, dtype=np.float32)
        for k in np.unique([lower, np.ceil(node)]).tolist():
            library = _library(self, self.diameter_um * DIAMETER_RATIO**k)
            weight = np.where(k == lower, 1 - fraction, np.where(k == lower + 1, fraction, 0.0)) * scale
            for i in np.flatnonzero(weight):
                library.place(frame, *positions[i].tolist(), float(weight[i]))
        return frame

    def _checked(self, particles: pd.DataFrame) -> tuple[NDArray, NDArray, NDArray]:
        """Return positions (n, 3), amplitudes (n,) and diameters over the microscope's (n,), or refuse them."""
        check_table("particles", particles, ["x_px", "y_px", "z_um"])
        positions = particles[["x_px", "y_px", "z_um"]].to_numpy(dtype=float)
        defaults = {"amplitude": 1.0, "diameter_um": self.diameter_um}
        sizes = [
            particles[name].to_numpy(dtype=float) if name in particles else np.full(len(positions), value)
            for name, value in defaults.items()
        ]
        if not all((np.abs(values) <= LARGEST).all() for values in (positions, *sizes)):
            raise ValueError(f"particles: got numbers that are NaN or beyond {LARGEST:g}, allowed are numbers to there")
        if not all((values > 0).all() for values in sizes):
            raise ValueError("particles: got an amplitude or diameter_um of 0 or below, allowed is above 0")
        deepest, z_um = self.depth_um / 2 + MARGIN_UM, positions[:, 2]
        if len(z_um) and np.abs(z_um).max() > deepest:
            worst = z_um[np.abs(z_um).argmax()]
            raise ValueError(f"particles: got z_um = {worst:.6g}, allowed is from {-deepest} to {deepest}")
        return positions, sizes[0], sizes[1] / self.diameter_um

    def stack(
        self,
        z_um: NDArray,
        size: int = 61,
        *,
        image_type: str = "fluorescent",
        camera: Camera | None = None,
        rng: np.random.Generator | int | None = None,
    ) -> NDArray[np.uint16]:
        """Render a calibration stack: one particle in the middle of small frames, at each depth.

        Parameters
        ----------
        z_um : array (N,)
        size : int
            Rows and columns of each image, odd.
        image_type, camera, rng
            As in `render`.

        Returns
        -------
        uint16 array (N, size, size)
        """
        if whole("size", size, 1, 2**20) % 2 == 0:
            raise ValueError(f"size: got {size}, allowed are odd numbers")
        rng, z_um = None if rng is None else generator("rng", rng), real_array("z_um", z_um, 1)
        middle = (size - 1) / 2
        return np.stack(
            [
                self.render(
                    pd.DataFrame({"x_px": [middle], "y_px": [middle], "z_um": [z]}),
                    (size, size),
                    image_type=image_type,
                    camera=camera,
                    rng=rng,
                )
                for z in z_um
            ]
        )


class Library:
    """Images of one particle on a fine grid of depths and sub-pixel offsets.

    Each entry is the light on whole pixels of a particle k / OVERSAMPLING px right of and below a pixel's centre.
    So an image is placed as a weighted sum of eight entries: area binning of an image that is constant over each
    fine pixel, and linear interpolation between depths.

    Parameters
    ----------
    z_um : array (n,)
        Depths, evenly spaced.
    fine : array (n, m, m)
        Traced images with OVERSAMPLING fine pixels per pixel, m = OVERSAMPLING times an odd number.
    """

    def __init__(self, z_um: NDArray, fine: NDArray) -> None:
        self.z_um = z_um
        self.entries = [_shifted_bins(_trimmed(image)) for image in fine]

    def place(self, frame: NDArray[np.float32], x_px: float, y_px: float, z_um: float, scale: float) -> None:
        """Add the light of one particle to `frame`, times `scale`."""
        depth = (z_um - self.z_um[0]) / (self.z_um[1] - self.z_um[0])
        slice_, between = int(depth), depth - int(depth)
        for k, fraction in ((slice_, 1 - between), (slice_ + 1, between)):
            if fraction > 0:
                _place(frame, self.entries[k], x_px, y_px, fraction * scale)


def _place(frame: NDArray, entry: NDArray, x_px: float, y_px: float, scale: float) -> None:
    """Add to `frame` (rows, columns) the image at a position, interpolated in an entry (q + 1, q + 1, n, n)."""
    half = entry.shape[-1] // 2
    (column, kx, fx), (row, ky, fy) = (_fine_offset(p) for p in (x_px, y_px))
    top, left = row - half, column - half
    bottom, right = (min(start + entry.shape[-1], n) for start, n in zip((top, left), frame.shape, strict=True))
    if bottom <= 0 or right <= 0 or top >= frame.shape[0] or left >= frame.shape[1]:
        return
    cut = slice(max(-top, 0), bottom - top), slice(max(-left, 0), right - left)
    weights_x = np.array([1 - fx, fx], dtype=np.float32)
    upper, lower = (weights_x @ entry[j, kx : kx + 2].reshape(2, -1) for j in (ky, ky + 1))
    image = (np.float32(scale * (1 - fy)) * upper + np.float32(scale * fy) * lower).reshape(entry.shape[-2:])
    frame[max(top, 0) : bottom, max(left, 0) : right] += image[cut]


def _fine_offset(position: float) -> tuple[int, int, float]:
    """Split a position into whole pixel, fine pixel inside it, and the fraction of the next fine pixel."""
    whole_px = int(np.floor(position))
    fine = (position - whole_px) * OVERSAMPLING
    k = min(int(fine), OVERSAMPLING - 1)  # rounding makes fine = OVERSAMPLING just below a whole number
    return whole_px, k, fine - k


def _trimmed(fine: NDArray, kept: float = 0.9999) -> NDArray:
    """Cut a fine image (m, m) to the smallest square of whole pixels that holds the fraction `kept` of its light."""
    q, m = OVERSAMPLING, len(fine)
    distance = np.abs(np.arange(m) - (m - 1) / 2)
    ring = np.maximum(*np.meshgrid(distance, distance))
    light = np.cumsum(np.bincount(ring.astype(int).ravel(), weights=fine.ravel(), minlength=m // 2))
    needed = int(np.searchsorted(light, kept * light[-1])) + 1
    half_px = min(-(-(needed - q // 2) // q), (m // q) // 2)
    cut = m // 2 - (half_px * q + q // 2)
    return fine[cut : m - cut, cut : m - cut]


def _shifted_bins(fine: NDArray) -> NDArray[np.float32]:
    """Bin a fine image (m, m) into pixels at every fine offset along y and x: (q + 1, q + 1, n, n)."""
    q, n = OVERSAMPLING, len(fine) // OVERSAMPLING + 2
    sums = np.pad(np.cumsum(np.cumsum(fine, axis=0), axis=1), ((1, 0), (1, 0)))
    out = np.empty((q + 1, q + 1, n, n), dtype=np.float32)
    # Pixel i of the entry starts at fine pixel q (i - 1) - offset; the sums are constant past the image's ends.
    edges = [np.clip(q * (np.arange(n + 1) - 1) - k, 0, len(fine)) for k in range(q + 1)]
    for j in range(q + 1):
        for i in range(q + 1):
            out[j, i] = np.diff(np.diff(sums[np.ix_(edges[j], edges[i])], axis=0), axis=1)
    return out


def _evenly_spread(rays: int, rng: np.random.Generator) -> NDArray:
    """Return evenly spread points (n, 4), n the next power of two: a Sobol sequence, shifted at random."""
    return (_sobol(int(np.ceil(np.log2(rays)))) + rng.random(4, np.float32)) % 1


@lru_cache(maxsize=2)
def _sobol(log2_rays: int) -> NDArray[np.float32]:
    """Return the first 2**log2_rays points (n, 4) of the Sobol sequence."""
    return qmc.Sobol(4, scramble=False).random_base2(log2_rays).astype(np.float32)


@lru_cache(maxsize=16)
def _light_at_zero(microscope: Microscope) -> float:
    """Return the mean weight of a ray from z = 0, which `Microscope.counts` refers to."""
    return float(microscope.trace(0.0, _evenly_spread(2**16, np.random.default_rng(0)))[2].mean())


@lru_cache(maxsize=LIBRARIES_IN_MEMORY)
def _library(microscope: Microscope, diameter_um: float) -> Library:
    """Return the traced images of one microscope and diameter, from the cache folder if they were traced before."""
    key = hashlib.sha256(Path(__file__).read_bytes() + repr((microscope, diameter_um)).encode()).hexdigest()
    folder = cache_folder()
    path = folder and folder / f"particle-images-{key[:16]}.npz"
    kept = path and kept_arrays(path)
    if kept and set(kept) == {"z_um", "fine"}:
        os.utime(path)  # its time tells when it was last used
        return Library(kept["z_um"], kept["fine"].astype(np.float32))
    z_um, fine = _traced_library(microscope, diameter_um)
    fine = fine.astype(np.float16)
    if path:
        keep_arrays(path, {"z_um": z_um, "fine": fine})
        with suppress(OSError):  # another process may remove the same files
            files = sorted(folder.glob("particle-images-*.npz"), key=lambda file: file.stat().st_mtime)
            for unused in files[:-LIBRARIES_ON_DISK]:
                unused.unlink()
    return Library(z_um, fine.astype(np.float32))


def _traced_library(microscope: Microscope, diameter_um: float, log2_rays: int = 20) -> tuple[NDArray, NDArray]:
    """Trace images at every µm of depth, smooth them along z, and sample them every half µm: z (n,), images (n, m, m).

    The rays are shifted anew at each depth, so that their noise is independent between depths, and a spline with a
    knot every 2.5 µm removes most of the noise. The optics are symmetric in x and y, so that each ray serves four
    times.
    """
    end = microscope.depth_um / 2 + MARGIN_UM
    traced_z = np.linspace(-end, end, 2 * int(np.ceil(end)) + 1)
    seeds = np.random.SeedSequence(0).spawn(len(traced_z))
    points = _sobol(log2_rays)
    widest = [microscope.trace(z, points[: 2**14], diameter_um)[:2] for z in (-end, end)]
    half_px = int(np.ceil(np.abs(widest).max())) + 1
    n = OVERSAMPLING * half_px + OVERSAMPLING // 2

    def quadrant(z: float, seed: np.random.SeedSequence) -> NDArray[np.float32]:
        """Return the light at x, y ≥ 0 on fine pixels (n, n), all four quadrants folded onto it."""
        total = np.zeros(n * n)
        shift = np.random.default_rng(seed).random(4, np.float32)
        for part in np.array_split(points, 2 ** max(log2_rays - 16, 0)):  # that fit the CPU cache
            x, y, weight = microscope.trace(z, (part + shift) % 1, diameter_um)
            i, j = (np.minimum(np.abs(p) * OVERSAMPLING, n - 1).astype(np.int64) for p in (x, y))
            total += np.bincount(j * n + i, weights=weight, minlength=n * n)
        return total.reshape(n, n).astype(np.float32)

    quadrants = np.stack(
        Parallel(n_jobs=-1, prefer="threads")(delayed(quadrant)(z, s) for z, s in zip(traced_z, seeds, strict=True))
    )
    knots = np.linspace(-end, end, int(end / 1.25) + 1)[1:-1]
    knots = np.concatenate([[-end] * 4, knots, [end] * 4])
    z_um = np.linspace(-end, end, 4 * int(np.ceil(end)) + 1)
    smooth = make_lsq_spline(traced_z, quadrants.reshape(len(traced_z), -1), knots, k=3)(z_um)
    smooth = np.maximum(smooth, 0).reshape(-1, n, n)
    half = np.concatenate([smooth[:, ::-1], smooth], axis=1)
    fine = np.concatenate([half[:, :, ::-1], half], axis=2) / 4
    return z_um, fine * microscope.counts / (_light_at_zero(microscope) * len(points))
