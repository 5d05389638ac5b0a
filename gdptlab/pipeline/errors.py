"""Standard deviations of what correlation measures, from C_m.

Where the template fits, a window is W = a T + noise, and C_m^2 = a^2 / |W|^2. So C_m tells the noise over the
amplitude, and the least squares that give x, y and z between pixels and slices tell what such noise does to them.
"""

import numpy as np
import pandas as pd

from gdptlab import _checks as check
from gdptlab.calibration import Calibration, checked


def with_errors(table: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """Add standard deviations to a table that was measured by correlation.

    They are those that the residual of each particle implies, as if it were white noise, and the calibration's own
    error at its depth. Where particles overlap, the neighbour is part of the residual, and they grow; of errors
    that it makes in the same direction they cannot know.

    Parameters
    ----------
    table : DataFrame
        `z_um` and `cm`, as from `locate` or `batch` with this calibration, refined.
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
    check.table("table", table, ("z_um", "cm"))
    z_um, cm = table["z_um"].to_numpy(dtype=float), table["cm"].to_numpy(dtype=float)
    if not ((cm > 0) & (cm <= 1)).all():
        raise ValueError("table: got cm that is not above 0 and at most 1, allowed is that of particles")
    slices = np.interp(z_um, checked(calibration).z_um, np.arange(len(calibration)))
    k = np.rint(slices).astype(int)
    displacement = calibration.displacement
    left = 1 / cm**2 - 1  # energy of the residual over that of the particle
    noise = np.sqrt(left / (calibration.size**2 - displacement.unknowns))
    std = np.hypot(displacement.gain[k] * noise[:, None], calibration.model.own_error[k][:, [1, 0, 2]])
    return table.assign(x_std_px=std[:, 1], y_std_px=std[:, 0], z_std_um=std[:, 2])
