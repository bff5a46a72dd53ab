"""The projection onto a polytope is the nearest point, and what its unit says of itself holds."""

from functools import partial

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.batches import Batch
from reachjax.loops.units import Mark, ProjectionSlack, evaluate, projected
from tests.input_polytopes import SETS, exact_multipliers, exactly, polygon, polytope_loop

ROUNDING = 1e-13


@pytest.fixture(scope="module", params=SETS.values(), ids=list(SETS))
def inputs(request):
    """Normals and offsets."""
    return request.param


def points(C, d, count, seed=0):
    """Points (count, n) near the polytope and far from it."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, C.shape[1])) * 10.0 ** rng.uniform(-1.5, 1, size=(count, 1))


def nearest(C, d, y):
    """The nearest points, by one quadratic program."""
    u, size = cp.Variable(y.T.shape), np.linalg.norm(C, axis=1)[:, None]
    facets = (C / size) @ u <= np.repeat(d[:, None] / size, len(y), axis=1)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(u - y.T)), [facets])
    problem.solve(cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    return u.value.T


def on_all(C, d, y):
    return jax.vmap(lambda y: projected(y, C, jnp.asarray(d), evaluate))(jnp.asarray(y))


@pytest.mark.costly
def test_it_is_the_nearest_point(inputs):
    y = points(*inputs, 12)
    np.testing.assert_allclose(on_all(*inputs, y), nearest(*inputs, y), atol=2e-5)


def test_multipliers_satisfy_the_optimality_conditions(inputs):
    C, d = inputs
    y = points(C, d, 500)
    unit = ProjectionSlack.scaled(C, d)
    C, d = np.array(unit.normals), unit.offsets
    m = unit(y @ C.T - d)
    u = y - m @ C
    size = abs(y).max(axis=1, keepdims=True) + 1
    slack = d - u @ C.T
    assert np.all(m >= -ROUNDING * size)
    assert np.all(slack >= -ROUNDING * size)
    assert np.all(abs(m * slack) <= ROUNDING * size**2)


@pytest.mark.costly
def test_points_inside_stay_where_they_are(inputs):
    C, d = inputs
    y = 0.05 * points(C, d, 300)
    inside = np.all(y @ C.T <= d, axis=1)
    np.testing.assert_array_equal(on_all(C, d, y[inside]), y[inside])


def test_compiled_mapped_and_in_batches_on_the_host_it_is_the_same(inputs):
    C, d = inputs
    y = points(C, d, 40)
    on_host = projected(
        Batch(y), C, d, lambda unit, *y: Batch(unit(*(each.values for each in y)))
    ).values
    np.testing.assert_allclose(jax.jit(partial(on_all, C))(d, y), on_host, atol=1e-12)


@pytest.mark.costly
def test_derivatives_are_those_of_differences():
    C, d = polygon(5)
    f = lambda y, d: jnp.sum(jnp.sin(3 * projected(y, C, d, evaluate)))  # noqa: E731
    rng = np.random.default_rng(0)
    for y in points(C, d, 6):
        by = rng.normal(size=2), rng.normal(size=5)
        gradients = jax.grad(f, argnums=(0, 1))(jnp.asarray(y), jnp.asarray(d))
        exact = sum(float(g @ b) for g, b in zip(gradients, by, strict=True))
        ends = (f(y + h * by[0], jnp.asarray(d + h * by[1])) for h in (1e-6, -1e-6))
        assert abs(exact - float(np.subtract(*map(float, ends))) / 2e-6) < 1e-6


@pytest.mark.costly
def test_facets_that_meet_next_to_each_other_are_told_apart():
    """The corner of two facets at an angle of 1e-6, and of two that are opposite but for 1e-15."""
    for C in ([[0.0, 1.0], [1e-6, 1.0]], [[0.0, 1.0], [1e-15, -1.0]]):
        C, d = np.array(C), np.array([0.1, 0.1])
        y = points(C, d, 50)
        u = on_all(C, d, y)
        assert np.all(u @ C.T <= d + 1e-9)
        np.testing.assert_allclose(u, nearest(C, d, y), atol=2e-5)


@pytest.mark.costly
def test_a_flat_polytope_whose_facets_are_opposite_but_for_rounding_is_named():
    C, d = polygon(4)
    flat = d[[0, 1]].tolist()
    loop = polytope_loop((C, d))
    found = []
    for turn in np.linspace(0.1, 0.9, 9):
        C, _ = polygon(4, turn)
        given = rj.Polytope(C, [*flat, -flat[0], d[3]])
        try:
            u = np.asarray(jax.vmap(loop.replace(input_box=given).input)(points(C, d, 50)))
        except ValueError as error:
            found.append("if only by rounding" in str(error))
        else:
            assert np.all(u @ C.T <= given.b + 1e-9)
    assert all(found)


def boxes(C, d, count, seed=0):
    """Boxes of excesses (2, count, r) of all sizes, and in each some excesses that there are."""
    rng = np.random.default_rng(seed)
    middle = rng.normal(size=(count, 1, C.shape[1])) * 10.0 ** rng.uniform(-1.5, 0.7, (count, 1, 1))
    off = rng.uniform(-1, 1, size=(count, 4, C.shape[1])) * 10.0 ** rng.uniform(
        -9, 0, (count, 1, 1)
    )
    y = exactly(middle + off) @ exactly(C).T - exactly(d)
    lower, upper = y.min(axis=1), y.max(axis=1)
    down, up = lower.astype(float), upper.astype(float)
    down = np.where(exactly(down) > lower, np.nextafter(down, -np.inf), down)
    up = np.where(exactly(up) < upper, np.nextafter(up, np.inf), up)
    return down, up, y


@pytest.mark.parametrize("known", [True, False], ids=["offsets", "no offsets"])
def test_intervals_lines_and_remainders_hold_exact_multipliers(inputs, known):
    unit = ProjectionSlack.scaled(*inputs)
    C, d = np.array(unit.normals), unit.offsets
    unit = unit if known else unit.kind
    lower, upper, y = boxes(C, d, 12)
    least, most = map(exactly, unit.interval(lower, upper))
    lines = unit.lines(lower, upper)
    slopes = np.random.default_rng(1).normal(size=lower.shape)
    rests = [
        (s, *map(exactly, unit.remainder(s, lower, upper))) for s in (slopes, lines.above.slope)
    ]
    below, above = ((exactly(slope), exactly(offset)) for slope, offset in lines)
    told = 0
    for i, excesses in enumerate(y):
        for each in excesses:
            basic = exact_multipliers(C, each)
            assert basic
            for m in basic:
                assert np.all(least[i] <= m)
                assert np.all(m <= most[i])
                assert np.all(below[0][i] * each + below[1][i] <= m)
                assert np.all(m <= above[0][i] * each + above[1][i])
                assert np.all(m[lines.affine[i]] == 0)
                for slope, low, high in rests:
                    rest = m - exactly(slope[i]) * each
                    assert np.all(low[i] <= rest)
                    assert np.all(rest <= high[i])
        told += lines.affine[i].sum()
    assert told > 0


def test_facts_hold_of_exact_multipliers_and_one_of_each_pair_is_zero(inputs):
    unit = ProjectionSlack.scaled(*inputs)
    C, d = np.array(unit.normals), unit.offsets
    lower, upper, y = boxes(C, d, 12)
    for low, high, excesses in zip(lower, upper, y, strict=True):
        for each in excesses:
            m = np.array(exact_multipliers(C, each)[0])
            facts = unit.facts(each.astype(float), m.astype(float), low, high)
            size = 1e-14 * (1 + float(abs(each).max()))
            for block in facts.blocks:
                assert np.all(block.rows >= -size), block.name
            for left, right in facts.zero:
                assert np.all(abs(facts[left] * facts[right]) <= size * (1 + abs(m.astype(float))))
            sectors = {block.name for block in facts.blocks if block.mark is Mark.SECTOR}
            assert {name for pair in facts.zero for name in pair} <= sectors


def test_what_is_no_number_is_no_bound():
    unit = ProjectionSlack.scaled(*polygon(5))
    for ends in ((-np.inf, np.inf), (np.nan, 1.0), (-np.inf, 1.0)):
        lower, upper = (np.full(5, end) for end in ends)
        with np.errstate(invalid="ignore"):
            assert not np.isfinite(unit.interval(lower, upper)[1]).any()
            assert not unit.lines(lower, upper).affine.any()
    assert np.isnan(unit(np.full(5, np.nan))).all()


def test_the_loop_keeps_normals_in_its_structure_and_offsets_among_its_numbers():
    C, d = polygon(5)
    loop = polytope_loop((C, d))
    np.testing.assert_array_equal(loop.input_box.normals, C)
    np.testing.assert_array_equal(loop.input_box.polytope.b, d)
    assert len(jax.tree.leaves(loop.input_box)) == 1
    assert loop.unit_layers[-1] == (ProjectionSlack.scaled(C, d).kind, 5, 5)
    twice = loop.replace(input_box=rj.Polytope(np.tile(C, (2, 1)), np.append(d + 1, d)))
    np.testing.assert_array_equal(twice.input_box.normals, C)
    np.testing.assert_array_equal(twice.input_box.offsets, d)
    assert twice.replace(plant=loop.plant).input_box is twice.input_box


def test_what_cannot_be_projected_onto_is_named():
    C, d = polygon(4)
    loop = polytope_loop((C, d))

    def given(C, d):
        return loop.replace(input_box=rj.Polytope(C, d))

    with pytest.raises(TypeError, match=r"normals Polytope\.A that are numbers, but traced"):
        jax.jit(lambda C: given(C, d).simulate(jnp.ones(2), 1))(C)
    with pytest.raises(ValueError, match=r"input_box must hold an input, but .* is empty"):
        given(C, -np.ones(4))
    with pytest.raises(ValueError, match="the dimension of input_box is 3, but"):
        given(np.eye(3), np.ones(3))
    with pytest.raises(ValueError, match=r"40 facets for 2 inputs, which are 821 sets"):
        given(*polygon(40))
    with pytest.raises(TypeError, match="a Box or a Polytope, but an Ellipsoid"):
        loop.replace(input_box=rj.Ellipsoid([0.0, 0.0], np.eye(2)))


def test_offsets_may_be_traced_and_an_empty_polytope_then_is_no_number():
    C, d = polygon(4)
    loop, start = polytope_loop((C, d)), jnp.ones(2)
    normals = jnp.asarray(C)
    expected = loop.simulate(start, 2)
    for made in (
        lambda d: loop.replace(input_box=rj.Polytope(normals, d)),
        lambda d: loop.replace(input_box=loop.input_box.replace(offsets=d)),
    ):
        simulated = jax.jit(lambda d, made=made: made(d).simulate(start, 2))
        np.testing.assert_allclose(simulated(d), expected, atol=1e-14)
        assert np.isnan(simulated(-np.ones(4))[1:]).all()


def test_the_papers_matrices_are_of_boxes():
    from reachjax.programs.basis import change_of_basis

    with pytest.raises(TypeError, match=r"loop\.input_box must be a Box, as the paper has it"):
        change_of_basis(polytope_loop(polygon(3)))
