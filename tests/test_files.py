"""Files appear whole or not at all."""

from pathlib import Path

import pytest

from gdptlab._files import cache_folder, written_whole


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
    with pytest.raises(FileNotFoundError, match="path"):
        with written_whole(tmp_path / "absent" / "stack.tif"):
            pytest.fail("the block should not run")
    assert list(tmp_path.iterdir()) == []


def test_writing_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "stack.tif"):
        pass


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "link.csv").symlink_to(tmp_path / "other" / "file.csv")
    for text in ("new", "newer"):
        with written_whole(tmp_path / "link.csv") as temporary:
            temporary.write_text(text)
        assert (tmp_path / "link.csv").is_symlink() and (tmp_path / "other" / "file.csv").read_text() == text


def test_names_may_be_as_long_as_the_file_system_allows(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 246 + ".csv")
    with written_whole(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


# -------------------- the cache's folder


def test_cache_folder_is_the_one_of_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path / "a" / "b"))
    assert cache_folder() == tmp_path / "a" / "b"
    assert cache_folder().is_dir()


@pytest.mark.parametrize("value", [None, ""])
def test_cache_folder_without_environment_is_the_users(tmp_path, monkeypatch, value):
    monkeypatch.setattr("gdptlab._files.user_cache_path", lambda name, appauthor: tmp_path / name)
    monkeypatch.delenv("GDPTLAB_CACHE", raising=False)
    if value is not None:
        monkeypatch.setenv("GDPTLAB_CACHE", value)
    assert cache_folder() == tmp_path / "gdptlab"
    assert cache_folder().is_dir()


def test_a_tilde_is_the_users_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.setenv("GDPTLAB_CACHE", str(Path("~", "cache")))
    monkeypatch.chdir(tmp_path)
    assert cache_folder() == tmp_path / "cache"
