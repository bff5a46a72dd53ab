"""One equation of a jaxpr, the rules that record it, and the error that there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.values import Operand, Parameter, UnsupportedError, Value, is_known

Rule = Callable[[Recorder, "Equation", Sequence[Operand]], Any]
"""From the operands, of which one at least is no plain array, to the value, or to several."""


class Equation:
    """One equation of a jaxpr.

    Attributes:
        name: of the primitive.
        shape: of its first output.
        kind: of the numbers of that.
        params: of the primitive.
    """

    def __init__(self, equation: Any):
        self.name = equation.primitive.name
        self.shape = tuple(equation.outvars[0].aval.shape)
        self.kind = equation.outvars[0].aval.dtype
        self.params, self._primitive = equation.params, equation.primitive

    def evaluate(self, *operands: Any, **changes: Any) -> Any:
        """Plain arrays in, plain arrays out: numpy's if all are. Some parameters may be changed."""
        params = self.params | changes
        if any(isinstance(each, Parameter) for each in operands):
            plain = (np.asarray(e) if isinstance(e, Parameter) else e for e in operands)
            return jax.tree.map(Parameter.of, self.evaluate(*plain, **changes))
        if not is_known(operands):
            return self._primitive.bind(*operands, **params)
        with jax.ensure_compile_time_eval():  # known numbers stay known where others are traced
            found = self._primitive.bind(*operands, **params)
        return jax.tree.map(np.asarray, found) if all(map(on_host, operands)) else found


NOT_FINITE = "one of its operands is a constant that is not finite: use a finite one in its place"


def on_host(operand: Any) -> bool:
    """Whether a plain operand is numpy's."""
    return isinstance(operand, np.ndarray | np.generic | float | int)


def shaped(recorder: Recorder, operand: Operand, shape: tuple[int, ...]) -> Operand:
    """An operand brought to a shape."""
    if isinstance(operand, Value):
        return operand if operand.shape == shape else recorder.broadcast(operand, shape)
    if on_host(operand):
        require_exact_whole(operand)
        return np.broadcast_to(np.asanyarray(operand, float), shape, subok=True)
    return jnp.broadcast_to(operand, shape)


def require_exact_whole(numbers: Any) -> None:
    """Raise an error for whole numbers that are no floats.

    Raises:
        UnsupportedError: there is one.
    """
    numbers = np.asarray(numbers)
    if numbers.dtype.kind in "iu" and np.any((numbers > 2**53) | (numbers < -(2**53))):
        raise UnsupportedError("its whole numbers are too large to be floats: keep them below 2^53")


def entrywise(rule: Rule) -> Rule:
    """With operands brought to the shape of the result."""

    def widened(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
        same = [shaped(recorder, each, equation.shape) for each in operands]
        return rule(recorder, equation, same)

    return widened


def shape_of(operand: Operand) -> tuple[int, ...]:
    """The shape of an operand."""
    return operand.shape if isinstance(operand, Value) else np.shape(operand)
