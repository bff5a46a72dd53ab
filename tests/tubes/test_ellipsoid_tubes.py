"""Tubes of ellipsoids, and tubes that start from ellipsoids."""

import dataclasses
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import ANSWERS, OF_SOLVERS, Proposal
from reachjax.solvers import GivenShape, ellipsoids
from reachjax.solvers.ellipsoids import flat, form_of
from tests.closed_loops import one_step, recursion
from tests.differences import error_in_all_parts
from tests.quick_cases import some
from tests.solvers.test_enclosures import case, ellipsoid, final

RELAXATIONS = [rj.LocalBounds(), rj.PaperQC(), rj.PaperQC(repeated=False)]


def holds(tube, count=20_000):
    """Whether simulated states, half of them from the boundary, are in every set."""
    trajectories = tube.simulate(count, seed=7)
    return [bool(X.contains(trajectories[:, t]).all()) for t, X in enumerate(tube.sets)]


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.costly
def test_the_image_of_an_affine_loop_is_exact(n):
    rng = np.random.default_rng(n)
    A, B, K, c = (rng.normal(size=s) for s in ((n, n), (n, 1), (1, n), n))
    net = rj.MLP.from_layers([(0.3 * K, [0.1])])
    X0, closed = ellipsoid(n, n), A + 0.3 * B @ K
    following, _ = one_step(rj.ClosedLoop(rj.AffinePlant(A, B, c), net), X0, rj.EllipsoidTemplate())
    np.testing.assert_allclose(following.center, closed @ X0.center + 0.1 * B[:, 0] + c, atol=1e-5)
    expected = closed @ X0.shape @ closed.T
    np.testing.assert_allclose(following.shape, expected, atol=1e-5 * abs(expected).max())
    facets, _ = one_step(rj.ClosedLoop(rj.AffinePlant(A, B, c), net), X0, rj.Template.box(n))
    widths = np.sqrt(np.diag(expected))
    middle = closed @ X0.center + 0.1 * B[:, 0] + c
    ends = np.stack([middle + widths, widths - middle], axis=1).ravel()
    np.testing.assert_allclose(facets.b, ends, atol=1e-6 * abs(ends).max())


@pytest.mark.costly
def test_a_given_shape_is_kept_and_larger_than_the_minimum_volume():
    loop, X0 = case(2, 0)
    shape = np.array([[2.0, 0.5], [0.5, 1.0]])
    given = recursion(loop, X0, 3, rj.EllipsoidTemplate(shape=shape))
    least = recursion(loop, X0, 3, rj.EllipsoidTemplate())
    for t in (1, 2, 3):
        size = given.sets[t].shape[0, 0] / shape[0, 0]
        np.testing.assert_allclose(given.sets[t].shape, size * shape, rtol=1e-6)
        assert given.sets[t].volume() >= least.sets[t].volume()
    np.testing.assert_allclose(given.sets[1].center, loop.step(X0.center, 0))


@pytest.mark.costly
def test_tighter_relaxations_give_smaller_ellipsoids():
    loop, X0 = case(3, 1)
    volumes = [
        float(rj.reach_step(loop, X0, rj.EllipsoidTemplate(), relaxation=r)[0].volume())
        for r in RELAXATIONS
    ]
    assert volumes[0] <= volumes[1] * (1 + 1e-6)
    assert volumes[1] <= volumes[2] * (1 + 1e-6)


ZERO_NET = [([[1.0, 0.0]], [0.0]), ([[1.0]], [0.0])]


def affine(A, c=None):
    """A loop whose network has no say."""
    return rj.ClosedLoop(rj.AffinePlant(A, [[0.0], [0.0]], c), rj.MLP.from_layers(ZERO_NET))


@pytest.mark.costly
def test_a_flat_image_has_an_ellipsoid_that_is_nearly_flat():
    tube = recursion(
        affine([[1.0, 1.0], [2.0, 2.0]]),
        rj.Ellipsoid([0.0, 0.0], np.eye(2)),
        2,
        rj.EllipsoidTemplate(),
    )
    assert all(holds(tube))
    assert tube.sets[1].volume() < 1e-2


@pytest.mark.costly
@pytest.mark.parametrize("shape", [None, np.eye(2)], ids=["free", "given"])
@pytest.mark.parametrize("point", [[0.0, 0.0], [1.0, 2.0], [1e-9, 1e9]])
def test_the_image_of_a_constant_loop_is_nearly_a_point(point, shape):
    loop = affine(np.zeros((2, 2)), point)
    tube = recursion(loop, rj.Box([1.0, 1.0], [3.0, 2.0]), 2, rj.EllipsoidTemplate(shape))
    assert all(holds(tube))
    assert tube.sets[2].volume() <= 1e-12 * np.dot(point, point) + 1e-150  # rounding


@pytest.mark.costly
def test_a_nilpotent_loop_comes_to_rest():
    loop = affine([[0.0, 1.0], [0.0, 0.0]])
    tube = recursion(loop, rj.Box([1.0, 1.0], [3.0, 2.0]), 4, rj.EllipsoidTemplate())
    assert all(holds(tube))
    assert tube.sets[2].volume() < 1e-12


