"""How the package is built: imports point down, what is shared has a public name, links lead somewhere."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

import gdptlab

ROOT = Path(__file__).parents[1]
PACKAGE = Path(gdptlab.__file__).parent

ALLOWED = {
    "core": set(),
    "experiment": {"core"},
    "fit": {"core"},
    "pipeline": {"core", "fit"},
    "tracking": {"core"},
    "live": {"core", "fit", "experiment"},
    "plots": {"core", "experiment", "fit", "pipeline", "tracking", "live"},
    "__main__": {"core", "experiment", "fit", "pipeline", "tracking", "live"},
}
"""What each room may import, besides itself."""

DOORS = {
    ("locate", "fit"),
    ("calibration", "fit"),
    ("calibration", "pipeline"),
    ("pipeline/measuring", "tracking"),
    ("pipeline/measuring", "plots"),
}
"""Modules that may open a room above, in a function: for the joint fit, calibrations from scans, tracks and pages."""

ONE_MODULE = {("tracking/acoustic_energy", "experiment")}
"""Modules that may import a room that the rest of their own may not."""


def room_of(module: str) -> str:
    """Room of ``gdptlab.room.module``; modules at the top are the core's."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in ALLOWED else "core"


def imports(tree: ast.Module) -> Iterator[tuple[str, list[str], bool]]:
    """Module, names, and whether the import stands at the top of the file, of all imports from the package."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "gdptlab":
            yield node.module, [a.name for a in node.names], node in tree.body
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "gdptlab":
                    yield alias.name, [], node in tree.body


def violations(name: str, source: str) -> list[str]:
    """What in a file, named by its path in the package without suffix, is against the plan."""
    here, found = room_of("gdptlab." + name.replace("/", ".")), []
    for module, names, at_top in imports(ast.parse(source)):
        rooms = {room_of(f"{module}.{n}" if module == "gdptlab" else module) for n in names or [""]}
        for room in rooms - {here} - ALLOWED[here]:
            door = (name, room) in DOORS and not at_top
            if not door and (name, room) not in ONE_MODULE:
                found.append(f"{name} imports {module}: from {here}, {room} is not below")
        private = [n for n in names if n.startswith("_") and not (PACKAGE / f"{n}.py").exists()]
        if private:
            found.append(f"{name} imports the private {', '.join(private)} of {module}")
    return found


MODULES = sorted(str(p.relative_to(PACKAGE).with_suffix("")) for p in PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("name", MODULES)
def test_imports_point_down(name: str) -> None:
    assert violations(name, (PACKAGE / f"{name}.py").read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("name", "source", "word"),
    [
        ("fit/solver", "from gdptlab.pipeline.images import open_images", "not below"),
        ("correlation", "from gdptlab.fit import joint", "not below"),
        ("locate", "from gdptlab.fit.joint import explained", "not below"),  # at the top of the file
        ("calibration", "def f():\n    from gdptlab.experiment import Microscope", "not below"),
        ("experiment/film", "from gdptlab import plots", "not below"),
        ("experiment/plain", "from gdptlab.locate import _table", "private"),
        ("plots/live", "from gdptlab.plots.experiment import _COLOUR", "private"),
    ],
)
def test_a_violation_is_seen(name: str, source: str, word: str) -> None:
    assert [word in text for text in violations(name, source)] == [True]


@pytest.mark.parametrize("name", [m for m in MODULES if not m.endswith(("__init__", "__main__"))])
def test_public_names_are_what_the_rooms_say(name: str) -> None:
    """What a room lists exists, and comes from a module of that room."""
    module = "gdptlab." + name.replace("/", ".")
    room = sys.modules.get(module.rpartition(".")[0]) or __import__(module.rpartition(".")[0], fromlist=["_"])
    for public in getattr(room, "__all__", []):
        assert getattr(room, public) is not None


def modules_after(code: str) -> set[str]:
    """Names of the modules that a fresh Python has loaded after some code."""
    code += "; import sys; print(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_import_is_quick_to_the_core() -> None:
    """Importing the package loads no room, and nothing that only a room needs."""
    loaded = modules_after("import gdptlab")
    rooms = {f"gdptlab.{room}" for room in ALLOWED}
    needless = {"matplotlib", "trackpy", "IPython", "scipy.stats", "skimage.registration"}
    assert loaded & (rooms | needless) == set()


def test_monitor_does_not_load_the_ray_tracer() -> None:
    loaded = modules_after("from gdptlab.live import MiddleThird, Monitor, Trigger")
    needless = {"gdptlab.experiment.microscope", "gdptlab.experiment.film", "matplotlib", "trackpy"}
    assert loaded & needless == set()


def links() -> Iterator[tuple[Path, str]]:
    """Relative links of README, of the notebooks' prose and of data/README.md, with the file they stand in."""
    for path in [ROOT / "README.md", ROOT / "data" / "README.md", *sorted((ROOT / "notebooks").glob("*.ipynb"))]:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".ipynb":
            cells = __import__("json").loads(text)["cells"]
            text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
        for target in re.findall(r"\]\(([^)#\s]+)", text):
            if not re.match(r"[a-z]+:", target):
                yield path, target


@pytest.mark.parametrize(("path", "target"), [pytest.param(p, t, id=f"{p.name}: {t}") for p, t in links()])
def test_links_lead_somewhere(path: Path, target: str) -> None:
    assert (path.parent / target).exists()


def test_files_named_in_code_style_exist() -> None:
    """Paths like `tests/benchmark_live.py` that README and .ci/run name."""
    for path in (ROOT / "README.md", ROOT / ".ci" / "run"):
        for name in re.findall(
            r"\b(?:tests|notebooks|data|figures|gdptlab)/[\w./-]+\.\w+", path.read_text(encoding="utf-8")
        ):
            assert (ROOT / name).exists(), name


def test_readme_has_the_verdict_of_the_claims() -> None:
    """README and notebook 06b cannot disagree."""
    claims = pd.read_csv(ROOT / "figures" / "claims.csv")
    count = claims["holds"].value_counts()
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"{count['yes']} yes, {count['partly']} partly, {count['no']} no" in readme
    assert claims["measured"].iloc[0] in readme
