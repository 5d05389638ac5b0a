"""Pictures in space: the still one and the one that turns show the same, and plotly accepts the description."""

import json
from base64 import b64decode

import numpy as np
import pandas as pd
import pytest

from gdptlab import plots
from gdptlab.experiment import Focusing, Trajectories
from gdptlab.plots.rotatable import MOMENTS

PLOTLY = "application/vnd.plotly.v1+json"


@pytest.fixture(scope="module")
def bundles() -> dict[str, dict]:
    """What a notebook gets of two particles and of some paths."""
    two = pd.DataFrame({"x_px": [10.0, 20], "y_px": [5.0, 40], "z_um": [-3.0, 12.34]})
    paths = Trajectories.seeded(Focusing(), 1, mean_in_view=5, duration_s=4.0)
    shown = {"particles": plots.turn_particles(two, 0.5, true=two[:1]), "paths": plots.turn_paths(paths)}
    return {name: picture._repr_mimebundle_() for name, picture in shown.items()}


def unpacked(part: dict[str, str]) -> np.ndarray:
    """Numbers of a packed array."""
    return np.frombuffer(b64decode(part["bdata"]), dtype="<" + part["dtype"])


def test_particles_stand_where_they_were_measured(bundles: dict[str, dict]) -> None:
    measured, true = bundles["particles"][PLOTLY]["data"]
    for axis, expected in {"x": [5, 10], "y": [2.5, 20], "z": [-3, 12.34]}.items():
        np.testing.assert_allclose(unpacked(measured[axis]), expected, rtol=1e-6)
    assert true["name"] == "true" and unpacked(true["x"]).tolist() == [5.0]
    assert bundles["particles"][PLOTLY]["layout"]["scene"]["yaxis"]["autorange"] == "reversed"  # as in the image


def test_paths_lie_in_the_field_of_view_and_are_not_joined(bundles: dict[str, dict]) -> None:
    (trace,) = bundles["paths"][PLOTLY]["data"]
    x, y, z, colour = (unpacked(part) for part in (trace["x"], trace["y"], trace["z"], trace["line"]["color"]))
    assert np.nanmin(x) >= 0 and np.isnan(x[MOMENTS :: MOMENTS + 1]).all() and np.isfinite(x).sum() > 20
    assert len(x) == len(y) == len(z) == len(colour)


@pytest.mark.parametrize("name", ["particles", "paths"])
def test_both_pictures_are_in_the_output(bundles: dict[str, dict], name: str) -> None:
    bundle = bundles[name]
    assert b64decode(bundle["image/png"]).startswith(b"\x89PNG")
    json.dumps(bundle[PLOTLY], allow_nan=False)
    plotly = pytest.importorskip("plotly.graph_objects")
    plotly.Figure(bundle[PLOTLY])  # refuses what it does not know
