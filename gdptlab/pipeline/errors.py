"""Standard deviations of what correlation measures, from C_m.

Where the template fits, a window is W = a T + noise, and C_m^2 = a^2 / |W|^2. So C_m tells the noise over the
amplitude, and the least squares that give x, y and z between pixels and slices tell what such noise does to them.
"""

import numpy as np
import pandas as pd

from gdptlab import _checks as check
from gdptlab.calibration import Calibration, checked

LEAST = 0.2
"""Least fraction of what C_m lacks to 1 that is taken for noise. Chosen on Gaussian spots with steps of 2 and 4 µm, for
what the displacement takes to higher orders; with a signal of less than some hundred times the noise it does not
matter."""


def with_errors(table: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """Add standard deviations to a table that was measured by correlation.

    They are those that the residual of each particle implies, as if it were white noise, and the calibration's own
    error at its depth. Where particles overlap, the neighbour is part of the residual, and they grow; of errors
    that it makes in the same direction they cannot know. Nor of particles that differ from the calibration's: for a
    real bead the error is as stated, to a factor of 1.4, if it is measured by its own images, and several times larger
    by those of another bead.

    Parameters
    ----------
    table : DataFrame
        `x_px`, `y_px`, `z_um` and `cm`, as from `locate` or `batch` with this calibration, refined.
    calibration : Calibration

    Returns
    -------
    DataFrame
        With `x_std_px`, `y_std_px` and `z_std_um`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form.
    """
    check.positions("table", table, ("x_px", "y_px", "z_um", "cm"))
    z_um, cm = table["z_um"].to_numpy(dtype=float), table["cm"].to_numpy(dtype=float)
    if not ((cm > 1e-6) & (cm <= 1)).all():
        raise ValueError("table: got cm that is not above 1e-6 and at most 1, allowed is that of particles")
    depths = checked(calibration).z_um
    k = np.rint(np.interp(z_um, depths, np.arange(len(depths)))).astype(int)
    position = table[["y_px", "x_px"]].to_numpy(dtype=float)
    away = np.column_stack([position - np.rint(position), z_um - depths[k]])
    covariance = calibration.displacement.covariance[k]
    shift = np.einsum("ni,nij,nj->n", away, np.linalg.inv(covariance), away)
    left = 1 / cm**2 - 1  # energy of the residual over that of the particle
    noise = np.maximum(left - shift, LEAST * left) / (calibration.size**2 - calibration.displacement.unknowns)
    own = calibration.model.own_error[k][:, [1, 0, 2]]
    std = np.sqrt(noise[:, None] * np.diagonal(covariance, axis1=1, axis2=2) + own**2)
    return table.assign(x_std_px=std[:, 1], y_std_px=std[:, 0], z_std_um=std[:, 2])
