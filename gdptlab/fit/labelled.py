"""Patterns learned from particles of known position and depth, many depths in one frame, some overlapping.

A frame is a smooth background and the sum of the particles' images, each a cubic spline in z, y and x through values at
nodes: it is linear in those values. They are solved for by regularised least squares over all frames at once (conjugate
gradients), in turns with the particles' amplitudes and small corrections of x and y.
"""

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, uniform_filter1d

from gdptlab._compiled import compiled
from gdptlab.denoising import denoised, noise_level, noise_line
from gdptlab.fit.background import Background
from gdptlab.fit.bounds import REPEATS, SMOOTHED, derivatives
from gdptlab.fit.model import PatternModel, error_density
from gdptlab.fit.pattern import continued
from gdptlab.fit.renderer import Columns, Renderer, along_z, spline_weights, weighted

SMOOTHNESS = 1e-3
"""Weight of the squares of the patterns' second differences along z, in units of the mean weight of a slice. It only
fills gaps: noise that is alike in neighbouring slices would be taken for structure when patterns are denoised."""

TURNS = 3
"""Turns of solving for patterns and for particles."""

RIDGE = 1e-4
"""Weight, in the same units, of the squares of the patterns themselves, where no particle tells of them."""

MARGIN = 2
"""Pixels by which patterns are learned beyond where they are used: few pixels tell of the outermost nodes."""

MISFIT = 0.02
"""Standard deviation of a pixel that the patterns' own error adds, as a fraction of the light in it."""

ITERATIONS, CONVERGED = 25, 1e-3
"""Most steps of conjugate gradients, and the residual, as a fraction of the first, at which they end."""

LONGEST = (0.5, 0.5, 0.3)
"""Longest step of y and x (px), and of the amplitude (as a fraction of it), in a turn."""

UNSURE_PX, LEAST_UNSURE_PX = 0.5, 0.003
"""Standard deviation of the labels' errors in y and x: at first, and least."""

LIGHT = 8
"""Highest degree of the polynomials in z that tell the light of the patterns from that of the particles; a third of the
number of slices, if that is less."""

MEDIAN_SQUARE = 0.4549
"""Median square of normal deviates of standard deviation 1."""

FAINTEST = 0.02
"""Least amplitude, as a fraction of the median."""

EDGE = 2
"""Nodes beyond the learned ones on each side that the spline's four-point support needs."""


