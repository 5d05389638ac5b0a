"""Images of a particle whose pattern and focus change over the field, anywhere in x, y and z.

The pattern at a place in the field is a mean plus a few changes, each times a smooth function of the place, plus
what makes one particle differ from the next, such as its size, or that it is two that stick together:

    T(x, y, z; u) = sum_m phi_m(x, y) P_m(z - f(x, y); u) + sum_k c_k Q_k(z - f(x, y); u),   phi = 1, x, y, r^2,

f being the focal surface. A particle's c_k are unknown, 0 on average with standard deviation 1. P_m and Q_k are kept
at half a pixel, since a particle in focus may be two pixels wide and is not told whole by samples a pixel apart.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, median_filter, spline_filter1d

from gdptlab._compiled import compiled
from gdptlab.fit.renderer import FAINT, RIM, Columns, along_z, spline_weights

FINE = 2
"""Nodes of a pattern per pixel."""


def field_terms(x_px: ArrayLike, y_px: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Terms 1, x, y, r^2 of smooth functions over frames of `shape`, (..., 4); each about -1 to 1."""
    rows, columns = shape
    half = max(shape) / 2
    u = (np.asarray(x_px, dtype=float) - (columns - 1) / 2) / half
    v = (np.asarray(y_px, dtype=float) - (rows - 1) / 2) / half
    square = ((rows / 2 / half) ** 2 + (columns / 2 / half) ** 2) / 3  # the mean of r^2 over the frame
    return np.stack([np.ones_like(u), u, v, u**2 + v**2 - square], axis=-1)


class FieldImages:
    """Drawn like `ParticleImages`, but the image depends on the place.

    Parameters
    ----------
    patterns : array (M, N, m, m)
        Mean pattern, and what is added to it for each further term of `field_terms`, at N steps; FINE nodes a
        pixel, m = 2 FINE h + 1 for images that reach h px from their middle. M is 4, or 1: the same everywhere.
    surface : array (4,)
        Focal surface in `field_terms`: the step at which a particle is in focus, less that in the middle.
    noise : float
        Standard deviation of a pixel's noise, which decides how far an image reaches.
    brightest : float
        Of the particles, for the same.
    modes : array (K, N, m, m), optional
        Ways in which particles differ from each other.
    """

    def __init__(
        self,
        patterns: NDArray,
        surface: NDArray,
        noise: float,
        brightest: float = 1.0,
        modes: NDArray | None = None,
    ) -> None:
        self.count, self.surface, self.terms = patterns.shape[1], surface, len(patterns)
        self.half = patterns.shape[-1] // (2 * FINE)
        self.modes = 0 if modes is None else len(modes)
        nodes = patterns if modes is None else np.concatenate([patterns, modes])
        nodes = np.pad(nodes.astype(np.float64), ((0, 0), (0, 0), (RIM, RIM), (RIM, RIM)))
        for axis in (2, 3):
            nodes = spline_filter1d(nodes, axis=axis)
        nodes = along_z(np.moveaxis(nodes, 1, 0))
        self._nodes = np.ascontiguousarray(np.moveaxis(nodes, 0, 1), dtype=np.float32)
        differ = np.flatnonzero(np.any(modes, axis=(0, 2, 3))) if self.modes else []
        self._differ = (differ[0] - 2, differ[-1] + 1) if len(differ) else (0, -1)
        light = gaussian_filter(np.abs(patterns).sum(axis=0)[:, ::FINE, ::FINE], (0, 2, 2))
        away = np.abs(np.arange(light.shape[1]) - self.half)
        seen = light * brightest > FAINT * noise
        reach = np.where(seen.any(axis=1), away, 3).max(axis=1)
        self.reach = np.minimum(median_filter(reach, 5, mode="nearest") + 1, self.half)

    def draw(
        self,
        places: NDArray[np.float64],
        shape: tuple[int, int],
        heights: NDArray[np.float64] | None = None,
        *,
        by_mode: bool = False,
    ) -> Columns:
        """Draw particles, with derivatives.

        Parameters
        ----------
        places : float64 array (P, 4 + K)
            y, x (px), step, brightness, and the particle's share of each mode; without them (P, 4), 0.
        shape : (rows, columns)
            Of the frame.
        heights : float64 array (P,), optional
            Steps at which the particles are in focus, if not those of the focal surface.
        by_mode : bool
            Append to the columns the derivative by each mode; (4 + K, pixels) then.

        Returns
        -------
        Columns
        """
        terms = field_terms(places[:, 1], places[:, 0], shape)
        steps = places[:, 2] - (terms @ self.surface if heights is None else heights)
        reach = self.reach[np.clip(np.rint(steps).astype(int), 0, self.count - 1)]
        middle = np.rint(places[:, :2]).astype(int)
        ends = [np.clip(middle[:, i] + sign * reach + (sign > 0), 0, shape[i]) for i in (0, 1) for sign in (-1, 1)]
        boxes = np.stack(ends, axis=1)
        area = np.maximum(boxes[:, 1] - boxes[:, 0], 0) * np.maximum(boxes[:, 3] - boxes[:, 2], 0)
        starts = np.concatenate([[0], np.cumsum(area)])
        values = np.empty((4 + by_mode * self.modes, starts[-1]), dtype=np.float32)
        shares = np.zeros((len(places), len(self._nodes)), np.float32)
        shares[:, : self.terms] = terms[:, : self.terms]
        shares[:, self.terms : self.terms + places.shape[1] - 4] = places[:, 4:]
        _draw(self._nodes, shares, self.terms, self._differ, places, steps + 1, boxes, starts, values)
        return Columns(boxes, starts, values)


