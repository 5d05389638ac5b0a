"""The renderer: particles drawn into a frame, with derivatives, from patterns at known depths.

Patterns become the coefficients of a cubic spline in z, y and x. From it the image of a particle anywhere is drawn
pixel by pixel, and so are the images that say how it changes with y, x, z, amplitude and modes: the columns of the
least-squares problem. Kernels are compiled (numba), as they touch each pixel of each particle in each step of the fit.

The nodes of a row are stored by phase, every `fine`-th beside each other, so that the four nodes which a pixel
needs, and those of the next pixel, are neighbours in memory whatever the number of nodes per pixel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, median_filter, spline_filter1d

from gdptlab._compiled import compiled, inlined
from gdptlab.fit.model import field_terms
from gdptlab.fit.threads import in_parts

FAINT = 0.35
"""Fraction of a pixel's noise: a particle's image, smoothed over 2 px, ends where it stays below. Of a stack with
noise the mean over 2 px has 0.14 of a pixel's, so that noise alone is hardly ever drawn as part of an image."""

UNSURE = 1.5
"""Standard deviations of a pattern's error: an image also ends where it stays below so many."""

LEVELS = 14
"""Number of amplitudes, each twice the one before, for which the support is tabulated."""

ROOM_PX = 2
"""Pixels by which a particle's place in memory is larger, on each side, than its support, which changes as it moves."""

