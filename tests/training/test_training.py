"""Penalties in a training loop: what they are, when they are computed, what a failure does."""

import dataclasses
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

import reachjax as rj
from tests.closed_loops import closed_loop, random_loop, recursion
from tests.networks import box_region

TEMPLATE = rj.Template.octagonal(2)
GOAL = rj.Box([-0.3, -0.3], [0.3, 0.3])


@pytest.fixture(scope="module")
def case():
    region = box_region(2, 1)
    X0 = rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))
    return closed_loop(random_loop(2, hidden=(5, 3), seed=1)), X0


def test_penalties_are_those_of_the_tube(case):
    """Of affine forms, unless a relaxation, a window or a solver say otherwise."""
    for options, tube in (
        ({}, rj.reach(*case, 2, TEMPLATE, rj.LinearBounds())),
        ({"window": 1}, recursion(*case, 2, TEMPLATE)),
        ({"relaxation": rj.LocalBounds()}, recursion(*case, 2, TEMPLATE)),
        ({"relaxation": rj.BranchAndCut()}, rj.reach(*case, 2, TEMPLATE)),
    ):
        logs = rj.volume_penalty(*case, 2, TEMPLATE, **options)
        assert float(logs) == pytest.approx(float(rj.log_volume(tube)) / 2, rel=1e-9)
        areas = rj.volume_penalty(*case, 2, TEMPLATE, measure=rj.volume, **options)
        expected = np.mean([region.volume() for region in tube.sets[1:]])
        assert float(areas) == pytest.approx(expected, rel=1e-9)
        missing = rj.specification_penalty(*case, 2, TEMPLATE, goal=GOAL, margin=0.1, **options)
        assert float(missing) == pytest.approx(float(rj.shortfall(tube, goal=GOAL, margin=0.1)))
        assert missing > 0


@pytest.mark.costly
@pytest.mark.parametrize("relaxation", [rj.LinearBounds(), rj.LocalBounds(), rj.BranchAndCut()])
def test_penalties_of_cells_are_the_mean_of_theirs(case, relaxation):
    loop, X0 = case
    tubes = rj.reach_partitioned(loop, X0, 1, rj.Template.box(2), cells=(1, 3)).tubes

    def penalty(X0, **cells):
        template = rj.Template.box(2)
        return rj.specification_penalty(
            loop, X0, 1, template, goal=GOAL, relaxation=relaxation, **cells
        )

    each = [float(penalty(tube.sets[0])) for tube in tubes]
    assert float(penalty(X0, cells=(1, 3))) == pytest.approx(np.mean(each), rel=1e-6)
    assert penalty(X0, cells=(1, 3)) <= penalty(X0) * (1 + 1e-6)


@pytest.mark.costly
def test_cells_have_derivatives_in_compiled_code(case):
    loop, X0 = case

    def penalty(net, X0):
        template = rj.Template.box(2)
        return rj.volume_penalty(loop.replace(controller=net), X0, 1, template, cells=(2, 2))

    plain = jax.grad(penalty)(loop.controller, X0)
    compiled = jax.jit(jax.grad(penalty))(loop.controller, X0)
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(compiled), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


@pytest.mark.costly
def test_several_initial_sets_are_penalised_at_once(case):
    loop, X0 = case
    sets = [rj.Box(X0.lower + shift, X0.upper + shift) for shift in (0.0, 0.1, 0.2)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sets)

    def penalty(X0):
        return rj.volume_penalty(loop, X0, 2, TEMPLATE)

    each = [float(penalty(X0)) for X0 in sets]
    np.testing.assert_allclose(jax.jit(jax.vmap(penalty))(stacked), each, rtol=1e-9)


@pytest.mark.parametrize("relaxation", [{}, {"relaxation": rj.BranchAndCut()}])
def test_what_is_no_loop_set_or_template_is_named(case, relaxation):
    loop, X0 = case
    for arguments, name in (
        (("loop", X0, 1, TEMPLATE), "loop"),
        ((loop, [0.0, 1.0], 1, TEMPLATE), "X0"),
        ((loop, X0, 1, "octagonal"), "template"),
    ):
        with pytest.raises(TypeError, match=f"^{name} must be"):
            rj.volume_penalty(*arguments, **relaxation)


