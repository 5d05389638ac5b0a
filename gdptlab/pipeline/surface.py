"""Tilt and curvature of the focal surface, taken from depths that were measured by one calibration for the whole field.

The beads of a scan lie on one plane, the slide. Where the optics (or the slide) are tilted or curved they come into
focus at different depths of the scan, and particles are measured too high or too low by as much. (The joint fit can do
more, with the scan's patterns learned over the field: `Calibration.from_scan(..., field=True)`.)
"""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gdptlab import _checks as check
from gdptlab.calibration import Calibration, checked

FEWEST = (6, 10)
"""Least number of beads for a tilt, and for a curvature as well. Derived: twice the number of coefficients, or more, so
that the residual tells how well they are known."""


def flattened(table: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """Depths as they are above the plane of the scan's beads, where the focal surface is tilted or curved.

    To the depths at which the scan's beads come into focus (`offset_um` of the report) a plane is fitted, or with ten
    beads or more a plane and a term in the square of the distance from the middle of the beads. Beyond the beads it is
    an extrapolation.

    Parameters
    ----------
    table : DataFrame
        `x_px`, `y_px`, `z_um`, and `z_std_um` if it is known, as measured with this calibration in frames that lie as
        the scan does (`Preparation.restored`).
    calibration : Calibration
        From `from_scan`.

    Returns
    -------
    DataFrame
        Copy with `z_um` plus the height of the surface, and with the error of the fit in `z_std_um`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form; if the calibration knows of fewer than six beads, or they lie on a line.
    """
    check.positions("table", table, ("x_px", "y_px", "z_um"))
    check.table("table", table, {"z_std_um"} & set(table))
    report = checked(calibration).report
    beads = None if report is None else report.beads.query("verdict == 'used'")
    n = 0 if beads is None else len(beads)
    if n < FEWEST[0]:
        raise ValueError(f"calibration: got one that knows of {n} beads, needed are {FEWEST[0]}, from `from_scan`")
    terms = 4 if n >= FEWEST[1] else 3
    centre, scale = (
        beads[["x_px", "y_px"]].mean().to_numpy(),
        float(np.ptp(beads[["x_px", "y_px"]].to_numpy(), axis=0).max()),
    )
    columns = _terms(beads[["x_px", "y_px"]], centre, scale)[:, :terms]
    if np.linalg.cond(columns) > 1e3:
        raise ValueError("calibration: got one whose beads lie on a line, needed are some beside it")
    height = beads["offset_um"].to_numpy()
    coefficients = np.linalg.lstsq(columns, height, rcond=None)[0]
    variance = ((height - columns @ coefficients) ** 2).sum() / (n - terms)
    covariance = variance * np.linalg.inv(columns.T @ columns)
    at = _terms(table[["x_px", "y_px"]], centre, scale)[:, :terms]
    table = table.assign(z_um=table["z_um"] + at @ coefficients)
    if "z_std_um" in table:
        table["z_std_um"] = np.sqrt(table["z_std_um"] ** 2 + np.einsum("ni,ij,nj->n", at, covariance, at))
    return table


def _terms(position: ArrayLike, centre: NDArray, scale: float) -> NDArray[np.float64]:
    """Terms 1, x, y, r^2 at positions (n, 2); (n, 4)."""
    away = (np.asarray(position, dtype=float) - centre) / scale
    return np.column_stack([np.ones(len(away)), away, (away**2).sum(axis=1)])
