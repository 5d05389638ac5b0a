"""What is installed here, for bug reports."""

from __future__ import annotations

import hashlib
import platform
import re
from functools import cache
from importlib import metadata
from pathlib import Path

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


@cache
def source_hash() -> str:
    """Hexadecimal SHA-256 of all sources of the package: what it computes may change with any of them."""
    folder, digest = Path(__file__).parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
