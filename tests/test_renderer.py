"""Images drawn from a spline: exact where they are known, near the microscope's between; derivatives and sums."""

import numpy as np
import pytest
from conftest import SIZE_PX, Z_UM, table
from scipy.interpolate import BSpline

from gdptlab.experiment.camera import Camera
from gdptlab.fit.model import field_terms
from gdptlab.fit.renderer import Renderer, along_z, draw_error, energy_beside_errors

HALF = SIZE_PX // 2
NOISE = Camera().read_noise
# Images between those of the stack, whose pixels are large against the sharpest structures: the worst pixel off by a
# share of the peak, all of them by a share of the image.
WORST, ALL = 0.08, 0.04
BETWEEN_DEPTHS = 0.015  # both, where only z is between


@pytest.fixture(scope="module")
def images(clean_stack):
    """Light of a particle at each depth."""
    return clean_stack - 500.0


@pytest.fixture(scope="module")
def shapes(images):
    return Renderer(images[None], 1, noise=NOISE)


def drawn(shapes, places, shape):
    """Frame of particles."""
    frame = np.zeros(shape, np.float32)
    shapes.draw(places, shape).add_to(frame, places[:, 3])
    return frame


def dense(columns, shape):
    """Columns as a matrix (pixels, 4 P)."""
    out = np.zeros((*shape, len(columns.boxes), 4))
    for i, (y0, y1, x0, x1) in enumerate(columns.boxes):
        values = columns.values[:, columns.starts[i] : columns.starts[i + 1]]
        if values.size:
            out[y0:y1, x0:x1, i] = values.reshape(4, y1 - y0, x1 - x0).transpose(1, 2, 0)
    return out.reshape(shape[0] * shape[1], -1)


def crowd(shape, n, seed, margin=0):
    """Random places, some beyond the frame by `margin`."""
    rng = np.random.default_rng(seed)
    y, x = (rng.uniform(-margin, side + margin, n) for side in shape)
    return np.stack([y, x, rng.uniform(0, len(Z_UM) - 1, n), rng.uniform(0.8, 1.2, n)], axis=1)


# -------------------- images


@pytest.mark.parametrize("k", [0, 1, 13, 36, 49, 50])
def test_images_themselves_come_back(shapes, images, k):
    """At whole pixels and the stack's own depths, within the box."""
    places = np.array([[40.0, 50.0, k, 1.0]])
    y0, y1, x0, x1 = shapes.draw(places, (90, 100)).boxes[0]
    assert y1 - y0 > 6 and x1 - x0 > 6
    expected = images[k, y0 - 40 + HALF : y1 - 40 + HALF, x0 - 50 + HALF : x1 - 50 + HALF]
    frame = drawn(shapes, places, (90, 100))
    np.testing.assert_allclose(frame[y0:y1, x0:x1], expected, atol=1e-4 * images[k].max())
    frame[y0:y1, x0:x1] = 0
    assert not frame.any()


def test_what_a_box_leaves_out_is_faint(shapes, images):
    for k, (down, across) in enumerate(shapes.support[0]):
        rest = images[k].copy()
        rest[HALF - down : HALF + down + 1, HALF - across : HALF + across + 1] = 0
        assert np.abs(rest).max() < 2 * NOISE
        assert np.abs(rest).sum() < 0.05 * images[k].sum()


def test_the_less_noise_the_farther_images_reach(images):
    reach = [Renderer(images[None], 1, noise=noise).support[0] for noise in (1.0, 38.0, 300.0)]
    assert (reach[0] >= reach[1]).all() and (reach[1] >= reach[2]).all()
    assert reach[0].mean() > reach[1].mean() > reach[2].mean()
    assert reach[0].max() <= HALF


