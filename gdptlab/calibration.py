"""The look-up table of GDPT: images of one particle at known depths, and what correlation makes of them.

A calibration holds the recorded stack, a denoised copy of it that serves as templates, the subset of N_sub
templates that a frame is correlated with, and the map of expected C_m profiles (the paper's Figure 2a).
"""

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import median
from scipy.ndimage import shift as shift_image
from skimage.registration import phase_cross_correlation

from gdptlab.check import flag, positive, real_array, whole
from gdptlab.cores import on_one_core
from gdptlab.correlation import Correlator, normalised
from gdptlab.denoising import denoised, noise_level
from gdptlab.displacement import Displacement
from gdptlab.files import written_whole

if TYPE_CHECKING:
    from gdptlab.fit.model import PatternModel

Plan = TypeVar("Plan")

VERSION = 1
"""Of the file format of `Calibration.save`."""

LARGEST = 121
"""Rows and columns, px, beyond which no size is chosen for a template unasked."""

RECENTRED = 4
"""How often, at most, a particle is cut out anew about the centre that was found."""

STANDS_OUT = 4.0
"""Height of a particle, over the noise of a pixel, from which on it is one."""

LOSSLESS = 0.98
"""Templates that keep this correlation with themselves at half resolution are searched for there."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration stack, templates, subset and map. Made by `from_stack`, `from_scan` or `load`.

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
    """

    stack: NDArray[np.float32]
    z_um: NDArray[np.float64]
    subset: NDArray[np.int64]
    templates: NDArray[np.float32]
    _plans: dict = field(default_factory=dict, repr=False)

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
            Any real type; n odd, the particle in the middle.
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
        stack, z_um = real_array("stack", stack, 3), _depths(z_um)
        if stack.shape[1] != stack.shape[2] or stack.shape[1] % 2 == 0:
            raise ValueError(f"stack: got images of {stack.shape[1:]} px, allowed are square ones of odd size")
        if len(stack) < 3:
            raise ValueError(f"stack: got {len(stack)} images, allowed are 3 or more")
        if len(z_um) != len(stack):
            raise ValueError(f"z_um: got {len(z_um)} depths, needed is one for each of {len(stack)} images")
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
        return replace(self, subset=subset, _plans={})

    @classmethod
    @on_one_core
    def from_scan(
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

        The particle's centre is found in every slice as the point about which its image is symmetric (under
        half a turn), made smooth over z, and every slice is moved so that it lies on the middle pixel.

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
            place stands out of the noise.
        """
        scan, z_um = real_array("scan", scan, 3), _depths(z_um)
        if len(z_um) != len(scan):
            raise ValueError(f"z_um: got {len(z_um)} depths, needed is one for each of {len(scan)} frames")
        rows, columns = scan.shape[1:]
        x_px, y_px = positive("x_px", x_px, zero=True), positive("y_px", y_px, zero=True)
        if size is not None and (not isinstance(size, Integral) or isinstance(size, bool)):
            raise TypeError(f"size: got {size!r}, allowed are odd whole numbers")
        given = size
        for _ in range(RECENTRED):
            room = int(min(x_px, y_px, columns - 1 - x_px, rows - 1 - y_px)) - 2
            where = f"a particle at x_px = {x_px:g}, y_px = {y_px:g} in frames of {columns} by {rows} px"
            if room < 1:
                raise ValueError(f"x_px, y_px: got {where}, allowed is one 3 px or more inside")
            if given is None:
                half = min(room, LARGEST // 2)
                size = _image_size(_cut(scan, x_px, y_px, half))
                if size >= 2 * half - 1 and half == room:
                    raise ValueError(f"x_px, y_px: got {where}, whose images reach the border: allowed is one inside")
            if not 3 <= size <= 2 * room + 1 or size % 2 == 0:
                raise ValueError(f"size: got {size} px, allowed are odd sizes from 3 to {2 * room + 1} for {where}")
            stack, centres = _centred(scan, z_um, x_px, y_px, size, room)
            middle = centres.mean(axis=0)
            if np.abs(middle - (x_px, y_px)).max() <= 1:
                break
            x_px, y_px = np.clip(middle, 0, (columns - 1, rows - 1)).tolist()
        calibration = cls.from_stack(stack, z_um, n_sub=n_sub, n=n, denoise=denoise)
        calibration._must_stand_out(where)
        return calibration

    def _must_stand_out(self, where: str) -> None:
        """Refuse a stack in whose middle is no particle, or with a brighter one beside it."""
        noise, edge = max(noise_level(self.stack), 1e-9), self.size // 4
        smooth = denoised(self.stack)
        height = np.abs(smooth - np.median(smooth, axis=(1, 2), keepdims=True)).max(axis=0) / noise
        inside = height[edge : self.size - edge, edge : self.size - edge].max()
        if inside < max(STANDS_OUT, height.max() / 2):
            raise ValueError(
                f"x_px, y_px: got {where}, where nothing stands out by more than {inside:.1f} times the noise (beside "
                f"it, by {height.max():.1f}); needed is a particle, alone, that does so by {STANDS_OUT:g}"
            )

    def __len__(self) -> int:
        return len(self.stack)

    def __repr__(self) -> str:
        z_um, ratio = self.z_um, self.signal_to_noise()
        return (
            f"<Calibration: {len(self)} images of {self.size} by {self.size} px, z = {z_um[0]:g} to {z_um[-1]:g} µm, "
            f"{len(self.subset)} in the subset, signal / noise {ratio.min():.0f} to {ratio.max():.0f}>"
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

    def at_search_resolution(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Images (k, n, n) at the resolution of the search, the middle pixel again in the middle."""
        return _halved(images) if self.half_resolution else images

    @cached_property
    def model(self) -> "PatternModel":
        """Patterns, and what is known of their errors, as the joint fit takes them."""
        from gdptlab.fit.model import PatternModel  # the fit's room stands on this module

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
        """What finds the part of a pixel and of a step by which a particle is off a template."""
        return Displacement(self.templates, self.z_um)

    def correlator(self, shape: tuple[int, int]) -> Correlator:
        """Plan for correlating frames of this shape with the subset, kept for this thread's next frame."""
        return self.plan(Calibration._correlator, shape)

    def _correlator(self, shape: tuple[int, int]) -> Correlator:
        return Correlator(self.search_templates[self.subset], shape)

    def plan(self, make: Callable[[Self, tuple[int, int]], Plan], shape: tuple[int, int]) -> Plan:
        """`make(self, shape)`, a plan for frames of this shape, kept for this thread's next frame."""
        key = make, shape, threading.get_ident()
        if key not in self._plans:
            self._plans[key] = make(self, shape)
        return self._plans[key]

    def __getstate__(self) -> dict[str, object]:
        """Plans stay behind when a calibration is sent to another process."""
        return self.__dict__ | {"_plans": {}}

    def self_similarity(self) -> NDArray[np.float32]:
        """Correlation of every template with every other, (N, N): what can be told apart, and what cannot."""
        flat = self.templates.reshape(len(self), -1)
        return flat @ flat.T

    def signal_to_noise(self) -> NDArray[np.float64]:
        """Largest deviation of each denoised image from its median, over the noise of a pixel; (N,)."""
        smooth = denoised(self.stack)
        contrast = np.abs(smooth - np.median(smooth, axis=(1, 2), keepdims=True)).max(axis=(1, 2))
        noise = noise_level(self.stack)
        return contrast.astype(np.float64) / noise if noise > 0 else np.full(len(self), np.inf)

    def save(self, path: str | os.PathLike) -> None:
        """Write the calibration to a `.npz` file, whole or not at all."""
        path = Path(path)
        if path.suffix != ".npz":
            raise ValueError(f"path: got {path.name!r}, allowed are names that end in .npz")
        with written_whole(path) as temporary:
            np.savez_compressed(
                temporary,
                gdptlab_calibration=VERSION,
                stack=self.stack,
                z_um=self.z_um,
                subset=self.subset,
                templates=self.templates,
            )

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
        try:
            with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
                data = {name: file[name] for name in file.files}
        except FileNotFoundError:
            raise
        except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
            raise ValueError(
                f"path: got {Path(path).name!r}, which cannot be read as a calibration: {error}"
            ) from error
        version = data.pop("gdptlab_calibration", None)
        name = Path(path).name
        if not np.array_equal(version, VERSION) or set(data) != {"stack", "z_um", "subset", "templates"}:
            raise ValueError(f"path: got {name!r} of version {version}, allowed are calibrations of version {VERSION}")
        if not len(data["stack"]) == len(data["z_um"]) == len(data["templates"]) > data["subset"].max():
            raise ValueError(f"path: got {name!r}, whose parts do not fit each other")
        return cls(**data)