@pytest.mark.parametrize(
    ("cells", "X0", "error", "match"),
    [
        ((2,), None, ValueError, "cells must be a number for each of 2 coordinates"),
        (4, None, ValueError, "cells must be a number for each of 2 coordinates"),
        ((2, 0), None, ValueError, "cells.1. must be at least 1"),
        ((2, 2), rj.Ellipsoid([0.0, 0.0], np.eye(2)), TypeError, "cells are of an X0 of type Box"),
    ],
)
def test_bad_cells_are_named(case, cells, X0, error, match):
    loop, box = case
    with pytest.raises(error, match=match):
        rj.volume_penalty(loop, X0 or box, 1, TEMPLATE, cells=cells)


@pytest.mark.costly
def test_a_gradient_step_lowers_each_penalty(case):
    loop, X0 = case
    for penalty in (
        lambda net: rj.volume_penalty(loop.replace(controller=net), X0, 2, TEMPLATE),
        lambda net: rj.specification_penalty(
            loop.replace(controller=net), X0, 2, TEMPLATE, goal=GOAL
        ),
    ):
        before, gradient = jax.value_and_grad(penalty)(loop.controller)
        size = sum(float(jnp.sum(g**2)) for g in jax.tree.leaves(gradient))
        after = penalty(jax.tree.map(lambda w, g: w - 1e-3 * g, loop.controller, gradient))
        assert float(before - after) == pytest.approx(1e-3 * size, rel=0.2)


def test_misspelt_options_are_errors(case):
    with pytest.raises(TypeError, match="relaxatoin"):
        rj.volume_penalty(*case, 1, TEMPLATE, relaxatoin=rj.PaperQC())
    with pytest.raises(TypeError, match="marign"):
        rj.specification_penalty(*case, 1, TEMPLATE, goal=GOAL, marign=1.0)


def test_a_schedule_warms_up_ramps_and_leaves_steps_out():
    schedule = rj.PenaltySchedule(weight=3.0, every=2, warmup=4, ramp=6)
    weights = [float(schedule(step)) for step in range(14)]
    expected = [0] * 4 + [0.5, 0, 1.5, 0, 2.5, 0, 3, 0, 3, 0]
    np.testing.assert_allclose(weights, expected)
    np.testing.assert_allclose(jax.jit(jax.vmap(schedule))(jnp.arange(14)), expected)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.costly
def test_a_schedule_sharpens_the_relaxation(case, compiled):
    stages = {6: rj.LocalBounds(), 2: rj.LinearBounds(), 4: rj.PaperQC()}
    schedule = rj.PenaltySchedule(1.0, relaxations=stages)
    of = {rj.LinearBounds(): 1.0, rj.PaperQC(): 2.0, rj.LocalBounds(): 3.0}

    def weighed(step, x):
        return schedule.apply(step, lambda x, relaxation: of[relaxation] * x, x)

    applied = jax.jit(weighed) if compiled else weighed
    assert [float(applied(step, 2.0)) for step in range(0, 8)] == [2, 2, 2, 2, 4, 4, 6, 6]
    assert [of[schedule.relaxation(step)] for step in (0, 3, 4, 100)] == [1, 1, 2, 3]
    assert rj.PenaltySchedule(1.0).relaxation(3) is None

    def penalty(relaxation):
        return rj.volume_penalty(*case, 1, TEMPLATE, relaxation=relaxation)

    first, last = (float(schedule.apply(step, penalty)) for step in (0, 6))
    assert first == pytest.approx(float(penalty(rj.LinearBounds())), rel=1e-9)
    assert last == pytest.approx(float(penalty(rj.LocalBounds())), rel=1e-6)