@pytest.mark.parametrize(("seed", "aligned"), [(0, False), (1, False), (2, True)])
def test_drawn_like_the_microscope_renders(shapes, microscope, seed, aligned):
    """At sub-pixel places and between depths, or between depths alone."""
    for y, x, step, _ in crowd((30, 30), 15, seed):
        y, x = (round(35 + y), round(35 + x)) if aligned else (35 + y, 35 + x)
        light = microscope.light(table(x, y, np.interp(step, np.arange(51), Z_UM)), (100, 100))
        frame = drawn(shapes, np.array([[y, x, step, 1.0]]), (100, 100))
        seen = frame != 0
        off = (frame - light)[seen]
        assert np.abs(off).max() < (BETWEEN_DEPTHS if aligned else WORST) * light.max()
        assert np.linalg.norm(off) < (BETWEEN_DEPTHS if aligned else ALL) * np.linalg.norm(light)
        assert frame.sum() == pytest.approx(light[seen].sum(), rel=0.01)


def test_amplitude_is_a_factor(shapes):
    one, other = (drawn(shapes, np.array([[40.3, 50.8, 20.4, a]]), (90, 100)) for a in (1.1, 1.9))
    np.testing.assert_allclose(other, 1.9 / 1.1 * one, rtol=1e-5)


@pytest.mark.parametrize("axis", range(4))
def test_derivatives_are_those_of_the_image(shapes, axis):
    places = np.stack([[40.2, 50.6, step, 1.3] for step in (0.4, 7.3, 21.4, 40.1, 49.6)])
    for place in places[:, None]:
        columns = shapes.draw(place, (90, 100))
        h = np.zeros(4)
        h[axis] = 0.02
        up, down = (shapes.draw(place + s * h, (90, 100)) for s in (1, -1))
        np.testing.assert_array_equal(up.boxes, columns.boxes)
        up, down = (c.values[3] * (place[0, 3] + s * h[3]) for c, s in ((up, 1), (down, -1)))
        difference = (up.astype(float) - down) / 0.04
        assert np.abs(difference - columns.values[axis]).max() < 3e-3 * np.abs(difference).max()


# -------------------- boxes


def test_frame_edges_cut_images(shapes):
    """A frame is what a larger one shows in its place."""
    places = crowd((120, 150), 60, 3, margin=40)
    large = drawn(shapes, places + np.array((100, 100, 0, 0)), (320, 350))
    np.testing.assert_allclose(drawn(shapes, places, (120, 150)), large[100:220, 100:250], atol=0.05)
    boxes = shapes.draw(places, (120, 150)).boxes
    assert (boxes >= 0).all() and (boxes[:, 1] <= 120).all() and (boxes[:, 3] <= 150).all()


@pytest.mark.parametrize("place", [(-200, 50), (300, 50), (50, -31.6), (50, 131.6), (-500, 500)])
def test_a_particle_wholly_outside_has_no_pixel(shapes, place):
    places = np.array([[*place, 20, 1.0], [50, 50, 20, 1.0]])
    columns = shapes.draw(places, (100, 100))
    assert columns.starts[1] == columns.starts[0] == 0 < columns.starts[2] == columns.values.shape[1]
    y0, y1, x0, x1 = columns.boxes[0]
    assert y1 <= y0 or x1 <= x0
    np.testing.assert_array_equal(drawn(shapes, places, (100, 100)), drawn(shapes, places[1:], (100, 100)))
    ones = np.ones((100, 100), np.float32)
    assert not columns.gradient(ones, ones)[0][0].any()
    assert not columns.matrix(ones)[:, :4].any()


# -------------------- sums


@pytest.fixture(scope="module", params=["as they come", "sorted by x"])
def overlapping(request, shapes):
    """Columns of a crowd, some of it beyond the frame; the same as a matrix; weights, some 0; a residual."""
    shape = (110, 140)
    places = crowd(shape, 40, 4, margin=50)
    if request.param == "sorted by x":
        places = places[np.argsort(places[:, 1])]
    columns, rng = shapes.draw(places, shape), np.random.default_rng(5)
    weight = rng.uniform(0.5, 2, shape).astype(np.float32)
    weight[rng.random(shape) < 0.1] = 0
    return columns, dense(columns, shape), weight, rng.normal(0, 100, shape).astype(np.float32)


def test_gradient_is_the_dense_product(overlapping):
    columns, matrix, weight, residual = overlapping
    gradient, chi2 = columns.gradient(residual, weight)
    expected = matrix.T @ (weight.astype(float) * residual).ravel()
    size = np.sqrt((matrix**2).T @ (weight.astype(float) * residual**2).ravel())
    np.testing.assert_allclose(gradient.ravel() / (size + 1), expected / (size + 1), atol=1e-4)
    squares = weight.astype(float) * residual**2
    np.testing.assert_allclose(chi2, [squares[a:b, c:d].sum() for a, b, c, d in columns.boxes], rtol=1e-4)


