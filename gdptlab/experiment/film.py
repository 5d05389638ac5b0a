"""The paper's experiment as its camera sees it: frames rendered when they are asked for, and the truth.

The frame shows the whole width of the channel, and the channel's middle lies on the middle row; the left edge of the
first column is x = 0. Depths are the same in the channel, in the frames' truth and in the calibration stack.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gdptlab._checks import choice, instance, pair, positive, whole
from gdptlab._checks import table as check_table
from gdptlab.experiment.camera import Camera
from gdptlab.experiment.channel import Focusing, Trajectories
from gdptlab.experiment.image_types import IMAGE_TYPES
from gdptlab.experiment.microscope import Microscope

BORDER_UM = 30.0
"""Distance, µm, beyond the frame up to which particles are rendered. Derived from the default microscope: the widest
image, 58 px at z = 50 µm, reaches 19 µm from its centre. With 0, a frame's edge would lack the light of particles just
outside; with more, particles are rendered that do not show."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """A film of particles in a channel: `len(film)`, `film[i]` and a loop give frames, which are not kept.

    A frame, noise included, depends on the fields and on its number only, not on what was rendered before.

    Attributes
    ----------
    trajectories : Trajectories
        Paths of the particles, duration, and length of the view.
    microscope : Microscope
    camera : Camera
    image_type : str
        A name in `image_types.IMAGE_TYPES`.
    frame_rate_hz : float
        Frame i is taken at t = i / frame_rate_hz (paper, section 4: 25).
    shape : (rows, columns)
        Of a frame (paper, section 3: 512 x 512).
    seed : int
        Of the camera's noise, 0 or more.

    Raises
    ------
    TypeError, ValueError
        If a field is not of its kind or out of range; if microscope and suspension differ in the diameter
        of the spheres; if the channel is deeper than the microscope's `depth_um` or wider than the frame;
        if the frame's length is not the trajectories' view; if there would be no frame.
    """

    trajectories: Trajectories
    microscope: Microscope = field(default_factory=Microscope)
    camera: Camera = field(default_factory=Camera)
    image_type: str = "fluorescent"
    frame_rate_hz: float = 25.0
    shape: tuple[int, int] = (512, 512)
    seed: int = 0

    def __post_init__(self) -> None:
        for name, kind in {"trajectories": Trajectories, "microscope": Microscope, "camera": Camera}.items():
            instance(name, getattr(self, name), kind)
        choice("image_type", self.image_type, IMAGE_TYPES)
        whole("seed", self.seed, 0, 2**63)
        object.__setattr__(self, "frame_rate_hz", positive("frame_rate_hz", self.frame_rate_hz))
        object.__setattr__(self, "shape", pair("shape", self.shape))
        if not self.trajectories.duration_s * self.frame_rate_hz < 2**31:
            raise ValueError(f"frame_rate_hz: got {self.frame_rate_hz:g}, allowed are 2**31 frames in all")
        if len(self) == 0:
            least = 1 / self.trajectories.duration_s
            raise ValueError(f"frame_rate_hz: got {self.frame_rate_hz:g}, allowed is {least:g} or more: one frame")
        channel, radius_um = self.trajectories.focusing.channel, self.trajectories.focusing.suspension.radius_um
        scope, (rows, columns) = self.microscope, self.shape
        if not np.isclose(scope.diameter_um, 2 * radius_um):
            raise ValueError(f"microscope: got diameter_um = {scope.diameter_um:g}, allowed is 2 x {radius_um:g}")
        if channel.height_um > scope.depth_um:
            needed = f"at least the channel's height_um = {channel.height_um:g}"
            raise ValueError(f"microscope: got depth_um = {scope.depth_um:g}, needed is {needed}")
        if channel.width_um > rows * scope.um_per_px:
            view = f"{rows} rows, which show {rows * scope.um_per_px:g} µm"
            raise ValueError(f"shape: got {view}, needed is at least the channel's width_um = {channel.width_um:g}")
        if not np.isclose(self.trajectories.view_length_um, columns * scope.um_per_px):
            view = f"{columns} columns, which show {columns * scope.um_per_px:g} µm"
            needed = f"view_length_um = {self.trajectories.view_length_um:g} of the trajectories"
            raise ValueError(f"shape: got {view}, needed is {needed}")

    @classmethod
    def seeded(
        cls,
        seed: int,
        *,
        focusing: Focusing | None = None,
        mean_in_view: float = 50.0,
        duration_s: float = 20.0,
        microscope: Microscope | None = None,
        camera: Camera | None = None,
        image_type: str = "fluorescent",
        frame_rate_hz: float = 25.0,
        shape: tuple[int, int] = (512, 512),
    ) -> Self:
        """Draw particles, and return their film; by default the paper's experiment.

        Films that differ in `image_type` only show the same particles, with the same read noise. Films that differ in
        `duration_s` only begin with the same frames: up to 1e-5 µm in x, one count in a pixel.

        Parameters
        ----------
        seed : int
            Of the particles' start and of the camera's noise.
        focusing : Focusing, optional
            Channel, acoustics and suspension.
        mean_in_view, duration_s
            As in `Trajectories.seeded`.
        microscope, camera, image_type, frame_rate_hz, shape
            As in the class.

        Raises
        ------
        TypeError, ValueError
            If an argument is out of range.
        """
        microscope = Microscope() if microscope is None else instance("microscope", microscope, Microscope)
        shape = pair("shape", shape)
        trajectories = Trajectories.seeded(
            Focusing() if focusing is None else focusing,
            whole("seed", seed, 0, 2**63),
            mean_in_view=mean_in_view,
            duration_s=duration_s,
            view_length_um=shape[1] * microscope.um_per_px,
            border_um=BORDER_UM,
        )
        return cls(
            trajectories=trajectories,
            microscope=microscope,
            camera=Camera() if camera is None else camera,
            image_type=image_type,
            frame_rate_hz=frame_rate_hz,
            shape=shape,
            seed=seed,
        )

    def __len__(self) -> int:
        """Return the number of frames."""
        return int(self.trajectories.duration_s * self.frame_rate_hz + 1e-9)  # of whole frames, but for rounding

    def __getitem__(self, frame: int) -> NDArray[np.uint16]:
        """Render one frame, array (rows, columns); negative numbers count from the end."""
        if not -len(self) <= frame < len(self):
            raise IndexError(f"frame: got {frame}, allowed are -{len(self)} to {len(self) - 1}")
        frame = range(len(self))[frame]
        seen = self.trajectories.positions(frame / self.frame_rate_hz, border_um=BORDER_UM)
        noise = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(0, frame)))
        particles = self._to_pixels(seen)
        return self.microscope.render(particles, self.shape, image_type=self.image_type, camera=self.camera, rng=noise)

    def __iter__(self) -> Iterator[NDArray[np.uint16]]:
        return (self[i] for i in range(len(self)))

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Times of the frames, (frames,)."""
        return np.arange(len(self)) / self.frame_rate_hz

    def truth(self) -> pd.DataFrame:
        """Return the positions of all particles whose centres lie in the frame.

        Returns
        -------
        DataFrame
            `frame`, `particle`, `x_px`, `y_px`, `z_um`, sorted by frame.
        """
        table = self._to_pixels(self.trajectories.table(self.times_s))
        return table[["frame", "particle", "x_px", "y_px", "z_um"]]

    def to_channel(self, table: pd.DataFrame) -> pd.DataFrame:
        """Add the channel's coordinates to a table of particles, measured or true.

        Parameters
        ----------
        table : DataFrame
            With columns `x_px`, `y_px`; `z_um` is the same in the channel.

        Returns
        -------
        DataFrame
            Copy with `x_channel_um`, downstream from the frame's left edge, and `y_channel_um`, from the channel's
            middle; of `x_std_px` and `y_std_px`, if there, `x_std_um` and `y_std_um`.

        Raises
        ------
        ValueError
            If a column is missing.
        """
        check_table("table", table, ["x_px", "y_px"])
        scale, middle = self.microscope.um_per_px, (self.shape[0] - 1) / 2
        stds = {f"{a}_std_um": table[f"{a}_std_px"] * scale for a in "xy" if f"{a}_std_px" in table}
        x_px, y_px = table["x_px"].to_numpy(), table["y_px"].to_numpy()
        return table.assign(x_channel_um=(x_px + 0.5) * scale, y_channel_um=(y_px - middle) * scale, **stds)

    def _to_pixels(self, table: pd.DataFrame) -> pd.DataFrame:
        """Add `x_px`, `y_px` to a table in the channel's coordinates."""
        scale, middle = self.microscope.um_per_px, (self.shape[0] - 1) / 2
        return table.assign(x_px=table["x_channel_um"] / scale - 0.5, y_px=table["y_channel_um"] / scale + middle)

    def stack(self, n: int = 51, size: int = 61, seed: int = 0) -> tuple[NDArray[np.uint16], NDArray[np.float64]]:
        """Return a calibration stack in this film's image type, from the channel's floor to its ceiling.

        It is recorded once, as in a laboratory: it is the same for films of any seed.

        Parameters
        ----------
        n : int
            Number of images, N of the paper (51 at most).
        size : int
            Rows and columns of an image, odd.
        seed : int
            Of the camera's noise in the stack.

        Returns
        -------
        stack : uint16 array (n, size, size)
        z_um : array (n,)
            From -height_um / 2 to height_um / 2.

        Raises
        ------
        TypeError, ValueError
            If an argument is out of range.
        """
        whole("n", n, 2, 10_000)
        if whole("size", size, 3, 10_001) % 2 == 0:
            raise ValueError(f"size: got {size}, allowed are odd numbers")
        half = self.trajectories.focusing.channel.height_um / 2
        z_um = np.linspace(-half, half, n)
        noise = np.random.default_rng(np.random.SeedSequence(whole("seed", seed, 0, 2**63), spawn_key=(1,)))
        return self.microscope.stack(z_um, size, image_type=self.image_type, camera=self.camera, rng=noise), z_um
