"""Claims about midpoint-radius arithmetic: it encloses the exact result, and not by much.

Exact results are computed with fractions. A ball `x` stands for every number within `x.rad` of
`x.mid`, so the result must hold the exact midpoint plus all that the radii can add.
"""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reachjax.numerics.rounding import TINY, UNIT, Ball, settled

fractions = np.vectorize(Fraction, otypes=[object])

# as JAX compiles by itself: `conftest` has most functions compiled without these passes
OPTIMISED = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False}


def random_data(seed, magnitude=1.0, rows=4, length=7):
    """A matrix, two vectors and their radii; signs vary, so sums cancel in part."""
    rng = np.random.default_rng(seed)
    W, M = magnitude * rng.normal(size=(rows, length)), rng.normal(size=(length, rows))
    x, y = rng.normal(size=(2, length))
    return W, M, magnitude * x, magnitude * y, *(magnitude * rng.uniform(size=(2, length)))


def mixed_data(seed):
    """Entries from 1e-20 to 1e20 in one sum."""
    W, M, x, y, dx, dy = random_data(seed)
    spread = 10.0 ** np.random.default_rng(seed).uniform(-20, 20, size=x.shape)
    return W, M, x * spread, y / spread, dx * spread * 1e-6, dy / spread * 1e-6


def cancelling_data(seed):
    """`W x` and `x + y` are at rounding level, though their terms are not."""
    W, M, x, _, dx, dy = random_data(seed)
    W[:, -1] = -(W[:, :-1] @ x[:-1]) / x[-1]
    M[-1] = -(x[:-1] @ M[:-1]) / x[-1]
    return W, M, x, -x * (1 + 3 * UNIT), 1e-17 * dx, 1e-17 * dy


DATA = {
    "of order one": random_data(0),
    "large": random_data(1, magnitude=1e90),
    "small": random_data(2, magnitude=1e-90),
    "of mixed magnitude": mixed_data(3),
    "cancelling": cancelling_data(4),
    "one term": random_data(5, length=1),
    "many terms": random_data(6, rows=2, length=300),
}

# (operation, what it does to radii, sizes of what is rounded)
OPERATIONS = {
    "matrix @ ball": (
        lambda W, M, x, y: W @ x,
        lambda W, M, dx, dy: abs(W) @ dx,
        lambda W, M, x, y: abs(W) @ abs(x),
    ),
    "ball @ matrix": (
        lambda W, M, x, y: x @ M,
        lambda W, M, dx, dy: dx @ abs(M),
        lambda W, M, x, y: abs(x) @ abs(M),
    ),
    "ball + ball": (
        lambda W, M, x, y: x + y,
        lambda W, M, dx, dy: dx + dy,
        lambda W, M, x, y: abs(x + y),
    ),
    "ball - ball": (
        lambda W, M, x, y: x - y,
        lambda W, M, dx, dy: dx + dy,
        lambda W, M, x, y: abs(x - y),
    ),
    "array + ball": (
        lambda W, M, x, y: W[0] + x,
        lambda W, M, dx, dy: dx,
        lambda W, M, x, y: abs(W[0] + x),
    ),
    "array - ball": (
        lambda W, M, x, y: W[0] - x,
        lambda W, M, dx, dy: dx,
        lambda W, M, x, y: abs(W[0] - x),
    ),
    "ball - array": (
        lambda W, M, x, y: x - W[0],
        lambda W, M, dx, dy: dx,
        lambda W, M, x, y: abs(x - W[0]),
    ),
    "matrix @ ball @ matrix": (
        lambda W, M, x, y: W @ x @ W,
        lambda W, M, dx, dy: abs(W) @ dx @ abs(W),
        lambda W, M, x, y: abs(W) @ abs(x) @ abs(W),
    ),
}


@pytest.mark.parametrize(
    ("numpy_like", "compiled"),
    [(np, False), (jnp, False), (jnp, True)],
    ids=["numpy", "jax", "compiled"],
)
@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS.keys())
@pytest.mark.parametrize("data", DATA.values(), ids=DATA.keys())
def test_the_exact_result_is_enclosed_by_a_small_radius(data, operation, numpy_like, compiled):
    compute, widen, size = operation
    W, M, x, y, dx, dy = data
    arrays = [numpy_like.asarray(part) for part in (W, M)]
    balls = [Ball(numpy_like.asarray(m), numpy_like.asarray(r)) for m, r in ((x, dx), (y, dy))]
    as_shipped = jax.jit(compute, compiler_options=OPTIMISED)
    ball = (as_shipped if compiled else compute)(*arrays, *balls)

    exact = [fractions(part) for part in data]
    distance = abs(fractions(ball.mid) - compute(*exact[:4])) + widen(*exact[:2], *exact[4:])
    radius = fractions(ball.rad)
    assert (distance <= radius).all()
    rounding = size(*exact[:4]) + widen(*exact[:2], *exact[4:])
    assert (radius <= distance + 4 * (len(x) + 30) * Fraction(UNIT) * rounding).all()