def test_matrix_is_the_dense_product(overlapping):
    """All of it that is not 0 lies in the band."""
    columns, matrix, weight, _ = overlapping
    expected = np.tril(matrix.T @ (weight.ravel()[:, None] * matrix))
    band = columns.matrix(weight)
    full = np.zeros_like(expected)
    for below, diagonal in enumerate(band):
        entries = np.arange(max(len(full) - below, 0))
        full[entries + below, entries] = diagonal[: len(entries)]
        assert not diagonal[len(entries) :].any()
    size = np.sqrt(np.diag(expected)) + 1
    np.testing.assert_allclose(full / np.outer(size, size), expected / np.outer(size, size), atol=1e-5)
    assert np.count_nonzero(np.abs(full / np.outer(size, size)) > 1e-3) > 4 * 4 * 40  # they overlap indeed


def test_sorted_particles_make_a_narrow_band(shapes):
    places = crowd((60, 1500), 60, 6)
    ones = np.ones((60, 1500), np.float32)
    band, sorted_band = (shapes.draw(p, ones.shape).matrix(ones) for p in (places, places[places[:, 1].argsort()]))
    assert len(sorted_band) < len(band) / 4


def test_no_particles(shapes):
    columns, ones = shapes.draw(np.zeros((0, 4)), (70, 80)), np.ones((70, 80), np.float32)
    gradient, chi2 = columns.gradient(ones, ones)
    assert gradient.shape == (0, 4) and chi2.shape == (0,) and columns.matrix(ones).shape[1] == 0
    columns.add_to(ones, np.zeros(0))
    assert (ones == 1).all()


@pytest.mark.parametrize(("count", "degree"), [(12, 3), (5, 3), (4, 1), (3, 1)])
def test_spline_along_z_follows_a_cubic_to_its_ends(count, degree):
    """Of few images, a line."""
    steps, fine = np.arange(count), np.linspace(0, count - 1, 50)
    cubic = np.polynomial.Polynomial([3.0, -2.0, 0.5, 0.1][: degree + 1])
    coefficients = along_z(cubic(steps)[:, None])[:, 0]
    assert len(coefficients) == count + 2
    np.testing.assert_allclose(BSpline(np.arange(count + 6) - 3.0, coefficients, 3)(fine), cubic(fine), atol=1e-9)


# -------------------- patterns over the field, modes, threads, errors


