"""The door from `locate` and `batch`: a frame, or the frame after one, explained by a calibration's model."""

import pandas as pd
from numpy.typing import ArrayLike

from gdptlab._checks import instance
from gdptlab._compiled import on_one_core
from gdptlab._plans import planned
from gdptlab.calibration import Calibration
from gdptlab.fit.joint import Explained, Joint
from gdptlab.locate import checked_image


@on_one_core
def explained(
    image: ArrayLike, calibration: Calibration, before: Explained | None = None
) -> tuple[pd.DataFrame, Explained]:
    """Fit all particles of a frame.

    Parameters
    ----------
    image : array (rows, columns)
    calibration : Calibration
    before : Explained, optional
        The frame before, where this one begins; without it, or if it has another shape, nothing is known beforehand.

    Returns
    -------
    table : DataFrame
        As from `Joint.table`.
    explained : Explained
        Where the next frame begins.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form.
    """
    image = checked_image(image, calibration)
    joint = planned(calibration, _joint, image.shape)
    if before is not None:
        instance("before", before, Explained)
    if before is None or before.fit.residual.shape != image.shape:
        found = joint.first(image)
    else:
        found = joint.following(image, before)
    return joint.table(found), found


def _joint(calibration: Calibration, shape: tuple[int, int]) -> Joint:
    """Plan for frames of this shape."""
    return Joint(calibration.model, shape)