@pytest.mark.parametrize("data", DATA.values(), ids=DATA.keys())
def test_lower_and_upper_bound_the_whole_ball(data):
    mid, rad = data[2], data[4]
    ball = Ball(jnp.asarray(mid), jnp.asarray(rad))
    below, above = fractions(mid) - fractions(rad), fractions(mid) + fractions(rad)
    spare = Fraction(40 * UNIT) * (abs(fractions(mid)) + fractions(rad))
    assert (below - spare <= fractions(ball.lower)).all()
    assert (fractions(ball.lower) <= below).all()
    assert (above <= fractions(ball.upper)).all()
    assert (fractions(ball.upper) <= above + spare).all()


@pytest.mark.parametrize("data", DATA.values(), ids=DATA.keys())
def test_a_ball_between_two_bounds_holds_both_and_little_more(data):
    lower, upper = np.minimum(data[2], data[3]), np.maximum(data[2], data[3])
    ball = Ball.between(jnp.asarray(lower), jnp.asarray(upper))
    mid, rad = fractions(ball.mid), fractions(ball.rad)
    assert (mid - rad <= fractions(lower)).all()
    assert (fractions(upper) <= mid + rad).all()
    size = abs(fractions(lower)) + abs(fractions(upper))
    half = (fractions(upper) - fractions(lower)) / 2
    # the radius covers every rounding of the midpoint, not only the one seen here
    assert (rad <= half * (1 + Fraction(40 * UNIT)) + Fraction(16 * UNIT) * size).all()


def test_a_ball_between_equal_bounds_is_that_number():
    x = jnp.asarray(DATA["of mixed magnitude"][2])
    ball = Ball.between(x, x)
    np.testing.assert_array_equal(ball.mid, x)
    np.testing.assert_array_equal(ball.rad, 0.0)


def test_a_ball_minus_itself_keeps_its_width():
    ball = Ball(jnp.array([1.0, -2.0]), jnp.array([0.5, 0.25]))
    difference = ball - ball
    np.testing.assert_array_equal(difference.mid, 0.0)
    np.testing.assert_allclose(difference.rad, [1.0, 0.5], rtol=1e-14)


def test_negation_and_indexing_keep_radii():
    ball = Ball(jnp.array([1.0, -2.0, 3.0]), jnp.array([0.1, 0.2, 0.3]))
    part = (-ball)[1:]
    np.testing.assert_array_equal(part.mid, [2.0, -3.0])
    np.testing.assert_array_equal(part.rad, [0.2, 0.3])


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other compilers keep barriers")
def test_what_is_settled_is_rounded_once_for_all_its_uses():
    x = jnp.arange(1.0, 4.0) / 3

    def used_twice(x):
        once = settled(x * x + 1.0)
        return jnp.concatenate([once[:, None] * x, once[:, None]], axis=1)

    compiled = jax.jit(used_twice).lower(x).compile()
    assert compiled.as_text().count(" call(") == 1
    np.testing.assert_array_equal(compiled(x)[:, -1], x * x + 1.0)
    np.testing.assert_allclose(jax.grad(lambda x: used_twice(x)[:, -1].sum())(x), 2 * x)


@pytest.mark.parametrize("first", [False, True])
def test_what_is_not_known_is_not_known_of_what_two_balls_hold(first):
    unknown, other = Ball(np.full(1, -np.inf), np.full(1, np.inf)), Ball(np.ones(1), np.ones(1))
    with np.errstate(invalid="ignore"):
        found = unknown.meeting(other) if first else other.meeting(unknown)
        assert not found.lower[0] > 0
        assert not found.upper[0] < 2


def test_compiled_ranges_narrower_than_all_normal_numbers_are_held():
    lower, upper = np.array([0.0, TINY, 1.0]), np.array([1.5 * TINY, 1.5 * TINY, 1.0])
    mid, rad = jax.jit(lambda *ends: ((ball := Ball.between(*ends)).mid, ball.rad))(lower, upper)
    mid, rad = np.asarray(mid), np.asarray(rad)
    assert np.all((mid - rad <= lower) & (upper <= mid + rad))
    assert rad[2] == 0.0


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other compilers keep barriers")
def test_what_is_settled_is_chosen_once_for_all_its_uses():
    x = jnp.arange(1.0, 4.0) / 3

    def chosen(x):
        better = settled(x * x + 1.0 <= 2.0 * x + 0.1)
        return jnp.where(better, x, 1.0), jnp.where(better, x * x, 0.0)

    compiled = jax.jit(chosen).lower(x).compile()
    assert compiled.as_text().count(" call(") == 1
    slopes = jax.grad(lambda x: sum(part.sum() for part in chosen(x)))(x)
    np.testing.assert_allclose(slopes, np.where(x == 1, 1 + 2 * x, 0.0))
    np.testing.assert_array_equal(jax.vmap(chosen)(x)[0], compiled(x)[0])
