"""Of a differential equation what is safe is decided at all times, in between samples too."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.batches import in_between
from reachjax.loops.units import UnboundedError
from reachjax.programs.unrolled import unrolled, unrolled_at_once, unrolled_from_boxes
from reachjax.verdicts.facet_rows import FacetRowsByTime
from reachjax.verdicts.specification import requirements

TURN = 2 * math.pi
X0 = rj.Box([-0.01, 0.99], [0.01, 1.01])
STILL = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])


def turning(x, u):
    """Half a turn a period."""
    return TURN * jnp.array([x[1], -x[0]]) + u


def loops():
    """A state that turns, as a function and by matrices."""
    matrices = [[0, TURN], [-TURN, 0]], [[1], [1]]
    plants = rj.SampledPlant(turning, 2, 1, 0.5), rj.SampledPlant.affine(*matrices, period=0.5)
    return [rj.ClosedLoop(plant, STILL) for plant in plants]


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_what_is_safe_at_samples_alone_is_refuted_in_between(loop):
    safe = rj.Box([-0.5, -2.0], [0.5, 2.0])
    tube = rj.reach(loop, X0, 2, rj.Template.box(2), relaxation=rj.LinearBounds())
    for each in tube.sets:
        assert np.all(np.asarray(safe.contains(each.bounding_box().corners())))
    for verdict in (rj.decide(loop, X0, 2, safe=safe), rj.verify(tube, safe=safe)):
        assert verdict.refuted
        instant = verdict.counterexample.instant
        assert min(abs(instant - k / 2) for k in range(3)) > 0.05


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_what_is_safe_at_all_times_is_proved(loop):
    safe, avoid = rj.Box([-1.2, -1.2], [1.2, 1.2]), [rj.Box([1.2, -0.1], [1.5, 0.1])]
    verdict = rj.decide(loop, X0, 2, safe=safe, avoid=avoid)
    assert verdict.proved
    tube = rj.reach(loop, X0, 2, rj.Template.regular(16), relaxation=rj.LinearBounds())
    assert rj.verify(tube, safe=safe).proved
    by_cells = rj.decide(loop, X0, 2, safe=safe, cells=[2, 1])
    assert by_cells.proved


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_a_goal_over_a_span_is_one_at_all_times_of_it(loop):
    right, wide = rj.Box([-0.2, -1.2], [1.2, 1.2]), rj.Box([-1.2, -1.2], [1.2, 1.2])
    first = rj.decide(loop, X0, 2, goal={(0.0, 0.5): right})  # half a turn on this side
    assert first.proved
    whole = rj.decide(loop, X0, 2, goal={(0.0, 1.0): right})
    assert whole.refuted
    assert 0.5 < whole.counterexample.instant < 1.0
    assert rj.decide(loop, X0, 2, goal={(0.5, 1.0): wide, 0.0: right}).proved


def test_errors_of_spans_say_which_times_there_are():
    loop, G = loops()[0], rj.Box([-1.2, -1.2], [1.2, 1.2])
    with pytest.raises(ValueError, match="no sample"):
        rj.decide(loop, X0, 2, goal={(0.2, 0.5): G})
    with pytest.raises(ValueError, match="no sample"):  # a fast state moves far meanwhile
        rj.decide(loop, X0, 2, goal={(0.5 - 4e-10, 1.0): G})
    with pytest.raises(ValueError, match="the horizon is 1"):
        rj.decide(loop, X0, 2, goal={(0.5, 1.5): G})
    discrete = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.zeros((2, 1))), STILL)
    with pytest.raises(TypeError, match="discrete time"):
        rj.decide(discrete, X0, 2, goal={0.5: G})


def test_a_plant_in_discrete_time_has_no_spans():
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.zeros((2, 1))), STILL)
    tube = rj.reach(loop, X0, 1, rj.Template.box(2))
    with pytest.raises(TypeError, match="no states in between"):
        _ = tube.spans


def test_spans_are_not_computed_in_32_bits():
    tube = rj.reach(loops()[1], X0, 1, rj.Template.box(2), relaxation=rj.LinearBounds())
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="needs 64-bit floats"):
        _ = tube.spans
    assert tube.spans[0].contains(tube.sets[0].center)


def test_states_that_are_looked_at_in_between_are_near_the_flow():
    loop = jax.device_get(loops()[0])
    points = np.random.default_rng(0).uniform(X0.lower, X0.upper, size=(5, 2))
    states = np.asarray(loop.simulate(points, 1))
    found = in_between(loop, points, states[:, 1], 0)
    exact = np.stack([np.sin(math.pi / 8) * points[:, 1] + np.cos(math.pi / 8) * points[:, 0]])
    np.testing.assert_allclose(found[0][:, 0], exact[0], atol=0.05)


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_winning_and_largest_sets_are_of_all_times(loop):
    """Half a turn apart a state is as far from zero as before; in between it is on the circle."""
    safe = rj.Box([-0.5, -2.0], [0.5, 2.0])
    lost = rj.winning_set(loop, X0, 1, safe=safe, cells=4)
    assert not lost.of(rj.VerdictStatus.PROVED)
    won = rj.winning_set(loop, rj.Box([-0.1, -0.3], [0.1, 0.3]), 1, safe=safe, cells=4)
    assert won.contains([[0.0, 0.0], [0.1, 0.3]]).all()
    found = rj.largest_set(loop, rj.Box([-0.1, -0.1], [0.1, 0.1]), 1, safe=safe, rounds=5)
    corners = np.asarray(found.region.corners())
    assert np.linalg.norm(corners, axis=1).max() <= 0.5 + 1e-9
    assert np.linalg.norm(corners, axis=1).max() >= 0.4


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_spans_are_little_larger_than_dense_samples(loop):
    tube = rj.reach(loop, X0, 3, rj.Template.box(2), relaxation=rj.LinearBounds())
    dense = np.asarray(loop.simulate(X0.corners(), 3, parts=64))
    ratios = []
    for k, span in enumerate(tube.spans):
        box, seen = span.bounding_box(), dense[:, 64 * k : 64 * (k + 1) + 1]
        ratios.append(np.prod(np.asarray(box.widths)) / np.prod(np.ptp(seen, axis=(0, 1))))
    assert 1 - 1e-12 <= np.mean(ratios) <= 1.1


def test_simulations_with_states_in_between_are_of_the_flow():
    for each in loops():
        loop = each.replace(plant=each.plant.replace(period=0.05))
        points = np.random.default_rng(0).uniform(X0.lower, X0.upper, size=(5, 2))
        dense = np.asarray(loop.simulate(points, 2, parts=4))
        angles = TURN * 0.05 * np.arange(9) / 4
        turned = np.cos(angles) * points[:, :1] + np.sin(angles) * points[:, 1:]
        np.testing.assert_allclose(dense[:, :, 0], turned, atol=1e-9)
        np.testing.assert_allclose(dense[:, ::4], loop.simulate(points, 2), rtol=1e-9, atol=1e-12)
    discrete = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.zeros((2, 1))), STILL)
    with pytest.raises(ValueError, match="parts must be 1"):
        discrete.simulate([0.0, 1.0], 2, parts=2)


@pytest.mark.costly
def test_a_trajectory_that_escapes_is_refuted_where_it_is_still_enclosed():
    net = rj.MLP.from_layers([([[0.3, 0.1], [-0.2, 0.3]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    plant = rj.SampledPlant(lambda x, u: jnp.array([x[0] ** 2 + u[0], -x[1]]), 2, 1, period=0.25)
    loop, wide = rj.ClosedLoop(plant, net), rj.Box([0.2, -1.0], [1.0, 1.0])
    verdict = rj.decide(loop, wide, 6, safe=rj.Box([-50.0, -5.0], [50.0, 5.0]), cells=64)
    assert verdict.refuted
    assert verdict.counterexample.states[-1][0] > 50.0


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_states_may_pass_a_corner_within_a_period(loop):
    """The corner is at a radius of 0.96 or 1.02, states are at 0.99 to 1.01."""
    within, beyond = (rj.Box([0.3, 0.3], [corner, corner]) for corner in (0.68, 0.72))
    for cells in (None, (2, 1)):
        assert rj.decide(loop, X0, 1, avoid=[within], cells=cells).proved
        assert rj.decide(loop, X0, 1, avoid=[beyond], cells=cells).refuted


def test_bounds_of_each_part_of_a_period_hold_the_states_in_it():
    loop = rj.ClosedLoop(rj.SampledPlant(turning, 2, 1, 0.5, steps=4), STILL)
    axes = jnp.tile(jnp.concatenate([jnp.eye(2), -jnp.eye(2)]), (2, 1, 1))
    ends, whole = (X0.lower[None], X0.upper[None]), jnp.ones(axes.shape[:2], bool)
    (bounds,) = np.asarray(unrolled_from_boxes(loop, *ends, axes, whole, between=8))
    points = jnp.concatenate([X0.corners(), X0.sample(jax.random.key(0), 50)])
    parts = bounds.shape[1]
    states = np.asarray(loop.simulate(points, 2, parts=4 * parts))
    values = np.concatenate([states, -states], axis=-1)
    for number, upper in enumerate(bounds.reshape(2 * parts, -1)):
        assert np.all(values[:, 4 * number : 4 * number + 5] <= upper + 1e-9)
    assert np.all(bounds.min(axis=1) < bounds.max(axis=1) - 0.9)  # the circle has a radius of one


@pytest.mark.parametrize("loop", loops(), ids=["function", "matrices"])
def test_directions_are_bounded_in_parts_of_their_own_or_at_samples_alone(loop):
    axes = np.tile(np.concatenate([np.eye(2), -np.eye(2)]), (2, 1, 1))
    every, few, some = (
        [*unrolled(loop, X0, X0, axes, between=parts)] for parts in (8, 1, (8, 0, 1, 8))
    )
    for at_all, whole, mixed in zip(every, few, some, strict=True):
        expected = np.array(at_all.between)
        expected[:, 1] = np.inf
        expected[:, 2] = np.repeat(whole.between, len(expected) // len(whole.between), axis=0)[:, 2]
        np.testing.assert_allclose(mixed.between, expected, rtol=1e-12)
        np.testing.assert_array_equal(mixed.offsets, at_all.offsets)


def test_as_few_directions_as_can_be_are_bounded_in_between():
    away, box = rj.Box([2.0, 2.0], [3.0, 3.0]), rj.Box([-2.0, -2.0], [2.0, 2.0])
    for goal in (box, {(0.5, 1.0): box}):
        required = requirements(2, 2, 0.5, goal=goal, avoid=[away])
        rows, proving = (
            FacetRowsByTime.of(required, 2, 2, refuting=many) for many in (True, False)
        )
        for each in rows.each:
            if each.item.throughout:
                assert set(rows.parts[each.first : each.end]) == {8}
        assert rows.parts.count(0) == (8 if goal is box else 0)
        assert len(rows.parts) == 2 * len(proving.parts)
        for most, least in zip(rows.each, proving.each, strict=True):
            np.testing.assert_array_equal(most.directions[: len(most.units)], least.directions)
            np.testing.assert_array_equal(most.limits[: len(most.units)], least.limits)
            for bound in (-10.0, 10.0):
                holds, _, margin = most.judged(np.full(len(rows.parts), bound))
                uppers = np.full(len(proving.parts), bound)
                assert least.judged(uppers) == (holds, False, margin)


@pytest.mark.costly
def test_directions_that_are_bounded_in_parts_of_their_own_have_derivatives():
    rows, asked, (_, turned) = np.tile(np.eye(3)[:, :2] + 0.5, (2, 1, 1)), (8, 0, 8), loops()

    def total(push, parts=asked):
        net = rj.MLP.from_layers([([[0.0, 0.0]], push)])
        loop, options = rj.ClosedLoop(turned.plant, net), {"between": parts, "counted": False}
        found = unrolled_at_once(loop, X0, X0, rows, **options).between
        return jnp.sum(jnp.where(np.array(asked) > 0, found, 0.0))

    value, slope = jax.value_and_grad(total)(jnp.array([0.1]))
    np.testing.assert_allclose(value, total(np.array([0.1]), 8), rtol=1e-9)
    above, below = (total(np.array([push])) for push in (0.101, 0.099))
    np.testing.assert_allclose(slope, [(above - below) / 0.002], rtol=1e-4)


def switching(f, **options):
    """A loop under ReLUs, of which forms leave out much, and a period of its own."""
    rng = np.random.default_rng(2)
    layers = [(rng.normal(size=(8, 2)), np.zeros(8)), (rng.normal(size=(1, 8)), [0])]
    return rj.ClosedLoop(rj.SampledPlant(f, 2, 1, 0.2, **options), rj.MLP.from_layers(layers))


def damped(x, u):
    return jnp.array([x[1], -x[0] - x[1] + u[0]])


def pushed(x, u, t):
    return damped(x, u) + jnp.array([0.0, 3 * jnp.sin(2 * t)])


WIDE = rj.Box([-1.0, -1.0], [1.0, 1.0])


@pytest.mark.parametrize(
    ("loop", "given", "start"),
    [
        (switching(damped), (WIDE, 3, rj.Template.box(2)), 0),
        (switching(pushed, clock=True), (WIDE, 3, rj.Template.box(2)), 3),
        (rj.delayed(switching(damped)), (rj.with_inputs(WIDE, [0.5]), 5, rj.Template.box(3)), 0),
    ],
    ids=["plain", "clock", "late"],
)
def test_spans_are_smaller_where_the_sets_of_samples_are(loop, given, start):
    """Forms leave out what ReLUs do; spans go by sets that programs, which do not, found."""
    X0, horizon, template = given
    tube, by_forms = (
        rj.reach(loop, X0, horizon, template, relaxation=relaxation, start=start)
        for relaxation in (rj.BranchAndCut(), rj.LinearBounds())
    )
    first = X0.sample(jax.random.key(0), 500)
    states = np.asarray(loop.simulate(first, horizon, start=start, parts=8))
    sizes = []
    for k, spans in enumerate(zip(tube.spans, by_forms.spans, strict=True)):
        seen = states[:, 8 * k + 1 : 8 * (k + 1) + 1].reshape(-1, loop.states)
        assert np.all(np.asarray(spans[0].contains(seen, 1e-9)))
        sizes.append([np.prod(np.asarray(span.bounding_box().widths)) for span in spans])
    assert sizes[-1][0] < 0.9 * sizes[-1][1]
    assert all(one <= other * (1 + 1e-9) for one, other in sizes)


def test_spans_are_smaller_beside_a_coordinate_of_larger_units():
    """Whether a set is smaller is asked along each row: of the third coordinate it is not."""

    def beside(x, u):
        return jnp.concatenate([damped(x[:2], u), -x[2:]])

    plain = switching(damped)
    (W, b), *rest = plain.controller.layers
    net = rj.MLP.from_layers([(jnp.pad(W, ((0, 0), (0, 1))), b), *rest])
    loop = rj.ClosedLoop(rj.SampledPlant(beside, 3, 1, 0.2), net)
    X0 = rj.Box([-1.0, -1.0, -1e4], [1.0, 1.0, 1e4])
    found, expected = rj.reach(loop, X0, 3), rj.reach(plain, WIDE, 3)
    for span, other in zip(found.spans, expected.spans, strict=True):
        widths, wanted = (np.asarray(each.bounding_box().widths) for each in (span, other))
        np.testing.assert_allclose(widths[:2], wanted, rtol=1e-3)


def test_spans_where_the_form_of_the_initial_set_is_lost_are_those_of_sets_in_between():
    def rooted(x, u):
        return damped(x, u) + jnp.array([0.0, 0.1 * jnp.sqrt(x[0] + 1.7)])

    loop, template = switching(rooted), rj.Template.box(2)
    with pytest.raises(UnboundedError, match="Sqrt"):
        rj.reach(loop, WIDE, 4, template, relaxation=rj.LinearBounds())
    tube = rj.reach(loop, WIDE, 4, template)
    states = np.asarray(loop.simulate(WIDE.sample(jax.random.key(0), 500), 4, parts=8))
    for k, span in enumerate(tube.spans):
        seen = states[:, 8 * k + 1 : 8 * (k + 1) + 1].reshape(-1, 2)
        assert np.all(np.asarray(span.contains(seen, 1e-9)))