@dataclasses.dataclass(frozen=True)
class Counting(rj.AbstractSolver):
    """Clarabel, which notes the programs that it is asked to solve, and breaks down on some."""

    asked: list = dataclasses.field(default_factory=list, hash=False, compare=False)
    failing: int | None = None

    def solve(self, program, goal):
        self.asked.append(program)
        if self.failing and len(self.asked) % self.failing == 0:
            raise ArithmeticError("one call in so many")
        return rj.Clarabel().solve(program, goal)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.costly
def test_nothing_is_solved_at_steps_without_a_weight(case, compiled):
    loop, X0 = case
    solver = Counting()
    schedule = rj.PenaltySchedule(1.0, every=3, warmup=1)

    def loss(net, step):
        def penalty(net):
            return rj.volume_penalty(
                loop.replace(controller=net), X0, 1, TEMPLATE, solver=solver, samples=1
            )

        return schedule.apply(step, penalty, net)

    gradient = jax.value_and_grad(loss)
    gradient = jax.jit(gradient) if compiled else gradient
    values = [float(gradient(loop.controller, step)[0]) for step in range(6)]
    assert [value != 0 for value in values] == [False, True, False, False, True, False]
    assert len(solver.asked) == 2  # one solve for value and gradient together


@pytest.mark.filterwarnings("ignore:the solver Counting counts as FAILED:RuntimeWarning")
@pytest.mark.parametrize("failing", [None, 3])
@pytest.mark.costly
def test_a_run_whose_solver_fails_at_every_third_call_keeps_improving(case, failing):
    """It says how often: no step is skipped, each follows the gradient of what is reported."""
    loop, X0 = case
    solver = Counting(failing=failing)
    optimizer = rj.skip_failures(optax.adam(1e-2))

    def loss(net):
        tube = recursion(loop.replace(controller=net), X0, 1, TEMPLATE, solver=solver)
        return rj.log_volume(tube), rj.unsolved(tube)

    @jax.jit
    def advance(net, state):
        (value, unsolved), gradient = jax.value_and_grad(loss, has_aux=True)(net)
        updates, state = optimizer.update(gradient, state, net)
        return optax.apply_updates(net, updates), state, value, unsolved

    net, state, values, failed = loop.controller, optimizer.init(loop.controller), [], []
    for _ in range(12):
        net, state, value, unsolved = advance(net, state)
        values.append(float(value))
        failed.append(int(unsolved))
    assert rj.failures(state) == 0
    assert failed == [
        len(TEMPLATE) * (failing is not None and step % 3 == 0) for step in range(1, 13)
    ]
    solved = [value for value, count in zip(values, failed, strict=True) if not count]
    assert all(after < before for before, after in pairwise(solved))
    broken = [value for value, count in zip(values, failed, strict=True) if count]
    assert all(after < before for before, after in pairwise(broken))


def test_a_step_without_a_gradient_is_skipped_and_counted(case):
    loop, _ = case
    optimizer = rj.skip_failures(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-2)))

    def trained(failing):
        @jax.jit
        def advance(net, state, lost):
            gradient = jax.tree.map(lambda w: jnp.where(lost, jnp.nan, w), net)
            updates, state = optimizer.update(gradient, state, net)
            return optax.apply_updates(net, updates), state

        nets, state = [loop.controller], optimizer.init(loop.controller)
        for step in range(4):
            net, state = advance(nets[-1], state, step in failing)
            nets.append(net)
        return nets, rj.failures(state)

    same = lambda a, b: all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))  # noqa: E731
    nets, skipped = trained(failing=(1, 2))
    assert skipped == 2
    assert [same(a, b) for a, b in pairwise(nets)] == [False, True, True, False]
    whole, none = trained(failing=())
    assert none == 0
    assert same(nets[-1], whole[2])  # also the optimiser's state was left alone


JAX_RAISES = (ValueError, jax.errors.JaxRuntimeError)
"""What JAX makes of an error in a callback, when it starts a computation or waits for it."""


