"""Which of two depths, where all particles are known to lie on one level plane."""

import numpy as np
import pandas as pd

from gdptlab._checks import positions
from gdptlab._checks import table as check_table
from gdptlab.fit.joint import AMBIGUOUS

PLANE_UM = 1.0
"""Standard deviation, in um, of depths about the plane."""

DEEPEST_UM = 5000.0
"""Largest difference of depths, um. Convention: beyond the reach of any microscope."""


def decided_by_plane(table: pd.DataFrame) -> pd.DataFrame:
    """Choose between the two depths of each particle, when it is known that all lie on one level plane.

    The plane is where it makes the depths of all most likely; each particle then takes the one of its two depths that
    is nearer to it. Nothing else is drawn to the plane.

    Parameters
    ----------
    table : DataFrame
        Of one frame, from `Joint.table`.

    Returns
    -------
    DataFrame
        The same rows; where the other depth was taken, `z_um` and `z_other_um` are exchanged and `log_ratio` has
        the other sign. `ambiguous` stays: it says what the images alone can tell.

    Raises
    ------
    TypeError, ValueError
        If a column is missing, a depth is NaN or depths differ by more than 5 mm.
    """
    check_table("table", positions("table", table, ["z_um"]), ["z_other_um", "log_ratio"])
    depths = table[["z_um", "z_other_um"]].to_numpy(dtype=float, copy=True)
    depths[:, 1] = np.where(np.isfinite(depths[:, 1]), depths[:, 1], depths[:, 0])  # one depth only: it is both
    if not len(depths):
        return table.copy()
    if np.ptp(depths) > DEEPEST_UM:
        raise ValueError(
            f"table: got depths from {depths.min():g} to {depths.max():g} µm, allowed are 5 mm between them"
        )
    planes = np.arange(depths.min(), depths.max() + 0.1, 0.1)
    off = np.minimum((depths - planes[:, None, None]) ** 2 / PLANE_UM**2, 9) / 2
    off[:, :, 1] += np.clip(table["log_ratio"].to_numpy(), -AMBIGUOUS, AMBIGUOUS)
    plane = planes[off.min(axis=2).sum(axis=1).argmin()]
    swap = np.abs(depths[:, 1] - plane) < np.abs(depths[:, 0] - plane)
    table = table.copy()
    table["z_um"], table["z_other_um"] = (
        np.where(swap, table[other], table[own]) for own, other in (("z_um", "z_other_um"), ("z_other_um", "z_um"))
    )
    table["log_ratio"] = np.where(swap, -table["log_ratio"], table["log_ratio"])
    return table