@pytest.mark.parametrize("shape", [None, [[1.0]]], ids=["free", "given"])
@pytest.mark.costly
def test_a_deadbeat_loop_comes_to_rest(shape):
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-1.0, 1.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net)  # x+ = 0
    tube = recursion(loop, rj.Box([1.0], [3.0]), 2, rj.EllipsoidTemplate(shape))
    assert all(holds(tube))
    assert tube.sets[1].volume() < 1e-12


@pytest.mark.parametrize("thinness", [1e-2, 1e-4])
@pytest.mark.costly
def test_thin_images_keep_their_volume(thinness):
    loop = affine([[1.0, 1.0], [1.0, 1.0 + thinness]])
    region, _ = one_step(loop, rj.Ellipsoid([0.0, 0.0], np.eye(2)), rj.EllipsoidTemplate())
    np.testing.assert_allclose(region.volume(), np.pi * thinness, rtol=1e-4)


@pytest.mark.costly
def test_volumes_do_not_depend_on_units():
    """Half-axes of 1e8 and 1e-8: the coordinates are those of the ellipsoids themselves."""
    units = np.diag([1e8, 1e-8])
    loop = affine(units @ [[0.9, 0.3], [-0.2, 0.8]] @ np.linalg.inv(units))
    tube = recursion(loop, rj.Ellipsoid([0.0, 0.0], units @ units), 2, rj.EllipsoidTemplate())
    volumes = np.array([region.volume() for region in tube.sets]) / np.pi
    np.testing.assert_allclose(volumes, [1.0, 0.78, 0.78**2], rtol=1e-4)


@pytest.mark.costly
def test_specifications_are_decided_from_ellipsoids():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net)  # x+ = 0.6 x
    tube = recursion(loop, rj.Ellipsoid([1.5], [[0.25]]), 2, rj.EllipsoidTemplate())  # [1, 2]
    proved = rj.verify(tube, goal=rj.Box([0.3], [0.8]), safe=rj.Box([0.0], [2.1]))
    assert proved.status is rj.VerdictStatus.PROVED
    assert proved.margins["goal"][2] == pytest.approx(0.06, abs=1e-4)
    away = rj.verify(tube, avoid=[rj.Box([3.0], [4.0])])
    assert away.status is rj.VerdictStatus.PROVED
    broken = rj.verify(tube, goal=rj.Box([0.3], [0.6]))
    assert broken.status is rj.VerdictStatus.REFUTED


@dataclasses.dataclass(frozen=True)
class Claiming(rj.AbstractSolver):
    """Clarabel, with another status and multipliers off by a factor."""

    status: rj.SolverStatus = rj.SolverStatus.SOLVED
    factor: float = 1.0

    def solve(self, program, goal):
        found = rj.Clarabel().solve(program, goal)
        return found._replace(
            statuses=np.array([int(self.status)]), multipliers=self.factor * found.multipliers
        )


@pytest.mark.parametrize("shape", [None, np.eye(2)], ids=["free", "given"])
@pytest.mark.parametrize("status", rj.SolverStatus)
@pytest.mark.costly
def test_whatever_a_solver_says_an_ellipsoid_has_a_gradient(status, shape):
    """The optimum's where numbers bear it out, and that of what is proved where they do not."""
    loop, X0 = case(2, 0)

    def size(loop, solver):
        tube = recursion(loop, X0, 1, rj.EllipsoidTemplate(shape), solver=solver)
        return rj.log_volume(tube)

    right = jax.grad(size)(loop, rj.Clarabel())
    for factor in (1.0, 0.5):
        found = jax.grad(size)(loop, Claiming(status, factor))
        if status in OF_SOLVERS and status in ANSWERS and (shape is None or factor == 1.0):
            # the central path is reached from what was proposed, and what is there is right
            jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), found, right)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@dataclasses.dataclass(frozen=True)
class Held(rj.AbstractSolver):
    """An answer that moves with the box around the successors, its multipliers off by a tenth.

    So what it proves is a function of the program, of which differences can be taken.
    """

    answering: bool
    said: list = dataclasses.field(default_factory=list, hash=False, compare=False)

    def solve(self, program, goal):
        if not self.answering:
            return Proposal.blank(program, goal)
        normal, shaped = presolved(program), isinstance(goal, GivenShape)
        if not self.said:
            found = rj.Clarabel().solve(program, goal)
            noise = np.random.default_rng(0).normal(size=found.multipliers.shape)
            limit = np.array([int(rj.SolverStatus.LIMIT)])  # not to be moved to the central path
            off = (1 + 0.1 * noise) * found.multipliers
            held = None if shaped else normal.to_unit_box(form_of(found.unknowns[0]))
            self.said.append((found._replace(multipliers=off, statuses=limit), held))
        spoilt, held = self.said[0]
        if shaped:
            return spoilt
        return spoilt._replace(unknowns=flat(normal.from_unit_box(held))[None])


