"""Files appear whole or not at all."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from gdptlab.files import cache_folder, read_images, written_whole


def test_content_arrives_under_the_name_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    with written_whole(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".tif"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_error_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "stack.tif"
    path.write_text("old")
    with pytest.raises(error), written_whole(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_two_writers_do_not_share_a_temporary_file(tmp_path: Path) -> None:
    path = tmp_path / "cache.npz"
    with written_whole(path) as first, written_whole(str(path)) as second:
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the last to finish


def test_no_folder_is_created(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="must lie in a folder that exists"):
        with written_whole(tmp_path / "absent" / "stack.tif"):
            pytest.fail("the block should not run")
    assert list(tmp_path.iterdir()) == []


def test_writing_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "stack.tif"):
        pass


# -------------------- reading images


@pytest.mark.parametrize("shape", [(9, 14), (1, 9, 14), (5, 9, 14)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_images_come_back_as_they_were(tmp_path, shape, dtype, compression):
    images = (np.random.default_rng(1).random(shape) * 200).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", images, compression=compression, photometric="minisblack")
    read = read_images(str(tmp_path / "a.tif"))
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, images.reshape(-1, 9, 14))


def test_no_such_image(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_images(tmp_path / "absent.tif")


@pytest.mark.parametrize("content", [b"", b"II*", b"not a tiff, though named so", bytes(1000)])
def test_not_a_tiff(tmp_path, content):
    path = tmp_path / "a.tif"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"^path: got 'a.tif', which cannot be read as a TIFF: "):
        read_images(path)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.99])
def test_truncated_tiff(tmp_path, compression, share):
    path = tmp_path / "a.tif"
    images = np.random.default_rng(1).integers(0, 4000, (6, 40, 50), np.uint16)
    tifffile.imwrite(path, images, compression=compression, photometric="minisblack")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        read_images(path)


@pytest.mark.parametrize("pages", [1, 3])
def test_colour_is_refused(tmp_path, pages):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((pages, 20, 30, 3), np.uint8), photometric="rgb")
    with pytest.raises(ValueError, match=r"^path: got 'a.tif' of shape .*, allowed are grey images of one size"):
        read_images(path)


def test_images_of_several_sizes_are_refused(tmp_path):
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        for n in (20, 21):
            file.write(np.zeros((n, 30), np.uint8), photometric="minisblack")
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        read_images(path)


# -------------------- the cache's folder


def test_cache_folder_is_the_one_of_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path / "a" / "b"))
    assert cache_folder() == tmp_path / "a" / "b"
    assert cache_folder().is_dir()


@pytest.mark.parametrize("value", [None, ""])
def test_cache_folder_without_environment_is_the_users(tmp_path, monkeypatch, value):
    monkeypatch.setattr("gdptlab.files.user_cache_path", lambda name, appauthor: tmp_path / name)
    monkeypatch.delenv("GDPTLAB_CACHE", raising=False)
    if value is not None:
        monkeypatch.setenv("GDPTLAB_CACHE", value)
    assert cache_folder() == tmp_path / "gdptlab"
    assert cache_folder().is_dir()
