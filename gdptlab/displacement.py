"""How far a particle is from the template that resembles it most: least squares within one window.

Around the pixel and the depth of a template T, a window shows a T(y - dy, x - dx; z + dz) on a background of some
level and slope. Linear in dz, and up to third order in dy and dx, the unknowns follow from a few products that are
prepared for each template, so that there is nothing to iterate but small numbers.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

# Central differences of order 0 to 3, of Stirling's interpolation formula.
DIFFERENCES = ([1.0], [-0.5, 0.0, 0.5], [1.0, -2.0, 1.0], [-0.5, 1.0, 0.0, -1.0, 0.5])

# Orders along (y, x) of what is not linear.
CURVED = [(i, j) for i in range(4) for j in range(4) if 2 <= i + j <= 3]

ROUNDS = 2
"""Of inserting the solution into the terms that are not linear."""


class Displacement:
    """Least-squares displacement of a particle from the middle of a window and the depth of a template.

    Parameters
    ----------
    templates : array (N, n, n)
    z_um : array (N,)
        Their depths, increasing.
    """

    def __init__(self, templates: NDArray, z_um: NDArray) -> None:
        count, n, _ = templates.shape
        along_z = np.gradient(templates, z_um, axis=0)
        linear = [templates, _difference(templates, 1, 0), _difference(templates, 0, 1), along_z]
        background = [np.broadcast_to(b, templates.shape) for b in (np.ones((n, n)), *np.indices((n, n)) - n // 2)]
        columns = np.stack([c.reshape(count, -1) for c in (*linear, *background)], axis=2)
        rows = np.linalg.pinv(columns)[:, :4]
        curved = np.stack([_difference(templates, i, j).reshape(count, -1) for i, j in CURVED], axis=2)
        self._rows = rows.astype(np.float32)
        self._curved = rows @ curved

    def __call__(self, windows: NDArray[np.float32], k: NDArray) -> NDArray[np.float64]:
        """Solve for each window.

        Parameters
        ----------
        windows : float32 array (m, n * n)
        k : int array (m,)
            Template that each is compared with.

        Returns
        -------
        float64 array (m, 3)
            dy, dx (px) and dz (µm); 0 where the window shows nothing like the template. Trustworthy to about
            a pixel, and half-way to the next template.
        """
        products = np.matmul(self._rows[k], windows[:, :, None])[..., 0].astype(np.float64)
        solution = products
        for _ in range(ROUNDS):
            a = np.where(products[:, :1] > 0, solution[:, :1], np.inf)
            d = np.clip(-solution[:, 1:3] / a, -1, 1)
            share = [np.ones_like(d), -d, d**2 / 2, -d * (d**2 - 1) / 6]
            terms = np.stack([share[i][:, 0] * share[j][:, 1] for i, j in CURVED], axis=1)
            solution = products - solution[:, :1] * np.einsum("mrt,mt->mr", self._curved[k], terms)
        a = np.where((products[:, 0] > 0) & (solution[:, 0] > 0), solution[:, 0], np.inf)
        return solution[:, 1:] / a[:, None] * (-1, -1, 1)


def _difference(images: NDArray, order_y: int, order_x: int) -> NDArray:
    """Central differences of (N, n, n) along y and x."""
    for axis, order in ((1, order_y), (2, order_x)):
        images = correlate1d(images, DIFFERENCES[order], axis=axis, mode="nearest")
    return images
