"""A jaxpr as steps of a recording: calls, loops and branches are followed, one by one."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from reachjax.loops.primitives import Equation, recorded
from reachjax.loops.recording import Recorder
from reachjax.loops.traces import equations
from reachjax.loops.values import Comparison, Operand, Parameter, UnsupportedError, Value, is_known

CALLS = (
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "core_closed_call",
    "checkpoint",
    "remat",
    "remat2",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
)
"""Primitives that only call a jaxpr."""

BODIES = {"jaxpr", "call_jaxpr", "fun_jaxpr"}
"""Under one of these names it is among their parameters."""

PRINTS = ("debug_callback", "debug_print")
"""Primitives without a value."""

DRAWS = ("random_", "rng_", "threefry")
"""How names of primitives begin that draw numbers."""

CALLBACKS = ("pure_callback", "io_callback")
"""Primitives that call Python, where nothing can be traced."""

TURNS = 1000
"""A loop that takes more turns than this is taken to be endless."""


def require_traced(jaxpr: Any) -> None:
    """Raise an error for what cannot be known of any number.

    Raises:
        UnsupportedError: it draws random numbers, or calls back to Python.
    """
    for equation in equations(jaxpr):
        name, why = equation.primitive.name, ""
        if name.startswith(DRAWS):
            why = (
                "it draws random numbers: what is random is a disturbance or a noise of the loop; "
                "put modules into evaluation mode"
            )
        if name in CALLBACKS:
            why = "what Python computes outside of JAX has no bounds"
        if why:
            raise _located(UnsupportedError(why), equation)


def walked(recorder: Recorder, closed: Any, operands: Sequence[Operand]) -> list[Operand]:
    """What a jaxpr makes of operands.

    Raises:
        UnsupportedError: there is no rule for one of its primitives.
    """
    jaxpr = getattr(closed, "jaxpr", closed)
    known: dict[Any, Operand] = {}
    constants = getattr(closed, "consts", ())
    known.update(zip(jaxpr.constvars, map(_plain, constants), strict=True))
    known.update(zip(jaxpr.invars, operands, strict=True))

    def read(variable: Any) -> Operand:
        return _plain(variable.val) if isinstance(variable, core.Literal) else known[variable]

    for equation in _needed(jaxpr):
        found = _equation(recorder, equation, [read(each) for each in equation.invars])
        known.update(zip(equation.outvars, found, strict=True))
    return [read(each) for each in jaxpr.outvars]


def _needed(jaxpr: Any) -> list[Any]:
    """The equations that its results depend on."""
    used = {each for each in jaxpr.outvars if not isinstance(each, core.Literal)}
    found = []
    for equation in reversed(jaxpr.eqns):
        if used.intersection(equation.outvars):
            used.update(each for each in equation.invars if not isinstance(each, core.Literal))
            found.append(equation)
    return found[::-1]


def _plain(value: Any) -> Any:
    """A constant; numpy's if it is known, so that it stays so where others are traced."""
    if isinstance(value, jax.Array):
        is_key = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        return value if is_key or not is_known(value) else np.asarray(value)
    return np.asarray(value)


def _is_plain(operand: Operand) -> bool:
    return not isinstance(operand, Value | Comparison)


def _equation(recorder: Recorder, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
    """What one equation makes of its operands."""
    name, params = equation.primitive.name, equation.params
    try:
        if all(map(_is_plain, operands)) and name.startswith("custom_"):
            return _called(equation, operands)
        if all(map(_is_plain, operands)):
            found = Equation(equation).evaluate(*operands)
            return list(found) if equation.primitive.multiple_results else [found]
        if name == "scan":
            return _unrolled(recorder, params, operands)
        if name == "while":
            return _repeated(recorder, params, operands)
        if name == "cond":
            which, *given = operands
            if not _is_plain(which) or not is_known(which):
                raise UnsupportedError("which branch is taken must not depend on inputs")
            branches = params["branches"]
            return walked(recorder, branches[int(np.clip(which, 0, len(branches) - 1))], given)
        if name in CALLS:
            return walked(recorder, params[(BODIES & params.keys()).pop()], operands)
        key = name, tuple(map(_identity, operands)), str(params)
        if key not in recorder.known:  # what is written twice is done once
            recorder.line = _line(equation) or recorder.line
            found = recorded(recorder, Equation(equation), operands)
            recorder.known[key] = found if isinstance(found, list) else [found], operands
        return recorder.known[key][0]
    except UnsupportedError as error:
        raise _located(error, equation) from None


def _called(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """A function with derivatives of its own, of plain arrays."""
    if any(isinstance(each, Parameter) for each in operands):
        return [*map(Parameter.of, _called(equation, [*map(np.asarray, operands)]))]
    given = dict(zip(equation.invars, operands, strict=True))
    given = {each: value for each, value in given.items() if not isinstance(each, core.Literal)}
    jaxpr = core.Jaxpr([], [*given], equation.outvars, [equation])
    call = core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, []))
    if not is_known(*given.values()):
        return call(*given.values())
    with jax.ensure_compile_time_eval():
        return call(*given.values())


