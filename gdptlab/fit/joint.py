"""A frame, or the frame after one, explained by all of its particles at once: the table of the joint fit."""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from gdptlab._compiled import on_one_core
from gdptlab._plans import planned
from gdptlab.calibration import Calibration
from gdptlab.fit.search import Explained, Overlap
from gdptlab.locate import as_table, checked_image

STD_COLUMNS = ("x_std_px", "y_std_px", "z_std_um")
"""More of them, if particles are fitted jointly."""

CORRELATED = 5.0
"""Pixels over which what a joint fit leaves of a particle is alike, about, where it is more than noise: an excess of
chi2 by 0.1 adds 0.5 times the variance. Found as what makes errors of particles in a crowd agree with their std."""

ODD = 3.0
"""Standard deviations by which a particle is brighter or fainter than the others where its variance is twice the usual:
it may not be alone."""


@on_one_core
def explained(
    image: ArrayLike, calibration: Calibration, before: Explained | None = None
) -> tuple[pd.DataFrame, Explained]:
    """Table of a frame by the joint fit, and where the next frame may begin."""
    image = checked_image(image, calibration)
    plan = planned(calibration, Overlap, image.shape)
    if before is None or before.fit.residual.shape != image.shape:
        found = plan.first(image)
    else:
        found = plan.following(image, before)
    fit = found.fit
    y, x, step, amplitude = fit.places.T
    z_um = calibration.z_um
    table = as_table(fit.places[:, :2], step, fit.cm, np.clip(z_um - calibration.own_bias_um, z_um[0], z_um[-1]))
    steps = np.arange(len(calibration))
    y_std, x_std, step_std = fit.std.T
    stds = x_std, y_std, step_std * np.interp(step, steps, np.gradient(z_um))
    odd = (amplitude - found.brightness) / found.spread
    misfit = np.sqrt(1 + CORRELATED * np.maximum(fit.chi2 - 1, 0) + (odd / ODD) ** 2)
    for name, noise, own in zip(STD_COLUMNS, stds, calibration.own_error.T, strict=True):
        table[name] = misfit * np.hypot(noise, np.interp(step, steps, own))
    inside = found.stays & (y >= -0.5) & (y < image.shape[0] - 0.5) & (x >= -0.5) & (x < image.shape[1] - 0.5)
    table["amplitude"], table["chi2"] = amplitude, fit.chi2
    order = np.argsort(-table["cm"].to_numpy(), kind="stable")
    return table.iloc[order[inside[order]]].reset_index(drop=True), found
