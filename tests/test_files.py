"""Files appear whole or not at all; what is cached is of these very sources."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import gdptlab
from gdptlab import _files
from gdptlab._files import (
    UNUSED_DAYS,
    cache_folder,
    keep_arrays,
    kept_arrays,
    sources_digest,
    sources_folder,
    written_whole,
)


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


def test_a_link_stays_and_the_file_behind_it_is_written(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    link, target = tmp_path / "stack.tif", tmp_path / "disk" / "images.tif"
    link.symlink_to(target)
    with written_whole(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and target.read_text() == "new"


def test_a_name_may_be_as_long_as_the_file_system_allows(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 246 + ".csv")
    with written_whole(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


# -------------------- the cache's folder


def test_cache_folder_is_the_one_of_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path / "a" / "b"))
    assert cache_folder() == tmp_path / "a" / "b"
    assert cache_folder("c").is_dir()


@pytest.mark.parametrize("value", [None, ""])
def test_cache_folder_without_environment_is_the_users(tmp_path, monkeypatch, value):
    monkeypatch.setattr("gdptlab._files.user_cache_path", lambda name, appauthor: tmp_path / name)
    monkeypatch.delenv("GDPTLAB_CACHE", raising=False)
    if value is not None:
        monkeypatch.setenv("GDPTLAB_CACHE", value)
    assert cache_folder() == tmp_path / "gdptlab"
    assert cache_folder().is_dir()


def test_a_tilde_in_the_environment_is_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.setenv("GDPTLAB_CACHE", "~/of gdptlab")
    assert cache_folder() == tmp_path / "of gdptlab"


def test_where_nothing_can_be_written_there_is_no_cache_folder(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path / "file" / "cache"))
    assert cache_folder() is None
    assert sources_folder.__wrapped__("tables") is None


def test_folders_of_other_sources_go_when_long_unused(tmp_path, monkeypatch):
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path))
    old, recent, other = (tmp_path / name for name in ("tables-0", "tables-1", "images-0"))
    for folder in (old, recent, other):
        folder.mkdir()
    long_ago = time.time() - (UNUSED_DAYS + 1) * 86400
    os.utime(old, (long_ago, long_ago))
    os.utime(other, (long_ago, long_ago))
    folder = sources_folder.__wrapped__("tables")
    assert folder == tmp_path / f"tables-{sources_digest()}"
    assert {path.name for path in tmp_path.iterdir()} == {folder.name, "tables-1", "images-0"}


HELPER = """
from gdptlab._compiled import inlined

@inlined
def factor(x):
    return {factor} * x
"""
USER = """
from gdptlab._compiled import compiled
from gdptlab._helper import factor

@compiled
def scaled(x):
    return factor(x)

if __name__ == "__main__":
    from gdptlab._user import scaled
    scaled(1.0)
    print(scaled(1.0), sum(scaled.stats.cache_hits.values()))
"""


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """A copy of what compiles and caches; returns a function that runs it with a factor in an inlined helper."""
    package = tmp_path / "gdptlab"
    package.mkdir()
    (package / "__init__.py").touch()
    for name in ("_compiled.py", "_files.py"):
        shutil.copy(Path(gdptlab.__file__).with_name(name), package)
    (package / "_user.py").write_text(USER)
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def run(factor: float) -> list[str]:
        (package / "_helper.py").write_text(HELPER.format(factor=factor))
        command = [sys.executable, "-m", "gdptlab._user"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()

    return run


def test_machine_code_is_kept_and_never_that_of_other_sources(copied):
    assert copied(3.0) == ["3.0", "0"]
    assert copied(3.0) == ["3.0", "1"]
    assert copied(5.0) == ["5.0", "0"]  # the helper stands in another file than the function that was kept


def test_without_a_cache_folder_code_is_compiled_each_time(copied, tmp_path, monkeypatch):
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path / "gdptlab" / "_user.py" / "cache"))
    assert copied(3.0) == ["3.0", "0"]
    assert not list((tmp_path / "gdptlab").rglob("*.nb?"))


def test_the_digest_changes_with_any_source(tmp_path, monkeypatch):
    monkeypatch.setattr(_files, "__file__", str(tmp_path / "_files.py"))
    (tmp_path / "room").mkdir()
    digests = []
    for text in ("a = 1", "a = 2"):
        (tmp_path / "room" / "module.py").write_text(text)
        digests.append(sources_digest.__wrapped__())
    assert digests[0] != digests[1] and digests[1] == sources_digest.__wrapped__()


# -------------------- arrays in the cache


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:-40], lambda data: b"\0" * len(data)])
def test_damaged_arrays_are_as_good_as_none(tmp_path, damage):
    path = tmp_path / "a.npz"
    assert kept_arrays(path) is None
    keep_arrays(path, {"a": np.arange(3)})
    assert kept_arrays(path)["a"].tolist() == [0, 1, 2]
    path.write_bytes(damage(path.read_bytes()))
    assert kept_arrays(path) is None


def test_arrays_that_cannot_be_kept_stop_nothing(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    keep_arrays(tmp_path / "a.npz", {"a": np.arange(3)})
    assert list(tmp_path.iterdir()) == []


def test_the_package_can_be_imported_where_nothing_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for name in ("GDPTLAB_CACHE", "HOME", "USERPROFILE", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "file" / "none"))
    monkeypatch.setenv("PYTHONPATH", str(Path(gdptlab.__file__).parents[1]))
    subprocess.run([sys.executable, "-c", "import gdptlab.fit.joint, gdptlab.correlation"], check=True)
