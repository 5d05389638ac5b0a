"""Pictures in space: the still one and the one that turns show the same, and plotly accepts the description."""

import json
from base64 import b64decode

import numpy as np
import pandas as pd
import pytest

from gdptlab import plots
from gdptlab.experiment import Focusing, Trajectories

PLOTLY = "application/vnd.plotly.v1+json"


@pytest.fixture(scope="module")
def bundles() -> dict[str, dict]:
    """What a notebook gets of two particles and of some paths."""
    two = pd.DataFrame({"x_px": [10.0, 20], "y_px": [5.0, 40], "z_um": [-3.0, 12.34]})
    paths = Trajectories.seeded(Focusing(), 1, mean_in_view=5, duration_s=4.0)
    shown = {"particles": plots.turn_particles(two, 0.5, true=two[:1]), "paths": plots.turn_paths(paths)}
    return {name: picture._repr_mimebundle_() for name, picture in shown.items()}


def test_particles_stand_where_they_were_measured(bundles: dict[str, dict]) -> None:
    measured, true = bundles["particles"][PLOTLY]["data"]
    assert (measured["x"], measured["y"], measured["z"]) == ([5.0, 10.0], [2.5, 20.0], [-3.0, 12.3])
    assert (true["name"], true["x"]) == ("true", [5.0])
    assert bundles["particles"][PLOTLY]["layout"]["scene"]["yaxis"]["autorange"] == "reversed"  # as in the image


def test_paths_lie_in_the_field_of_view_and_are_not_joined(bundles: dict[str, dict]) -> None:
    (trace,) = bundles["paths"][PLOTLY]["data"]
    x = np.array(trace["x"], dtype=float)
    assert np.nanmin(x) >= 0 and np.isnan(x[26::27]).all() and np.isfinite(x).sum() > 20
    assert len(trace["x"]) == len(trace["y"]) == len(trace["z"]) == len(trace["line"]["color"])


@pytest.mark.parametrize("name", ["particles", "paths"])
def test_both_pictures_are_in_the_output(bundles: dict[str, dict], name: str) -> None:
    bundle = bundles[name]
    assert b64decode(bundle["image/png"]).startswith(b"\x89PNG")
    json.dumps(bundle[PLOTLY], allow_nan=False)
    plotly = pytest.importorskip("plotly.graph_objects")
    plotly.Figure(bundle[PLOTLY])  # refuses what it does not know
