"""Which results of a jaxpr depend on its inputs, and whether any number is rounded that does not.

Numbers that depend on constants and parameters alone are computed once, equation by equation; XLA,
which compiles a function as a whole, would round them in other ways. Where none is rounded, that
makes no difference, and an equation with a jaxpr of its own can be left as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.extend import core

CALLS = (
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "core_closed_call",
    "checkpoint",
    "remat",
    "remat2",
)
"""Primitives that only call a jaxpr."""

OWN_SLOPES = ("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr")
"""Primitives that call one, and have a rule of their own for its derivative."""

Sought = Callable[[Any, bool], bool]
"""Whether an equation is one that is looked for, and whether operands of it depend on inputs."""

BODIES = {"jaxpr", "call_jaxpr", "fun_jaxpr"}
"""Under one of these names it is among their parameters."""

# fmt: off
EXACT = {
    "abs", "argsort", "bitcast_convert_type", "broadcast_in_dim", "ceil", "clamp", "concatenate",
    "copy", "copy_p", "cummax", "cummin", "dynamic_slice", "dynamic_update_slice", "expand_dims",
    "floor", "gather", "imag", "iota", "max", "min", "neg", "optimization_barrier", "pad", "real",
    "reduce_max", "reduce_min", "reduce_window_max", "reduce_window_min", "reshape", "rev",
    "round", "scatter", "select_and_gather_add", "select_n", "sign", "slice", "sort", "split",
    "squeeze", "stack", "stop_gradient", "tile", "top_k", "transpose",
}
"""Primitives whose results are not rounded."""
# fmt: on


def body_of(params: dict[str, Any]) -> Any:
    """The jaxpr that an equation with these parameters calls."""
    return params[(BODIES & params.keys()).pop()]


def rounds(equation: Any) -> bool:
    """Whether an equation, all operands of which are plain, may round.

    What a call rounds may decide its results also where these are whole numbers or truth values.
    """
    inner = [*_bodies(equation)]
    if inner:
        return any(rounds(each) for body in inner for each in _jaxpr(body).eqns)
    if not any(jnp.issubdtype(each.aval.dtype, jnp.inexact) for each in equation.outvars):
        return False
    name = equation.primitive.name
    if name == "convert_element_type":
        return not _is_wider(equation.outvars[0].aval.dtype, equation.invars[0].aval.dtype)
    return name not in EXACT


def rounds_to_fewer_bits(jaxpr: Any, varies: Sequence[bool]) -> bool:
    """Whether numbers that depend on inputs are computed in fewer bits than floats have.

    Args:
        jaxpr: as it is with parameters of their own precision.
        varies: which of its arguments depend on inputs.
    """
    return _through(jaxpr, varies, _varies_in_fewer_bits)[1]


def _plain_rounds(equation: Any, varies: bool) -> bool:
    """Whether an equation of plain numbers may round."""
    return not varies and rounds(equation)


def _varies_in_fewer_bits(equation: Any, varies: bool) -> bool:
    """Whether a result that depends on inputs may be rounded, to fewer bits than floats have."""
    whole, name = jnp.finfo(jnp.result_type(float)).bits, equation.primitive.name
    kinds = [each.aval.dtype for each in equation.outvars]
    narrow = [k for k in kinds if jnp.issubdtype(k, jnp.inexact) and jnp.finfo(k).bits < whole]
    if not varies or not narrow or name in EXACT:
        return False
    if name == "convert_element_type":
        given = equation.invars[0].aval.dtype
        if jnp.issubdtype(given, jnp.integer):
            return jnp.iinfo(given).bits - 1 > jnp.finfo(narrow[0]).nmant + 1
        return not _is_wider(narrow[0], given)
    return True


def _bodies(equation: Any) -> list[Any]:
    name, params = equation.primitive.name, equation.params
    if name in (*CALLS, *OWN_SLOPES):
        return [body_of(params)]
    if name == "scan":
        return [params["jaxpr"]]
    if name == "while":
        return [params["cond_jaxpr"], params["body_jaxpr"]]
    return list(params["branches"]) if name == "cond" else []


def _jaxpr(body: Any) -> Any:
    return getattr(body, "jaxpr", body)


def _is_wider(kind: np.dtype, than: np.dtype) -> bool:
    """Whether each number of one kind is one of another."""
    if jnp.issubdtype(than, jnp.integer):  # rounded once if it is large, the same everywhere
        return True
    return jnp.promote_types(kind, than) == kind


def rounds_within(equation: Any, varies: Sequence[bool]) -> bool:
    """Whether an equation with a jaxpr of its own rounds numbers in it that are plain.

    Args:
        equation: some operand of which depends on inputs.
        varies: which ones do.
    """
    return _followed(equation, varies, _plain_rounds)[1]


def rounds_plain(jaxpr: Any, varies: Sequence[bool]) -> bool:
    """Whether a jaxpr, some arguments of which depend on inputs, rounds numbers that do not."""
    return _through(jaxpr, varies, _plain_rounds)[1]


def _followed(equation: Any, varies: Sequence[bool], sought: Sought) -> tuple[list[bool], bool]:
    """Which results of an equation vary, and whether it is what is looked for, or holds it."""
    name, params, varies = equation.primitive.name, equation.params, list(varies)
    if not any(varies):
        return [False] * len(equation.outvars), sought(equation, False)
    if name in (*CALLS, *OWN_SLOPES):
        return _through(body_of(params), varies, sought)
    if name == "cond":
        found = [_through(each, varies[1:], sought) for each in params["branches"]]
        outs = [varies[0] or any(each) for each in zip(*(outs for outs, _ in found), strict=True)]
        return outs, any(holds for _, holds in found)
    if name == "scan":
        first, count = params["num_consts"], params["num_carry"]
        carry = varies[first : first + count]
        while True:
            given = [*varies[:first], *carry, *varies[first + count :]]
            outs, holds = _through(params["jaxpr"], given, sought)
            after = [a or b for a, b in zip(carry, outs, strict=False)]
            if after == carry:
                return [*carry, *outs[count:]], holds
            carry = after
    if name == "while":
        first, second = params["cond_nconsts"], params["body_nconsts"]
        done, carry = varies[first : first + second], varies[first + second :]
        while True:
            outs, holds = _through(params["body_jaxpr"], [*done, *carry], sought)
            after = [a or b for a, b in zip(carry, outs, strict=True)]
            if after == carry:
                asked = _through(params["cond_jaxpr"], [*varies[:first], *carry], sought)[1]
                return carry, holds or asked
            carry = after
    return [True] * len(equation.outvars), sought(equation, True)


def _through(body: Any, varies: Sequence[bool], sought: Sought) -> tuple[list[bool], bool]:
    """Which results of a jaxpr vary, and whether it holds what is looked for."""
    jaxpr = _jaxpr(body)
    known = dict.fromkeys(jaxpr.constvars, False)
    known.update(zip(jaxpr.invars, varies, strict=True))

    def read(atom: Any) -> bool:
        return not isinstance(atom, core.Literal) and known[atom]

    holds = False
    for equation in jaxpr.eqns:
        outs, inside = _followed(equation, [read(each) for each in equation.invars], sought)
        holds = holds or inside
        known.update(zip(equation.outvars, outs, strict=True))
    return [read(each) for each in jaxpr.outvars], holds