RIM = 4
"""Nodes of the spline around the patterns, for its four-point support about a particle between two pixels."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Particles drawn into a frame: for each the pixels of its support, its image and that image's derivatives.

    Attributes
    ----------
    boxes : int array (P, 4)
        First row, end of the rows, first column and end of the columns of each particle, cut at the frame.
    starts : int array (P + 1,)
        Where its pixels, row by row, begin in `values`; there may be room for more of them than the support has.
    values : float32 array (4 or 4 + K, pixels)
        Derivatives by y, x, slice and amplitude, then by each mode; [3] is the image at amplitude 1.
    threads : int
    """

    boxes: NDArray[np.int64]
    starts: NDArray[np.int64]
    values: NDArray[np.float32]
    threads: int = 1

    @property
    def area(self) -> NDArray[np.int64]:
        """Pixels of each particle's support in the frame, (P,)."""
        return _area(self.boxes)

    def add_to(self, frame: NDArray[np.float32], amplitude: NDArray[np.float64]) -> None:
        """Add all images, each times its `amplitude` (P,), to `frame`."""

        def kernel(top: int, bottom: int) -> None:
            _add(frame, amplitude, top, bottom, self.boxes, self.starts, self.values)

        in_parts(self.threads, np.ones(len(frame)), kernel)

    def gradient(
        self, residual: NDArray[np.float32], weight: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Right-hand side of weighted least squares.

        Parameters
        ----------
        residual, weight : float32 arrays (rows, columns)
            What the model leaves of the frame, and one over the variance of each pixel.

        Returns
        -------
        gradient : float64 array (P, 4)
            Products of the first four columns with the residual.
        chi2 : float64 array (P,)
            Squares of the residual on each support. Both are weighted.
        """
        sums = np.zeros((len(self.boxes), 5))

        def kernel(first: int, end: int) -> None:
            _gradient(residual, weight, first, end, self.boxes, self.starts, self.values, sums)

        in_parts(self.threads, self.area, kernel)
        return sums[:, :4], sums[:, 4]

    def matrix(self, weight: NDArray[np.float32]) -> NDArray[np.float64]:
        """Matrix of weighted least squares: its lower band (b, 4 P), as `scipy.linalg.cholesky_banded` takes it.

        The better the particles are sorted by x, the narrower it is.
        """
        band = np.zeros((4 * self._widest() + 4, 4 * len(self.boxes)))
        self.renew(band, weight, np.ones(len(self.boxes), bool))
        return band

    def renew(self, band: NDArray[np.float64], weight: NDArray[np.float32], moved: NDArray[np.bool_]) -> bool:
        """Compute anew what a `matrix` has of the particles that `moved` (P,); False if it is too narrow."""
        if 4 * self._widest() + 4 > len(band):
            return False

        def kernel(first: int, end: int) -> None:
            _matrix(weight, first, end, moved, self.boxes, self.starts, self.values, band)

        in_parts(self.threads, self.area, kernel)
        return True

    def _widest(self) -> int:
        """Largest distance, in their order, of two particles that can overlap."""
        count = len(self.boxes)
        # The last particle that can overlap with particle i; boxes are sorted by x only roughly.
        nearest_start = np.minimum.accumulate(self.boxes[::-1, 2])[::-1]
        last = np.searchsorted(nearest_start, self.boxes[:, 3]) - 1 - np.arange(count)
        return max(int(last.max(initial=0)), 0)


class Renderer:
    """Draws particles from patterns.

    Parameters
    ----------
    patterns : array (M, N, m, m)
        As in `PatternModel`.
    nodes_per_px : int
    surface : array (4,), optional
        Focal surface.
    modes : array (K, N, m, m), optional
    noise : float
        Standard deviation of a pixel, which decides with the amplitude how far an image reaches.
    error : array (N, m, m), optional
        Standard deviation of the patterns' error, as in `PatternModel`, for the same.
    threads : int
    """

    def __init__(
        self,
        patterns: NDArray,
        nodes_per_px: int,
        *,
        noise: float,
        surface: NDArray | None = None,
        modes: NDArray | None = None,
        error: NDArray | None = None,
        threads: int = 1,
    ) -> None:
        self.terms, self.count, m, _ = patterns.shape
        self.fine, self.half, self.threads = nodes_per_px, m // (2 * nodes_per_px), threads
        self.surface = np.zeros(4) if surface is None else surface
        self.modes = 0 if modes is None else len(modes)
        differ = np.flatnonzero(np.any(modes, axis=(0, 2, 3))) if self.modes else []
        self._differ = (differ[0] - 2, differ[-1] + 1) if len(differ) else (0, -1)
        self._nodes = _nodes(patterns if modes is None else np.concatenate([patterns, modes]), nodes_per_px)
        self.support = _support(patterns, nodes_per_px, noise, error)

    def boxes(self, places: NDArray, slices: NDArray, shape: tuple[int, int]) -> NDArray[np.int64]:
        """Pixels (P, 4) of the particles' supports, as in `Columns`, at `places` and `slices` of the stack (P,)."""
        level = np.ceil(np.log2(np.maximum(places[:, 3], 1))).astype(int)
        nearest = np.clip(np.rint(slices).astype(int), 0, self.count - 1)
        support = self.support[np.minimum(level, LEVELS - 1), nearest]
        middle = np.rint(places[:, :2]).astype(int)
        ends = [
            np.clip(middle[:, i] + sign * support[:, i] + (sign > 0), 0, shape[i]) for i in (0, 1) for sign in (-1, 1)
        ]
        return np.stack(ends, axis=1)

    def draw(
        self,
        places: NDArray[np.float64],
        shape: tuple[int, int],
        heights: NDArray[np.float64] | None = None,
        *,
        derivatives: bool = True,
        by_mode: bool = False,
        room_px: int = 0,
    ) -> Columns:
        """Draw particles.

        Parameters
        ----------
        places : float64 array (P, 4 + K)
            y, x (px), slice, amplitude, and the particle's coefficient of each mode; without them (P, 4), 0.
        shape : (rows, columns)
            Of the frame; particles may be cut by its edges or lie outside.
        heights : float64 array (P,), optional
            Slices at which the particles are in focus, if not those of the focal surface.
        derivatives : bool
            Draw the derivatives by y, x and slice as well; without them these columns are undefined.
        by_mode : bool
            Append to the columns the derivative by each mode.
        room_px : int
            Room that is left for particles to be drawn again elsewhere (`redraw`), px.
        """
        terms = field_terms(places[:, 1], places[:, 0], shape)
        slices = self._slices(places, terms, heights)
        boxes = self.boxes(places, slices, shape)
        capacity = _area(boxes + room_px * np.array([-1, 1, -1, 1])) * (_area(boxes) > 0)
        starts = np.concatenate([[0], np.cumsum(capacity)])
        values = np.empty((4 + by_mode * self.modes, starts[-1]), dtype=np.float32)
        columns = Columns(boxes, starts, values, self.threads)
        self._fill(columns, places, slices, terms, np.arange(len(places)), derivatives)
        return columns

    def redraw(
        self, columns: Columns, places: NDArray[np.float64], shape: tuple[int, int], moved: NDArray[np.bool_]
    ) -> bool:
        """Draw again, in their place, the particles that `moved` (P,); False if the room does not do."""
        which = np.flatnonzero(moved)
        terms = field_terms(places[:, 1], places[:, 0], shape)
        slices = self._slices(places, terms, None)
        boxes = self.boxes(places[which], slices[which], shape)
        if (_area(boxes) > np.diff(columns.starts)[which]).any():
            return False
        columns.boxes[which] = boxes
        self._fill(columns, places, slices, terms, which, True)
        return True

    def _slices(self, places: NDArray, terms: NDArray, heights: NDArray | None) -> NDArray[np.float64]:
        """Slices of the patterns (P,) of particles in focus at `heights`, or on the focal surface."""
        return np.clip(places[:, 2] - (terms @ self.surface if heights is None else heights), -1.0, float(self.count))

    def _fill(
        self,
        columns: Columns,
        places: NDArray,
        slices: NDArray,
        terms: NDArray,
        which: NDArray[np.int64],
        derivatives: bool,
    ) -> None:
        """Fill the columns of the particles `which`."""
        factors = np.zeros((len(places), self._nodes.shape[3]), np.float32)
        factors[:, : self.terms] = terms[:, : self.terms]
        factors[:, self.terms : self.terms + places.shape[1] - 4] = places[:, 4 : 4 + self.modes]
        size = 2 * self.half + 1

        def kernel(first: int, end: int) -> None:
            scratch = np.zeros((5, self.fine, self.fine, (size + RIM) * (size + RIM)), np.float32)
            sums = np.zeros((4, size + RIM), np.float32)
            _draw(
                self._nodes, factors, self.terms, self._differ, places, slices, which[first:end],
                columns.boxes, columns.starts, columns.values, derivatives, scratch, sums,
            )  # fmt: skip

        in_parts(self.threads, columns.area[which], kernel)

    def image(self, places: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Model image (rows, columns) of all particles at `places` (P, 4 + K)."""
        frame = np.zeros(shape, np.float32)
        self.draw(places, shape, derivatives=False).add_to(frame, places[:, 3])
        return frame


def _area(boxes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pixels of boxes (P, 4): first row, end of the rows, first column, end of the columns."""
    return np.maximum(boxes[:, 1] - boxes[:, 0], 0) * np.maximum(boxes[:, 3] - boxes[:, 2], 0)


def _nodes(patterns: NDArray, fine: int) -> NDArray[np.float32]:
    """Spline coefficients (N + 2, m + 2 RIM, fine, T, columns) of patterns (T, N, m, m), columns by phase.

    All that a row of pixels needs lies together in memory. Of several terms the number is filled up to one that the
    kernel can take by four.
    """
    more = -len(patterns) % 4 if len(patterns) > 1 else 0
    nodes = np.pad(patterns.astype(np.float64), ((0, more), (0, 0), (RIM, RIM), (RIM, RIM)))
    for axis in (2, 3):
        nodes = spline_filter1d(nodes, axis=axis)
    nodes = along_z(np.moveaxis(nodes, 1, 0)).astype(np.float32)  # N + 2, T, rows, columns
    nodes = np.pad(nodes, ((0, 0), (0, 0), (0, 0), (0, -nodes.shape[-1] % fine)))
    return np.ascontiguousarray(nodes.reshape(*nodes.shape[:-1], -1, fine).transpose(0, 2, 4, 1, 3))


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


def _support(patterns: NDArray, fine: int, noise: float, error: NDArray | None) -> NDArray[np.int64]:
    """Rows and columns (LEVELS, N, 2) from the middle to where images of amplitude 1, 2, 4, ... end."""
    images = patterns[..., ::fine, ::fine]
    half = images.shape[-1] // 2
    light = np.abs(gaussian_filter(images, (0, 0, 2, 2))).sum(axis=0)
    # Smoothed over 2 px, as the light, the error is far less.
    unsure = 0 if error is None else UNSURE * error[:, ::fine, ::fine] / (2 * np.sqrt(np.pi) * 2)
    away, support = np.abs(np.arange(-half, half + 1)), np.empty((LEVELS, images.shape[1], 2), int)
    for level in range(LEVELS):
        visible = light > np.maximum(FAINT * noise / 2**level, unsure)
        ends = [np.where(visible.any(axis=other), away, 3).max(axis=1) for other in (2, 1)]
        support[level] = median_filter(np.stack(ends, axis=1), (5, 1), mode="nearest") + 1
    return np.minimum(support, half)


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
def _draw(
    nodes, factors, terms, differ, places, slices, which, boxes, starts, values, derivatives, scratch, sums
):  # pragma: no cover
    """Fill `values` of the particles `which`: along z over the nodes of the support, then x, then y.

    Without `derivatives` only the image is drawn. Nodes are handled by phase, and those of one phase of rows and
    columns as one long line, a row after the other. `scratch` (5, fine, fine, nodes) holds such lines: image,
    derivative by z, then the same and the derivative by x between the nodes of a row; `sums` (4, nodes of a row) the
    sum of the terms in four slices.
    """
    levels, middle, (_, fine, _, width) = len(nodes), nodes.shape[1] // 2, nodes.shape[1:]
    for i in which:
        y0, y1, x0, x1 = boxes[i]
        rows, columns = y1 - y0, x1 - x0
        if rows <= 0 or columns <= 0:
            continue
        k = min(max(int(np.floor(slices[i])), 0), levels - 4)
        z, dz = spline_weights(slices[i] - k)
        used = nodes.shape[3] if differ[0] <= k <= differ[1] else terms
        top, left = fine * (y0 - places[i, 0]) + middle, fine * (x0 - places[i, 1]) + middle
        row, column = int(np.floor(top)) - 1, int(np.floor(left)) - 1
        v, dv = spline_weights(top - row - 1)
        h, dh = spline_weights(left - column - 1)
        begin, offset = column // fine, column % fine
        across = min(columns + 3, width - begin)
        for j in range(fine * (rows - 1) + 4):
            for p in range(fine):
                s = (j // fine) * across
                if used == 1:
                    lines = nodes[k : k + 4, row + j, p, 0, begin:]
                else:
                    lines = sums
                    for n in range(4):
                        for t in range(0, used, 4):
                            four = nodes[k + n, row + j, p, t : t + 4, begin:]
                            weighted(four, factors[i, t : t + 4], np.float32(1), across, sums[n], t > 0)
                weighted(lines, z, np.float32(1), across, scratch[0, j % fine, p, s:], False)
                if derivatives:
                    weighted(lines, dz, np.float32(1), across, scratch[1, j % fine, p, s:], False)
        s, light, step = starts[i], np.float32(places[i, 3]), np.float32(-places[i, 3] * fine)
        _along_x(scratch[0], offset, h, rows, across, scratch[2])
        _along_y(scratch[2], v, np.float32(1), rows, columns, across, values[3, s:])
        if not derivatives:
            continue
        _along_y(scratch[2], dv, step, rows, columns, across, values[0, s:])
        _along_x(scratch[0], offset, dh, rows, across, scratch[3])
        _along_y(scratch[3], v, step, rows, columns, across, values[1, s:])
        _along_x(scratch[1], offset, h, rows, across, scratch[4])
        _along_y(scratch[4], v, light, rows, columns, across, values[2, s:])
        for m in range(4, len(values)):
            if used == terms:
                values[m, s : s + rows * columns] = 0
                continue
            for j in range(fine * (rows - 1) + 4):
                for p in range(fine):
                    out = scratch[0, j % fine, p, (j // fine) * across :]
                    weighted(nodes[k : k + 4, row + j, p, terms + m - 4, begin:], z, np.float32(1), across, out, False)
            _along_x(scratch[0], offset, h, rows, across, scratch[2])
            _along_y(scratch[2], v, light, rows, columns, across, values[m, s:])


@inlined
def weighted(lines, weights, factor, count, out, add):  # pragma: no cover
    """Set `out` (count), or add to it, the sum of four `lines` with their `weights`, times a factor."""
    a0, a1, a2, a3 = lines[0], lines[1], lines[2], lines[3]
    w0, w1, w2, w3 = factor * weights[0], factor * weights[1], factor * weights[2], factor * weights[3]
    if add:
        for q in range(count):
            out[q] += w0 * a0[q] + w1 * a1[q] + w2 * a2[q] + w3 * a3[q]
    else:
        for q in range(count):
            out[q] = w0 * a0[q] + w1 * a1[q] + w2 * a2[q] + w3 * a3[q]


@inlined
def _along_x(lines, offset, h, rows, across, out):  # pragma: no cover
    """Fill `out` (fine, 1, pixels) from lines (fine, fine, nodes): four nodes for each pixel, the first at `offset`."""
    fine = len(lines)
    for p in range(fine):
        count = ((fine * (rows - 1) + 3 - p) // fine + 1) * across
        four = (
            lines[p, offset % fine, offset // fine :],
            lines[p, (offset + 1) % fine, (offset + 1) // fine :],
            lines[p, (offset + 2) % fine, (offset + 2) // fine :],
            lines[p, (offset + 3) % fine, (offset + 3) // fine :],
        )
        weighted(four, h, np.float32(1), count, out[p, 0], False)


@inlined
def _along_y(lines, v, factor, rows, columns, across, image):  # pragma: no cover
    """Fill `image` (rows * columns): four rows, of lines (fine, 1, pixels) by phase, for each pixel, times `factor`."""
    fine = len(lines)
    for r in range(rows):
        four = (
            lines[0, 0, r * across :],
            lines[1 % fine, 0, (r + 1 // fine) * across :],
            lines[2 % fine, 0, (r + 2 // fine) * across :],
            lines[3 % fine, 0, (r + 3 // fine) * across :],
        )
        weighted(four, v, factor, columns, image[r * columns :], False)


@compiled
def _add(frame, amplitude, top, bottom, boxes, starts, values):  # pragma: no cover
    """Add to the rows `top` to `bottom` of the frame."""
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        light = np.float32(amplitude[i])
        for r in range(max(y0, top), min(y1, bottom)):
            row, image = frame[r, x0:x1], values[3, starts[i] + (r - y0) * (x1 - x0) :]
            for q in range(len(row)):  # from 0: an index that cannot be negative is far faster
                row[q] += light * image[q]


@compiled
def _gradient(residual, weight, first, end, boxes, starts, values, sums):  # pragma: no cover
    for i in range(first, end):
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
def _matrix(weight, begin, end, moved, boxes, starts, values, band):  # pragma: no cover
    """Fill the columns `begin` to `end` of the band, where one of the two particles `moved`."""
    j0, j1, j2, j3 = values[0], values[1], values[2], values[3]
    zero = np.float32(0)
    for i in range(begin, end):
        y0, y1, x0, x1 = boxes[i]
        columns, c = x1 - x0, 4 * i
        if moved[i]:
            m00 = m01 = m02 = m03 = m11 = m12 = m13 = m22 = m23 = m33 = zero
            for r in range(y0, y1):
                s = starts[i] + (r - y0) * columns
                row = weight[r, x0:x1]
                a0, a1, a2, a3 = j0[s:], j1[s:], j2[s:], j3[s:]
                for q in range(len(row)):
                    w = row[q]
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
            band[0, c], band[1, c], band[2, c], band[3, c] = m00, m01, m02, m03
            band[0, c + 1], band[1, c + 1], band[2, c + 1] = m11, m12, m13
            band[0, c + 2], band[1, c + 2], band[0, c + 3] = m22, m23, m33
        for j in range(i + 1, len(boxes)):
            d = 4 * (j - i)
            if d + 3 >= len(band):
                break
            if not (moved[i] or moved[j]):
                continue
            top, bottom = max(y0, boxes[j, 0]), min(y1, boxes[j, 1])
            left, right = max(x0, boxes[j, 2]), min(x1, boxes[j, 3])
            if top >= bottom or left >= right:
                if band[d, c] != 0:
                    for k in range(4):
                        band[d - k : d - k + 4, c + k] = 0
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


def draw_error(
    error: NDArray[np.float32],
    step: int,
    places: NDArray[np.float64],
    boxes: NDArray[np.int64],
    slices: NDArray[np.float64],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Variance (rows, columns) of the patterns' error, from its standard deviation (N, m, m), `step` nodes a pixel."""
    out = np.zeros(shape, np.float32)
    nearest = np.clip(np.rint(slices).astype(int), 0, len(error) - 1)
    _add_error(error, step, places, boxes, nearest, out)
    return out


@compiled
def _add_error(error, step, places, boxes, nearest, out):  # pragma: no cover
    half = error.shape[1] // 2
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        row, column = half - int(np.rint(step * places[i, 0])), half - int(np.rint(step * places[i, 1]))
        light = np.float32(places[i, 3] ** 2)
        for r in range(y0, y1):
            j = min(max(row + step * r, 0), 2 * half)
            for c in range(x0, x1):
                k = min(max(column + step * c, 0), 2 * half)
                std = error[nearest[i], j, k]
                out[r, c] += light * std * std


def energy_beside_errors(
    columns: Columns,
    error: NDArray[np.float32],
    step: int,
    places: NDArray[np.float64],
    slices: NDArray[np.float64],
    weight: NDArray[np.float32],
    total: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Weighted squares of each particle's pattern, (P,), where the errors of the others' patterns add to the variance.

    `total` is the variance of all errors (rows, columns), from `draw_error`.
    """
    out = np.zeros(len(places))
    nearest = np.clip(np.rint(slices).astype(int), 0, len(error) - 1)
    _energy(columns.boxes, columns.starts, columns.values[3], error, step, places, nearest, weight, total, out)
    return out


@compiled
def _energy(boxes, starts, images, error, step, places, nearest, weight, total, out):  # pragma: no cover
    half = error.shape[1] // 2
    for i in range(len(boxes)):
        y0, y1, x0, x1 = boxes[i]
        row, column = half - int(np.rint(step * places[i, 0])), half - int(np.rint(step * places[i, 1]))
        light = np.float32(places[i, 3] ** 2)
        sum_ = 0.0
        for r in range(y0, y1):
            j = min(max(row + step * r, 0), 2 * half)
            s = starts[i] + (r - y0) * (x1 - x0) - x0
            for c in range(x0, x1):
                k = min(max(column + step * c, 0), 2 * half)
                std, trust, image = error[nearest[i], j, k], weight[r, c], images[s + c]
                others = max(total[r, c] - light * std * std, np.float32(0))
                sum_ += image * image * trust / (1 + trust * others)
        out[i] = sum_