@pytest.mark.parametrize("how", ["plain", "jit", "scan", "vmap"])
def test_more_skipped_steps_in_a_row_than_the_limit_are_an_error(how):
    optimizer = rj.skip_failures(optax.sgd(0.1), limit=3)

    def advance(weights, state, gradient):
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(weights, updates), state

    if how == "vmap":
        advance = jax.vmap(advance)
    if how in ("jit", "vmap"):
        advance = jax.jit(advance)

    def run(weights, state, steps, gradient):
        if how == "scan":
            several = lambda carry, _: (advance(*carry, gradient), None)  # noqa: E731
            return jax.lax.scan(several, (weights, state), length=steps)[0]
        for _ in range(steps):
            weights, state = advance(weights, state, gradient)
        return weights, state

    shape = (2, 2) if how == "vmap" else (2,)
    weights, lost = jnp.ones(shape), jnp.full(shape, jnp.nan).at[0].set(1.0)
    state = jax.vmap(optimizer.init)(weights) if how == "vmap" else optimizer.init(weights)
    if how == "vmap":  # one of the batch is stuck, the other is not
        lost = lost.at[0].set(1.0)
    weights, state = run(weights, state, 3, lost)
    assert rj.failures(state) == 3
    weights, state = run(weights, state, 1, jnp.ones(shape))  # a good step, and the row is broken
    weights, state = run(weights, state, 3, lost)
    assert rj.failures(state) == 6
    message = r"(?s)the last 4 steps had no finite gradient.*limit="
    with pytest.raises(RuntimeError if how == "plain" else JAX_RAISES, match=message):
        jax.block_until_ready(run(weights, state, 1, lost))


def test_a_compiled_loop_that_is_stuck_ends_by_itself():
    """Nobody looks at the state: the next step is handed what cannot be had."""
    optimizer = rj.skip_failures(optax.sgd(0.1))

    @jax.jit
    def advance(weights, state):
        updates, state = optimizer.update(jnp.nan * weights, state)
        return optax.apply_updates(weights, updates), state

    done = []

    def train(weights):
        state = optimizer.init(weights)
        for _ in range(1000):
            weights, state = advance(weights, state)
            done.append(1)

    with pytest.raises(JAX_RAISES, match="the last 11 steps"):
        train(jnp.ones(2))
    assert len(done) < 100


@pytest.mark.parametrize(
    ("limit", "error"), [(-1, ValueError), (2.5, TypeError), ("many", TypeError)]
)
def test_a_limit_that_is_none_is_named(limit, error):
    with pytest.raises(error, match="limit must be"):
        rj.skip_failures(optax.sgd(0.1), limit=limit)


@pytest.fixture(scope="module")
def unboxed(case):
    """A network, an optimiser that skips failures, and its compiled step, without an input box."""
    loop, X0 = case
    loop = loop.replace(input_box=None)
    optimizer = rj.skip_failures(optax.sgd(1e-2))

    @jax.jit
    def advance(net, state):
        gradient = jax.grad(
            lambda net: rj.specification_penalty(
                loop.replace(controller=net), X0, 4, TEMPLATE, goal=GOAL
            )
        )(net)
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(net, updates), state

    return loop.controller, optimizer, advance


@pytest.mark.parametrize(
    ("factor", "skipped"), [(np.nan, 1), (np.inf, 1), (1e200, 1), (1e12, 0), (1e4, 0)]
)
@pytest.mark.costly
def test_weights_that_went_astray_are_skipped_where_they_have_no_bound(unboxed, factor, skipped):
    """Without an input box, sets that are not numbers have none; those that are large have."""
    controller, optimizer, advance = unboxed
    net = jax.tree.map(lambda w: factor * w, controller)
    after, state = advance(net, optimizer.init(net))
    assert rj.failures(state) == skipped
    moved = [np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (after, net)), strict=True)]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after)) or skipped
    assert any(moved) != bool(skipped) or np.isnan(factor)


