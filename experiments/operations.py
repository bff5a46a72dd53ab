"""Floating-point operations of a JAX function: matrix products and factorisations."""

from collections.abc import Callable
from math import prod
from typing import Any

import jax


def operations(function: Callable, *arguments: Any) -> float:
    """How many one call takes; loops of unknown length count nothing.

    Elementwise work and gathers are left out: memory limits those, not arithmetic.
    """
    return _of(jax.make_jaxpr(function)(*arguments).jaxpr)


def _of(jaxpr: Any) -> float:
    return sum(_COUNTS.get(each.primitive.name, _inside)(each) for each in jaxpr.eqns)


def _inside(equation: Any) -> float:
    """Those of the functions that an equation calls."""
    total = 0.0
    for parameter in equation.params.values():
        for part in parameter if isinstance(parameter, tuple | list) else (parameter,):
            inner = getattr(part, "jaxpr", part)
            total += _of(inner) if hasattr(inner, "eqns") else 0.0
    return total * equation.params.get("length", 1)


def _product(equation: Any) -> float:
    (contracted, _), _ = equation.params["dimension_numbers"]
    shape = equation.invars[0].aval.shape
    return 2.0 * prod(shape[axis] for axis in contracted) * equation.outvars[0].aval.size


def _cube(share: float) -> Callable[[Any], float]:
    """That share of the cube of a matrix's size, for each matrix of a batch."""
    return lambda equation: share * equation.invars[0].aval.size * equation.invars[0].aval.shape[-1]


_COUNTS = {
    "while": lambda equation: 0.0,
    "dot_general": _product,
    "cholesky": _cube(1 / 3),
    "eigh": _cube(4 / 3),  # without vectors
    "triangular_solve": _cube(1 / 3),  # of the identity
}
