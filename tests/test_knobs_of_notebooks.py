"""Every notebook runs to its end with other settings in its parameters cell: what a reader does first.

The cells are executed in this process, which saves a kernel for each run; settings of size are small, for time.
"""

import linecache
import os
import sys
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import nbformat
import pytest
from conftest import THOROUGH
from IPython.display import display

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

SMALL = {
    "01": {"rays": 2**13, "every": 2},
    "02": {"n_frames": 1, "n_sub_tried": (3, 7)},
    "03": {"n_frames": 1, "amplitudes": (80, 1280), "periods_px": (512, 122), "seeds": (3,)},
    "04": {"population": 4000, "sizes_px": (31,), "taus_s": (0.2, 1), "phases": 2, "pictures": 2, "duration_s": 8.0},
    "05": {"densities": (25.0,), "sizes_px": (31,), "n_films_last": 1, "n_films": 1, "phases": 1, "watched_s": 3.0},
    "06": {"watched_s": 3.0, "phases": 1},
    "06b": {"n_films_accuracy": 1, "until_s": 0.6, "phases": 1},
    "07": {
        "n_subs": (4, 9),
        "counts": (10,),
        "sizes_px": (31,),
        "frames_px": (256,),
        "frames_opencv_px": (256,),
        "frames_scikit_px": (256,),
    }
    | {"rounds": 1, "film_s": 0.4, "processes": (1,), "point_s": 0.01},
    "08": {
        "counts": (10, 50),
        "n_frames": 1,
        "n_types": 1,
        "n_spread": 1,
        "spreads": (0.0, 0.6),
        "spread_counts": (50,),
    },
    "08b": {"counts": (50,), "n_frames": 1, "n_isolated": 1, "film_s": 4.0, "n_films": 1, "every": 25},
    "09": {"n_others": 1, "n_jobs": 1, "modes": 0},
    "10": {"n_beads": 2, "n_frames": 2, "crowds": (25,), "noises": (38.0,), "n_crowded": 2, "step_um": 4.0},
    "11": {"duration_s": 3.0, "factors": (1,), "n_films": 3, "n_measured": 1, "measured_s": 2.0, "n_jobs": 1},
    "12": {"live_s": 1.0, "n_again": 2, "n_loops": 8},
    "13": {"size": 45, "film_s": 0.2},
    "14": {"n_frames": 100, "checked": 1, "every": 57, "n_tests": 1, "n_beads": 25, "steps_um": (0.0, 4.0)},
}
"""Settings of size, by the number of the notebook."""

LONG = {"09", "14"}
"""Numbers of the notebooks that take more than 15 s of processor time with the settings `SMALL`: at least 40 s each."""

CHANGED = [
    ("00", {"threshold": 0.7, "n_sub": 5}),
    ("00", {"image_type": "disturbed", "frame_number": 2}),
    ("00", {"image_type": "brightfield", "n_sub": 14, "threshold": 0.35}),
    ("01", {"read_noise": 100.0}),
    ("01", {"step_um": 5.0, "electrons_per_count": 1.0}),
    ("01", {"step_um": 4.0, "read_noise": 5.0, "electrons_per_count": 0.05}),
    ("02", {"n_sub": 4, "threshold": 0.6}),
    ("02", {"n_sub": 20, "followed": 0, "frame_number": 1}),
    ("02", {"seed": 8, "threshold": 0.4, "followed": 30, "frame_number": 2}),
    ("03", {"amplitude": 0.0, "n_sub": 5}),
    ("03", {"amplitude": 1500.0, "threshold": 0.7, "n_frames": 2}),
    ("03", {"period_px": (122.0, 200.0), "seeds": (4, 5)}),
    ("04", {"E_ac": 6.0, "seed": 3}),
    ("04", {"Q": 4.0, "two_half_waves": True}),
    ("04", {"E_ac": 0.5, "tau_s": 0.3, "threshold": 0.7}),
    ("05", {"n": 6, "n_sub": 4, "refine": False, "E_ac": 3.0}),
    ("05", {"mean_in_view": 50.0, "seed": 5, "tau_s": 0.3, "threshold": 0.6}),
    ("05", {"Q": 2.0, "two_half_waves": True, "n_sub": 6}),
    ("06", {"n": 11, "n_sub": 4, "E_ac": 3.0}),
    ("06", {"seed": 7, "threshold": 0.6, "refine": False}),
    ("06", {"Q": 2.0, "two_half_waves": True, "mean_in_view": 40.0}),
    ("06b", {"seed": 5}),
    ("06b", {"densities": (10.0, 60.0)}),
    ("06b", {"until_s": 1.0, "every": 10}),
    ("07", {"n_sub": 6, "count": 30, "mean_in_view": 50.0}),
    ("08", {"count": 60, "count_types": 50, "seed": 9}),
    ("08b", {"mean_in_view": 50.0, "seed": 9}),
    ("09", {"n_sub": 7, "threshold": 0.6}),
    ("10", {"noise": 60.0, "seed": 5}),
    ("11", {"E_ac": 2.4, "mean_in_view": 30.0, "crowd_in_view": 60.0}),
    ("11", {"duration_s": 1.0, "seed": 7}),
    ("12", {"live_in_view": 25.0, "n_sub": 6, "level": 0.85, "tau_s": 0.12}),
    ("13", {"threshold": 0.6, "method": "correlation", "frame_number": 0}),
    ("14", {"image_type": "brightfield", "unequal": 0.2, "mean_in_view": 40.0}),
]


def execute(path: Path, changed: dict[str, object]) -> None:
    """Execute the code cells of a notebook, with other values right after its parameters cell."""
    module = ModuleType("changed_notebook")
    module.__dict__["display"] = display  # a kernel has it without an import
    sys.modules[module.__name__] = module
    try:
        for number, cell in enumerate(nbformat.read(path, as_version=4).cells):
            if cell.cell_type != "code":
                continue
            name = f"<{path.stem}, cell {number}>"
            linecache.cache[name] = len(cell.source), None, cell.source.splitlines(keepends=True), name
            exec(compile(cell.source, name, "exec"), module.__dict__)
            if "parameters" in cell.metadata.get("tags", []):
                unknown = set(changed) - set(module.__dict__)
                assert not unknown, f"{path.stem} has no knob {unknown}"
                module.__dict__.update(changed)
            plt.close("all")
    finally:
        del sys.modules[module.__name__]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of widgets without a kernel
@pytest.mark.parametrize(("number", "changed"), CHANGED, ids=lambda value: value if isinstance(value, str) else "")
def test_a_changed_notebook_runs_to_its_end(
    number: str, changed: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if number in LONG and not THOROUGH:
        pytest.skip("takes minutes: GDPTLAB_THOROUGH=1 pytest tests/test_knobs_of_notebooks.py")
    if number == "09" and not os.environ.get("GDPTLAB_DATA"):
        pytest.skip("needs the images of another group")
    if not THOROUGH:
        monkeypatch.delenv("GDPTLAB_DATA", raising=False)  # the parts on other people's images take long
    (path,) = NOTEBOOKS.glob(f"{number}-*.ipynb")
    monkeypatch.chdir(NOTEBOOKS)
    monkeypatch.delenv("GDPTLAB_SAVE", raising=False)
    monkeypatch.setattr("gdptlab.plots.style.FIGURES", tmp_path)  # nothing is written into the repository
    execute(path, SMALL.get(number, {}) | changed)