class Labelled:
    """Frames (F, rows, columns) and what is known of the particles in them.

    Parameters
    ----------
    frames : float32 array (F, rows, columns)
    frame : int array (P,)
        Frame of each particle.
    places : float64 array (P, 4)
        y, x (px), slice (0 to count - 1), amplitude.
    count : int
        Number of slices of the patterns.
    half : int
        Support of the patterns to each side of the middle, px.
    fine : int
        Nodes per px, 1 or 2.

    Attributes
    ----------
    patterns : float32 array (count, m, m)
        In counts at amplitude 1, the median particle's; m = 2 fine half + 1.
    places
        As they are after the last turn.
    weights : float32 array (F, rows, columns)
        One over the variance of each pixel.
    """

    def __init__(
        self, frames: NDArray[np.float32], frame: NDArray, places: NDArray, count: int, half: int, fine: int = 1
    ) -> None:
        order = np.lexsort((places[:, 1], frame))
        self.order, self.frames = order, frames
        self.frame, self.places = frame[order], places[order].astype(float)
        self.count, self.half, self.fine = count, half, fine
        self.labels, self.unsure = self.places.copy(), np.full(2, UNSURE_PX)
        self.noise = max(noise_level(frames), 1e-4 * float(np.ptp(frames))) or 1.0
        self.line = np.array([0.0, self.noise**2])
        self._reach, self._surface = half + MARGIN, Background(frames.shape[1:], 4 * half)
        self._along = along_z(np.eye(count)).astype(np.float32)
        m = 2 * fine * self._reach + 1 + 2 * EDGE
        self._nodes = np.zeros((count, m, m), np.float32)
        self.weights = np.full(frames.shape, self.noise**-2, np.float32)
        self._offset = np.median(frames)
        self._levels = np.stack([self._surface.gradient(image, image) for image in np.zeros_like(frames)])
        self.backgrounds = np.full_like(frames, self._offset)

    def learn(self, turns: int = TURNS) -> None:
        """Patterns, amplitudes and corrections of x and y, in turns."""
        for _ in range(turns):
            self.solve()
            self.correct()
        self.solve()

    # ---------------- patterns

    def solve(self) -> None:
        """Patterns and backgrounds that fit best, together, from those there are, by conjugate gradients."""
        normal, smooth = self._normal_in_z()
        inverse = np.linalg.inv(normal).astype(np.float32)
        surfaces = [np.linalg.inv(self._surface.matrix(weight)) for weight in self.weights]

        def pushed(nodes: NDArray, levels: NDArray) -> tuple[NDArray, NDArray]:
            image = self._drawn(nodes) + np.stack([self._surface.surface(level) for level in levels])
            collected, gradient = pulled(image)
            return collected + _along(smooth, nodes), gradient

        def pulled(image: NDArray) -> tuple[NDArray, NDArray]:
            gradients = [self._surface.gradient(i, w) for i, w in zip(image, self.weights, strict=True)]
            return self._collected(self.weights * image), np.stack(gradients)

        def conditioned(nodes: NDArray, levels: NDArray) -> tuple[NDArray, NDArray]:
            return _along(inverse, nodes), np.stack([m @ level for m, level in zip(surfaces, levels, strict=True)])

        solution = self._nodes, self._levels
        rest = _sum(pulled(self.frames - self._offset), -1, pushed(*solution))
        direction = step = conditioned(*rest)
        power = first = _dot(rest, step)
        for _ in range(ITERATIONS):
            if power <= CONVERGED**2 * first or power == 0:
                break
            product = pushed(*direction)
            length = power / _dot(direction, product)
            solution, rest = _sum(solution, length, direction), _sum(rest, -length, product)
            step = conditioned(*rest)
            before, power = power, _dot(rest, step)
            direction = _sum(step, power / before, direction)
        self._nodes, self._levels = solution
        values = self._nodes
        for axis in (1, 2):
            values = convolve1d(values, [1 / 6, 4 / 6, 1 / 6], axis=axis)
        inner = slice(EDGE + self.fine * MARGIN, -EDGE - self.fine * MARGIN)
        self.patterns = np.ascontiguousarray(values[:, inner, inner])
        self.backgrounds = self._offset + np.stack([self._surface.surface(level) for level in self._levels])

    def _normal_in_z(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix (N, N) of the least squares for a pixel in the middle of all particles, and what keeps it smooth."""
        shares = self.places[:, 3, None] * self._z_weights()
        matrix = float(np.median(self.weights)) * shares.T @ shares
        second = np.diff(np.eye(self.count), 2, axis=0)
        smooth = np.trace(matrix) / self.count * (SMOOTHNESS * second.T @ second + RIDGE * np.eye(self.count))
        return matrix + smooth, smooth

    def _z_weights(self) -> NDArray[np.float64]:
        """By how much each slice counts in each particle's image, (P, N)."""
        k = np.clip(np.floor(self.places[:, 2]).astype(int), 0, self.count - 2)
        f = self.places[:, 2] - k
        four = np.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, 3 * (1 - f) ** 3 - 6 * (1 - f) ** 2 + 4, f**3]) / 6
        return sum(four[j, :, None] * self._along[k + j] for j in range(4))

    def _drawn(self, nodes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Images (F, rows, columns) of the particles."""
        out = np.zeros(self.frames.shape, np.float32)
        _draw(_along(self._along, nodes), self.frame, self.places, self.fine, self._reach, out)
        return out

    def _collected(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Transpose of `_drawn`."""
        out = np.zeros((self.count + 2, *self._nodes.shape[1:]), np.float32)
        _collect(images, self.frame, self.places, self.fine, self._reach, out)
        return _along(self._along.T, out)

    # ---------------- particles

    def correct(self) -> None:
        """A Gauss-Newton step of all particles' y, x and amplitude; weights anew. Depths stay as they are labelled.

        What the frames say of a label counts beside the label itself: `unsure` is how far labels are off, on the whole.
        """
        renderer, places, model = Renderer(self.patterns[None], self.fine, noise=self.noise), self.places, []
        variance = np.empty((len(places), 2))
        for k in range(len(self.frames)):
            here = np.flatnonzero(self.frame == k)
            columns, light = self._light(renderer, k)
            model.append(light + self.backgrounds[k])
            self.weights[k] = self._weight(light, model[k])
            index = (4 * np.arange(len(here))[:, None] + (0, 1, 3)).ravel()
            matrix, right = normal_equations(columns, self.frames[k] - model[k], self.weights[k])
            matrix, right = matrix[np.ix_(index, index)], right[index]
            precision = np.tile([*self.unsure**-2, 0], (len(here), 1))
            off = places[here][:, [0, 1, 3]] - self.labels[here][:, [0, 1, 3]]
            right -= (precision * off).ravel()
            matrix[np.diag_indices(len(matrix))] += precision.ravel() + 1e-9 * np.trace(matrix) / max(len(matrix), 1)
            inverse = np.linalg.inv(matrix)
            variance[here] = np.diag(inverse).reshape(-1, 3)[:, :2]
            longest = np.full((len(here), 3), LONGEST)
            longest[:, 2] *= places[here, 3]
            places[np.ix_(here, [0, 1, 3])] += np.clip((inverse @ right).reshape(-1, 3), -longest, longest)
        self.line = noise_line(self.frames - np.stack(model), np.stack(model))
        places[:, 3] = np.maximum(places[:, 3] / np.median(places[:, 3]), FAINTEST)
        self._learn_unsure(variance)
        self._share_light()

    def _learn_unsure(self, variance: NDArray[np.float64]) -> None:
        """How far labels are off in y and x: the scatter of what the frames alone say, less the error of that.

        `variance` (P, 2) is that of a place as frames and labels say together.
        """
        weight = np.maximum(1 - variance / self.unsure**2, 0.1)  # of the frames
        off = (self.places - self.labels)[:, :2] / weight
        excess = np.median(off**2, axis=0) / MEDIAN_SQUARE - np.median(variance / weight, axis=0)
        self.unsure = np.sqrt(np.clip(excess, LEAST_UNSURE_PX**2, self.unsure**2))

    def _share_light(self) -> None:
        """Share the light at each depth between patterns and amplitudes, whose product is all that frames tell.

        The light of the patterns is made smooth along z; that of the particles to have no trend along z.
        """
        at, depth = np.linspace(-1, 1, self.count), 2 * self.places[:, 2] / (self.count - 1) - 1
        light, degree = (
            np.log(np.maximum(np.linalg.norm(self.patterns, axis=(1, 2)), 1e-9)),
            min(LIGHT, self.count // 3),
        )
        rough = Polynomial.fit(at, light, degree)(at) - light
        amplitude = np.log(self.places[:, 3]) - np.interp(depth, at, rough)
        trend = Polynomial.fit(depth, np.clip(amplitude - np.median(amplitude), -1, 1), degree)
        factor = np.exp(rough + trend(at)).astype(np.float32)[:, None, None]
        self.places[:, 3] = np.exp(amplitude - trend(depth))
        self.patterns, self._nodes = self.patterns * factor, self._nodes * factor

    def _light(self, renderer: Renderer, k: int) -> tuple[Columns, NDArray[np.float32]]:
        """Particles of frame k as they are drawn, and their sum."""
        here = self.places[self.frame == k]
        columns, light = renderer.draw(here, self.frames.shape[1:]), np.zeros(self.frames.shape[1:], np.float32)
        columns.add_to(light, here[:, 3])
        return columns, light

    def _weight(self, light: NDArray[np.float32], model: NDArray[np.float32]) -> NDArray[np.float32]:
        """One over the variance of each pixel: of its noise and of the patterns' own error."""
        return 1 / (self._variance(model) + np.square(np.float32(MISFIT) * light))

    def _variance(self, model: NDArray[np.float32]) -> NDArray[np.float32]:
        """Variance of the noise of each pixel."""
        slope, intercept = self.line.astype(np.float32)
        return np.maximum(intercept + slope * model, np.float32(self.noise**2 / 4))

    # ---------------- what is handed over

    def explained(self) -> NDArray[np.float64]:
        """Fraction of the light in each frame, beyond background and noise, that the model explains, (F,)."""
        image, left = self._drawn(self._nodes), self.frames - self.backgrounds
        squares = np.square(left), np.square(left - image), self._variance(image + self.backgrounds)
        before, after, noise = ((self.weights * square).mean(axis=(1, 2)) for square in squares)
        return (before - after) / np.maximum(before - noise, 1e-9)

    def model(self, z_um: NDArray[np.float64]) -> PatternModel:
        """Denoised patterns that go on beyond their cut, with their errors: those of patterns with fresh noise."""
        smooth = denoised(self.patterns)
        noise = np.sqrt(np.polyval(noise_line(self.patterns - smooth, smooth), smooth))
        known = np.sqrt(np.diag(np.linalg.inv(self._normal_in_z()[0])))
        noise *= (known / np.median(known))[:, None, None]
        draws = [smooth + np.random.default_rng(seed).normal(0, noise) for seed in range(REPEATS)]
        errors = np.array([denoised(draw) for draw in draws]) - smooth
        images = smooth[:, :: self.fine, :: self.fine]
        rows = np.linalg.pinv(derivatives(images, z_um))[:, :3]
        off = rows @ errors[:, :, :: self.fine, :: self.fine].reshape(REPEATS, len(images), -1, 1)
        patterns = continued(smooth)
        rim = (patterns.shape[-1] - smooth.shape[-1]) // 2
        around = ((0, 0), (0, 0), (rim, rim), (rim, rim))
        return PatternModel(
            patterns=patterns[None].astype(np.float32),
            z_um=z_um,
            nodes_per_px=self.fine,
            noise=self.noise,
            size=2 * self.half + 1,
            pattern_error=error_density(np.pad(errors, around, mode="edge"), self.fine),
            own_error=np.sqrt(uniform_filter1d(np.mean(off**2, axis=0)[..., 0], SMOOTHED, axis=0, mode="nearest")),
            own_bias_um=np.zeros(len(z_um)),
        )


def normal_equations(
    columns: Columns, residual: NDArray[np.float32], weight: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix (4 P, 4 P) and right-hand side (4 P,) for y, x, slice and amplitude of the particles of a frame."""
    band, n = columns.matrix(weight), 4 * len(columns.boxes)
    matrix = np.zeros((n, n))
    for below, row in enumerate(band):
        i = np.arange(n - below)
        matrix[i + below, i] = matrix[i, i + below] = row[: n - below]
    return matrix, columns.gradient(residual, weight)[0].ravel()


def _sum(one: tuple, factor: float, other: tuple) -> tuple:
    """Arrays of `one` plus `factor` times those of `other`."""
    return tuple(a + a.dtype.type(factor) * b for a, b in zip(one, other, strict=True))


def _dot(one: tuple, other: tuple) -> float:
    """Product of all arrays of `one` with those of `other`."""
    return sum(float(np.vdot(a, b)) for a, b in zip(one, other, strict=True))


def _along(matrix: NDArray, nodes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Matrix (L, N) applied along z to nodes (N, m, m)."""
    return (matrix.astype(np.float32) @ nodes.reshape(len(nodes), -1)).reshape(-1, *nodes.shape[1:])


@compiled
def _ends(position, half, size):  # pragma: no cover
    """First pixel and end of the support of a particle, cut at the frame."""
    return max(int(np.ceil(position - half)), 0), min(int(np.floor(position + half)) + 1, size)


@compiled
def _draw(nodes, frame, places, fine, half, out):  # pragma: no cover
    """Add the images of particles to `out`: along z, then y, then x.

    The renderer itself takes patterns, not nodes, and its supports change with the amplitude, so that it has no
    transpose in the nodes.
    """
    levels, m, one = nodes.shape[0], nodes.shape[1], np.float32(1)
    plane, line = np.empty((m, m), np.float32), np.empty(m, np.float32)
    for i in range(len(places)):
        y, x, s, amplitude = places[i]
        k = min(max(int(np.floor(s)), 0), levels - 4)
        z = spline_weights(s - k)[0]
        for r in range(m):
            weighted(nodes[k : k + 4, r], z, np.float32(amplitude), m, plane[r], False)
        y0, y1 = _ends(y, half, out.shape[1])
        x0, x1 = _ends(x, half, out.shape[2])
        top, left = fine * (y0 - y) + fine * half, fine * (x0 - x) + fine * half
        row, column = int(np.floor(top)), int(np.floor(left))
        v, h = spline_weights(top - row)[0], spline_weights(left - column)[0]
        q = column + EDGE - 1
        four = line[q::fine], line[q + 1 :: fine], line[q + 2 :: fine], line[q + 3 :: fine]
        for r in range(y0, y1):
            j = row + fine * (r - y0) + EDGE - 1
            weighted(plane[j : j + 4], v, one, m, line, False)
            weighted(four, h, one, x1 - x0, out[frame[i], r, x0:], True)


@compiled
def _collect(images, frame, places, fine, half, out):  # pragma: no cover
    """Transpose of `_draw`: add to the nodes `out` what each particle has of the images."""
    levels, m = out.shape[0], out.shape[1]
    plane, line = np.empty((m, m), np.float32), np.empty(m, np.float32)
    for i in range(len(places)):
        y, x, s, amplitude = places[i]
        y0, y1 = _ends(y, half, images.shape[1])
        x0, x1 = _ends(x, half, images.shape[2])
        top, left = fine * (y0 - y) + fine * half, fine * (x0 - x) + fine * half
        row, column = int(np.floor(top)), int(np.floor(left))
        v, h = spline_weights(top - row)[0], spline_weights(left - column)[0]
        plane[:] = 0
        for r in range(y0, y1):
            line[:] = 0
            image = images[frame[i], r]
            for c in range(x0, x1):
                q = column + fine * (c - x0) + EDGE - 1
                line[q] += h[0] * image[c]
                line[q + 1] += h[1] * image[c]
                line[q + 2] += h[2] * image[c]
                line[q + 3] += h[3] * image[c]
            j = row + fine * (r - y0) + EDGE - 1
            for n in range(4):
                into = plane[j + n]
                for c in range(m):
                    into[c] += v[n] * line[c]
        k = min(max(int(np.floor(s)), 0), levels - 4)
        z = spline_weights(s - k)[0]
        for n in range(4):
            factor = np.float32(amplitude) * z[n]
            for r in range(m):
                into, given = out[k + n, r], plane[r]
                for c in range(m):
                    into[c] += factor * given[c]
