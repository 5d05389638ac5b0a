"""Images of a particle anywhere in x, y and z, with their derivatives: what overlapping images are fitted with.

The images of a calibration become the coefficients of a cubic spline in z, y and x. From it the image of a
particle at any place is drawn pixel by pixel, and so are the four images that say how it changes with y, x, z
and brightness: the columns of the least-squares problem. The kernels are compiled (numba), as they touch each
pixel of each particle in each step of the fit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, median_filter, spline_filter1d

from gdptlab._compiled import compiled, inlined

FAINT = 0.35
"""A particle's image ends where it stays, once smoothed, below this share of the noise of a pixel."""

RIM = 2
"""Nodes of the spline around the images, for its four-point support."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Particles drawn into a frame: for each the pixels it reaches, its image and that image's derivatives.

    Attributes
    ----------
    boxes : int array (P, 4)
        First row, end of the rows, first column and end of the columns of each particle, cut at the frame.
    starts : int array (P + 1,)
        Where its pixels, row by row, begin in `values`.
    values : float32 array (4, pixels)
        Derivatives by y, x, step along the stack, and brightness; the last is the image at brightness 1.
    """

    boxes: NDArray[np.int64]
    starts: NDArray[np.int64]
    values: NDArray[np.float32]

    def add_to(self, frame: NDArray[np.float32], brightness: NDArray[np.float64]) -> None:
        """Add all images, each times its `brightness` (P,), to `frame`."""
        _add(frame, brightness, self.boxes, self.starts, self.values)

    def gradient(
        self, residual: NDArray[np.float32], weight: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Right-hand side of weighted least squares.

        Parameters
        ----------
        residual, weight : float32 arrays (rows, columns)
            What the particles leave of the frame, and one over the variance of each pixel.

        Returns
        -------
        gradient : float64 array (P, 4)
            Products of the columns with the residual.
        chi2 : float64 array (P,)
            Squares of the residual in each box. Both are weighted.
        """
        sums = np.zeros((len(self.boxes), 5))
        _gradient(residual, weight, self.boxes, self.starts, self.values, sums)
        return sums[:, :4], sums[:, 4]

    def matrix(self, weight: NDArray[np.float32]) -> NDArray[np.float64]:
        """Matrix of weighted least squares: its lower band (b, 4 P), as `scipy.linalg.cholesky_banded` takes it.

        The better the particles are sorted by x, the narrower it is.
        """
        count = len(self.boxes)
        # The last particle that can overlap with particle i; boxes are sorted by x only roughly.
        nearest_start = np.minimum.accumulate(self.boxes[::-1, 2])[::-1]
        reach = np.searchsorted(nearest_start, self.boxes[:, 3]) - 1 - np.arange(count)
        band = np.zeros((4 * max(int(reach.max(initial=0)), 0) + 4, 4 * count))
        _matrix(weight, self.boxes, self.starts, self.values, band)
        return band


class ParticleImages:
    """Image of a particle at any place, from images at known depths.

    Parameters
    ----------
    images : array (N, n, n)
        A particle of brightness 1 in the middle of each, on no background; n is odd.
    noise : float
        Standard deviation of a pixel's noise, which decides how far an image reaches.
    """

    def __init__(self, images: NDArray, noise: float) -> None:
        self.count, self.size, _ = images.shape
        nodes = np.pad(images.astype(np.float64), ((0, 0), (RIM, RIM), (RIM, RIM)))
        for axis in (1, 2):
            nodes = spline_filter1d(nodes, axis=axis)
        self._nodes = along_z(nodes.reshape(len(nodes), -1)).astype(np.float32)
        self.reach = _reach(images, noise)

    def boxes(self, places: NDArray, shape: tuple[int, int]) -> NDArray[np.int64]:
        """Pixels that particles reach in a frame of `shape`, (P, 4) as in `Columns`.

        Parameters
        ----------
        places : array (P, 4)
            y, x (px), step along the stack, brightness.
        shape : (rows, columns)
        """
        nearest = np.clip(np.rint(places[:, 2]).astype(int), 0, self.count - 1)
        reach = self.reach[nearest]
        middle = np.rint(places[:, :2]).astype(int)
        ends = [
            np.clip(middle[:, i] + sign * reach[:, i] + (sign > 0), 0, shape[i]) for i in (0, 1) for sign in (-1, 1)
        ]
        return np.stack(ends, axis=1)

    def draw(self, places: NDArray[np.float64], shape: tuple[int, int]) -> Columns:
        """Draw particles, with derivatives.

        Parameters
        ----------
        places : float64 array (P, 4)
            y, x (px), step along the stack, brightness.
        shape : (rows, columns)
            Of the frame; particles may be cut by its edges or lie outside.
        """
        boxes = self.boxes(places, shape)
        area = np.maximum(boxes[:, 1] - boxes[:, 0], 0) * np.maximum(boxes[:, 3] - boxes[:, 2], 0)
        starts = np.concatenate([[0], np.cumsum(area)])
        values = np.empty((4, starts[-1]), dtype=np.float32)
        _draw(self._nodes, self.size + 2 * RIM, places, boxes, starts, values)
        return Columns(boxes, starts, values)


def along_z(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (N + 2, ...) of the cubic spline through values (N, ...), one more beyond either end.

    Nothing is known of the ends but the values: the last two pieces are one cubic ("not a knot"), or, of few values,
    the end is straight.
    """
    count = len(values)
    end = np.array([1, -4, 6, -4, 1] if count > 4 else [1, -2, 1])
    matrix = np.zeros((count + 2, count + 2))
    matrix[0, : len(end)] = matrix[-1, -len(end) :] = end
    for k in range(count):
        matrix[k + 1, k : k + 3] = 1 / 6, 4 / 6, 1 / 6
    ends = np.zeros((1, *values.shape[1:]))
    return np.einsum("kn,n...->k...", np.linalg.inv(matrix), np.concatenate([ends, values, ends]), optimize=True)


def _reach(images: NDArray, noise: float) -> NDArray[np.int64]:
    """Rows and columns (N, 2) from the middle to where each image ends."""
    half = images.shape[1] // 2
    visible = np.abs(gaussian_filter(images, (0, 2, 2))) > FAINT * noise
    away = np.abs(np.arange(images.shape[1]) - half)
    reach = [np.where(visible.any(axis=other), away, 3).max(axis=1) for other in (2, 1)]
    return np.minimum(median_filter(np.stack(reach, axis=1), (5, 1), mode="nearest") + 1, half)


@inlined
def spline_weights(f):  # pragma: no cover
    """Weights, and their derivatives, of the four nodes around a point at `f` between the middle two."""
    g = 1 - f
    weights = (g * g * g / 6, (3 * f * f * f - 6 * f * f + 4) / 6, (3 * g * g * g - 6 * g * g + 4) / 6, f * f * f / 6)
    slopes = (-g * g / 2, (3 * f * f - 4 * f) / 2, -(3 * g * g - 4 * g) / 2, f * f / 2)
    return (
        (np.float32(weights[0]), np.float32(weights[1]), np.float32(weights[2]), np.float32(weights[3])),
        (np.float32(slopes[0]), np.float32(slopes[1]), np.float32(slopes[2]), np.float32(slopes[3])),
    )


@compiled
def _draw(nodes, width, places, boxes, starts, values):  # pragma: no cover
    """Fill `values` (4, pixels): along z over the nodes in reach, then x, then y."""
    half = (width - 2 * RIM) // 2
    scratch = np.zeros((5, width * width + 3), np.float32)
    a, b, c, d, e = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for i in range(len(places)):
        y0, y1, x0, x1 = boxes[i]
        rows, columns = y1 - y0, x1 - x0
        if rows <= 0 or columns <= 0:
            continue
        y, x, step, brightness = places[i]
        k = min(max(int(np.floor(step)), 0), len(nodes) - 4)
        top, left = y0 - y + half, x0 - x + half
        row, column = int(np.floor(top)), int(np.floor(left))
        (z0, z1, z2, z3), (dz0, dz1, dz2, dz3) = spline_weights(step - k)
        (v0, v1, v2, v3), (dv0, dv1, dv2, dv3) = spline_weights(top - row)
        (h0, h1, h2, h3), (dh0, dh1, dh2, dh3) = spline_weights(left - column)
        across = columns + 3
        for r in range(rows + 3):
            s, t = (row + 1 + r) * width + column + 1, r * across
            n0, n1, n2, n3, a0, b0 = nodes[k, s:], nodes[k + 1, s:], nodes[k + 2, s:], nodes[k + 3, s:], a[t:], b[t:]
            for j in range(across):
                a0[j] = z0 * n0[j] + z1 * n1[j] + z2 * n2[j] + z3 * n3[j]
                b0[j] = dz0 * n0[j] + dz1 * n1[j] + dz2 * n2[j] + dz3 * n3[j]
        length = (rows + 3) * across
        for j in range(length):
            c[j] = h0 * a[j] + h1 * a[j + 1] + h2 * a[j + 2] + h3 * a[j + 3]
            d[j] = dh0 * a[j] + dh1 * a[j + 1] + dh2 * a[j + 2] + dh3 * a[j + 3]
            e[j] = h0 * b[j] + h1 * b[j + 1] + h2 * b[j + 2] + h3 * b[j + 3]
        length -= 3 * across
        c1, c2, c3 = c[across:], c[2 * across :], c[3 * across :]
        d1, d2, d3 = d[across:], d[2 * across :], d[3 * across :]
        e1, e2, e3 = e[across:], e[2 * across :], e[3 * across :]
        for j in range(length):
            a[j] = v0 * c[j] + v1 * c1[j] + v2 * c2[j] + v3 * c3[j]
            b[j] = dv0 * c[j] + dv1 * c1[j] + dv2 * c2[j] + dv3 * c3[j]
        for j in range(length):
            c[j] = v0 * d[j] + v1 * d1[j] + v2 * d2[j] + v3 * d3[j]
        for j in range(length):
            d[j] = v0 * e[j] + v1 * e1[j] + v2 * e2[j] + v3 * e3[j]
        light = np.float32(brightness)
        for r in range(rows):
            s, t = starts[i] + r * columns, r * across
            j0, j1, j2, j3 = values[0, s:], values[1, s:], values[2, s:], values[3, s:]
            b0, c0, d0, a0 = b[t:], c[t:], d[t:], a[t:]
            for q in range(columns):
                j0[q], j1[q], j2[q], j3[q] = -light * b0[q], -light * c0[q], light * d0[q], a0[q]


@compiled
def _add(frame, brightness, boxes, starts, values):  # pragma: no cover
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        light = np.float32(brightness[i])
        for r in range(y0, y1):
            row, image = frame[r, x0:x1], values[3, starts[i] + (r - y0) * (x1 - x0) :]
            for q in range(len(row)):  # from 0: an index that cannot be negative is far faster
                row[q] += light * image[q]


@compiled
def _gradient(residual, weight, boxes, starts, values, sums):  # pragma: no cover
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        for r in range(y0, y1):
            s = starts[i] + (r - y0) * (x1 - x0)
            j0, j1, j2, j3 = values[0, s:], values[1, s:], values[2, s:], values[3, s:]
            rest, trust = residual[r, x0:x1], weight[r, x0:x1]
            g0 = g1 = g2 = g3 = chi2 = np.float32(0)
            for q in range(len(rest)):
                u = rest[q]
                v = u * trust[q]
                g0 += v * j0[q]
                g1 += v * j1[q]
                g2 += v * j2[q]
                g3 += v * j3[q]
                chi2 += v * u
            sums[i, 0] += g0
            sums[i, 1] += g1
            sums[i, 2] += g2
            sums[i, 3] += g3
            sums[i, 4] += chi2


@compiled
def _matrix(weight, boxes, starts, values, band):  # pragma: no cover
    j0, j1, j2, j3 = values[0], values[1], values[2], values[3]
    largest = 0
    for i in range(len(boxes)):
        largest = max(largest, starts[i + 1] - starts[i])
    trusted = np.empty(largest, np.float32)
    zero = np.float32(0)
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        first, area, columns = starts[i], starts[i + 1] - starts[i], x1 - x0
        if area <= 0:
            continue
        for r in range(y0, y1):
            row, there = weight[r, x0:x1], trusted[(r - y0) * columns :]
            for q in range(columns):
                there[q] = row[q]
        a0, a1, a2, a3 = j0[first:], j1[first:], j2[first:], j3[first:]
        m00 = m01 = m02 = m03 = m11 = m12 = m13 = m22 = m23 = m33 = zero
        for q in range(area):
            w = trusted[q]
            u0, u1, u2, u3 = a0[q], a1[q], a2[q], a3[q]
            m00 += w * u0 * u0
            m01 += w * u0 * u1
            m02 += w * u0 * u2
            m03 += w * u0 * u3
            m11 += w * u1 * u1
            m12 += w * u1 * u2
            m13 += w * u1 * u3
            m22 += w * u2 * u2
            m23 += w * u2 * u3
            m33 += w * u3 * u3
        c = 4 * i
        band[0, c], band[1, c], band[2, c], band[3, c] = m00, m01, m02, m03
        band[0, c + 1], band[1, c + 1], band[2, c + 1] = m11, m12, m13
        band[0, c + 2], band[1, c + 2], band[0, c + 3] = m22, m23, m33
        for j in range(i + 1, len(boxes)):
            d = 4 * (j - i)
            if d + 3 >= len(band):
                break
            top, bottom = max(y0, boxes[j, 0]), min(y1, boxes[j, 1])
            left, right = max(x0, boxes[j, 2]), min(x1, boxes[j, 3])
            if top >= bottom or left >= right:
                continue
            others = boxes[j, 3] - boxes[j, 2]
            s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = zero
            s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = zero
            for r in range(top, bottom):
                s = starts[i] + (r - y0) * columns + left - x0
                t = starts[j] + (r - boxes[j, 0]) * others + left - boxes[j, 2]
                row = weight[r, left:right]
                a0, a1, a2, a3 = j0[s:], j1[s:], j2[s:], j3[s:]
                b0, b1, b2, b3 = j0[t:], j1[t:], j2[t:], j3[t:]
                for q in range(len(row)):
                    w = row[q]
                    u0, u1, u2, u3 = w * a0[q], w * a1[q], w * a2[q], w * a3[q]
                    v0, v1, v2, v3 = b0[q], b1[q], b2[q], b3[q]
                    s00 += u0 * v0
                    s01 += u0 * v1
                    s02 += u0 * v2
                    s03 += u0 * v3
                    s10 += u1 * v0
                    s11 += u1 * v1
                    s12 += u1 * v2
                    s13 += u1 * v3
                    s20 += u2 * v0
                    s21 += u2 * v1
                    s22 += u2 * v2
                    s23 += u2 * v3
                    s30 += u3 * v0
                    s31 += u3 * v1
                    s32 += u3 * v2
                    s33 += u3 * v3
            band[d, c], band[d + 1, c], band[d + 2, c], band[d + 3, c] = s00, s01, s02, s03
            c1, c2, c3 = c + 1, c + 2, c + 3
            band[d - 1, c1], band[d, c1], band[d + 1, c1], band[d + 2, c1] = s10, s11, s12, s13
            band[d - 2, c2], band[d - 1, c2], band[d, c2], band[d + 1, c2] = s20, s21, s22, s23
            band[d - 3, c3], band[d - 2, c3], band[d - 1, c3], band[d, c3] = s30, s31, s32, s33