@pytest.mark.costly
def test_a_loop_and_a_set_may_be_constants_of_a_compiled_function(case):
    plain = rj.specification_penalty(*case, 1, TEMPLATE, goal=GOAL, margin=0.1)
    compiled = jax.jit(lambda m: rj.specification_penalty(*case, 1, TEMPLATE, goal=GOAL, margin=m))
    assert float(compiled(0.1)) == pytest.approx(float(plain), rel=1e-9)
    once = jax.lax.scan(lambda sum, _: (sum + compiled(0.1), None), 0.0, None, length=2)[0]
    assert float(once) == pytest.approx(2 * float(plain), rel=1e-9)


def test_an_empty_set_inside_jit_has_no_size(case):
    loop, _ = case
    empty = jax.jit(lambda low, up: rj.volume_penalty(loop, rj.Box(low, up), 1, TEMPLATE))
    assert np.isnan(empty(jnp.ones(2), jnp.zeros(2)))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"margin": -1.0}, ValueError, r"margin must be finite and at least 0, but -1\.0 arrived"),
        ({"margin": float("nan")}, ValueError, "margin must be finite .* but nan arrived"),
        ({"margin": "0.1"}, TypeError, "margin must be a number, but '0.1' arrived"),
        ({"margin": jnp.ones(3)}, TypeError, "margin must be a number"),
        ({"goal": rj.Box([0.0], [1.0])}, ValueError, "goal has dimension 1, but the loop has 2"),
        ({"goal": None}, ValueError, "nothing to verify"),
        ({"avoid": 0}, TypeError, "avoid must be a sequence of sets, .* but 0 arrived"),
        ({"avoid": {True: [GOAL]}}, TypeError, "avoid must name times or ranges of them"),
        ({"avoid": {7: [GOAL]}}, ValueError, "avoid names time 7"),
    ],
)
def test_mistakes_in_a_specification_are_named_before_anything_is_solved(
    case, options, error, message
):
    with pytest.raises(error, match=message):
        rj.specification_penalty(*case, 2, TEMPLATE, **{"goal": GOAL, "solver": Never()} | options)


@dataclasses.dataclass(frozen=True)
class Never(rj.AbstractSolver):
    """A solver that must not be asked."""

    def solve(self, program, goal):
        raise AssertionError("a program was solved")


@pytest.mark.parametrize(
    ("measure", "error", "message"),
    [
        ("volume", TypeError, "measure must be a function of a set, but 'volume' arrived"),
        (rj.log_widths, ValueError, r"measure must give one number .* of shape \(2,\) arrived"),
        (lambda X: None, ValueError, "measure must give one number for a set, but None arrived"),
    ],
)
def test_a_bad_measure_is_named(case, measure, error, message):
    with pytest.raises(error, match=message):
        rj.volume_penalty(*case, 1, TEMPLATE, measure=measure)


@pytest.mark.parametrize("optimizer", [optax.adam, None, 1e-3])
def test_what_is_no_optimiser_is_named(optimizer):
    with pytest.raises(TypeError, match="optimizer must be an optax optimiser, such as"):
        rj.skip_failures(optimizer)


def test_failures_of_several_optimisers_and_of_batches_are_summed():
    optimizer = rj.skip_failures(optax.sgd(1e-2))
    states = jax.vmap(optimizer.init)(jnp.ones((3, 2)))
    nans = jnp.array([[1.0, 1.0], [jnp.nan, 1.0], [jnp.nan, jnp.nan]])
    _, states = jax.vmap(optimizer.update)(nans, states)
    assert rj.failures(states) == 2
    assert rj.failures((states, states)) == 4
    with pytest.raises(ValueError, match=r"call failures\(state\) outside jax\.jit"):
        jax.jit(rj.failures)(states)


def test_failures_are_counted_in_a_flax_optimiser():
    model = nnx.Linear(2, 1, rngs=nnx.Rngs(0))
    optimizer = nnx.Optimizer(model, rj.skip_failures(optax.adam(1e-2)), wrt=nnx.Param)
    before = model.kernel[...]
    broken = jax.tree.map(lambda w: w * jnp.nan, nnx.state(model, nnx.Param))
    optimizer.update(model, broken)
    np.testing.assert_array_equal(model.kernel[...], before)
    assert rj.failures(optimizer.opt_state) == 1


