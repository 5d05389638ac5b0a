"""The look-up table of GDPT: images of one particle at known depths, and what correlation makes of them.

A calibration holds the recorded stack, a denoised copy of it that serves as templates, the subset of N_sub
templates that a frame is correlated with, and the map of expected C_m profiles (the paper's Figure 2a).
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab._checks import choice, depth_factor, depths, flag, image_array, instance, positive, whole
from gdptlab._compiled import on_one_core
from gdptlab._plans import planned
from gdptlab.correlation import Correlator, normalised
from gdptlab.denoising import denoised
from gdptlab.preparation import Preparation, preparation
from gdptlab.refinement import Displacement

SIDES = ("near", "far")
"""Sides of focus: depths smaller, and larger, than that of the sharpest image."""

LOSSLESS = 0.98
"""Templates that keep this correlation with themselves at half resolution are searched for there."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration stack, templates, subset and map. Made by one of `from_...`, or `load`.

    Attributes
    ----------
    stack : float32 array (N, n, n)
        Images as recorded, the particle in the middle; n is odd.
    z_um : float64 array (N,)
        Their depths, increasing.
    subset : int array (n_sub,)
        Indices of the stack images that frames are correlated with.
    templates : float32 array (N, n, n)
        The stack, denoised, each image with mean 0 and norm 1.
    learned : PatternModel, optional
        Patterns that `from_scan` learned from all beads of a scan at once, which the joint fit then draws with.
    report : ScanReport or FilmReport, optional
        How `from_scan` or `from_film` came to this calibration.
    depth_factor : float
        Depth in the sample over travel of the stage that `z_um` contains (`with_depth_factor`); 1 if it is as given.
    camera : Preparation, optional
        Dark and flat image that the scan was corrected with, and with which `batch` corrects frames, too.
    """

    stack: NDArray[np.float32]
    z_um: NDArray[np.float64]
    subset: NDArray[np.int64]
    templates: NDArray[np.float32]
    learned: Any = None
    report: Any = None
    depth_factor: float = 1.0
    camera: Preparation | None = None

    @classmethod
    @on_one_core
    def from_stack(
        cls,
        stack: ArrayLike,
        z_um: ArrayLike,
        *,
        n_sub: int = 9,
        n: int | None = None,
        denoise: bool = True,
    ) -> Self:
        """Calibrate with a stack that is already cut around one particle.

        Parameters
        ----------
        stack : array (N, n, n)
            Any real type, the particle in the middle. If n is even, the first or the last row and column are left out,
            so that the pixel nearest to the centre of symmetry of the images is in the middle.
        z_um : array (N,)
            Depths, strictly increasing or decreasing.
        n_sub : int
            How many images frames are correlated with, N_sub of the paper: those in the middle of n_sub equal
            bins of the stack.
        n : int, optional
            Use only this many of the images, evenly spread from first to last (N of the paper's Figure 5).
        denoise : bool
            Replace the images by a smooth model of the stack (`denoised`) where they serve as templates. Noise
            in the templates pulls z towards the sharp, bright ones.

        Raises
        ------
        TypeError, ValueError
            If the stack or z_um are not of that form, hold NaN, or an image is constant; if n or n_sub is out
            of range.
        """
        stack, z_um = image_array("stack", stack, 3), depths("z_um", z_um)
        if stack.shape[1] != stack.shape[2] or stack.shape[1] < 3:
            raise ValueError(f"stack: got images of {stack.shape[1:]} px, allowed are square ones of 3 px or more")
        if len(stack) < 3:
            raise ValueError(f"stack: got {len(stack)} images, allowed are 3 or more")
        if len(z_um) != len(stack):
            raise ValueError(f"z_um: got {len(z_um)} depths, needed is one for each of {len(stack)} images")
        if stack.shape[1] % 2 == 0:
            stack = _odd(stack)
        constant = np.flatnonzero(np.ptp(stack, axis=(1, 2)) == 0)
        if len(constant):
            raise ValueError(f"stack: got constant images at {constant.tolist()}, allowed are images with contrast")
        n = len(stack) if n is None else whole("n", n, 3, len(stack))
        n_sub = whole("n_sub", n_sub, 2, n)
        order = np.argsort(z_um)[np.rint(np.linspace(0, len(stack) - 1, n)).astype(int)]
        stack, z_um = stack[order], z_um[order]
        templates = normalised(levelled(denoised(stack) if flag("denoise", denoise) else stack))
        return cls(stack, z_um, _middles(n, n_sub), templates)

    def with_subset(self, n_sub: int) -> Self:
        """Return the same calibration with another number of images that frames are correlated with.

        Parameters
        ----------
        n_sub : int
            As in `from_stack`, 2 to N.

        Raises
        ------
        TypeError, ValueError
            If it is no such number.
        """
        subset = _middles(len(self), whole("n_sub", n_sub, 2, len(self)))
        return replace(self, subset=subset)

    def with_depth_factor(self, factor: float | tuple[float, float]) -> Self:
        """Return the same calibration with depths in the sample, where `z_um` was the travel of the stage.

        When the stage moves by dz, the focus moves within the sample by the factor times dz, as light is refracted
        where it leaves the sample: n_sample / n_immersion for rays near the axis, 1.33 for water and a dry lens. (Rays
        at the rim of an aperture NA need more, sqrt((n_sample^2 - NA^2) / (n_immersion^2 - NA^2)). Above NA of about
        0.5 measure it: focus on the floor and on the ceiling of a channel of known height, filled as in the
        experiment; the factor is the height over the travel.)

        Parameters
        ----------
        factor : float or (n_immersion, n_sample)
            Depth over travel, as it was measured; or refractive indices of what is between lens and cover glass (air
            1, water 1.33, oil 1.52), and of the liquid about the particles.

        Raises
        ------
        TypeError, ValueError
            If it is neither, or not from 0.1 to 10.

        Examples
        --------
        >>> import numpy as np
        >>> stack = np.random.default_rng(1).normal(size=(3, 5, 5))
        >>> calibration = Calibration.from_stack(stack, [0, 1, 2], n_sub=2)
        >>> calibration.with_depth_factor((1.0, 1.33)).z_um
        array([0.  , 1.33, 2.66])
        """
        factor = depth_factor("factor", factor)
        ratio = factor / self.depth_factor
        changes: dict[str, Any] = {"z_um": self.z_um * ratio, "depth_factor": factor}
        if self.learned is not None:
            changes["learned"] = replace(
                self.learned,
                z_um=self.learned.z_um * ratio,
                own_error=self.learned.own_error * (1, 1, ratio),
                own_bias_um=self.learned.own_bias_um * ratio,
            )
        if self.report is not None:
            changes["report"] = self.report.scaled(ratio)
        return replace(self, **changes)

    def with_depth_error(self, std_um: float) -> Self:
        """Return the calibration with a further error of z, which is in every `z_std_um` measured with it.

        Parameters
        ----------
        std_um : float
            Standard deviation, at any depth: such as what frames that the calibration does not fit quite may stand for
            (`fit.mismatch_error_um`).

        Raises
        ------
        TypeError, ValueError
            If it is no number, or below 0.
        """
        own_error = np.hypot(self.model.own_error, (0, 0, positive("std_um", std_um, zero=True)))
        return replace(self, learned=replace(self.model, own_error=own_error))

    def one_side(self, side: str) -> Self:
        """Return the part of the calibration on one side of focus, where images of both sides look alike.

        Parameters
        ----------
        side : str
            "near": depths up to that of the sharpest image; "far": from there on.

        Raises
        ------
        ValueError
            If it is neither, or fewer than 3 images lie on that side.
        """
        return self._near if choice("side", side, SIDES) == "near" else self._far

    @cached_property
    def _near(self) -> Self:
        return self._part("near", slice(0, self._sharpest + 1))

    @cached_property
    def _far(self) -> Self:
        return self._part("far", slice(self._sharpest, len(self)))

    @property
    def _sharpest(self) -> int:
        """Index of the image whose light lies in the fewest pixels."""
        return int((self.templates.astype(np.float64) ** 4).sum(axis=(1, 2)).argmax())

    def _part(self, side: str, part: slice) -> Self:
        """Calibration with some of the images, if there are enough."""
        n = len(self.z_um[part])
        if n < 3:
            raise ValueError(f"side: got {side!r}, where the calibration has {n} images, allowed is a side with 3")
        changes = {name: getattr(self, name)[part] for name in ("stack", "z_um", "templates")}
        changes["subset"] = _middles(n, min(len(self.subset), n))
        if self.learned is not None:
            model = self.learned
            changes["learned"] = replace(
                model,
                patterns=model.patterns[:, part],
                modes=None if model.modes is None else model.modes[:, part],
                **{name: getattr(model, name)[part] for name in ("z_um", "pattern_error", "own_error", "own_bias_um")},
            )
        if self.report is not None:
            changes["report"] = self.report.part(part)
        return replace(self, **changes)

    @classmethod
    def from_bead(
        cls,
        scan: ArrayLike,
        z_um: ArrayLike,
        x_px: float,
        y_px: float,
        *,
        size: int | None = None,
        n_sub: int = 9,
        n: int | None = None,
        denoise: bool = True,
    ) -> Self:
        """Calibrate with one particle of a scan of full frames.

        The particle's centre is found in every slice as the point about which its image is symmetric under half a
        turn. The centres are made smooth over z, and every slice is moved so that the centre lies on the middle pixel.

        Parameters
        ----------
        scan : array (N, rows, columns)
            Frames at known depths; the particle should have no near neighbour.
        z_um : array (N,)
            Depths, strictly increasing or decreasing.
        x_px, y_px : float
            About where the particle is (to a few pixels), with x to the right and y down from the first pixel.
        size : int, optional
            Rows and columns of the templates, odd. Without it, the smallest that holds the widest image.
        n_sub, n, denoise
            As in `from_stack`.

        Raises
        ------
        TypeError, ValueError
            As `from_stack`; also if the particle is nearer to the border than half a template, or nothing at that
            position stands out of the noise.
        """
        from gdptlab.pipeline.bead_images import stack_of_bead

        stack, z_um = stack_of_bead(scan, z_um, x_px, y_px, size)
        return cls.from_stack(stack, z_um, n_sub=n_sub, n=n, denoise=denoise)

    @classmethod
    def from_scan(
        cls,
        scan: ArrayLike,
        z_um: ArrayLike,
        *,
        beads_px: ArrayLike | None = None,
        size: int | None = None,
        n_sub: int | None = None,
        field: bool = False,
        modes: int = 0,
        prepare: Preparation | None = None,
    ) -> Self:
        """Calibrate with a scan of full frames: beads, size of the templates and subset are found in the scan.

        Parameters
        ----------
        scan : array (N, rows, columns)
            Frames at known depths, of beads that come into focus together (on a plane).
        z_um : array (N,)
            Depths, strictly increasing or decreasing, µm.
        beads_px : array (n, 2), optional
            x and y of the beads to use, px, all of them; found if not given.
        size : int, optional
            Rows and columns of a template, odd. If not given, just enough for the widest image of the beads, or less
            if more beads of the scan, whose depths are known, are then found. With `beads_px`, `field` or `modes`, the
            former.
        n_sub : int, optional
            Images that frames are correlated with. If not given, as many as it takes for an image at any depth to be
            like one of them.
        field : bool
            For the joint fit: learn from all beads of the scan how images change over the field, and the focal surface.
            Frames must then have the shape of the scan.
        modes : int
            For the joint fit: learn from all beads of the scan in how many ways their images differ (by size, say), so
            that a particle may differ as they do. About eight beads are needed for each.
        prepare : Preparation, optional
            Its dark and flat image correct the scan. The calibration remembers them (`camera`). The rest of it is for
            films.

        Returns
        -------
        Calibration
            Its attribute `report` says which beads were used, what was chosen, and why.

        Raises
        ------
        TypeError, ValueError
            If an argument is not of that form, nothing in the scan changes with z, it is a film of particles that flow,
            or no bead can be used: the message says why not.
        """
        from gdptlab.pipeline.beads import averaged_beads

        camera = None if prepare is None else preparation(prepare).camera
        if camera is not None:
            scan = np.asarray(camera(scan))
        joint = flag("field", field) or whole("modes", modes, 0, 100) > 0
        calibration = averaged_beads(scan, z_um, beads_px=beads_px, size=size, n_sub=n_sub, smaller=not joint)
        calibration = replace(calibration, camera=camera)
        if not joint:
            return calibration
        from gdptlab.fit.learning import learned

        beads = calibration.report.beads[["x_px", "y_px"]].to_numpy()
        order = np.argsort(z_um)
        model, _ = learned(np.asarray(scan)[order], calibration.z_um, beads, size=size, field=field, modes=modes)
        return replace(calibration, learned=model)

    @classmethod
    def from_film(
        cls,
        frames: Sequence[ArrayLike],
        *,
        height_um: float,
        radius_um: float = 0.0,
        speed: Callable[[NDArray, NDArray, NDArray], ArrayLike] | None = None,
        reverse: bool = False,
        size: int | None = None,
        fitted: int = 50,
        prepare: Preparation | None = None,
    ) -> Self:
        """Calibrate without a scan, with a film of particles of one kind whose depths nobody knows.

        Images that stand alone are ordered along the curve on which they lie, as they differ by depth alone. Then all
        particles in some frames are measured, and their places on the curve become depths, from -height_um / 2 to
        height_um / 2 about the middle of the channel, by what is known:

        * Particles are evenly spread over the height (before a force acts on them). Frames must lie so far apart in
          time that the flow brings new particles. The error falls with the root of their number.
        * Or, with `speed`, the profile of the flow: particles are followed from a frame to the next, which must come so
          soon that they move by less than half a template. They need not be evenly spread.

        Which end is the near one no film tells: z increases towards the end with the wider images, unless `reverse`.

        Parameters
        ----------
        frames : sequence of arrays (rows, columns)
            A film that can be asked for any frame: an array, a list, `open_images`. The background must be level
            (`prepare`). 100 particles at least must stand alone somewhere.
        height_um : float
            Height of the channel, or of the layer that the particles fill.
        radius_um : float
            Distance that the centres of the particles keep from either wall.
        speed : callable, optional
            speed(x_px, y_px, z_um): how fast the flow is along x, in any unit; arrays (n,) in and out.
        reverse : bool
            Let z increase towards the end with the narrower images.
        size : int, optional
            Rows and columns of a template, odd; just enough for the widest image if not given.
        fitted : int
            Number of frames in which all particles are measured.
        prepare : Preparation, optional
            What is done to the frames first; its dark and flat image are remembered (`camera`).

        Returns
        -------
        Calibration
            Its attribute `report` says how the depths were found, and how far they are known; `z_std_um` of the joint
            fit contains the error of the depths.

        Raises
        ------
        TypeError, ValueError
            If an argument is not of that form, too few particles stand alone, or no depths follow.
        """
        from gdptlab.pipeline.without_stage import calibrated

        camera = None
        if prepare is not None:
            camera, frames = preparation(prepare).camera, preparation(prepare)(frames)
        made = calibrated(
            frames, height_um, radius_um=radius_um, speed=speed, reverse=reverse, size=size, fitted=fitted
        )
        return replace(made, camera=camera)

    @classmethod
    def from_labelled(
        cls, frames: ArrayLike, table: pd.DataFrame, *, size: int | None = None, n_sub: int | None = None
    ) -> Self:
        """Calibrate without a scan, with particles of known position and depth; some may overlap.

        Labels may come from a simulation, a second camera, particles on the floor and the ceiling, or from hand. All
        frames together are explained by one image for each depth, smooth in z, and an amplitude for each particle.
        Errors of x and y are corrected; depths are taken as they are. A sign of z that is wrong in all labels alike
        turns the calibration over, which no image can tell.

        Parameters
        ----------
        frames : array (F, rows, columns)
        table : DataFrame
            Columns `frame` (from 0; not needed if there is one frame), `x_px`, `y_px` (the first pixel's centre is
            (0, 0)) and `z_um`: nearly all particles of the frames.
        size : int, optional
            Rows and columns of the images, odd. If not given, enough for the widest.
        n_sub : int, optional
            As in `from_scan`.

        Returns
        -------
        Calibration

        Raises
        ------
        TypeError, ValueError
            If an argument is not of that form; if there are too few particles, or labels do not fit the images: the
            message says in which way, if another one fits.
        """
        from gdptlab.pipeline.labels import calibration_of_labels

        return calibration_of_labels(frames, table, size=size, n_sub=n_sub)

    @classmethod
    def from_tilt(
        cls,
        frames: ArrayLike,
        *,
        tilt_deg: float,
        um_per_px: float,
        axis: str = "x",
        size: int | None = None,
        n_sub: int | None = None,
    ) -> Self:
        """Calibrate without a stage, with beads on a slide that is tilted by a known angle.

        The beads' depths are a plane over the field, z = z_k + tan(tilt) um_per_px (x - x_middle) in frame k. How much
        higher one frame lies than the first is found from the images; z = 0 is the slide in the middle of the first
        frame. The tilt gives the scale of z: an error of 1 % in tan(tilt) is one in every depth. What no image tells:
        the sign of the tilt, which turns z over; a pattern that changes over the field along the axis, which is taken
        for its change with depth; a focal surface that is tilted or curved, which adds to the slide's plane.

        A warning says so if more than 5 % of the beads are measured more than 5 % of the depth off the plane, by the
        last calibration but one: then the axis is wrong, beads lie too close, or dirt was taken for beads.

        Parameters
        ----------
        frames : array (F, rows, columns)
            The slide, one frame or several, moved up or down between them by unknown steps such that each shares a
            third of its depths with those before.
        tilt_deg : float
            Angle of the slide, degrees, at most 60 either way; above 0 where depth increases along the axis.
        um_per_px : float
            Size of a pixel in the object plane, µm.
        axis : str
            "x" or "y": along which the slide rises.
        size, n_sub : int, optional
            As in `from_labelled`.

        Returns
        -------
        Calibration

        Raises
        ------
        TypeError, ValueError
            If an argument is not of that form, if too few beads stand alone, or if beads on this plane do not explain
            the frames.
        """
        from gdptlab.pipeline.tilt import calibration_of_tilt

        return calibration_of_tilt(frames, tilt_deg, axis, um_per_px, size=size, n_sub=n_sub)

    def __len__(self) -> int:
        return len(self.stack)

    def __repr__(self) -> str:
        z_um = self.z_um
        return (
            f"<Calibration: {len(self)} images of {self.size} by {self.size} px, z = {z_um[0]:g} to {z_um[-1]:g} µm, "
            f"{len(self.subset)} in the subset>"
        )

    @property
    def size(self) -> int:
        """Rows and columns of a template, px."""
        return self.stack.shape[-1]

    @cached_property
    def half_resolution(self) -> bool:
        """Whether particles can be searched for at half resolution without loss."""
        original = _even_centre(self.templates)
        m = original.shape[-1]
        restored = np.stack([cv2.pyrUp(half)[:m, :m] for half in _halved(self.templates)])
        kept = np.einsum("kij,kij->k", normalised(restored), normalised(original))
        return bool(kept.min() >= LOSSLESS)

    @cached_property
    def search_templates(self) -> NDArray[np.float32]:
        """Templates at the resolution of the search, (N, m, m), each with mean 0 and norm 1."""
        return normalised(_halved(self.templates)) if self.half_resolution else self.templates

    @cached_property
    def model(self) -> Any:
        """What the joint fit draws particles with: `learned`, or else a `fit.PatternModel` of this one particle."""
        if self.learned is not None:
            return self.learned
        from gdptlab.fit.model import PatternModel

        return PatternModel.from_calibration(self)

    @cached_property
    def expected(self) -> NDArray[np.float32]:
        """Map of expected C_m profiles, (N, n_sub): every stack image correlated with the subset (Figure 2a).

        Where an image meets itself the correlation is 1 whatever its noise, which no measured particle can
        match; the entry is replaced by a parabola through its neighbours along z.
        """
        images = levelled(self.stack)
        images = normalised(_halved(images) if self.half_resolution else images)
        map_ = np.einsum("nij,sij->ns", images, self.search_templates[self.subset]).astype(np.float32)
        for column, k in enumerate(self.subset):
            near = np.array([i for i in range(k - 2, k + 3) if i != k and 0 <= i < len(self)])
            if len(near) >= 3:
                z0 = self.z_um[k]
                map_[k, column] = np.polyfit(self.z_um[near] - z0, map_[near, column], 2)[-1]
        return np.minimum(map_, 1)

    @cached_property
    def displacement(self) -> Displacement:
        """Finds the part of a pixel and of a slice by which a particle is off a template."""
        return Displacement(self.templates, self.z_um)

    def correlator(self, shape: tuple[int, int]) -> Correlator:
        """Plan for correlating frames of this shape with the subset, kept for this thread's next frame."""
        return planned(self, _correlator, shape)

    def self_similarity(self) -> NDArray[np.float32]:
        """Correlation of every template with every other, (N, N): what can be told apart, and what cannot."""
        flat = self.templates.reshape(len(self), -1)
        return flat @ flat.T

    def save(self, path: str | os.PathLike) -> None:
        """Write the calibration, with the patterns learned from a whole scan, to a `.npz` file, whole or not at all.

        Raises
        ------
        ValueError
            If the name does not end in .npz.
        """
        from gdptlab.pipeline.calibration_file import write

        write(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Self:
        """Read a calibration that `save` wrote.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If it is damaged, of another version, or no calibration.
        """
        from gdptlab.pipeline.calibration_file import read

        return cls(**read(path))


def _correlator(calibration: Calibration, shape: tuple[int, int]) -> Correlator:
    """Plan for correlating frames of this shape with the calibration's subset."""
    return Correlator(calibration.search_templates[calibration.subset], shape)


def checked(calibration: object) -> Calibration:
    """Return `calibration` if it is one.

    Raises
    ------
    TypeError
        If not.
    """
    return instance("calibration", calibration, Calibration)


def _middles(n: int, n_sub: int) -> NDArray[np.int64]:
    """Indices of the images in the middle of n_sub equal bins of n."""
    return ((np.arange(n_sub) + 0.5) * (n - 1) / n_sub + 0.5).astype(np.int64)  # to the nearest


def levelled(images: NDArray) -> NDArray:
    """Subtract from each image the plane that fits it best.

    The product of a template without tilt with a window does not depend on a gradient of the window's
    background, so that uneven illumination moves neither x and y nor z.

    Parameters
    ----------
    images : array (..., n, n)

    Returns
    -------
    array (..., n, n)
    """
    n = images.shape[-1]
    ramp = (np.arange(n) - (n - 1) / 2).astype(images.dtype)
    unit = ramp / (n * (ramp**2).sum())
    down, across = (np.einsum(f"...ij,{axis}->...", images, unit)[..., None, None] for axis in "ij")
    return images - images.mean(axis=(-2, -1), keepdims=True) - down * ramp[:, None] - across * ramp


def _odd(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images (N, n, n) of even size without the row and the column that are farther from their centre of symmetry.

    An image that is symmetric under half a turn about c correlates best with the turned one when that is moved by
    2 c - (n - 1), which is where the product of its spectrum with itself has its maximum.
    """
    n = stack.shape[1]
    spectrum = np.fft.rfft2(levelled(stack), s=(2 * n, 2 * n))
    turned = np.fft.irfft2((spectrum**2).sum(axis=0))
    along = (turned.max(axis=1), turned.max(axis=0))  # 2 c, along rows and columns, is where these are largest
    down, right = (slice(1, None) if p[n:].max() > p[: n - 1].max() else slice(None, -1) for p in along)
    return np.ascontiguousarray(stack[:, down, right])


def _even_centre(images: NDArray) -> NDArray:
    """Trim odd-sized images by a pixel all round if need be, so that their middle has an even index."""
    return images if (images.shape[-1] // 2) % 2 == 0 else images[:, 1:-1, 1:-1]


def _halved(images: NDArray) -> NDArray[np.float32]:
    """Images at half resolution, the middle pixel of the large on that of the small."""
    return np.stack([cv2.pyrDown(np.ascontiguousarray(image)) for image in _even_centre(images)])
