"""Tubes of intersections: facets and an ellipsoid together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import one_step, recursion
from tests.differences import error_in_all_parts
from tests.networks import box_region, simplex_region
from tests.sets.test_intersection import intersection
from tests.solvers.test_enclosures import PROMISED, case

FACETS = {1: rj.Template.box(1), 2: rj.Template.octagonal(2), 3: rj.Template.box(3)}


def starts(n):
    """One initial set of each kind."""
    corners, simplex = box_region(n, 1).corners, simplex_region(n, 1)
    return {
        "box": rj.Box(corners.min(axis=0), corners.max(axis=0)),
        "polytope": rj.Polytope(simplex.A, simplex.b),
        "ellipsoid": case(n, 1)[1],
        "intersection": intersection(n, 1),
    }


@pytest.mark.parametrize("X0", ["box", "polytope", "ellipsoid", "intersection"])
@pytest.mark.costly
def test_a_step_has_what_either_template_alone_has(X0):
    loop, region = case(2, 1, hidden=(3,))[0], starts(2)[X0]
    both, _ = one_step(loop, region, rj.MixedTemplate(FACETS[2]))
    polytope, _ = one_step(loop, region, FACETS[2])
    ellipsoid, _ = one_step(loop, region, rj.EllipsoidTemplate())
    np.testing.assert_allclose(both.polytope.b, polytope.b, atol=1e-7)
    np.testing.assert_allclose(both.ellipsoid.shape, ellipsoid.shape, atol=1e-7)
    D = np.random.default_rng(0).normal(size=(8, 2))
    least = np.minimum(polytope.support(D), ellipsoid.support(D))
    np.testing.assert_allclose(both.support(D), least, atol=1e-6)


@pytest.mark.costly
def test_later_sets_are_smaller_than_those_of_either_template_alone():
    loop, X0 = case(3, 1)
    both = recursion(loop, X0, 3, rj.MixedTemplate(FACETS[3]))
    for alone in (FACETS[3], rj.EllipsoidTemplate()):
        tube = recursion(loop, X0, 3, alone)
        for t in (1, 2, 3):
            assert both.sets[t].volume() <= tube.sets[t].volume() * (1 + 1e-6)


@pytest.mark.costly
def test_facets_tell_a_program_what_the_ellipsoid_does_not():
    # x+ = x / 2 from the half of a disk: the facet `x_1 <= 0` counts beside the cone
    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1))), net)
    half = rj.Intersection(rj.Box([-1.0, -1.0], [0.0, 1.0]), rj.Ellipsoid([0.0, 0.0], np.eye(2)))
    following, _ = one_step(loop, half, rj.MixedTemplate(rj.Template.box(2)))
    np.testing.assert_allclose(following.polytope.b, [0.0, 0.5, 0.5, 0.5], atol=1e-6)
    # the ellipse of least area around half of a disk has sqrt(16 / 27) times the disk's area
    least = np.sqrt(16 / 27) * np.pi / 4
    assert float(following.ellipsoid.volume()) == pytest.approx(least, rel=1e-5)


@pytest.mark.costly
def test_units_that_never_switch_may_be_kept():
    loop, X0 = case(2, 1, hidden=(3,))
    relaxation = rj.LocalBounds(remove_stable=False)
    tube = recursion(loop, X0, 2, rj.MixedTemplate(FACETS[2]), relaxation)
    reached = tube.simulate(2000)
    for t in (1, 2):
        assert bool(tube.sets[t].contains(reached[:, t], 1e-9).all())


@pytest.mark.costly
def test_flat_images_and_flat_parts_hold():
    plant = rj.AffinePlant([[1.0, 1.0], [2.0, 2.0]], [[0.0], [0.0]])
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers([([[0.0, 0.0]], [0.0])]))
    ball, template = rj.Ellipsoid([0.0, 0.0], np.eye(2)), rj.MixedTemplate(FACETS[2])
    for X0 in (ball, rj.Intersection(rj.Box([0.1, -0.5], [0.1, 0.5]), ball)):
        tube = recursion(loop, X0, 2, template)
        reached = tube.simulate(200)
        for t in (1, 2):
            assert bool(tube.sets[t].contains(reached[:, t], 1e-9).all())
            assert (tube.proof(t).gaps >= -1e-9).all()
        assert tube.sets[1].volume() < 1e-2


def final(template, horizon):
    """A number that depends on both parts of the last set, and on all volumes."""

    def f(loop, X0):
        tube, n = recursion(loop, X0, horizon, template), loop.states
        last, weights = tube.sets[-1], np.random.default_rng(n).normal(size=(n, n))
        offsets = last.polytope.b @ jnp.linspace(0.5, 2.0, len(last.polytope.b))
        shape = last.ellipsoid.center @ jnp.arange(1.0, n + 1) + jnp.sum(
            weights * last.ellipsoid.shape
        )
        return rj.log_volume(tube) + jnp.sum(rj.log_widths(last)) + offsets + shape

    return f


@pytest.mark.parametrize(
    ("horizon", "shape"),
    [
        (1, None),
        pytest.param(1, [[2.0, 0.5], [0.5, 1.0]], marks=pytest.mark.long),
        pytest.param(3, None, marks=pytest.mark.long),
        pytest.param(3, [[2.0, 0.5], [0.5, 1.0]], marks=pytest.mark.long),
    ],
    ids=["1, least volume", "1, given shape", "3, least volume", "3, given shape"],
)
@pytest.mark.costly
def test_the_gradient_is_the_central_difference(horizon, shape):
    f = final(rj.MixedTemplate(rj.Template.box(2), rj.EllipsoidTemplate(shape)), horizon)
    args = case(2, 1)
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert error_in_all_parts(f, args, gradient, 1e-4) <= PROMISED


@pytest.mark.long  # a quicker test has the steps
@pytest.mark.parametrize("horizon", [1, 2])
def test_compiled_and_plain_penalties_agree(horizon):
    loop, X0 = case(2, 0, hidden=(3,))
    avoid, goal = [rj.Box([0.0, 0.0], [0.1, 0.1])], rj.Box([-0.1, -0.1], [0.1, 0.1])

    def missed(net):
        template, closed = rj.MixedTemplate(rj.Template.box(2)), loop.replace(controller=net)
        return rj.specification_penalty(closed, X0, horizon, template, goal=goal, avoid=avoid)

    value, gradient = jax.jit(jax.value_and_grad(missed))(loop.controller)
    assert float(value) == pytest.approx(float(missed(loop.controller)), abs=1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.costly
def test_specifications_are_decided_by_the_better_part():
    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1))), net)
    half = rj.Intersection(rj.Box([-2.0, -2.0], [0.0, 2.0]), rj.Ellipsoid([0.0, 0.0], np.eye(2)))
    tube = recursion(loop, half, 1, rj.MixedTemplate(rj.Template.box(2)))
    diagonal = rj.Polytope([[-1.0, -1.0]], [-0.78])  # beyond the disk, not beyond its box
    proved = rj.verify(tube, safe=rj.Box([-1.1, -1.1], [0.1, 1.1]), avoid={1: [diagonal]})
    assert proved.status is rj.VerdictStatus.PROVED
    assert proved.margins["safe"][1] == pytest.approx(0.1, abs=1e-6)
    refuted = rj.verify(tube, goal=rj.Box([-0.4, -1.0], [1.0, 1.0]))
    assert refuted.status is rj.VerdictStatus.REFUTED
    assert half.surely_contains(refuted.counterexample.states[0])


@pytest.mark.costly
def test_parts_and_mismatches_are_named():
    loop, X0 = case(2, 0)
    tube = recursion(loop, X0, 1, rj.MixedTemplate(rj.Template.box(2)))
    assert repr(tube) == "ReachTube(horizon=1, facets=4, ellipsoids, states=2)"
    proof = tube.proof(1)
    facets, ellipsoid = proof.parts
    np.testing.assert_array_equal(proof.bounds, [*facets.bounds, *ellipsoid.bounds])
    assert len(proof.statuses) == 5
    with pytest.raises(ValueError, match=r"multipliers must have shape \(5, \d+\)"):
        proof.recheck(proof.multipliers[:4])
    with pytest.raises(TypeError, match=r"MixedTemplate\.facets must be a template such as"):
        rj.MixedTemplate(rj.EllipsoidTemplate())  # type: ignore[arg-type]  # the mistake
    with pytest.raises(TypeError, match=r"MixedTemplate\.ellipsoid must be a template such as"):
        rj.MixedTemplate(rj.Template.box(2), rj.Template.box(2))  # type: ignore[arg-type]  # the mistake
    with pytest.raises(ValueError, match=r"MixedTemplate\.ellipsoid has dimension 3"):
        rj.MixedTemplate(rj.Template.box(2), rj.EllipsoidTemplate(np.eye(3)))
    with pytest.raises(ValueError, match="template is 3, but the loop's number of states is 2"):
        recursion(loop, X0, 1, rj.MixedTemplate(rj.Template.box(3)))
    apart = rj.Intersection(rj.Box([9.0, 9.0], [10.0, 10.0]), X0)
    with pytest.raises(ValueError, match="X0 cannot be used: the polytope and the ellipsoid have"):
        recursion(loop, apart, 1, rj.Template.box(2))


@pytest.mark.costly
def test_a_compiled_step_from_an_intersection_that_is_traced_is_the_plain_one():
    loop, X0 = case(1, 0, hidden=(3,))[0], intersection(1)

    def size(X0):
        return rj.log_volume(recursion(loop, X0, 1, rj.MixedTemplate(FACETS[1])))

    assert float(jax.jit(size)(X0)) == pytest.approx(float(size(X0)), abs=1e-6)