def field_renderer(fine, half=12, count=9):
    """Smooth patterns with four terms, a focal surface, and two modes that begin at slice 2 and end at 6."""
    rng, m = np.random.default_rng(10), 2 * fine * half + 1
    y, x = (np.indices((m, m)) - m // 2) / fine
    rim = np.maximum(1 - (x**2 + y**2) / (half - 1) ** 2, 0) ** 2

    def smooth(n):
        a, b, c = rng.uniform(0.2, 0.5, (3, n, count, 1, 1))
        return rim * np.cos(a * x + b * y + 3 * c + 0.3 * np.arange(count)[:, None, None])

    modes = smooth(2)
    modes[:, :2], modes[:, 7:] = 0, 0
    surface = np.array([0.1, 0.6, -0.4, 0.3])
    patterns = smooth(4)
    return Renderer(patterns, fine, noise=1e-3, surface=surface, modes=modes), surface, patterns, modes


@pytest.mark.parametrize("fine", [1, 2])
@pytest.mark.parametrize("axis", range(6))
def test_derivatives_over_the_field(fine, axis):
    """By y, x, slice, amplitude and modes; the terms of the field are constant over an image."""
    renderer = field_renderer(fine)[0]
    shape, h = (4000, 5000), 0.01
    for place in ([1502.3, 2100.8, 3.3, 1.2, 0.5, -0.3], [2100.7, 900.2, 5.6, 0.8, -1.0, 0.4]):
        place = np.array([place])
        step = np.zeros(6)
        step[axis] = h
        columns = renderer.draw(place, shape, by_mode=True)
        up, down = (renderer.draw(place + s * step, shape, by_mode=True) for s in (1, -1))
        np.testing.assert_array_equal(up.boxes, columns.boxes)
        up, down = (c.values[3] * (place[0, 3] + s * step[3]) for c, s in ((up, 1), (down, -1)))
        difference = (up.astype(float) - down) / (2 * h)
        assert np.abs(difference).max() > 0.01
        assert np.abs(difference - columns.values[axis]).max() < 0.01 * np.abs(difference).max()


@pytest.mark.parametrize("fine", [1, 2])
def test_nodes_come_back_as_the_formula_says(fine):
    """At a whole pixel and slice: patterns weighted with the terms, plus modes."""
    renderer, surface, patterns, modes = field_renderer(fine)
    shape, (y, x), half = (90, 120), (40, 70), 12
    terms = field_terms(x, y, shape)
    place = np.array([[y, x, 4 + terms @ surface, 1.0, 0.7, -1.3]])
    expected = np.einsum("m,mij->ij", terms, patterns[:, 4]) + np.einsum("k,kij->ij", place[0, 4:], modes[:, 4])
    y0, y1, x0, x1 = renderer.draw(place, shape).boxes[0]
    inside = np.s_[y0 - y + half : y1 - y + half, x0 - x + half : x1 - x + half]
    np.testing.assert_allclose(drawn(renderer, place, shape)[y0:y1, x0:x1], expected[::fine, ::fine][inside], atol=1e-5)


def test_threads_change_nothing(images):
    """To the last bit: image, matrix, right-hand side."""
    places, rng = crowd((200, 300), 60, 12, margin=20), np.random.default_rng(13)
    weight, residual = rng.random((2, 200, 300)).astype(np.float32)
    one, two = (Renderer(images[None], 1, noise=NOISE, threads=n).draw(places, (200, 300)) for n in (1, 2))
    np.testing.assert_array_equal(one.values, two.values)
    np.testing.assert_array_equal(one.matrix(weight), two.matrix(weight))
    np.testing.assert_array_equal(one.gradient(residual, weight)[0], two.gradient(residual, weight)[0])
    frames = np.zeros((2, 200, 300), np.float32)
    for columns, frame in zip((one, two), frames, strict=True):
        columns.add_to(frame, places[:, 3])
    np.testing.assert_array_equal(*frames)


def test_brighter_particles_reach_farther(shapes):
    support = shapes.support
    assert (np.diff(support, axis=0) >= 0).all() and (support[4] > support[0]).mean() > 0.5


def test_errors_of_patterns_and_what_they_leave_of_others(shapes, images):
    """The variance is the square of amplitude and error; a particle's own error takes nothing from it."""
    error = np.full(images.shape, 7.0, np.float32)
    places = np.array([[60, 50, 20, 2.0], [63, 66, 24, 0.5], [60, 180, 24, 1.0]])
    columns, shape = shapes.draw(places, (120, 240)), (120, 240)
    total = draw_error(error, 1, places, columns.boxes, places[:, 2], shape)
    y0, y1, x0, x1 = columns.boxes[0]
    only = np.zeros(shape, bool)
    only[y0:y1, x0:x1] = True
    y0, y1, x0, x1 = columns.boxes[1]
    both = np.zeros(shape, bool)
    both[y0:y1, x0:x1] = True
    np.testing.assert_allclose(total[only & ~both], 14.0**2, rtol=1e-5)
    np.testing.assert_allclose(total[only & both], 14.0**2 + 3.5**2, rtol=1e-5)
    assert (only & both).any() and (only & ~both).any()
    weight = np.full(shape, NOISE**-2, np.float32)
    sure = energy_beside_errors(columns, error, 1, places, places[:, 2], weight, total)
    alone = np.add.reduceat(columns.values[3] ** 2, columns.starts[:-1])
    assert sure[2] == pytest.approx(alone[2] / NOISE**2, rel=1e-3)
    assert 0.3 * alone[1] < sure[1] * NOISE**2 < 0.97 * alone[1]
    assert sure[0] * NOISE**2 > 0.98 * alone[0]
