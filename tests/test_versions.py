"""The versions for bug reports."""

import re
import tomllib
from importlib import metadata
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from gdptlab._versions import versions


def test_names_every_direct_dependency() -> None:
    with (Path(__file__).parents[1] / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    requirements = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = [re.split(r"[\[<>=~]", requirement)[0] for requirement in requirements]
    found = versions()
    assert list(found) == ["gdptlab", "python", "platform", *names]
    assert found["gdptlab"] == project["version"]
    assert found["numpy"] == np.__version__
    assert all(type(version) is str and version for version in found.values())


def test_says_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    monkeypatch.setattr(metadata, "requires", absent)
    found = versions()
    assert list(found) == ["gdptlab", "python", "platform"]
    assert found["gdptlab"] == "not installed"
