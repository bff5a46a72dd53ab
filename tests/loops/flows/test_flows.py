"""Flows hold the solutions of differential equations, at samples and in between."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mpf

import reachjax as rj
from reachjax.loops.batches import Batch
from reachjax.loops.flows.steps import WORTH, drift
from reachjax.loops.flows.taylor_models import Symbols
from reachjax.loops.tracing.limits import Limits
from reachjax.loops.units import UnboundedError
from reachjax.numerics.numbers import split
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine import AffineForms
from reachjax.programs.basis import columns
from reachjax.programs.flows import flowed_forms
from reachjax.programs.initial import InitialColumns
from tests.loops.flows.fields import KINDS, field, solution

STATES = 1, 2, 3, 6
PARTS = 0.0, 0.1, 0.37, 0.5, 0.83, 1.0
CUT = 4
DENSE = tuple(k / 50 for k in range(1, 51))


def on_host(plant):
    """A plant of numpy arrays."""
    return jax.device_get(plant)


def outside(ball: Ball, exact) -> int:
    """How many numbers are not inside of their interval, in arithmetic of 40 digits."""
    pairs = zip(ball.mid, ball.rad, exact, strict=True)
    return sum(abs(mpf(float(m)) - e) > mpf(float(r)) for m, r, e in pairs)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("states", STATES)
def test_from_points_solutions_are_enclosed_and_enclosures_are_thin(kind, states):
    rng = np.random.default_rng(states)
    own = field(rng, kind, states)
    plant = on_host(rj.SampledPlant(own, states, 1, period=0.3))
    for _ in range(3):
        x, u = rng.uniform(-0.6, 0.6, size=states), rng.uniform(-0.5, 0.5, size=1)
        (exact,) = solution(own, x, [u], [plant.period])
        found = plant.propagate(Ball.exact(x), Ball.exact(u))
        assert outside(found, exact) == 0
        assert np.all(found.rad <= 1e-9 * (abs(found.mid) + 1e-2))
        simulated = plant.propagate(x, u)
        np.testing.assert_allclose(simulated, [float(e) for e in exact], rtol=1e-9, atol=1e-9)


def value(forms: AffineForms, columns) -> tuple[Any, Any]:
    """The middles of forms at some initial columns, and how far numbers may be from them."""
    count = len(columns)
    rows, rest = forms.columns[:, :count], forms.columns[:, count:]
    error = 1e-14 * (1 + abs(forms.rows).sum(axis=1))
    return forms.rows[:, 0] + rows @ columns, abs(rest).sum(axis=1) + forms.radii[:, 0] + error


def columns_of(start: InitialColumns, x) -> np.ndarray:
    """The initial columns of a state."""
    w = start.back @ (x - start.center)
    i, j = start.pairs
    return np.concatenate([w, np.where(i == j, 2 * w[i] * w[j] - 1, w[i] * w[j])])


def next_forms(found: AffineForms) -> AffineForms:
    """Forms whose radii are columns of their own, as a step of the loop has them."""
    forms, _ = AffineForms(found.rows, found.radii * [0, 1]).with_own(found.radii[:, 0], None)
    return forms


def missed(
    own, plant, box: rj.Box, gain, rng, periods: int = 2, points: int = 3, parts=PARTS
) -> int:
    """How often a solution is outside of what forms say of it, at samples or in between.

    The last of the parts is 1, the sample.
    """
    assert parts[-1] == 1.0
    start = InitialColumns.of(box, box, curved=True)
    center, wide = np.asarray(box.center), np.asarray(box.widths) / 2
    signs = rng.choice([-1.0, 1.0], size=(points, own.states))
    signs[1:] *= rng.uniform(size=(points - 1, own.states))
    firsts = [center + wide * each * (1 - 1e-9) for each in signs]
    states, wrong = [[mpf(a) for a in x] for x in firsts], 0
    forms = AffineForms.beginning(start)
    directions = np.concatenate([np.eye(own.states), -np.eye(own.states)])
    directions = np.concatenate([directions, rng.normal(size=(2, own.states))])
    for _ in range(periods):
        forms, between = flowed_forms(plant.flow, (forms, gain @ forms), start, between=True)
        hulls = [[directions @ point for point in four] for four in between.points]
        cut = split(between.values(directions, CUT), CUT * len(hulls))
        cut = [split(part, 4) for part in cut]
        for n, first in enumerate(firsts):
            w = columns_of(start, first)
            u = [sum(mpf(g) * a for g, a in zip(row, states[n], strict=True)) for row in gain]
            times = [(k, part) for k in range(len(between.ends)) for part in parts]
            ends = (0.0, *between.ends)
            moments = [mpf(ends[k]) + part * (mpf(ends[k + 1]) - mpf(ends[k])) for k, part in times]
            exact = solution_of(own, states[n], u, [mpf(float(plant.period)) * m for m in moments])
            for (k, part), x in zip(times, exact, strict=True):
                reached = directions @ np.array([float(a) for a in x])
                for four in (hulls[k], cut[k * CUT + min(int(CUT * part), CUT - 1)]):
                    uppers = [sum(value(point, w)) for point in four]
                    wrong += np.sum(~(reached <= np.max(uppers, axis=0) + 1e-12))
            states[n] = exact[-1]
            middle, error = value(forms, w)
            apart = abs(np.array([float(a) for a in exact[-1]]) - middle)
            wrong += np.sum(~(apart <= error + 1e-12))
            lower, upper = forms.ends(start)
            inside = [
                lo - 1e-12 <= a <= up + 1e-12
                for lo, a, up in zip(lower, states[n], upper, strict=True)
            ]
            wrong += inside.count(False)
        forms = next_forms(forms)
    return int(wrong)


def solution_of(own, x, u, times):
    """States at some times from a state of 40 digits."""
    return solution(own, x, [u], times)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("states", STATES)
def test_from_boxes_solutions_are_enclosed_at_samples_and_in_between(kind, states):
    rng = np.random.default_rng(10 + states)
    own = field(rng, kind, states)
    plant = on_host(rj.SampledPlant(own, states, 1, period=0.3))
    center = rng.uniform(-0.4, 0.4, size=states)
    for radius in (0.01, 0.15):
        box = on_host(rj.Box(center - radius, center + radius))
        gain = rng.uniform(-1, 1, size=(1, states))
        assert missed(own, plant, box, gain, rng) == 0


@pytest.mark.long
@pytest.mark.parametrize("first", range(0, 200, 10))
def test_solutions_of_two_hundred_fields_are_enclosed_at_fifty_times(first):
    for number in range(first, first + 10):
        rng = np.random.default_rng([number, 200])
        states = 1 + number % 6
        own = field(rng, KINDS[number % len(KINDS)], states)
        plant = on_host(rj.SampledPlant(own, states, 1, period=0.3))
        x, u = rng.uniform(-0.6, 0.6, size=states), rng.uniform(-0.5, 0.5, size=1)
        (exact,) = solution(own, x, [u], [plant.period])
        found = plant.propagate(Ball.exact(x), Ball.exact(u))
        assert outside(found, exact) == 0
        assert np.all(found.rad <= 1e-9 * (abs(found.mid) + 1e-2))
        gain, radius = rng.uniform(-1, 1, size=(1, states)), 10.0 ** rng.uniform(-8, -0.8)
        box = on_host(rj.Box(x - radius, x + radius))
        assert missed(own, plant, box, gain, rng, 1, 1, DENSE) == 0


@pytest.mark.long
@pytest.mark.parametrize("order", range(1, 13))
def test_orders_and_steps_at_random_enclose_at_fifty_times(order):
    rng = np.random.default_rng([order, 12])
    for kind in KINDS[:4]:
        states, steps = int(rng.integers(1, 7)), int(rng.integers(1, 21))
        own = field(rng, kind, states)
        plant = rj.SampledPlant(own, states, 1, period=0.4, order=order, steps=steps)
        center, radius = rng.uniform(-0.4, 0.4, size=states), 10.0 ** rng.uniform(-6, -1)
        box = on_host(rj.Box(center - radius, center + radius))
        gain = rng.uniform(-1, 1, size=(1, states))
        assert missed(own, on_host(plant), box, gain, rng, 1, 1, DENSE[4::5]) == 0


@pytest.mark.parametrize("order", [1, 2, 3, 5, 12])
@pytest.mark.parametrize("steps", [1, 3, 20])
def test_whatever_the_order_and_the_steps_solutions_are_enclosed(order, steps):
    rng = np.random.default_rng(order + steps)
    own = field(rng, KINDS[order % len(KINDS)], 2)
    plant = rj.SampledPlant(own, 2, 1, period=0.4, order=order, steps=steps)
    center = rng.uniform(-0.4, 0.4, size=2)
    box = on_host(rj.Box(center - 0.1, center + 0.1))
    assert missed(own, on_host(plant), box, rng.uniform(-1, 1, size=(1, 2)), rng, 1) == 0


def raised(plant, x, radius=0.0) -> UnboundedError:
    """The error of a plant over a box around a state."""
    with pytest.raises(UnboundedError) as found:
        on_host(plant).propagate(Ball(np.array(x), np.full(len(x), radius)), Ball.exact(np.ones(1)))
    return found.value


def test_solutions_that_escape_end_with_an_error_that_names_the_state_and_the_time():
    plant = rj.SampledPlant(lambda x, u: jnp.array([u[0], x[1] ** 2]), 2, 1, period=2.0)
    error = raised(plant, [0.0, 1.0])  # x_2 = 1 / (1 - t)
    assert "state 2" in str(error)
    assert "t = 0" in str(error)


def test_solutions_that_leave_a_domain_end_with_an_error_that_names_the_line():
    plant = rj.SampledPlant(lambda x, u: jnp.array([-1 / x[0]]), 1, 1, period=1.0)
    error = raised(plant, [1.0])  # x = sqrt(1 - 2 t)
    assert "Reciprocal" in str(error)
    assert "test_flows.py" in str(error)


def test_near_a_pole_solutions_are_enclosed():
    plant = on_host(rj.SampledPlant(lambda x, u: jnp.array([x[0] ** 2]), 1, 1, period=0.9))
    found = plant.propagate(Ball.exact(np.ones(1)), Ball.exact(np.zeros(1)))
    exact = 1 / (1 - mpf(float(plant.period)))
    assert outside(found, [exact]) == 0
    assert found.rad[0] <= 1e-9 * found.mid[0]


def decaying(rate: float):
    """A plant whose state goes to its input at this rate."""
    return rj.SampledPlant(lambda x, u: -rate * (x - u), 1, 1, period=1.0)


def test_fast_plants_are_enclosed():
    found = on_host(decaying(40.0)).propagate(Ball.exact(np.full(1, 2.0)), Ball.exact(np.ones(1)))
    assert abs(found.mid[0] - (1 + np.exp(-40.0))) <= found.rad[0] + 1e-15
    assert found.rad[0] <= 1e-9


def test_stiff_plants_end_with_an_error_that_says_so():
    assert "too fast" in str(raised(decaying(1e6), [2.0]))


def test_what_is_not_known_stays_so():
    plant = on_host(rj.SampledPlant(lambda x, u: jnp.sin(x) + u, 1, 1, period=0.1))
    for mid, rad in ((np.nan, 0.0), (0.0, np.inf), (np.inf, 0.0), (0.0, np.nan)):
        found = plant.propagate(Ball(np.array([mid]), np.array([rad])), Ball.exact(np.zeros(1)))
        assert not np.isfinite(found.mid + found.rad).any()


def test_slopes_of_a_step_that_are_not_known_take_states_anywhere():
    known = Ball.exact(np.ones((1, 1)))
    lost = Ball(np.full((1, 1), np.nan), np.full((1, 1), np.nan))
    for slopes in ((known, lost), (lost, known), (lost, lost)):
        for steps in ([(known, known), slopes], [slopes, (known, known)]):
            end, within = drift(steps, Ball(np.zeros(1), np.ones(1)), 0.1)
            assert not np.isfinite(end + within).any()


@pytest.mark.parametrize(("held", "steps"), [(True, 1), (False, 1), (False, 4)])
def test_disturbances_take_states_nowhere_else_than_is_said(held, steps):
    def own(x, u, w):
        return jnp.array([x[1] + 0.3 * w[0], jnp.sin(x[0]) + u[0] + w[1] * x[1]])

    period, pieces, rng = 0.2, 16, np.random.default_rng(0)
    plant = rj.SampledPlant(own, 2, 1, period, disturbances=2, held=held, steps=steps)
    short = on_host(rj.SampledPlant(own, 2, 1, period / pieces, disturbances=2, held=True))
    X, U = Ball(np.array([0.3, -0.5]), np.full(2, 0.05)), Ball.exact(np.array([0.4]))
    W = Ball(np.zeros(2), np.array([0.5, 0.2]))
    found = on_host(plant).propagate(X, U, w=W)
    most = np.full(2, -np.inf)
    for signal in range(60):
        x = X.mid + X.rad * rng.choice([-1, 1], size=2)
        constant = W.rad * rng.choice([-1, 1], size=2)
        first = constant if signal % 2 else -constant
        switch = rng.integers(pieces + 1)
        for k in range(pieces):
            w = constant if held or k >= switch else first
            x = short.propagate(x, U.mid, w=w)
        assert np.all((found.lower <= x) & (x <= found.upper))
        most = np.maximum(most, (abs(x - found.mid)) / found.rad)
    assert np.all(most >= (0.9 if held else 0.8))  # nor is much more said


@pytest.mark.costly
def test_compiled_flows_hold_what_flows_in_numpy_do(monkeypatch):
    """On the host more products are symbols, with which no less is held."""
    rng = np.random.default_rng(5)
    own = field(rng, "trigonometric", 2)
    plant = rj.SampledPlant(own, 2, 1, period=0.05)
    box = rj.Box(np.full(2, -0.1), np.full(2, 0.1))
    gain = rng.uniform(-1, 1, size=(1, 2))

    def ends(plant, box):
        start = InitialColumns.of(box, box, curved=True)
        forms = AffineForms.beginning(start)
        found, between = flowed_forms(plant.flow, (forms, gain @ forms), start, between=True)
        directions = np.concatenate([np.eye(2), -np.eye(2)])
        return found.ends(start), between.bounds(directions, start)

    (lower, upper), spans = jax.jit(ends)(plant, box)
    (least, most), _ = ends(*on_host((plant, box)))
    monkeypatch.setattr(Symbols, "with_higher", property(lambda symbols: symbols))
    (low, high), over = ends(*on_host((plant, box)))
    assert np.all((low <= least + 1e-12) & (most - 1e-12 <= high))
    left_out = 2 * WORTH * (high - low)  # the host's order and the compiled one differ by that
    assert np.all(abs(lower - low) <= left_out)
    assert np.all(abs(upper - high) <= left_out)
    np.testing.assert_allclose(spans, over, atol=1e-4)
    simulated = np.asarray(plant.propagate(jnp.full(2, 0.1), jnp.asarray(gain @ np.full(2, 0.1))))
    assert np.all((lower <= simulated) & (simulated <= upper))
    assert np.all(np.concatenate([simulated, -simulated]) <= np.asarray(spans))


def test_an_error_says_what_a_plant_was_given():
    with pytest.raises(ValueError, match="period must be above 0"):
        rj.SampledPlant(lambda x, u: x, 1, 1, period=0.0)
    with pytest.raises(TypeError, match="period must be a number"):
        rj.SampledPlant(lambda x, u: x, 1, 1)
    with pytest.raises(TypeError, match="no Taylor series"):
        rj.SampledPlant(lambda x, u: jnp.sinc(x) + u, 1, 1, period=0.1)


def test_solutions_that_meet_a_kink_are_refused_at_its_line():
    plant = on_host(rj.SampledPlant(lambda x, u: abs(x) + u, 1, 1, period=0.1))
    for x in (0.0, -0.02, 1e-12):
        with pytest.raises(UnboundedError, match=r"test_flows\.py"):
            plant.propagate(Ball.exact(np.full(1, x)), Ball.exact(np.full(1, 1.5)))
    away = plant.propagate(Ball.exact(np.full(1, 0.5)), Ball.exact(np.zeros(1)))
    assert abs(away.mid - 0.5 * np.exp(0.1)) <= away.rad + 1e-15


@pytest.mark.parametrize("clock", [False, True])
@pytest.mark.parametrize("affine", [False, True])
def test_a_number_of_any_kind_says_how_it_goes_through_a_flow(clock, affine):
    """What holds a state holds its successor, whatever the kind; forms are asked at a layer."""
    rng = np.random.default_rng(2 * clock + affine)
    A, B = rng.uniform(-1, 1, size=(2, 2)), rng.uniform(-1, 1, size=(2, 1))
    rate = (lambda x, u, t: A @ jnp.sin(x) + B @ u * t) if clock else lambda x, u: A @ jnp.sin(x)
    plant = on_host(
        rj.SampledPlant.affine(A, B, period=0.3)
        if affine
        else rj.SampledPlant(rate, 2, 1, period=0.3, clock=clock)
    )
    points, inputs = rng.uniform(-0.1, 0.1, size=(20, 2)), rng.uniform(-1, 1, size=(20, 1))
    exact = np.stack([plant.propagate(x, u, 3, None) for x, u in zip(points, inputs, strict=True)])
    simulated = plant.propagate(Batch(points), Batch(inputs), 3, Batch.evaluated).values
    np.testing.assert_allclose(simulated, exact, rtol=0, atol=1e-12)
    ends = (points.min(axis=0), points.max(axis=0)), (inputs.min(axis=0), inputs.max(axis=0))
    ball = plant.propagate(*(Ball.between(*each) for each in ends), 3, None)
    limits = plant.propagate(*(Limits(*each) for each in ends), 3, None)
    for lower, upper in ((ball.lower, ball.upper), (limits.least, limits.most)):
        assert np.all((lower <= exact + 1e-12) & (exact - 1e-12 <= upper))
        assert np.all(upper - lower <= 2)
    unknown = plant.propagate(Limits.unknown(2), Limits(*ends[1]), 3, None)
    assert not np.isfinite(unknown.least).any()
    start = InitialColumns.of(*[rj.Box(*ends[0])] * 2, curved=True)
    forms = AffineForms.beginning(on_host(start))
    flows = []
    found = plant.propagate(forms, B.T @ forms, 3, lambda *given: flows.append(given) or "asked")
    assert found == "asked"
    assert [type(each) for each in flows[0][1:]] == [AffineForms] * 2


def test_rows_over_a_basis_are_refused_by_name():
    plant = rj.SampledPlant(lambda x, u: jnp.sin(x) + u, 1, 1, period=0.1)
    with pytest.raises(TypeError, match="has no rows over a basis: give relaxation=LinearBounds"):
        plant.propagate(columns(0, 1, 3), columns(1, 1, 3))
