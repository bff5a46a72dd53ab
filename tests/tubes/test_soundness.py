"""A verdict that a trajectory of the compiled loop breaks is an error, whoever says it."""

from typing import Any

import jax
import pytest

import reachjax as rj
from reachjax.numerics.pytrees import pytree
from reachjax.programs.affine import AffineForms

X0 = rj.Box([0.5], [1.0])
INSIDE = rj.Box([-0.2], [1.2])
"""Where the loop that bounds are of stays, and the one that is run does not."""


@pytree
class MisreadPlant(rj.AffinePlant):
    """A plant whose bounds are of half the successor that JAX computes."""

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
