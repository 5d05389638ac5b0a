"""Files that are no TIFFs, by their readers; those that are not installed are skipped, or stood in for."""

import sys
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from gdptlab.pipeline import open_images, open_scan
from gdptlab.pipeline.readers import PACKAGES

FILM = np.random.default_rng(1).integers(0, 250, (12, 40, 64), dtype=np.uint8)


def assert_same(images, expected) -> None:
    """All of them, some of them, in any order."""
    np.testing.assert_array_equal(np.asarray(images), expected)
    np.testing.assert_array_equal(images[3], expected[3])
    np.testing.assert_array_equal(np.asarray(images[[5, 1, 2, 7]]), expected[[5, 1, 2, 7]])
    np.testing.assert_array_equal(np.asarray(images[4:][1:3]), expected[5:7])


@pytest.mark.parametrize(("name", "codec", "form"), [("a.avi", "rawvideo", "gray"), ("b.avi", "ffv1", "gray16le")])
def test_grey_video(tmp_path, name, codec, form) -> None:
    av = pytest.importorskip("av")
    film = FILM if form == "gray" else FILM.astype(np.uint16) * 200
    written(av, tmp_path / name, film, codec, form)
    images = open_images(tmp_path / name)
    assert images.shape == film.shape and images.dtype == film.dtype and images.um_per_px is None
    assert_same(images, film)


def written(av, path, film, codec, form) -> None:
    """Write a video."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = *film.shape[1:], form
        for image in film:
            source = av.VideoFrame.from_ndarray(image, format=form if form.startswith("gray") else "gray")
            file.mux(stream.encode(source))
        file.mux(stream.encode())


def test_frames_of_a_compressed_video_are_found(tmp_path) -> None:
    """Also where a frame is told by its difference from others."""
    av = pytest.importorskip("av")
    film = np.broadcast_to(np.arange(20, 220, 5, dtype=np.uint8)[:, None, None], (40, 32, 48))
    written(av, tmp_path / "a.mp4", film, "mpeg4", "yuv420p")
    images = open_images(tmp_path / "a.mp4")
    levels = np.asarray(images).mean(axis=(1, 2))
    assert images.shape == film.shape and np.abs(np.diff(levels) - 5).mean() < 2
    for k in (31, 2, 17, 39, 0):
        assert images[k].mean() == levels[k]


@pytest.mark.parametrize("scenes", [1, 2])
def test_czi(tmp_path, scenes) -> None:
    czi = pytest.importorskip("pylibCZIrw.czi")
    with czi.create_czi(str(tmp_path / "a.czi")) as file:
        for scene in range(scenes):
            for k, image in enumerate(FILM):
                for c in range(2):
                    data = np.ascontiguousarray(image[..., None] // (1 + c) // (1 + scene))
                    file.write(data, plane={"T": 0, "Z": k, "C": c}, scene=scene, location=(100 * scene, 0))
        file.write_metadata("a", scale_x=0.325e-6, scale_y=0.325e-6)
    where = {} if scenes == 1 else {"position": 1}
    images = open_images(tmp_path / "a.czi", channel=1, **where)
    assert images.shape == FILM.shape and images.um_per_px == pytest.approx(0.325)
    assert_same(images, FILM // 2 // scenes)
    scan, z_um = open_scan(tmp_path / "a.czi", start_um=10, step_um=-2, channel=0, **where)
    np.testing.assert_array_equal(scan[0], FILM[-1] // scenes)
    assert z_um[0] == -12
    with pytest.raises(ValueError, match=r"^path: got 'a.czi' with 2 (channels|positions)"):
        open_images(tmp_path / "a.czi", position=0 if scenes == 2 else None)
    with pytest.raises(ValueError, match=r"^position: got 5"):
        open_images(tmp_path / "a.czi", channel=0, position=5)


def test_nd2(tmp_path, monkeypatch) -> None:
    """The reader's documented interface, of a file with times, positions and channels."""
    planes = np.random.default_rng(2).integers(0, 4000, (12, 2, 3, 20, 30), dtype=np.uint16)  # T P C Y X

    @contextmanager
    def nd2_file(path):
        yield SimpleNamespace(
            sizes={"T": 12, "P": 2, "C": 3, "Y": 20, "X": 30},
            is_rgb=False,
            dtype=np.dtype(np.uint16),
            voxel_size=lambda: SimpleNamespace(x=0.65, y=0.65, z=1.0),
            read_frame=lambda k: planes[k // 2, k % 2],
        )

    (tmp_path / "a.nd2").touch()
    monkeypatch.setitem(sys.modules, "nd2", module("nd2", ND2File=nd2_file))
    images = open_images(tmp_path / "a.nd2", channel=2, position=1)
    assert images.um_per_px == 0.65
    assert_same(images, planes[:, 1, 2])
    with pytest.raises(ValueError, match=r"^path: got 'a.nd2' with 2 positions"):
        open_images(tmp_path / "a.nd2", channel=0)
    with pytest.raises(ValueError, match=r"^position: got 2"):
        open_images(tmp_path / "a.nd2", channel=0, position=2)


def test_lif(tmp_path, monkeypatch) -> None:
    """The reader's documented interface, of a file with two images of which the second is a scan."""
    stack = np.random.default_rng(3).integers(0, 4000, (9, 20, 30), dtype=np.uint16)
    scan = SimpleNamespace(
        dims=("Z", "Y", "X"),
        sizes={"Z": 9, "Y": 20, "X": 30},
        dtype=np.dtype(np.uint16),
        coords={"X": np.arange(30) * 0.5e-6, "Y": np.arange(20) * 0.5e-6},
        frame=lambda Z: stack[Z],
    )

    @contextmanager
    def lif_file(path):
        yield SimpleNamespace(images=[scan, scan])

    (tmp_path / "a.lif").touch()
    monkeypatch.setitem(sys.modules, "liffile", module("liffile", LifFile=lif_file))
    images = open_images(tmp_path / "a.lif", position=1)
    assert images.um_per_px == pytest.approx(0.5)
    assert_same(images, stack)


def module(name, **names) -> ModuleType:
    """A module with these names."""
    made = ModuleType(name)
    made.__dict__.update(names)
    return made


@pytest.mark.parametrize("suffix", PACKAGES)
def test_what_is_missing_or_damaged_is_said(tmp_path, monkeypatch, suffix) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"no such file" * 10)
    with pytest.raises(ValueError, match=rf"^path: got 'a{suffix}', which cannot be read"):
        open_images(path)
    monkeypatch.setitem(sys.modules, PACKAGES[suffix], None)
    with pytest.raises(ValueError, match=f"pip install {PACKAGES[suffix]}"):
        open_images(path)
