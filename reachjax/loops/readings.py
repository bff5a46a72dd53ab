"""Three readings of a traced function: its steps, its values, and its constants.

All of them follow its jaxpr in one order, and compute in one way what depends on no input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from reachjax.loops.interpreter import Constants, Interpreter, bound, line_of
from reachjax.loops.primitives import Equation, recorded
from reachjax.loops.recording import Recorder
from reachjax.loops.traces import equations
from reachjax.loops.values import Comparison, Operand, UnsupportedError, Value, is_plain

DRAWS = ("random_", "rng_", "threefry")
"""How names of primitives begin that draw numbers."""

CALLBACKS = ("pure_callback", "io_callback")
"""Primitives that call Python, where nothing can be traced."""

PASSED = ("copy", "copy_p", "optimization_barrier", "stop_gradient")
"""Primitives whose results are their operands, of whatever kind."""


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
        key = name, tuple(map(_identity, operands)), str(equation.params)
        if key not in recorder.known:
            recorder.line = line_of(equation) or recorder.line
            found = recorded(recorder, Equation(equation), operands)
            recorder.known[key] = found if isinstance(found, list) else [found], operands
        return recorder.known[key][0]

    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis."""
        if isinstance(operand, Comparison):
            return Comparison(self.entry(operand.value, k))
        index = np.arange(operand.size).reshape(operand.shape)[k]
        return self._recorder.picked(operand, index)

    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands of one kind, or plain ones, as one."""
        if all(isinstance(each, Comparison) for each in column):
            return Comparison(self.stacked([each.value for each in column]))
        if any(isinstance(each, Comparison) for each in column):
            raise UnsupportedError(
                "a comparison of numbers in one of its steps is none in another: compare in all"
            )
        joined = self._recorder.joined(column)
        shape = next(each.shape for each in column if isinstance(each, Value))
        index = np.arange(joined.size).reshape(len(column), *shape)
        return self._recorder.picked(joined, index)


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

    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis."""
        return Number(operand.array[k])

    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands as one."""
        return Number(jnp.stack([*map(_array, column)]))


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

    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis."""
        return None

    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands as one."""
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
        if name in CALLBACKS:
            why = "what Python computes outside of JAX has no bounds: use functions of JAX"
        if why:
            error = UnsupportedError(why)
            error.primitive, error.line = name, line_of(equation)
            raise error