def test_a_state_without_a_count_is_an_error():
    with pytest.raises(ValueError, match="state must be that of an optimiser wrapped by skip_fail"):
        rj.failures(optax.adam(1e-2).init(jnp.zeros(2)))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"weight": -1.0}, ValueError, r"weight must be finite and at least 0, but -1\.0 arrived"),
        ({"weight": float("nan")}, ValueError, "weight must be finite .* but nan arrived"),
        ({"weight": "much"}, TypeError, "weight must be a number, but 'much' arrived"),
        ({"weight": 1.0, "every": 0}, ValueError, "every must be at least 1, but 0 arrived"),
        ({"weight": 1.0, "warmup": -1}, ValueError, "warmup must be at least 0, but -1 arrived"),
        ({"weight": 1.0, "ramp": 0.5}, TypeError, r"ramp must be a whole number, but 0\.5 arrived"),
        ({"weight": 1.0, "wramup": 5}, TypeError, "wramup"),
        ({"weight": 1.0, "relaxations": rj.PaperQC()}, TypeError, "a mapping from steps to relax"),
        ({"weight": 1.0, "relaxations": {0: 3}}, TypeError, "a relaxation object, but 3 arrived"),
        ({"weight": 1.0, "relaxations": {-1: rj.PaperQC()}}, ValueError, "at least 0, but -1"),
    ],
)
def test_bad_schedules_are_named(options, error, message):
    with pytest.raises(error, match=message):
        rj.PenaltySchedule(**options)


@pytest.mark.parametrize(
    ("step", "penalty", "error", "message"),
    [
        (1, 2.0, TypeError, r"penalty must be a function, but 2\.0 arrived"),
        (0, lambda: jnp.ones(3), ValueError, r"penalty must give one real number, .* shape \(3,\)"),
        (0, lambda: None, TypeError, "penalty must give one real number, but None arrived"),
        (0, lambda: "x", TypeError, "penalty must give one real number, but 'x' arrived"),
        (0, lambda: 1j, ValueError, "penalty must give one real number, .* kind complex128"),
        (0.5, lambda: 1.0, TypeError, r"step must be a whole number, but 0\.5 arrived"),
        (jnp.array([0.5]), lambda: 1.0, TypeError, r"step must be a whole number"),
        (jnp.array([1, -1]), lambda: 1.0, ValueError, "step must be at least 0"),
        (-1, lambda: 1.0, ValueError, "step must be at least 0, but -1 arrived"),
        (jnp.arange(2), lambda: 1.0, ValueError, r"step must be one number, .* shape \(2,\)"),
    ],
)
def test_mistakes_in_applying_a_schedule_are_named(step, penalty, error, message):
    with pytest.raises(error, match=message):
        rj.PenaltySchedule(1.0, every=2).apply(step, penalty)


def test_a_schedule_takes_arrays_and_penalties_of_single_precision():
    schedule = rj.PenaltySchedule(jnp.asarray(0.5), every=jnp.asarray(2))
    apply = jax.jit(lambda step: schedule.apply(step, lambda: jnp.float32(2)))
    assert [float(apply(step)) for step in range(3)] == [1.0, 0.0, 1.0]


@pytest.mark.costly
def test_a_batch_of_networks_is_penalised_one_by_one(case):
    loop, X0 = case
    penalty = partial(rj.specification_penalty, goal=GOAL, margin=0.1)
    nets = [jax.tree.map(lambda w, s=s: w * s, loop.controller) for s in (0.9, 1.1)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)

    def of(net):
        return penalty(loop.replace(controller=net), X0, 2, TEMPLATE)

    batch = jax.jit(jax.vmap(jax.grad(of)))(together)
    for k, net in enumerate(nets):
        single = jax.grad(of)(net)
        jax.tree.map(
            # compiled and plain programs are rounded differently: alike to what is promised
            lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-3, atol=1e-6),
            batch,
            single,
        )
