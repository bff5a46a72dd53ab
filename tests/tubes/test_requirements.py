"""How far a tube misses a specification: the hinge that training penalises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.verdicts.specification import Compared, Requirement
from tests.closed_loops import recursion


def tube(rate=0.5, n=2):
    """`x+ = rate x` from `[0.5, 1]^n` in two steps: its sets are known exactly."""
    net = rj.MLP.from_layers([(np.zeros((1, n)), [0.0])])
    plant = rj.AffinePlant(rate * jnp.eye(n), np.zeros((n, 1)))
    X0 = rj.Box([0.5] * n, [1.0] * n)
    return recursion(rj.ClosedLoop(plant, net), X0, 2, rj.Template.box(n))


HALF = rj.Polytope([[3.0, 4.0]], [1.0])  # nearest corner of [1/8, 1/4]^2: 7/8, so it is met there

CASES = {
    "met": ({"goal": rj.Box([0, 0], [1, 1])}, 0.0),
    "one facet short": ({"goal": rj.Box([0.0, 0.0], [0.2, 1.0])}, 0.05),
    "two facets short": ({"goal": rj.Box([0.15, 0.0], [0.2, 1.0])}, 0.075),
    "with a margin": ({"goal": rj.Box([0.0, 0.0], [0.2, 1.0]), "margin": 0.1}, 0.15),
    "unsafe at three times": ({"safe": rj.Polytope([[1.0, 0.0]], [0.2])}, 0.8 + 0.3 + 0.05),
    "far from what is avoided": ({"avoid": [rj.Polytope([[1.0, 0.0]], [0.0])]}, 0.0),
    "in what is avoided": ({"avoid": {2: [HALF]}}, (1 - 7 / 8) / 5),
}


@pytest.mark.parametrize(("spec", "expected"), CASES.values(), ids=CASES.keys())
@pytest.mark.costly
def test_the_shortfall_sums_what_is_missing(spec, expected):
    assert float(rj.shortfall(tube(), **spec)) == pytest.approx(expected, abs=1e-7)


@pytest.mark.costly
def test_it_is_zero_exactly_where_the_specification_is_proved():
    for half in (0.2, 0.24, 0.26, 0.3):
        goal = rj.Box([-half] * 2, [half] * 2)
        proved = rj.verify(tube(), goal=goal).status is rj.VerdictStatus.PROVED
        assert proved == (float(rj.shortfall(tube(), goal=goal)) == 0)


@pytest.mark.parametrize(
    ("spec", "slope"),
    [
        # the goal is missed by rate^2 - 0.2; the safe set by 1 - 0.2, rate - 0.2, rate^2 - 0.2
        ({"goal": rj.Box([0.0, 0.0], [0.2, 1.0])}, 2 * 0.5),
        ({"safe": rj.Polytope([[1.0, 0.0]], [0.2])}, 1 + 2 * 0.5),
        # the nearest corner is rate^2 (1/2, 1/2), 7/2 rate^2 along (3, 4)
        ({"avoid": {2: [HALF]}}, -3.5 * 2 * 0.5 / 5),
    ],
    ids=["goal", "safe", "avoid"],
)
@pytest.mark.costly
def test_its_derivative_goes_through_the_sets(spec, slope):
    gradient = jax.jit(jax.grad(lambda rate: rj.shortfall(tube(rate), **spec)))(0.5)
    assert float(gradient) == pytest.approx(slope, rel=1e-5)


@pytest.mark.costly
def test_bad_specifications_are_named():
    with pytest.raises(ValueError, match="nothing to verify"):
        rj.shortfall(tube())
    with pytest.raises(TypeError, match="tube must be a ReachTube"):
        rj.shortfall(rj.Box([0], [1]), goal=rj.Box([0], [1]))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="goal has dimension 1, but the loop has 2 states"):
        rj.shortfall(tube(), goal=rj.Box([0], [1]))
    with pytest.raises(TypeError, match="margn"):
        rj.shortfall(tube(), goal=rj.Box([0, 0], [1, 1]), margn=0.1)  # type: ignore[call-arg]


@pytest.mark.parametrize("scale", [1e155, 1e-170])
@pytest.mark.costly
def test_the_shortfall_does_not_depend_on_the_length_of_normals(scale):
    goal = lambda d: rj.Polytope(np.array([[3.0, 4.0]]) * scale, d[None] * scale)  # noqa: E731
    missing = lambda d: rj.shortfall(tube(), goal=goal(d))  # noqa: E731
    value, slope = jax.value_and_grad(missing)(jnp.array(1.5))
    assert float(value) == pytest.approx((7 / 4 - 1.5) / 5, abs=1e-7)
    assert float(slope) == pytest.approx(-1 / 5)


def test_what_overflows_proves_nothing():
    far, inside = np.array([-np.inf]), Requirement("goal", 1, rj.Box([0.0], [1.0]), True)
    assert not inside.proved(Compared(far, far, np.ones(1)))
    assert not inside.proved(Compared(-far, -far, np.ones(1)))
    assert inside.proved(Compared(np.zeros(1), np.zeros(1), np.ones(1)))
