"""The loop as JAX runs it: trajectories, single steps, and whether the numbers of one say anything.

What is compiled rounds within what enclosures allow for, but for three kinds of steps: some numbers
have fewer than 64 bits, some overflow, or some are so small that XLA takes them for zero. Readings
compute powers and products otherwise, and then differ lawfully. Such a step is held against nothing
(`is_telling`); equation by equation, its own numbers say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.loops.tracing.dependence import CALLS, EXACT, OWN_SLOPES, body_of
from reachjax.loops.tracing.functions import Compiled
from reachjax.numerics.compilations import ONCE
from reachjax.numerics.rounding import TINY

TRIALS = 64
"""So many trajectories are run by JAX where bounds and simulations are of the host."""

SMALL, LARGE = 1e-150, 1e150
"""Squares of numbers in between are neither taken for zero nor infinite."""

PRODUCTS = frozenset({"mul", "dot_general", "conv_general_dilated"})
"""Primitives that multiply two operands."""

POSITIVE = frozenset({"exp", "exp2", "logistic", "erfc"})
"""Primitives whose exact values are never zero."""

POWERS = frozenset({"pow", "integer_pow"})
"""Primitives whose exact values are zero for a zero alone."""


def compiled_runs(
    loop: ClosedLoop, scenarios: Scenarios, rows: Float[np.ndarray, "c s"], start: int
) -> Runs:
    """Trajectories of some scenarios as JAX runs the loop, step by step: one step is compiled."""
    rows = np.asarray(rows)[:TRIALS]
    if not len(rows):
        return Runs(rows, np.zeros((0, scenarios.steps + 1, loop.states)))
    states, *drawn = scenarios.split(np.resize(rows, (TRIALS, rows.shape[1])))
    loop, found = jax.device_put(loop), [states]
    for k in range(scenarios.steps):
        at = [None if part is None else part[:, k] for part in drawn]
        found.append(_stepped(loop, found[-1], start + k, *at))
    return Runs(rows, np.stack(jax.device_get(found), axis=1)[: len(rows)])


def compiled_steps(
    loop: ClosedLoop,
    states: Float[np.ndarray, "h n_x"],
    disturbances: Float[np.ndarray, "h n_w"] | None,
    noises: Float[np.ndarray, "h n_x"] | None,
    start: int,
) -> Float[np.ndarray, "h n_x"]:
    """The successor of each of some states, one for each time, as JAX runs the loop."""
    # tiled to the shape for which `compiled_runs` compiles a step: nothing is compiled anew
    loop, found = jax.device_put(loop), [np.zeros((0, states.shape[1]))]
    for k, x in enumerate(states):
        given = x, *(None if part is None else part[k] for part in (disturbances, noises))
        x, *drawn = (None if part is None else np.tile(part, (TRIALS, 1)) for part in given)
        found.append(np.asarray(_stepped(loop, x, start + k, *drawn), float)[:1])
    return np.concatenate(found)


@partial(Compiled, compiler_options=ONCE)
def _stepped(
    loop: ClosedLoop,
    states: Float[Array, "c n_x"],
    t: int,
    disturbances: Float[Array, "c n_w"] | None,
    noises: Float[Array, "c n_x"] | None,
) -> Float[Array, "c n_x"]:
    """The successors of many states."""
    given = states, disturbances, noises
    return jax.vmap(lambda x, w, v: loop.step(x, t, w=w, v=v))(*given)


def is_telling(
    loop: ClosedLoop,
    state: Float[np.ndarray, " n_x"],
    t: int,
    disturbance: Float[np.ndarray, " n_w"] | None = None,
    noise: Float[np.ndarray, " n_x"] | None = None,
) -> bool:
    """Whether JAX computes a step in numbers of 64 bits, none too large or too small for it.

    Args:
        loop: the closed loop, of numbers.
        state: from which.
        t: the time.
        disturbance: of the step, of a loop that has some.
        noise: of the step, of a loop that has some.
    """
    given = state, disturbance, noise
    loop = jax.device_put(loop)
    closed = jax.make_jaxpr(lambda x, w, v: loop.step(x, t, w=w, v=v))(*given)
    try:
        with np.errstate(all="ignore"):
            _followed(closed, [jnp.asarray(each) for each in given if each is not None])
    except _LostError:
        return False
    return True


class _LostError(Exception):
    """A number has fewer than 64 bits, overflows, or is taken for zero."""


def _followed(body: Any, given: Sequence[Any]) -> list[Any]:
    """What a jaxpr makes of numbers, equation by equation.

    Raises:
        _LostError: what one of them makes of them says nothing.
    """
    jaxpr = getattr(body, "jaxpr", body)
    consts = getattr(body, "consts", ())
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *given), strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, core.Literal) else known[atom]

    for equation in jaxpr.eqns:
        inputs = [read(each) for each in equation.invars]
        name, params = equation.primitive.name, equation.params
        if name in (*CALLS, *OWN_SLOPES):
            outputs = _followed(body_of(params), inputs)
        else:
            _follow_inner(name, params, inputs)
            outputs = equation.primitive.bind(*inputs, **params)
            outputs = outputs if equation.primitive.multiple_results else [outputs]
        if name not in EXACT and _is_lost(name, inputs, outputs):
            raise _LostError
        known.update(zip(equation.outvars, outputs, strict=True))
    return [read(each) for each in jaxpr.outvars]


def _follow_inner(name: str, params: dict[str, Any], inputs: Sequence[Any]) -> None:
    """Follow the jaxprs that an equation runs on numbers, one after the other.

    Raises:
        _LostError: what one of their equations makes says nothing.
    """
    if name == "cond":
        _followed(params["branches"][int(inputs[0])], inputs[1:])
    elif name == "scan":
        first = params["num_consts"]
        last = first + params["num_carry"]
        carry, places = list(inputs[first:last]), range(params["length"])
        for k in reversed(places) if params["reverse"] else places:
            given = [*inputs[:first], *carry, *(each[k] for each in inputs[last:])]
            carry = _followed(params["jaxpr"], given)[: last - first]
    elif name == "while":
        first = params["cond_nconsts"]
        last = first + params["body_nconsts"]
        carry = list(inputs[last:])
        while _followed(params["cond_jaxpr"], [*inputs[:first], *carry])[0]:
            carry = _followed(params["body_jaxpr"], [*inputs[first:last], *carry])


def _is_lost(name: str, inputs: Sequence[Any], outputs: Sequence[Any]) -> bool:
    """Whether an equation made infinite or few-digit numbers, or zeros of what is no zero."""
    found = [each for each in outputs if jnp.issubdtype(jnp.result_type(each), jnp.inexact)]
    if not found:
        return False
    if any(jnp.finfo(each.dtype).bits < 64 for each in found):
        return True
    if all(map(_is_finite, inputs)) and not all(map(_is_finite, found)):
        return True
    if any(not (least >= SMALL and most <= LARGE) for least, most in map(_sizes, found)):
        return True
    sizes = [_sizes(each) for each in inputs]
    if name in PRODUCTS:
        return bool(sizes[0][0] * sizes[1][0] < TINY)
    if name == "div":
        return bool(sizes[0][0] < TINY * sizes[1][1])
    if name not in POSITIVE | POWERS:
        return False
    base = np.asarray(inputs[0])
    some = np.isfinite(base) if name in POSITIVE else np.isfinite(base) & (base != 0)
    return bool(np.any((np.asarray(found[0]) == 0) & some))


def _is_finite(values: Any) -> bool:
    """Whether all of some numbers are numbers."""
    return bool(np.isfinite(np.asarray(values)).all())


def _sizes(values: Any) -> tuple[float, float]:
    """The least and the largest absolute value of numbers that are not zero; else one and one."""
    sizes = abs(np.asarray(values)).ravel()
    sizes = sizes[(sizes > 0) & (sizes < np.inf)]
    return (float(sizes.min()), float(sizes.max())) if len(sizes) else (1.0, 1.0)