def checked(calibration: object) -> Calibration:
    """Return `calibration` if it is one.

    Raises
    ------
    TypeError
        If not.
    """
    if isinstance(calibration, Calibration):
        return calibration
    inner = isinstance(getattr(calibration, "calibration", None), Calibration)
    advice = "; that is its attribute `calibration`" if inner else ""
    raise TypeError(f"calibration: got a {type(calibration).__name__}, allowed is a Calibration{advice}")


def _middles(n: int, n_sub: int) -> NDArray[np.int64]:
    """Indices of the images in the middle of n_sub equal bins of n."""
    return ((np.arange(n_sub) + 0.5) * (n - 1) / n_sub + 0.5).astype(np.int64)  # to the nearest


def _depths(z_um: ArrayLike) -> NDArray[np.float64]:
    """Check depths, which need more digits than images have."""
    real_array("z_um", z_um, 1)
    z_um = np.array(z_um, dtype=np.float64)
    steps = np.diff(z_um)
    if not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError("z_um: got depths that turn or repeat, allowed are strictly increasing or decreasing")
    return z_um


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


def _even_centre(images: NDArray) -> NDArray:
    """Trim odd-sized images by a pixel all round if need be, so that their middle has an even index."""
    return images if (images.shape[-1] // 2) % 2 == 0 else images[:, 1:-1, 1:-1]


def _halved(images: NDArray) -> NDArray[np.float32]:
    """Images at half resolution, the middle pixel of the large on that of the small."""
    return np.stack([cv2.pyrDown(np.ascontiguousarray(image)) for image in _even_centre(images)])


def _cut(scan: NDArray, x_px: float, y_px: float, half: int) -> NDArray:
    x, y = round(x_px), round(y_px)
    return scan[:, y - half : y + half + 1, x - half : x + half + 1]


def _centred(
    scan: NDArray, z_um: NDArray, x_px: float, y_px: float, size: int, room: int
) -> tuple[NDArray, NDArray[np.float64]]:
    """Images (N, size, size) with the particle on the middle pixel, and where it was, (x, y) in (N, 2)."""
    centres = _centres(scan, z_um, x_px, y_px, size)
    margin = min(room + 2 - size // 2, 16)  # for the spline, and for a particle that drifts
    stack = [
        shift_image(image, (round(y_px) - y, round(x_px) - x), order=3, mode="nearest")
        for image, (x, y) in zip(_cut(scan, x_px, y_px, size // 2 + margin), centres, strict=True)
    ]
    return np.stack(stack)[:, margin:-margin, margin:-margin], centres


def _image_size(cut: NDArray, faint: float = 0.06) -> int:
    """Smallest odd size that holds the particle in nearly every slice of (N, 2 r + 1, 2 r + 1).

    An image ends where the median over a ring about the centre, which a neighbour does not move, first falls
    below the share `faint` of the brightest ring's.
    """
    half = cut.shape[-1] // 2
    y, x = np.indices(cut.shape[1:]) - half
    ring = np.rint(np.hypot(x, y)).astype(int)
    reach = []
    for image in denoised(cut):
        light = image - np.median(np.concatenate([image[[0, -1]].ravel(), image[:, [0, -1]].ravel()]))
        profile = np.abs(median(light, ring, np.arange(half + 1)))
        brightest = int(profile.argmax())
        faint_from = np.flatnonzero(profile[brightest:] < faint * profile[brightest])
        reach.append(brightest + int(faint_from[0]) if len(faint_from) else half)
    return 2 * int(np.percentile(reach, 95)) + 1


def _centres(scan: NDArray, z_um: NDArray, x_px: float, y_px: float, size: int) -> NDArray[np.float64]:
    """Centre (x, y) of the particle in every slice, (N, 2), px."""
    cut = levelled(_cut(scan, x_px, y_px, size // 2).astype(np.float32))
    smooth = denoised(cut)
    weight = np.einsum("kij,kij->k", smooth, smooth)  # of the particle's light, not of the noise
    if not weight.all():
        blank = np.flatnonzero(weight == 0).tolist()
        raise ValueError(f"scan: got frames without contrast around x_px, y_px at {blank}, allowed are frames with it")
    shifts = [
        # Half a turn about the middle moves an image that is symmetric about c by -2 c.
        phase_cross_correlation(image, image[::-1, ::-1], upsample_factor=100, normalization=None)[0] / 2
        for image in cut
    ]
    order = np.argsort(z_um)
    weight = weight[order]
    offsets = np.empty((len(scan), 2))
    for axis, values in enumerate(np.asarray(shifts).T):
        if len(scan) >= 5:
            values[order] = make_smoothing_spline(z_um[order], values[order], w=weight / weight.max())(z_um[order])
        offsets[:, axis] = values
    return offsets[:, ::-1] + (round(x_px), round(y_px))
