"""Three readings of a traced function: its steps, its values, and its constants.

All of them follow its jaxpr in one order, and compute in one way what depends on no input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.interpreter import PASSED, Constants, Interpreter, bound, line_of
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules import Equation, recorded
from reachjax.loops.tracing.rules.choices import chosen_by
from reachjax.loops.tracing.rules.functions import rule_of
from reachjax.loops.tracing.rules.jumps import WHOLE, entering, entry_of, stack_of
from reachjax.loops.tracing.traces import equations
from reachjax.loops.tracing.values import (
    Choice,
    Comparison,
    Operand,
    Pick,
    Unknown,
    UnsupportedError,
    Value,
    is_plain,
)

DRAWS = ("random_", "rng_", "threefry")
"""How names of primitives begin that draw numbers."""

CALLBACKS = ("pure_callback", "io_callback")
"""Primitives that call Python, where nothing can be traced."""

WRITES = ("get", "swap", "addupdate", "new_ref", "ref", "freeze")
"""Primitives of arrays that are written into."""


class Recording(Interpreter):
    """The steps of a function: each equation is recorded by its rule.

    Args:
        constants: its numbers that depend on parameters alone.
        recorder: of the steps.
    """

    follows_all = True

    def __init__(self, constants: Constants, recorder: Recorder):
        super().__init__(constants)
        self._recorder = recorder

    def is_plain(self, operand: Operand) -> bool:
        """Whether an operand depends on no input."""
        return is_plain(operand)

    def apply(self, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
        """What an equation makes of its operands; what is written twice is done once."""
        recorder, name = self._recorder, equation.primitive.name
        if name in PASSED:
            return [*operands]
        kinds = [str(each.aval.dtype) for each in (*equation.invars, *equation.outvars)]
        key = name, tuple(map(_identity, operands)), str(equation.params), *kinds
        if key not in recorder.known:
            recorder.line = line_of(equation) or recorder.line
            found = recorded(recorder, Equation(equation), operands)
            recorder.known[key] = found if isinstance(found, list) else [found], operands
        return recorder.known[key][0]

    def varying(self, operand: Operand) -> Operand:
        """A plain number as a value, which rounding is bounded of; what is whole stays as it is."""
        shape, recorder = np.shape(operand), self._recorder
        if not jnp.issubdtype(jnp.result_type(operand), jnp.floating):
            return operand
        some = recorder.taken(recorder.inputs[0], np.zeros(shape, int))
        return recorder.shifted(recorder.scaled(some, np.zeros(shape)), operand)

    def whole(self, equation: Any, operands: Sequence[Operand]) -> list[Operand] | None:
        """The result of a function that has a rule as a whole."""
        rule = rule_of(equation)
        if rule is None or any(isinstance(each, Choice | Unknown) for each in operands):
            return None
        shape = tuple(equation.outvars[0].aval.shape)
        return [rule(self._recorder, [*operands], shape)]

    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis."""
        if isinstance(operand, Comparison):
            return Comparison(self.entry(operand.value, k), operand.strict)
        if isinstance(operand, Choice):
            return entry_of(self._recorder, operand, k)
        if not isinstance(operand, Value):
            raise UnsupportedError(WHOLE)
        index = np.arange(operand.size).reshape(operand.shape)[k]
        return self._recorder.taken(operand, index)

    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands of one kind, or plain ones, as one."""
        if any(isinstance(each, Choice) for each in column):
            kinds = {each.strict for each in column if isinstance(each, Comparison)}
            if len(kinds) == 1 and all(isinstance(each, Comparison) for each in column):
                return Comparison(self.stacked([each.value for each in column]), *kinds)
            return stack_of(self._recorder, column)
        joined = self._recorder.joined(column)
        shape = next(each.shape for each in column if isinstance(each, Value))
        index = np.arange(joined.size).reshape(len(column), *shape)
        return self._recorder.picked(joined, index)

    def entering(
        self, which: Operand, count: int, operands: Sequence[Operand]
    ) -> Sequence[Sequence[Operand]]:
        """The operands of each branch: one that is picked out of several gets points elsewhere."""
        if not isinstance(which, Pick):
            return super().entering(which, count, operands)
        return entering(self._recorder, which, count, operands)

    def either(self, which: Operand, cases: Sequence[Operand]) -> Operand:
        """The result of the branch that is taken, of which nobody knows which one it is."""
        if all(each is cases[0] for each in cases):
            return cases[0]
        if not isinstance(which, Choice):
            raise UnsupportedError(
                "which branch is taken must not depend on numbers that depend on inputs, other "
                "than by comparing them"
            )
        shape = np.shape(cases[0]) if is_plain(cases[0]) else cases[0].shape
        return chosen_by(self._recorder, which, cases, shape)


def _identity(operand: Operand) -> Any:
    """What two operands have in common only if they are the same."""
    if isinstance(operand, Value):
        return operand.place, operand.shape
    if isinstance(operand, np.ndarray) and operand.size == 1:
        return type(operand), str(operand.dtype), operand.shape, operand.item()
    return id(operand)


class Number:
    """An array that depends on inputs.

    Attributes:
        array: of JAX.
    """

    def __init__(self, array: Any):
        self.array = array


class Evaluation(Interpreter):
    """The values of a function: equations are those that were traced."""

    has_effects = True

    def is_plain(self, operand: Operand) -> bool:
        """Whether an operand depends on no input."""
        return not isinstance(operand, Number)

    def apply(self, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
        """The results of an equation."""
        return [*map(Number, bound(equation, [*map(_array, operands)]))]

    def whole(self, equation: Any, operands: Sequence[Operand]) -> list[Operand] | None:
        """The result of a function that is not looked into."""
        return None if rule_of(equation) is None else self.apply(equation, operands)

    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis."""
        return Number(operand.array[k])

    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands as one."""
        return Number(jnp.stack([*map(_array, column)]))

    def either(self, which: Operand, cases: Sequence[Operand]) -> Operand:
        """The result of one branch."""
        index = jnp.clip(_array(which), 0, len(cases) - 1)
        return Number(jax.lax.select_n(*_alike(index, [*map(_array, cases)])))


def _alike(index: Any, cases: Sequence[Any]) -> list[Any]:
    """A place, and arrays of one kind."""
    kind = jnp.result_type(*cases)
    return [index.astype(jnp.int32), *(jnp.asarray(each, kind) for each in cases)]


def _array(operand: Any) -> Any:
    if isinstance(operand, Number):
        return operand.array
    return np.asarray(operand) if isinstance(operand, np.ndarray) else operand


class ConstantPart(Interpreter):
    """The constants of a function alone: `None` stands for all that depends on inputs."""

    def is_plain(self, operand: Operand) -> bool:
        """Whether an operand depends on no input."""
        return operand is not None

    def apply(self, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
        """Nothing of an equation whose operands depend on inputs."""
        return [None] * len(equation.outvars)

    def whole(self, equation: Any, operands: Sequence[Operand]) -> list[Operand] | None:
        """Nothing of a function that is not looked into."""
        return None if rule_of(equation) is None else self.apply(equation, operands)

    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis."""
        return None

    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands as one."""
        return None

    def either(self, which: Operand, cases: Sequence[Operand]) -> Operand:
        """Nothing, as it depends on inputs which one it is."""
        return None


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
        if name in WRITES:
            why = "it writes into an array: use x.at[...].set(...), which makes another one"
        if name in CALLBACKS:
            why = "what Python computes outside of JAX has no bounds: use functions of JAX"
        if why:
            error = UnsupportedError(why)
            error.primitive, error.line = name, line_of(equation)
            raise error