def _located(error: UnsupportedError, equation: Any) -> UnsupportedError:
    error.primitive = error.primitive or equation.primitive.name
    error.line = error.line or _line(equation)
    return error


def _identity(operand: Operand) -> Any:
    """What two operands have in common only if they are the same."""
    if isinstance(operand, Value):
        return operand.place, operand.shape
    if isinstance(operand, np.ndarray) and operand.size == 1:
        return str(operand.dtype), operand.shape, operand.item()
    return id(operand)


def _unrolled(
    recorder: Recorder, params: dict[str, Any], operands: Sequence[Operand]
) -> list[Operand]:
    """A scan, step by step."""
    constants = list(operands[: params["num_consts"]])
    carry = list(operands[params["num_consts"] : params["num_consts"] + params["num_carry"]])
    streams = operands[params["num_consts"] + params["num_carry"] :]
    length, rows = params["length"], []
    order = range(length)[::-1] if params["reverse"] else range(length)
    for k in order:
        given = [_slice(recorder, each, k) for each in streams]
        found = walked(recorder, params["jaxpr"], [*constants, *carry, *given])
        carry, row = found[: len(carry)], found[len(carry) :]
        rows.append(row)
    if not rows:
        empty = params["jaxpr"].out_avals[len(carry) :]
        return [*carry, *(np.zeros((0, *each.shape), each.dtype) for each in empty)]
    rows = rows[::-1] if params["reverse"] else rows
    return [*carry, *(_stacked(recorder, column) for column in zip(*rows, strict=True))]


def _repeated(
    recorder: Recorder, params: dict[str, Any], operands: Sequence[Operand]
) -> list[Operand]:
    """A loop whose condition is known."""
    first, second = params["cond_nconsts"], params["body_nconsts"]
    asked, done = operands[:first], operands[first : first + second]
    carry = list(operands[first + second :])
    for _ in range(TURNS):
        (goes_on,) = walked(recorder, params["cond_jaxpr"], [*asked, *carry])
        if not _is_plain(goes_on) or not is_known(goes_on):
            raise UnsupportedError(
                "how often it repeats must not depend on inputs or traced parameters"
            )
        if not bool(np.asarray(goes_on)):
            return carry
        carry = walked(recorder, params["body_jaxpr"], [*done, *carry])
    raise UnsupportedError(f"it has not ended after {TURNS} turns")


def _slice(recorder: Recorder, operand: Operand, k: int) -> Operand:
    if not isinstance(operand, Value):
        return operand[k]
    return recorder.picked(operand, np.arange(operand.size).reshape(operand.shape)[k])


def _stacked(recorder: Recorder, column: Sequence[Operand]) -> Operand:
    if all(map(_is_plain, column)):
        on_host = all(isinstance(each, np.ndarray | np.generic) for each in column)
        return np.stack(column) if on_host else jnp.stack(column)
    if all(isinstance(each, Comparison) for each in column):
        return Comparison(_stacked(recorder, [each.value for each in column]))
    if any(isinstance(each, Comparison) for each in column):
        raise UnsupportedError("a comparison in one of its steps is none in another")
    joined, (first, *_) = recorder.joined(column), column
    shape = first.shape if isinstance(first, Value) else np.shape(first)
    return recorder.picked(joined, np.arange(joined.size).reshape(len(column), *shape))


@lru_cache(maxsize=1)
def _folders() -> tuple[Path, ...]:
    """Where packages are whose lines are none of a user's."""
    found = [Path(__file__).parent]
    for name in ("jax", "jaxlib", "flax", "equinox", "optax"):
        spec = importlib.util.find_spec(name)
        found += map(Path, (spec and spec.submodule_search_locations) or ())
    return tuple(found)


def _line(equation: Any) -> str:
    """Where a user wrote it: ` (in NAME, FILE:LINE)`; nothing where that is not known."""
    frames = getattr(equation.source_info.traceback, "frames", ())
    for frame in frames:
        if not any(Path(frame.file_name).is_relative_to(each) for each in _folders()):
            return f" (in {frame.function_name}, {frame.file_name}:{frame.line_num})"
    return ""