@pytest.mark.parametrize(
    ("answering", "shape"),
    some(
        product([True, False], [None, np.eye(2)]), lambda answers, shape: answers == (shape is None)
    ),
    ids=["inaccurate-free", "inaccurate-given", "failed-free", "failed-given"],
)
@pytest.mark.costly
def test_the_gradient_of_what_is_reported_is_the_central_difference(answering, shape, monkeypatch):
    monkeypatch.setattr(ellipsoids, "ATTEMPTS", 1)  # others would begin where the first one ended
    args, template = case(2, 0, hidden=(4, 3)), rj.EllipsoidTemplate(shape)
    f = final(template, 1, solver=Held(answering))
    assert f(*args) > final(template, 1)(*args) + 1e-3
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert error_in_all_parts(f, args, gradient, 1e-5) <= 1e-6


@pytest.mark.parametrize("shape", [None, np.eye(2)], ids=["free", "given"])
@pytest.mark.parametrize("center", [0.0, 1e5, 1e7, 1e8])
@pytest.mark.costly
def test_the_recheck_of_an_ellipsoid_far_from_the_origin_is_no_larger_than_one(center, shape):
    """The proof is repeated in the frame in which it was made."""
    loop = affine([[0.9, 0.2], [-0.1, 0.8]])
    for seed in range(3):
        X0 = rj.Ellipsoid(np.array([1.0, -0.7]) * center, ellipsoid(2, seed).shape)
        tube = recursion(loop, X0, 2, rj.EllipsoidTemplate(shape), samples=10)
        assert all(tube.proof(t).recheck() <= 1 for t in (1, 2))


@pytest.mark.parametrize(
    ("horizon", "shape"),
    some(
        product([1, 2], [None, np.eye(2)]),
        lambda horizon, shape: horizon == 1 and shape is not None,
    ),
    ids=["1, free", "1, given", "2, free", "2, given"],
)
@pytest.mark.costly
def test_compiled_batched_and_plain_ellipsoids_agree(shape, horizon):
    loop, X0 = case(2, 0, hidden=(3,))

    def size(net):
        tube = recursion(loop.replace(controller=net), X0, horizon, rj.EllipsoidTemplate(shape))
        return rj.log_volume(tube)

    nets = [jax.tree.map(lambda w, s=s: w * s, loop.controller) for s in (0.9, 1.1)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(size)))(stacked)
    for k, net in enumerate(nets):
        value, gradient = jax.value_and_grad(size)(net)
        assert float(values[k]) == pytest.approx(float(value), abs=1e-6)
        jax.tree.map(
            lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-3, atol=1e-5),
            gradients,
            gradient,
        )


@pytest.mark.long  # what a gradient that is right does
@pytest.mark.parametrize("horizon", [1, 3])
def test_a_gradient_step_lowers_the_volume_penalty(horizon):
    loop, X0 = case(2, 0)

    def penalty(net):
        return rj.volume_penalty(loop.replace(controller=net), X0, horizon, rj.EllipsoidTemplate())

    before, gradient = jax.value_and_grad(penalty)(loop.controller)
    size = sum(float(jnp.sum(g**2)) for g in jax.tree.leaves(gradient))
    after = penalty(jax.tree.map(lambda w, g: w - 1e-3 * g, loop.controller, gradient))
    assert float(before - after) == pytest.approx(1e-3 * size, rel=0.2)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ([[1.0, 0.0]], "EllipsoidTemplate.shape must be square"),
        ([[1.0, 2.0], [0.0, 1.0]], "EllipsoidTemplate.shape must be symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "EllipsoidTemplate.shape must be positive definite"),
        ([1.0, 2.0], r"EllipsoidTemplate.shape must be an array of shape \(n, n\)"),
    ],
)
def test_bad_shapes_are_named(shape, message):
    with pytest.raises(ValueError, match=message):
        rj.EllipsoidTemplate(shape)


@pytest.mark.costly
def test_mismatches_are_named():
    loop, X0 = case(2, 0)
    with pytest.raises(ValueError, match=r"template is 3, but the loop's number of states is 2"):
        recursion(loop, X0, 1, rj.EllipsoidTemplate(np.eye(3)))
    with pytest.raises(TypeError, match="template must be a template, such as"):
        recursion(loop, X0, 1, rj.EllipsoidTemplate)

    class Facets(rj.AbstractSolver):
        def solve(self, program, goal):
            raise NotImplementedError("it solves for facets, not for ellipsoids")

    with pytest.raises(NotImplementedError, match="it solves for facets, not for ellipsoids"):
        recursion(loop, X0, 1, rj.EllipsoidTemplate(), solver=Facets())
    certificate = one_step(loop, X0, rj.EllipsoidTemplate())[1]
    with pytest.raises(ValueError, match=r"multipliers must have shape \(1, \d+\)"):
        certificate.recheck(certificate.multipliers[0])
