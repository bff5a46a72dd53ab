"""Gradients through the seam: right, alike in every mode of JAX, and refused where they are not."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.proposal import OF_SOLVERS
from reachjax.proofs.reported import judged_offsets
from reachjax.solvers import Facets, proved
from reachjax.solvers.clarabel import Cone
from tests.closed_loops import closed_loop, random_loop, recursion, step_program
from tests.differences import along, error_in_all_parts, norm, relative_error
from tests.networks import box_region, simplex_region
from tests.quick_cases import some

TEMPLATE = rj.Template.octagonal(2)
WEIGHTS = jnp.linspace(0.5, 2.0, len(TEMPLATE))


def planar(seed, polytope=False, hidden=(5, 3)):
    """A loop and a set in the plane, at a generic point."""
    data = random_loop(2, hidden=hidden, seed=seed)
    region = simplex_region(2, seed) if polytope else box_region(2, seed)
    low, high = region.corners.min(axis=0), region.corners.max(axis=0)
    X0 = rj.Polytope(region.A, region.b) if polytope else rj.Box(low, high)
    return closed_loop(data), X0


def proved_offsets(program, solver):
    """The offsets of a program, and what the solver proposed."""
    return proved(Facets(TEMPLATE.directions), program, solver)[1:]


def value(loop, X0, horizon=1, **options):
    tube = recursion(loop, X0, horizon, TEMPLATE, **options)
    return sum(WEIGHTS @ region.b for region in tube.sets[1:])


# At tolerance 1e-9 a value is good to some 1e-9, and a difference over 1e-4 to some 1e-5; 1e-3 is
# what is promised. Kinks closer than 2e-4 would show as errors of order one: these points have none
# along these directions, and every facet is solved.
STEP, PROMISED = 1e-4, 1e-3
ONE_STATUS = some(OF_SOLVERS, lambda status: status is rj.SolverStatus.INACCURATE)
ALL_PARTS = 3e-5  # a step in all parts: those of small gradients move by up to ten times as much


@pytest.mark.parametrize(
    "args",
    [(0, False), (1, True), pytest.param((3, False), marks=pytest.mark.long)],
    ids=str,
)
def test_the_gradient_of_a_step_is_the_central_difference(args):
    args = planar(*args)
    gradient = jax.grad(value, argnums=(0, 1))(*args)
    assert error_in_all_parts(value, args, gradient, ALL_PARTS) <= PROMISED


@pytest.mark.parametrize(
    ("seed", "polytope"), [(0, True), (0, False), (1, False), (1, True), (2, True)]
)
@pytest.mark.long  # what gradients of one step, and of two, claim in minutes
def test_the_gradient_of_five_steps_is_the_central_difference(seed, polytope):
    """Neurons leave and enter the basis on the way."""
    args = planar(seed, polytope)
    tube = recursion(*args, 5, TEMPLATE, samples=1)
    kept = {tuple(np.asarray(tube.proof(t).program.used).tolist()) for t in range(1, 6)}
    assert len(kept) > 1
    assert all(s is rj.SolverStatus.SOLVED for t in range(1, 6) for s in tube.proof(t).statuses)
    f = partial(value, horizon=5)
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert error_in_all_parts(f, args, gradient, ALL_PARTS) <= PROMISED


@pytest.mark.long
def test_the_gradient_of_a_volume_penalty_is_the_central_difference():
    args = planar(1)

    def f(loop, X0):
        return rj.volume_penalty(loop, X0, 5, TEMPLATE)

    gradient = jax.jit(jax.grad(f, argnums=(0, 1)))(*args)
    assert error_in_all_parts(jax.jit(f), args, gradient, ALL_PARTS) <= PROMISED


@pytest.mark.costly
def test_the_gradient_is_as_accurate_as_the_solver():
    loop, X0 = planar(1)
    exact = jax.grad(partial(value, horizon=5))(loop, X0)
    errors = []
    for tolerance in (1e-4, 1e-6, 1e-8):
        solver = rj.Clarabel(tolerance=tolerance)
        gradient = jax.grad(partial(value, horizon=5, solver=solver))(loop, X0)
        errors.append(norm(jax.tree.map(jnp.subtract, gradient, exact)) / norm(exact))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] <= PROMISED


@pytest.mark.costly
def test_the_lagrangian_at_the_solution_is_the_offset():
    loop, X = planar(0)
    program = step_program(loop, X, X.bounding_box(), TEMPLATE.directions, 0, rj.LocalBounds())
    offsets, solution = jax.device_get(proved_offsets(program, rj.Clarabel()))
    facts, objective = program.facts.mid, program.objective.mid
    goal, program = Facets(TEMPLATE.directions), jax.device_get(program)
    judged = judged_offsets(program, solution)
    for facet in range(len(offsets)):
        slopes, _ = goal.slopes(program, judged, np.eye(len(offsets))[facet])
        # it is quadratic in the facts and linear in the objective
        value = np.sum(slopes.facts * facts) / 2 + np.sum(slopes.objective * objective)
        assert value == pytest.approx(offsets[facet], abs=1e-6)


def agree(first, second):
    """Compilations round differently; multipliers are exact to the root of a tolerance, 1e-9.

    That is a part of the whole gradient, as accuracy is promised: what a small entry sums is large.
    """
    assert norm(jax.tree.map(jnp.subtract, first, second)) <= 3e-5 * norm(second)


@pytest.mark.costly
def test_compiled_and_plain_gradients_agree():
    args = planar(0)
    plain = jax.grad(value, argnums=(0, 1))(*args, 2)
    compiled = jax.jit(jax.grad(value, argnums=(0, 1)), static_argnums=2)(*args, 2)
    agree(plain, compiled)


@pytest.mark.costly
def test_a_batch_of_networks_and_sets_equals_one_at_a_time():
    loop, X0 = planar(0)
    nets = [jax.tree.map(lambda w, s=s: w * (1 + s), loop.controller) for s in (0.0, 0.1, 0.2)]
    boxes = [rj.Box(X0.lower - s, X0.upper + s) for s in (0.0, 0.05, 0.1)]
    stack = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)  # noqa: E731

    def of(net, box):
        return value(loop.replace(controller=net), box)

    both = jax.vmap(jax.value_and_grad(of, argnums=(0, 1)))(stack(nets), stack(boxes))
    single = stack(
        [jax.value_and_grad(of, argnums=(0, 1))(*pair) for pair in zip(nets, boxes, strict=True)]
    )
    np.testing.assert_allclose(both[0], single[0], rtol=1e-6)
    agree(both[1], single[1])


@pytest.mark.long
def test_scan_and_remat_give_the_same_gradient():
    loop, X0 = planar(0)
    plain = jax.grad(value)(loop, X0)
    again = jax.jit(jax.grad(jax.remat(value)))(loop, X0)

    def descend(net, _):
        gradient = jax.grad(lambda net: value(loop.replace(controller=net), X0))(net)
        return jax.tree.map(lambda w, g: w - 1e-3 * g, net, gradient), gradient

    _, first = jax.jit(lambda net: jax.lax.scan(descend, net, length=2))(loop.controller)
    agree(again, plain)
    agree(jax.tree.map(lambda leaf: leaf[0], first), plain.controller)


@pytest.mark.costly
def test_a_training_loop_compiles_once_while_neurons_become_stable():
    loop, X0 = planar(0)
    compiled = []

    @jax.jit
    def gradient(net):
        compiled.append(net)
        return jax.value_and_grad(lambda net: value(loop.replace(controller=net), X0))(net)

    stable = set()
    for shift in (0.0, 3.0, -3.0):
        layers = loop.controller.layers
        moved = ((layers[0][0], layers[0][1] + shift), *layers[1:])
        net = loop.controller.replace(layers=moved)
        assert np.isfinite(gradient(net)[0])
        program = step_program(
            loop.replace(controller=net), X0, X0, TEMPLATE.directions, 0, rj.LocalBounds()
        )
        stable.add(tuple((~np.asarray(program.used)).tolist()))
    assert len(stable) > 1
    assert len(compiled) == 1


@pytest.mark.costly
def test_forward_mode_and_second_derivatives_raise():
    loop, X0 = planar(0)
    of = lambda c: value(loop.replace(plant=loop.plant.replace(c=c)), X0)  # noqa: E731
    for derivative in (
        lambda c: jax.jvp(of, (c,), (c,)),
        jax.hessian(of),
    ):
        with pytest.raises(TypeError, match="first derivatives only, and in reverse mode"):
            derivative(loop.plant.c)


@pytest.mark.parametrize("relaxation", [rj.LinearBounds(), rj.BranchAndCut()], ids=str)
@pytest.mark.costly
def test_second_derivatives_of_forms_and_branches_are_refused(relaxation):
    loop, X0 = planar(0)

    def slope(c):
        made = loop.replace(plant=loop.plant.replace(c=c))
        sizes = lambda c: rj.log_volume(  # noqa: E731
            rj.reach(loop.replace(plant=made.plant.replace(c=c)), X0, 1, TEMPLATE, relaxation)
        )
        return jax.grad(sizes)(c).sum()

    assert np.isfinite(slope(loop.plant.c))
    with pytest.raises(TypeError, match="first derivatives only"):
        jax.grad(slope)(loop.plant.c)


@pytest.mark.parametrize("wrapped", [jax.jit, lambda f: f], ids=["compiled", "eager"])
@pytest.mark.parametrize(
    "template", [TEMPLATE, rj.EllipsoidTemplate(), rj.EllipsoidTemplate(np.eye(2))], ids=str
)
@pytest.mark.costly
def test_second_derivatives_in_reverse_mode_raise(template, wrapped):
    """Numbers cross to the host as integers, whose derivative would be zero."""
    loop, X0 = planar(0)

    def once(scale):
        scaled = loop.replace(plant=loop.plant.replace(c=scale * loop.plant.c))
        tube = recursion(scaled, X0, 1, template, relaxation=rj.LocalBounds())
        return tube.sets[1].support(jnp.eye(2)).sum() ** 2

    with pytest.raises(TypeError, match="first derivatives"):
        wrapped(jax.grad(jax.grad(once)))(1.0)


@pytest.mark.parametrize("n", [pytest.param(1, marks=pytest.mark.long), 3])
@pytest.mark.costly
def test_the_gradient_is_the_central_difference_in_other_dimensions(n):
    region = box_region(n, seed=n)
    X0 = rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))
    args = (closed_loop(random_loop(n, hidden=(4, 3), seed=n)), X0)
    template = rj.Template.box(n)

    def f(loop, X0):
        return jnp.linspace(0.5, 2.0, 2 * n) @ recursion(loop, X0, 2, template).sets[2].b

    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert error_in_all_parts(f, args, gradient, ALL_PARTS) <= PROMISED


FORKED = rj.MLP.from_layers(
    [([[1.0, 0.5], [-1.0, 0.3], [0.4, -1.0]], [0.1, 0.2, -0.7]), ([[-0.3, 0.3, 0.5]], [0.0])]
)
INTEGRATOR = rj.AffinePlant([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]])


@pytest.mark.costly
@pytest.mark.parametrize(
    "widths",
    [
        pytest.param((1e-3, 0.5), marks=pytest.mark.long),
        (1e-6, 0.5),
        pytest.param((0.0, 0.5), marks=pytest.mark.long),
        (0.0, 0.0),
    ],
)
def test_flat_and_thin_sets_and_points_have_gradients(widths):
    """Of where they are, and of the loop: not of the width, which has a kink at zero."""

    def f(loop, position):
        X0 = rj.Box(position, position + jnp.array(widths))
        tube = recursion(loop, X0, 2, rj.Template.box(2))
        return tube.sets[2].b @ jnp.array([1.0, 2.0, 3.0, 4.0])

    args = (rj.ClosedLoop(INTEGRATOR, FORKED), jnp.array([2.0, -0.25]))
    gradient, rng = jax.grad(f, argnums=(0, 1))(*args), np.random.default_rng(0)
    for _ in range(3):
        direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), args)
        assert relative_error(f, args, gradient, direction, STEP) <= PROMISED


@pytest.mark.costly
def test_a_coordinate_that_becomes_constant_has_a_gradient():
    plant = rj.AffinePlant([[1.0, 1.0], [0.0, 0.0]], [[0.5], [0.0]], [0.0, 0.3])

    def f(c):
        loop = rj.ClosedLoop(plant.replace(c=c), FORKED)
        return recursion(loop, rj.Box([2.0, -0.25], [2.5, 0.25]), 3, rj.Template.box(2)).sets[3].b

    slopes, h = jax.jacrev(f)(plant.c), 1e-4
    for k in range(2):
        move = jnp.zeros(2).at[k].set(h)
        np.testing.assert_allclose(
            slopes[:, k], (f(plant.c + move) - f(plant.c - move)) / (2 * h), atol=1e-5
        )


@pytest.mark.costly
def test_an_input_range_of_zero_width_has_a_one_sided_gradient():
    def f(lower, upper):
        loop = rj.ClosedLoop(INTEGRATOR, FORKED, input_box=rj.Box(lower, upper))
        X0 = rj.Box([2.5, -0.25], [3.0, 0.25])
        return recursion(loop, X0, 2, rj.Template.box(2)).sets[2].b[0]

    zero, h = jnp.zeros(1), 1e-6
    gradient = jax.grad(f, argnums=(0, 1))(zero, zero)
    np.testing.assert_allclose(gradient[0], (f(zero, zero) - f(zero - h, zero)) / h, atol=1e-4)
    np.testing.assert_allclose(gradient[1], (f(zero, zero + h) - f(zero, zero)) / h, atol=1e-4)


@pytest.mark.costly
def test_normals_have_a_derivative_where_bounds_are_attained_at_corners():
    loop, X0 = planar(1, polytope=True)

    def f(A):
        return WEIGHTS @ recursion(loop, rj.Polytope(A, X0.b), 1, TEMPLATE).sets[1].b

    gradient, direction = (
        jax.grad(f)(X0.A),
        jnp.asarray(np.random.default_rng(0).normal(size=X0.A.shape)),
    )
    assert relative_error(f, (X0.A,), (gradient,), (direction,), STEP) <= PROMISED
    square = rj.Polytope(*rj.Box([0.0, 0.0], [1.0, 1.0]).facets)
    sides = jax.grad(lambda A: recursion(loop, rj.Polytope(A, square.b), 1, TEMPLATE).sets[1].b[0])
    assert np.isfinite(sides(square.A)).all()  # though each bound is attained on a whole side


@dataclasses.dataclass(frozen=True)
class Stubborn(rj.AbstractSolver):
    """What Clarabel found for the first program, off by a part of itself, for all later ones.

    So what it proves is a function of the program, of which differences can be taken.
    """

    status: rj.SolverStatus
    spread: float = 0.0
    changes: dict = dataclasses.field(default_factory=dict, hash=False)
    said: list = dataclasses.field(default_factory=list, hash=False, compare=False)

    def solve(self, program, goal):
        if not self.said:
            found = rj.Clarabel().solve(program, goal)
            noise = np.random.default_rng(0).normal(size=found.multipliers.shape)
            self.said.append(
                found._replace(
                    statuses=np.full_like(found.statuses, self.status),
                    multipliers=(1 + self.spread * noise) * found.multipliers,
                    **{
                        name: factor * getattr(found, name) for name, factor in self.changes.items()
                    },
                )
            )
        return self.said[0]


@pytest.mark.costly
@pytest.mark.parametrize("status", ONE_STATUS)
def test_the_gradient_of_an_inaccurate_bound_is_the_central_difference(status):
    """Multipliers off by a fifth prove less than the optimum, whatever the solver calls them."""
    args = planar(0)
    f = partial(value, solver=Stubborn(status, 0.2))
    bound, gradient = jax.value_and_grad(f, argnums=(0, 1))(*args)
    assert bound > value(*args) + 1e-3
    for part in ("weights", "initial set"):
        assert relative_error(f, args, gradient, along(part, *args, 0), 1e-5) <= 1e-6, part


@pytest.mark.parametrize("status", ONE_STATUS)
@pytest.mark.costly
def test_a_claim_that_is_borne_out_has_the_gradient_of_the_optimum_whatever_the_status(status):
    loop, X0 = planar(0)
    solver = Stubborn(status)
    gradient, right = (
        jax.grad(partial(value, **given))(loop, X0) for given in ({"solver": solver}, {})
    )
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-9), gradient, right)


@pytest.mark.parametrize(
    "changes",
    some(
        [
            {"moments": -3.0},
            {"moments": 0.99},
            {"moments": np.nan},
            {"unknowns": 1.1},
            {"unknowns": 0.9},
        ],
        lambda changes: changes.get("moments") == 0.99 or changes.get("unknowns") == 0.9,
    ),
    ids=str,
)
@pytest.mark.costly
def test_a_claim_that_is_not_borne_out_has_the_gradient_of_what_is_proved(changes):
    args = planar(0)
    f = partial(value, solver=Stubborn(rj.SolverStatus.SOLVED, 0.2, changes))
    # first of all: the multipliers are those of the first program, and traced ones round otherwise
    proved = float(value(*args, solver=Stubborn(rj.SolverStatus.FAILED, 0.2)))
    assert float(f(*args)) == pytest.approx(proved, rel=1e-12)  # not the claim
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert relative_error(f, args, gradient, along("weights", *args, 0), 1e-5) <= 1e-6


@pytest.mark.costly
def test_what_a_solver_proposes_has_no_derivative():
    loop, X0 = planar(0)

    def claimed(loop):
        return recursion(loop, X0, 1, TEMPLATE).proof(1).solver_offsets.sum()

    assert all(np.isnan(leaf).any() for leaf in jax.tree.leaves(jax.grad(claimed)(loop).controller))


@pytest.mark.parametrize(
    "relaxation",
    [rj.LocalBounds(), pytest.param(rj.CuttingPlanes(), marks=pytest.mark.long)],
    ids=str,
)
@pytest.mark.costly
def test_the_gradient_of_an_interval_bound_is_the_central_difference(monkeypatch, relaxation):
    def fail(cone, constant):
        return rj.SolverStatus.FAILED, None

    args, f = planar(0), partial(value, relaxation=relaxation)
    optimum = f(*args)
    monkeypatch.setattr(Cone, "solved", fail)
    bound, gradient = jax.value_and_grad(f, argnums=(0, 1))(*args)
    assert bound > optimum + 0.1
    for part in ("weights", "A", "B", "c", "initial set"):
        assert relative_error(f, args, gradient, along(part, *args, 0), 1e-5) <= 1e-6, part


@pytest.mark.costly
def test_a_neuron_whose_weights_have_decayed_does_not_spoil_the_gradient():
    """Its input is constant but for 1e-10: facts of that size would have multipliers of 1e5."""
    loop, X0 = planar(3)
    (W0, b0), (W1, b1), last = loop.controller.layers
    faint = W1.at[0].set(1e-10 * W1[0]), b1.at[0].set(-0.2)
    net = loop.controller.replace(layers=((W0, b0), faint, last))
    args = (loop.replace(controller=net), X0)
    gradient = jax.grad(value, argnums=(0, 1))(*args)
    assert abs(gradient[0].controller.layers[1][0][0]).max() <= 1e-3
    assert relative_error(value, args, gradient, along("weights", *args, 0), 1e-5) <= PROMISED
