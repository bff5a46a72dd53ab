"""A verdict that a trajectory of the compiled loop breaks is an error, whoever says it."""

import pickle
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.closed_loop import Scenario
from reachjax.numerics.pytrees import pytree, static
from reachjax.programs.affine import AffineForms
from reachjax.verdicts import counterexamples
from reachjax.verdicts.compiled import is_telling
from reachjax.verdicts.counterexamples import deviates

X0 = rj.Box([0.5], [1.0])
INSIDE = rj.Box([-0.2], [1.2])
"""Where the loop that bounds are of stays, and the one that is run does not."""


@pytree
class MisreadPlant(rj.AffinePlant):
    """A plant whose bounds are of half the successor that JAX computes."""

    @property
    def clock(self) -> bool:
        return False

    def propagate(self, x: Any, u: Any, t: Any = 0, unit: Any = None, w: Any = None) -> Any:
        following = super().propagate(x, u, t, unit, w)
        return following if isinstance(following, jax.Array) else 0.5 * following


def misread_loop() -> rj.ClosedLoop:
    """`x+ = 1.5 x` as it runs, and `x+ = 0.75 x` as it is bounded."""
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[0.0, 0.0]], [0.0])])
    return rj.ClosedLoop(MisreadPlant([[1.5]], [[1.0]], [0.0]), net)


def sound_loop(factor: float) -> rj.ClosedLoop:
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[0.0, 0.0]], [0.0])])
    return rj.ClosedLoop(rj.AffinePlant([[factor]], [[1.0]]), net)


