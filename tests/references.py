"""Slow and obvious: what fast kernels are tested against."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray


def correlate_plainly(image: NDArray, templates: NDArray) -> NDArray[np.float64]:
    """Normalised cross-correlation by its definition, window by window (slow).

    Parameters
    ----------
    image : array (rows, columns)
    templates : array (k, n, n)

    Returns
    -------
    float64 array (k, rows - n + 1, columns - n + 1)
        From -1 to 1; 0 where image or template is flat.
    """
    windows = sliding_window_view(np.asarray(image, dtype=np.float64), templates.shape[-2:])
    windows = windows - windows.mean(axis=(-2, -1), keepdims=True)
    norm = np.sqrt((windows**2).sum(axis=(-2, -1)))
    templates = templates - templates.mean(axis=(-2, -1), keepdims=True)
    scaled = np.einsum("rcij,kij->krc", windows, templates)
    product = norm * np.sqrt((templates**2).sum(axis=(-2, -1)))[:, None, None]
    return np.divide(scaled, product, out=np.zeros_like(scaled), where=product > 0)