@compiled
def _draw(nodes, shares, terms, differ, places, steps, boxes, starts, values):  # pragma: no cover
    """Fill `values`: along z over the nodes in reach, then x, then y to the pixels."""
    modes, levels, width, _ = nodes.shape
    half, alike, differs = width // 2, terms, modes
    a, b = np.empty(width, np.float32), np.empty(width, np.float32)
    scratch = np.empty((3, width, width), np.float32)
    c, d, e = scratch[0], scratch[1], scratch[2]
    for i in range(len(places)):
        y0, y1, x0, x1 = boxes[i]
        rows, columns = y1 - y0, x1 - x0
        if rows <= 0 or columns <= 0:
            continue
        y, x, brightness = places[i, 0], places[i, 1], places[i, 3]
        step = min(max(steps[i], 0.0), levels - 1.0)
        k = min(max(int(np.floor(step)) - 1, 0), levels - 4)
        modes = differs if differ[0] <= k <= differ[1] else alike
        top, left = FINE * (y0 - y) + half, FINE * (x0 - x) + half
        row, column = int(np.floor(top)) - 1, int(np.floor(left)) - 1
        z, dz = spline_weights(step - k - 1)
        (v0, v1, v2, v3), (dv0, dv1, dv2, dv3) = spline_weights(top - row - 1)
        (h0, h1, h2, h3), (dh0, dh1, dh2, dh3) = spline_weights(left - column - 1)
        first, last = max(row, 0), min(row + FINE * (rows - 1) + 4, width)
        c_first, c_last = max(column, 0), min(column + FINE * (columns - 1) + 4, width)
        for r in range(first, last):
            a[:] = 0
            b[:] = 0
            for m in range(modes):
                t = shares[i, m]
                n0, n1, n2, n3 = nodes[m, k, r], nodes[m, k + 1, r], nodes[m, k + 2, r], nodes[m, k + 3, r]
                n0, n1, n2, n3 = n0[c_first:], n1[c_first:], n2[c_first:], n3[c_first:]
                a0, b0 = a[c_first:], b[c_first:]
                for j in range(c_last - c_first):
                    a0[j] += t * (z[0] * n0[j] + z[1] * n1[j] + z[2] * n2[j] + z[3] * n3[j])
                    b0[j] += t * (dz[0] * n0[j] + dz[1] * n1[j] + dz[2] * n2[j] + dz[3] * n3[j])
            for q in range(columns):
                j = column + FINE * q
                if j < 0 or j + 3 >= width:
                    c[r, q] = d[r, q] = e[r, q] = 0
                    continue
                c[r, q] = h0 * a[j] + h1 * a[j + 1] + h2 * a[j + 2] + h3 * a[j + 3]
                d[r, q] = dh0 * a[j] + dh1 * a[j + 1] + dh2 * a[j + 2] + dh3 * a[j + 3]
                e[r, q] = h0 * b[j] + h1 * b[j + 1] + h2 * b[j + 2] + h3 * b[j + 3]
        light, fine = np.float32(brightness), np.float32(FINE)
        for r in range(rows):
            s, j = starts[i] + r * columns, row + FINE * r
            if j < 0 or j + 3 >= width:
                values[:, s : s + columns] = 0
                continue
            j0, j1, j2, j3 = values[0, s:], values[1, s:], values[2, s:], values[3, s:]
            c0, c1, c2, c3 = c[j], c[j + 1], c[j + 2], c[j + 3]
            d0, d1, d2, d3 = d[j], d[j + 1], d[j + 2], d[j + 3]
            e0, e1, e2, e3 = e[j], e[j + 1], e[j + 2], e[j + 3]
            for q in range(columns):
                j0[q] = -fine * light * (dv0 * c0[q] + dv1 * c1[q] + dv2 * c2[q] + dv3 * c3[q])
                j1[q] = -fine * light * (v0 * d0[q] + v1 * d1[q] + v2 * d2[q] + v3 * d3[q])
                j2[q] = light * (v0 * e0[q] + v1 * e1[q] + v2 * e2[q] + v3 * e3[q])
                j3[q] = v0 * c0[q] + v1 * c1[q] + v2 * c2[q] + v3 * c3[q]
        for m in range(4, len(values)):
            if modes == alike:
                values[m, starts[i] : starts[i + 1]] = 0
                continue
            n = nodes[m - 4 + alike]
            for r in range(first, last):
                n0, n1, n2, n3 = n[k, r], n[k + 1, r], n[k + 2, r], n[k + 3, r]
                for j in range(c_first, c_last):
                    a[j] = z[0] * n0[j] + z[1] * n1[j] + z[2] * n2[j] + z[3] * n3[j]
                for q in range(columns):
                    j = column + FINE * q
                    inside = j >= 0 and j + 3 < width
                    c[r, q] = h0 * a[j] + h1 * a[j + 1] + h2 * a[j + 2] + h3 * a[j + 3] if inside else 0
            for r in range(rows):
                s, j = starts[i] + r * columns, row + FINE * r
                if j < 0 or j + 3 >= width:
                    values[m, s : s + columns] = 0
                    continue
                c0, c1, c2, c3, j4 = c[j], c[j + 1], c[j + 2], c[j + 3], values[m, s:]
                for q in range(columns):
                    j4[q] = light * (v0 * c0[q] + v1 * c1[q] + v2 * c2[q] + v3 * c3[q])