CALLS = {
    "verify": lambda loop, **wanted: rj.verify(
        rj.reach(loop, X0, 2, rj.Template.box(1)), samples=50, **wanted
    ),
    "verify, linear bounds": lambda loop, **wanted: rj.verify(
        rj.reach(loop, X0, 2, rj.Template.box(1), rj.LinearBounds()), samples=50, **wanted
    ),
    "verify for ever": lambda loop, **wanted: rj.verify(
        rj.reach(loop, X0, 2, rj.Template.box(1)), samples=50, forever=True, **wanted
    ),
    "verify a partition": lambda loop, **wanted: rj.verify(
        rj.reach_partitioned(loop, X0, 2, rj.Template.box(1), cells=(2,)), samples=50, **wanted
    ),
    "decide": lambda loop, **wanted: rj.decide(loop, X0, 2, **wanted),
    "decide by cells": lambda loop, **wanted: rj.decide(loop, X0, 2, cells=4, **wanted),
    "winning set": lambda loop, **wanted: rj.winning_set(loop, X0, 2, cells=4, **wanted),
    "largest set": lambda loop, **wanted: rj.largest_set(loop, X0, 2, rounds=0, **wanted),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_what_is_proved_of_a_loop_that_is_misread_is_no_verdict_but_an_error(call):
    with pytest.raises(rj.UnsoundError) as raised:
        call(misread_loop(), safe=INSIDE)
    error = raised.value
    assert error.requirement == "safe"
    assert error.certified > max(error.simulated, 0)
    assert INSIDE.upper[0] - error.states[-1, 0] == pytest.approx(error.simulated)
    for shown in (f"{error.certified:+.4g}", f"{error.simulated:+.4g}", "report"):
        assert shown in str(error)


BY_FORMS = [name for name in CALLS if "linear" not in name and "ever" not in name]


@pytest.mark.parametrize("name", BY_FORMS)
def test_a_margin_that_a_trajectory_does_not_have_is_an_error_though_both_are_positive(
    name, monkeypatch
):
    ends = AffineForms.ends

    def too_small(self: AffineForms, *given: Any, **options: Any) -> Any:
        lower, upper = ends(self, *given, **options)
        return lower, upper - 1e-3

    monkeypatch.setattr(AffineForms, "ends", too_small)
    with pytest.raises(rj.UnsoundError):
        CALLS[name](sound_loop(1.1), safe=rj.Box([-0.5], [1.3]))


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("beside", [0.0, 1e-12])
@pytest.mark.costly
def test_what_is_touched_but_for_rounding_is_no_error(name, beside):
    touched = rj.Box([0.0], [1.0 + beside])  # where trajectories are, and bounds all but are
    found = str(CALLS[name](sound_loop(1.0), safe=touched))
    assert "REFUTED" not in found


AWAY = rj.Box([1.0], [3.0])
"""Where the loop that is run is after two steps, and the one that bounds are of is not."""


REFUTING = {
    "decide": lambda loop: rj.decide(loop, X0, 2, goal=AWAY),
    "decide by cells": lambda loop: rj.decide(loop, X0, 2, goal=AWAY, cells=4),
    "verify for ever": lambda loop: rj.verify(
        rj.reach(loop, X0, 2, rj.Template.box(1)),
        avoid=[rj.Box([-0.1], [0.1])],
        samples=20,
        forever=True,
    ),
}


@pytest.mark.parametrize("call", REFUTING.values(), ids=REFUTING)
def test_what_is_refuted_of_a_loop_that_is_misread_is_no_verdict_but_an_error(call):
    with pytest.raises(rj.UnsoundError) as raised:
        call(misread_loop())
    error = raised.value
    assert error.departs.step == 0
    assert error.departs.coordinate == 0
    x = error.states[0, 0]
    assert error.departs.run == pytest.approx(1.5 * x)
    assert error.departs.enclosed == pytest.approx(0.75 * x)
    assert np.isnan(error.certified)
    assert error.simulated < 0
    for shown in ("JAX runs the loop otherwise", f"{error.departs.run!r}", "report"):
        assert shown in str(error)
    assert "certified" not in str(error)
    again = pickle.loads(pickle.dumps(error))
    assert again.departs == error.departs
    assert str(again) == str(error)


def runs_as(change: Any) -> rj.ClosedLoop:
    """`x+ = x / 2` as it is read; as JAX runs it, a function of the state and of that."""

    @pytree
    class Plant(rj.AffinePlant):
        def propagate(self, x: Any, u: Any, t: Any = 0, unit: Any = None, w: Any = None) -> Any:
            following = rj.AffinePlant.propagate(self, x, u, t, unit, w)
            return change(x, following) if isinstance(following, jax.Array) else following

    net = rj.MLP.from_layers([([[0.0]], [0.0])])
    return rj.ClosedLoop(Plant([[0.5]], [[1.0]], [0.0]), net)


def in_turns(x, following):
    """What a loop adds up: some numbers of it are hidden in its turns."""

    def turn(carry, _):
        return carry * 1e-60, None

    tiny, _ = jax.lax.scan(turn, x, None, length=6)
    return following - x + tiny * 1e300 * 1e60


LAWFUL = {
    "few bits": lambda x, following: following.astype(jnp.float32).astype(float),
    "taken for zero": lambda x, following: following - x**2 + (1e-170 * x) ** 2 * 1e300 * 1e40,
    "too large": lambda x, following: following - x**-2 + 1 / (1e170 * x) ** 2 * 1e300 * 1e40,
    "in turns": in_turns,
    "no numbers": lambda x, following: following + jnp.sqrt(-x),
}
"""What compiled code makes of a function otherwise than exact arithmetic."""


@pytest.mark.parametrize("change", LAWFUL.values(), ids=LAWFUL)
def test_numbers_that_are_too_large_or_small_or_short_say_nothing_against_what_is_refuted(change):
    loop, x = runs_as(change), jnp.array([0.7])
    assert not abs(loop.step(x, 0) - x / 2)[0] < 1e-9  # a departure, were it not for its numbers
    assert rj.decide(loop, rj.Box([0.51], [0.93]), 2, goal=AWAY).refuted


MISREAD = {
    "a function": lambda x, following: following + jnp.sin(x),
    "by little": lambda x, following: following * (1 + 1e-12),
    "behind a mask": lambda x, following: jnp.max(
        jnp.where(jnp.array([True, False]), following + 1e-3, -jnp.inf), keepdims=True
    ),
    "in turns": lambda x, following: jax.lax.fori_loop(0, 3, lambda k, y: y + 0.1, following),
    "of a call": lambda x, following: jax.jit(jnp.tanh)(following),
    "of a branch": lambda x, following: jax.lax.cond(x[0] > 0, jnp.cos, lambda y: y, following),
}


@pytest.mark.parametrize("change", MISREAD.values(), ids=MISREAD)
def test_other_numbers_say_that_a_refuted_loop_is_misread(change):
    with pytest.raises(rj.UnsoundError, match="JAX runs the loop otherwise"):
        rj.decide(runs_as(change), X0, 2, goal=AWAY)


def test_steps_tell_something_by_their_own_numbers():
    x = np.array([0.7])
    for change in LAWFUL.values():
        assert not is_telling(runs_as(change), x, 0)
    for change in MISREAD.values():
        assert is_telling(runs_as(change), x, 0)


def free_loop(f):
    net = rj.MLP.from_layers([([[0.0]], [0.0])])
    return rj.ClosedLoop(rj.NonlinearPlant(f, 1, 1), net)


def test_a_chaotic_loop_is_held_to_single_steps_when_it_is_refuted():
    """Twenty steps take the last bit of a compiled trajectory to the fifth digit."""
    loop = free_loop(lambda x, u: 3.9 * x * (1 - x) + u)
    start = rj.Box([0.3], [0.3001])
    assert rj.decide(loop, start, 20, goal=rj.Box([2.0], [3.0])).refuted


TIES = {
    "a step": lambda x, u: jnp.where(x + 0.1 - 0.2 > 0.3, x + 2.0, x - 2.0) + u,
    "a sign": lambda x, u: x + jnp.sign(x - 0.4) + u,
    "a choice": lambda x, u: (
        jnp.array([1.0, 5.0])[jnp.argmax(jnp.concatenate([x + 0.1, x / 3 + 0.1 + 2 * x / 3]))][None]
        + u
    ),
}


@pytest.mark.parametrize("f", TIES.values(), ids=TIES)
def test_at_a_tie_each_winner_is_right_also_where_something_is_refuted(f):
    """What is required is broken after either, and at the next step again."""
    loop = free_loop(f)
    start = rj.Box([0.4], [0.4])
    assert rj.decide(loop, start, 1, goal=rj.Box([20.0], [30.0])).refuted


@pytest.mark.parametrize("name", ["input", "moved", "step"])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_loop_must_not_change_a_method_that_bounds_do_without(name, mixed):
    own = {name: lambda self, *given: given[0] + 1.0}
    bases = (type("Biasing", (), own), rj.ClosedLoop) if mixed else (rj.ClosedLoop,)
    with pytest.raises(TypeError, match=f"Biased.{name} must be that of ClosedLoop.*parts"):
        type("Biased", bases, {} if mixed else own)


@pytree
class Growing(rj.Box):
    def at(self, t):
        return rj.Box(self.lower * (1 + t), self.upper * (1 + t))


@pytree
class Cornered(rj.Polytope):
    """A polytope with a method that is called as one of a box is."""

    def at(self, i):
        return self.vertices()[i]


def test_what_is_drawn_must_be_all_that_its_set_says():
    plant = rj.AffinePlant([[0.5]], [[1.0]], E=[[1.0]])
    net = rj.MLP.from_layers([([[0.0]], [0.0])])
    gusts = {"disturbance": rj.Box([-0.1], [0.1])}
    for name in ("disturbance", "noise"):
        with pytest.raises(TypeError, match=f"{name} must have the at of Box, but Growing"):
            rj.ClosedLoop(plant, net, **{**gusts, name: Growing([-0.1], [0.1])})
        rj.ClosedLoop(plant, net, **{**gusts, name: Cornered([[1.0], [-1.0]], [0.1, 0.1])})


@pytree
class Windy(rj.SampledPlant):
    """A differential equation of a user's class, with a field of its own."""

    wind: float = static(default=0.0)

    def __init__(self, wind: float):
        super().__init__(lambda x, u: u - x + wind, 1, 1, 0.1)
        self._set(wind=wind)


def test_a_derived_differential_equation_keeps_its_class_and_fields_when_it_is_changed():
    plant = Windy(0.3)
    changed = plant.replace(period=0.2), plant.shortened(0.5), plant.finer
    assert all(type(each) is Windy and each.wind == 0.3 for each in changed)
    assert [float(each.period) for each in changed] == [0.2, 0.05, 0.1]
    assert changed[1].part == 0.5
    assert changed[2].fewest > plant.fewest


@pytest.mark.parametrize("change", [{"clock": True}, {"states": 2}, {"disturbances": 1}])
def test_sizes_of_a_function_that_has_been_read_stay(change):
    plants = [
        rj.SampledPlant(lambda x, u: u - x, 1, 1, 0.1),
        rj.NonlinearPlant(lambda x, u: u - x, 1, 1),
        rj.Network(lambda x: -x, 1, 1),
    ]
    (name,) = change
    own = {"clock": plants[:1], "states": plants[:2], "disturbances": plants[:2]}[name]
    for plant in own:
        with pytest.raises(ValueError, match="as f has been read with so many"):
            plant.replace(**change)
    with pytest.raises(ValueError, match=r"Network.outputs must be 1"):
        plants[2].replace(outputs=3)


def test_a_plant_in_continuous_time_must_not_step_in_a_way_of_its_own():
    """Half of two flows of a period would be looked at in between samples, or none of a jump."""

    def twice(self, x, u, t=0, unit=None, w=None):
        return x

    with pytest.raises(TypeError, match=r"Twice\.propagate must be that of AbstractSampledPlant"):
        type("Twice", (rj.SampledPlant,), {"propagate": twice})
    plant = rj.AffinePlant([[0.5]], [[1.0]])
    kind = type("Always", (rj.AffinePlant,), {"continuous": True, "propagate": twice})
    with pytest.raises(TypeError, match="must step by its flow alone, but Always"):
        rj.ClosedLoop(kind(plant.A, plant.B), rj.MLP.from_layers([([[0.0]], [0.0])]))


def test_inputs_of_a_users_plant_or_loop_are_not_made_late():
    """Its own steps would be lost."""
    net = rj.MLP.from_layers([([[0.0]], [0.0])])
    with pytest.raises(TypeError, match=r"loop\.plant must be of a class of reachjax"):
        rj.delayed(misread_loop())

    @pytree
    class Tired(rj.ClosedLoop):
        @property
        def varies(self):
            return False

        def measured(self, x, t=0, unit=None, v=None):
            return 0.5 * x

    with pytest.raises(TypeError, match="loop must be of a class of reachjax"):
        rj.delayed(Tired(rj.AffinePlant([[0.5]], [[1.0]]), net))


def test_a_trajectory_contradicts_what_forms_read_otherwise_than_intervals(monkeypatch):
    """Both enclose the trajectory of what they read: where they are apart, that is two loops."""
    loop, states = sound_loop(1.5), np.array([[0.8], [1.2], [1.8]])
    given = Scenario(states[0], None, None), states, 0
    assert not deviates(loop, *given)
    read = counterexamples.boxes_from_point
    monkeypatch.setattr(
        counterexamples, "boxes_from_point", lambda loop, *rest: read(sound_loop(0.5), *rest)
    )
    assert deviates(loop, *given)
