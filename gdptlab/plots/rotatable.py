"""Pictures in space that a reader turns with the mouse in JupyterLab; elsewhere they are still pictures.

A notebook keeps both in one output. What the mouse turns is a description that plotly's extension of JupyterLab draws
(the format is stable and published), so nothing here imports plotly, and without it nothing is missing but the turning.
"""

from base64 import b64encode
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from gdptlab.experiment.channel import Trajectories
from gdptlab.plots.experiment import draw_paths
from gdptlab.plots.frames import particles_3d
from gdptlab.plots.style import styled

PLOTLY = "application/vnd.plotly.v1+json"
"""Type of a description that plotly draws."""

MOMENTS = 21
"""Points of each path that can be turned: enough to look smooth, few enough for a notebook to stay small."""


class Rotatable:
    """A picture in space, still and to be turned.

    Parameters
    ----------
    figure : Figure
        Shown where nothing can be turned: on the web, in print.
    traces : list of dict
        What plotly draws, in its own terms; lengths in µm.
    y_downwards : bool
        Whether y grows towards the viewer, as in an image.
    """

    def __init__(self, figure: Figure, traces: list[dict], *, y_downwards: bool = False) -> None:
        axes = {f"{a}axis": {"title": {"text": f"{a} (µm)"}} for a in "xyz"}
        if y_downwards:
            axes["yaxis"]["autorange"] = "reversed"
        camera = {"eye": {"x": 0.9, "y": -1.6, "z": 0.8}}
        scene = axes | {"aspectmode": "data", "camera": camera}
        layout = {"scene": scene, "height": 460, "margin": dict.fromkeys("lrtb", 0), "legend": {"x": 0, "y": 1}}
        self.figure, self.described = figure, {"data": traces, "layout": layout}

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, object]:
        """Both pictures, for a notebook, which shows the richest it can."""
        file = BytesIO()
        self.figure.savefig(file, format="png", dpi=80, metadata={"Software": None})
        still = b64encode(file.getvalue()).decode("ascii")
        return {PLOTLY: self.described, "image/png": still, "text/plain": "a picture in space (turns in JupyterLab)"}


def _packed(values: ArrayLike) -> dict[str, str]:
    """Numbers as plotly takes them in one string, (n,); NaN is a gap. As a list they would fill pages of a notebook."""
    packed = np.ravel(np.asarray(values, dtype="<f4")).tobytes()
    return {"dtype": "f4", "bdata": b64encode(packed).decode("ascii")}


def turn_particles(particles: pd.DataFrame, um_per_px: float, *, true: pd.DataFrame | None = None) -> Rotatable:
    """Show particles where they are in space, to scale; the mouse turns them.

    Parameters
    ----------
    particles, um_per_px, true
        As in `particles_3d`, which draws the still picture.

    Returns
    -------
    Rotatable
    """
    measured = {"color": _packed(particles["z_um"]), "colorscale": "Viridis", "size": 5}
    measured["colorbar"] = {"title": {"text": "z (µm)"}, "len": 0.6}
    marks = [("measured", particles, measured)]
    if true is not None:
        marks.append(("true", true, {"color": "#595959", "symbol": "x", "size": 3}))
    traces = []
    for name, table, marker in marks:
        x, y, z = table["x_px"] * um_per_px, table["y_px"] * um_per_px, table["z_um"]
        places = {"x": _packed(x), "y": _packed(y), "z": _packed(z)}
        traces.append({"type": "scatter3d", "mode": "markers", "name": name, "marker": marker} | places)
    still = particles_3d(particles, um_per_px, true=true)
    return Rotatable(still, traces, y_downwards=True)


def turn_paths(paths: Trajectories) -> Rotatable:
    """Show the paths of particles through the field of view, coloured by time; the mouse turns them.

    Parameters
    ----------
    paths : Trajectories

    Returns
    -------
    Rotatable
    """
    times = paths.duration_s * np.linspace(0, 1, MOMENTS) ** 2  # most of it happens early
    table = paths.table(times, border_um=np.inf)
    points = table[["x_channel_um", "y_channel_um", "z_um"]].to_numpy().reshape(len(times), -1, 3)
    seen = (points[..., :1] >= 0) & (points[..., :1] <= paths.view_length_um)
    points = np.where(seen, points, np.nan)
    gap = np.full((1, *points.shape[1:]), np.nan)
    x, y, z = np.concatenate([points, gap]).transpose(2, 1, 0)  # each (particles, times and a gap)
    colour = np.sqrt(np.broadcast_to([*times, 0.0], x.shape))
    ticks = [t for t in (0, 1, 2, 5, 10, 20, 50) if t <= paths.duration_s]
    bar = {"title": {"text": "t (s)"}, "tickvals": np.sqrt(ticks).round(3).tolist(), "ticktext": ticks, "len": 0.6}
    line = {"color": _packed(colour), "colorscale": "Plasma", "width": 3, "showscale": True, "colorbar": bar}
    places = {"x": _packed(x), "y": _packed(y), "z": _packed(z)}
    trace = {"type": "scatter3d", "mode": "lines", "line": line, "showlegend": False, "hoverinfo": "skip"} | places
    return Rotatable(_still(paths), [trace])


@styled
def _still(paths: Trajectories) -> Figure:
    """Draw the same without turning."""
    figure = plt.figure(figsize=(7, 3.6), layout="constrained")
    draw_paths(figure, paths)
    return figure
