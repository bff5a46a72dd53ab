"""Taylor coefficients through recordings are those of the functions."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops import units
from reachjax.loops.flows.series import Series, Solution
from reachjax.loops.flows.taylor_models import TaylorModels
from reachjax.numerics.rounding import Ball
from tests.loops.flows.fields import KINDS, Digits, field

ORDER = 7
EXACT = {
    "Exp": mpmath.exp,
    "Log": mpmath.log,
    "XLogX": lambda y: y * mpmath.log(y),
    "Tanh": mpmath.tanh,
    "Softplus": lambda y: mpmath.log(1 + mpmath.exp(y)),
    "Sqrt": mpmath.sqrt,
    "Reciprocal": lambda y: 1 / y,
    "Sin": mpmath.sin,
    "Cos": mpmath.cos,
    "Atan": mpmath.atan,
    "Asin": mpmath.asin,
    "Asinh": mpmath.asinh,
    "Erf": mpmath.erf,
    "ISRU": lambda y: y / mpmath.sqrt(1 + y * y),
}
FUNCTIONS = {
    "Exp": jnp.exp,
    "Log": jnp.log,
    "XLogX": lambda y: jax.scipy.special.xlogy(y, y),
    "Tanh": jnp.tanh,
    "Softplus": jax.nn.softplus,
    "Sqrt": jnp.sqrt,
    "Reciprocal": lambda y: 1 / y,
    "Sin": jnp.sin,
    "Cos": jnp.cos,
    "Atan": jnp.arctan,
    "Asin": jnp.arcsin,
    "Asinh": jnp.arcsinh,
    "Erf": jax.scipy.special.erf,
    "ISRU": lambda y: y / jnp.sqrt(1 + y * y),
}


def tape_of(function, *sizes):
    """The tape of a function of vectors."""
    n, m = sizes
    plant = jax.device_get(rj.SampledPlant(function, n, m, period=0.5))
    return plant.flow.tape


@pytest.mark.parametrize("name", sorted(EXACT))
def test_coefficients_of_a_unit_are_those_of_its_taylor_series(name):
    mpmath.mp.dps = 40
    tape = tape_of(lambda x, u: FUNCTIONS[name](x + 0 * u), 1, 1)
    rng = np.random.default_rng(len(name))
    low, high = (-0.7, 0.7) if name == "Asin" else (0.4, 1.5)
    inputs = [rng.uniform(low, high), *rng.uniform(-0.3, 0.3, size=ORDER)]
    exact = mpmath.taylor(
        lambda t: EXACT[name](sum(mpmath.mpf(c) * t**k for k, c in enumerate(inputs))), 0, ORDER
    )
    for kind in (np.asarray, Ball.exact, lambda x: TaylorModels.of(Ball.exact(x))):
        series = Series(tape)
        for k, c in enumerate(inputs):
            number = kind(np.array([c]))
            found = series.advance([number, kind(np.zeros(1))])
            middle = (
                found
                if kind is np.asarray
                else found.ball
                if k >= 0 and hasattr(found, "ball")
                else found
            )
            if kind is np.asarray:
                assert abs(middle[0] - float(exact[k])) <= 1e-10 * (1 + abs(float(exact[k])))
            else:
                assert middle.lower[0] <= exact[k] <= middle.upper[0]
                assert middle.rad[0] <= 1e-9


def test_every_smooth_unit_with_a_slope_is_tried():
    smooth = {
        name
        for name in units.__all__
        if isinstance(unit := getattr(units, name), type) and issubclass(unit, units.SmoothUnit)
    }
    assert smooth - {"SmoothUnit", "Square", "Within", "Sinc"} == set(EXACT)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("states", [1, 2, 3, 6])
def test_coefficients_of_solutions_hold_those_of_forty_digits(kind, states):
    rng = np.random.default_rng(states)
    own = field(rng, kind, states)
    tape = tape_of(own, states, 1)
    x, u = rng.uniform(-0.5, 0.5, size=states), rng.uniform(-0.5, 0.5, size=1)
    balls = Solution(tape, Ball.exact(x), [Ball.exact(u)], 0.5)
    mpmath.mp.dps = 40
    exact = [[mpmath.mpf(a)] for a in x]
    for k in range(5):
        found = balls.advance()

        def rate(t, k=k):
            here = [sum(c * t**i for i, c in enumerate(row)) for row in exact]
            return own.of(Digits, here, [mpmath.mpf(u[0])])

        for i, row in enumerate(exact):
            taylor = mpmath.taylor(lambda t, i=i: rate(t)[i], 0, k)
            row.append(taylor[k] / (k + 1))
        for i in range(states):
            assert found.lower[i] <= exact[i][k + 1] / 2 ** (k + 1) <= found.upper[i]
            assert found.rad[i] <= 1e-11 * (1 + abs(found.mid[i]))
