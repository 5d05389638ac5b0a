"""What is installed here, for bug reports."""

from __future__ import annotations

import platform
import re
from importlib import metadata

__all__ = ["versions"]


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Give the versions that a bug report needs.

    Returns
    -------
    dict of str to str
        The version of ``gdptlab``, of ``python``, the ``platform``, and then of each package that
        pyproject.toml names, optional ones included; ``'not installed'`` where there is none.

    Examples
    --------
    >>> for name, version in versions().items():  # doctest: +SKIP
    ...     print(f"{name:25s} {version}")
    """
    found = {
        "gdptlab": _version("gdptlab"),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    try:
        requirements = metadata.requires("gdptlab") or []
    except metadata.PackageNotFoundError:  # a checkout that was never installed
        requirements = []
    names = [re.match(r"[\w.-]+", requirement)[0] for requirement in requirements]
    return found | {name: _version(name) for name in names}
