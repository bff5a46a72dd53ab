"""JAX functions over any kind of number: traced once, and interpreted as often as one likes.

A function's parameters are the arrays of the tree that it is (`jax.tree_util.Partial(f, params)`, a
flax or equinox module); those that it merely closes over are constants. Its jaxpr becomes a list of
steps (`recording`), affine ones and layers of units, that any kind of number can be run through.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from reachjax.loops.primitives import Equation, UnsupportedError, recorded
from reachjax.loops.recording import Operand, Recorder, Value
from reachjax.loops.units import AtUnit, evaluate
from reachjax.numerics.checks import described, is_concrete
from reachjax.numerics.pytrees import pytree, static

Sizes = tuple[int, ...]


class Structure(NamedTuple):
    """What of a function is no number: hashable.

    Attributes:
        tree: the structure of the tree that it is.
        others: its leaves that are no arrays of floats; None for those that are.
        inputs: the sizes of its arguments.
        outputs: the size of its result.
    """

    tree: Any
    others: tuple[Any, ...]
    inputs: Sizes
    outputs: int


class _Held:
    """An array that is no number to be differentiated, such as a key."""

    def __init__(self, array: Any):
        self.array = array


@pytree
class Function:
    """A function of vectors, with one vector for a result.

    Attributes:
        parameters: its arrays.
        structure: all else.
    """

    parameters: tuple[Any, ...]
    structure: Structure = static()

    @classmethod
    def of(cls, function: Callable, inputs: Sizes, outputs: int, name: str) -> Function:
        """A function that is checked.

        Args:
            function: of as many vectors as there are sizes.
            inputs: these.
            outputs: the size of its result.
            name: what errors call it.

        Raises:
            TypeError: it is no function, or contains what has no bounds.
            ValueError: it cannot be called with such vectors, or its result has another shape.
        """
        if not callable(function):
            raise TypeError(f"{name} must be a function, but {described(function)} arrived")
        leaves, tree = jax.tree.flatten(function)
        numbers = [_is_float(leaf) for leaf in leaves]
        parameters = tuple(
            jnp.asarray(leaf, float)
            for leaf, is_number in zip(leaves, numbers, strict=True)
            if is_number
        )
        others = tuple(
            None if is_number else _Held(leaf) if hasattr(leaf, "dtype") else leaf
            for leaf, is_number in zip(leaves, numbers, strict=True)
        )
        made = cls(parameters, Structure(tree, others, inputs, outputs))
        made._check(name)
        return made

    def _check(self, name: str) -> None:
        try:
            closed = self._traced
        except (TypeError, ValueError, IndexError) as error:
            raise ValueError(
                f"{name} cannot be called with vectors of sizes {list(self.structure.inputs)}: "
                f"{error}"
            ) from error
        shapes = [tuple(each.shape) for each in closed.out_avals]
        outputs = self.structure.outputs
        if shapes != [(outputs,)]:
            arrived = shapes[0] if len(shapes) == 1 else shapes
            raise ValueError(f"{name} must return shape ({outputs},), but {arrived} arrived")
        jax.eval_shape(lambda function: function._recorded()[0], self)

    @property
    def _traced(self) -> core.ClosedJaxpr:
        shapes = tuple(jnp.shape(each) for each in self.parameters)
        return _traced(self.structure, shapes, bool(jax.config.read("jax_enable_x64")))

    def __call__(self, *inputs: Any) -> Any:
        """The value, for arrays of JAX."""
        return _restored(self.structure, self.parameters)(*inputs)

    def stored(self) -> tuple[Callable, Sizes, int]:
        """The function with its parameters, and its sizes: what a file needs."""
        function = _restored(self.structure, self.parameters)
        return function, self.structure.inputs, self.structure.outputs

    @classmethod
    def restored(cls, parts: tuple[Callable, Sizes, int]) -> Function:
        """From what was stored."""
        return cls.of(*parts, name="the function of a file")

    def propagate(self, inputs: Sequence[Any], unit: AtUnit) -> Any:
        """The value over any kind of number, with `unit` at each layer of units."""
        if unit is evaluate and all(isinstance(each, jax.Array) for each in inputs):
            return self(*inputs)
        recorder, wanted = self._steps()
        if not isinstance(wanted, Value):  # a constant: as a number of this kind
            nothing = np.zeros((np.size(wanted), self.structure.inputs[0]))
            return nothing @ inputs[0] + wanted
        return recorder.run(inputs, unit, wanted)

    def _steps(self) -> tuple[Recorder, Operand]:
        """The steps; of numpy arrays they are kept."""
        if not all(isinstance(each, np.ndarray) for each in self.parameters):
            return self._recorded()[1]
        kept = self.__dict__.get("_kept")
        if kept is None:
            kept = self._recorded()[1]
            object.__setattr__(self, "_kept", kept)
        return kept

    def _recorded(self) -> tuple[Any, tuple[Recorder, Operand]]:
        """The parameters, so that this can be traced, and the steps with what they end in."""
        closed, sizes = self._traced, self.structure.inputs
        recorder = Recorder([(size,) for size in sizes])
        try:
            (wanted,) = _walked(recorder, closed, [*self.parameters, *recorder.inputs])
        except UnsupportedError as error:
            raise TypeError(
                f"the primitive {error.primitive!r}{error.line} cannot be certified: {error}"
            ) from None
        return self.parameters, (recorder, wanted)


def _is_float(leaf: Any) -> bool:
    if not (isinstance(leaf, jax.Array | np.ndarray | np.generic | float)):
        return False
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


def _restored(structure: Structure, parameters: Sequence[Any]) -> Callable:
    """The function with these parameters."""
    numbers = iter(parameters)
    leaves = [
        next(numbers) if other is None else other.array if isinstance(other, _Held) else other
        for other in structure.others
    ]
    return jax.tree.unflatten(structure.tree, leaves)


@lru_cache(maxsize=256)
def _traced(structure: Structure, shapes: tuple[Sizes, ...], double: bool) -> core.ClosedJaxpr:
    """The jaxpr of parameters and inputs."""

    def called(parameters: Sequence[Any], *inputs: Any) -> Any:
        return _restored(structure, parameters)(*inputs)

    parameters = [jax.ShapeDtypeStruct(shape, float) for shape in shapes]
    inputs = [jax.ShapeDtypeStruct((size,), float) for size in structure.inputs]
    return jax.make_jaxpr(called)(parameters, *inputs)


def _walked(recorder: Recorder, closed: Any, operands: Sequence[Operand]) -> list[Operand]:
    """What a jaxpr makes of operands."""
    jaxpr = getattr(closed, "jaxpr", closed)
    known: dict[Any, Operand] = {}
    constants = getattr(closed, "consts", ())
    known.update(zip(jaxpr.constvars, map(_plain, constants), strict=True))
    known.update(zip(jaxpr.invars, operands, strict=True))

    def read(variable: Any) -> Operand:
        return _plain(variable.val) if isinstance(variable, core.Literal) else known[variable]

    for equation in jaxpr.eqns:
        found = _equation(recorder, equation, [read(each) for each in equation.invars])
        known.update(zip(equation.outvars, found, strict=True))
    return [read(each) for each in jaxpr.outvars]


def _plain(value: Any) -> Any:
    return value if isinstance(value, jax.Array) else np.asarray(value)


def _equation(recorder: Recorder, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
    """What one equation makes of its operands.

    Raises:
        UnsupportedError: there is no rule for its primitive.
    """
    name, params = equation.primitive.name, equation.params
    try:
        if all(not hasattr(each, "place") and not hasattr(each, "value") for each in operands):
            found = Equation(equation).evaluate(*operands)
            return list(found) if equation.primitive.multiple_results else [found]
        if name == "scan":
            return _unrolled(recorder, params, operands)
        if name == "cond":
            which, *given = operands
            if hasattr(which, "place") or not is_concrete(which):
                raise UnsupportedError("which branch is taken must not depend on inputs")
            return _walked(recorder, params["branches"][int(which)], given)
        for inner in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
            if inner in params:
                return _walked(recorder, params[inner], operands)
        key = name, tuple(map(_identity, operands)), str(params)
        if key not in recorder.known:  # what is written twice is done once
            recorder.line = _line(equation) or recorder.line
            found = recorded(recorder, Equation(equation), operands)
            recorder.known[key] = found if isinstance(found, list) else [found], operands
        return recorder.known[key][0]
    except UnsupportedError as error:
        error.primitive = error.primitive or name
        error.line = error.line or _line(equation)
        raise


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
        found = _walked(recorder, params["jaxpr"], [*constants, *carry, *given])
        carry, row = found[: len(carry)], found[len(carry) :]
        rows.append(row)
    rows = rows[::-1] if params["reverse"] else rows
    return [*carry, *(_stacked(recorder, column) for column in zip(*rows, strict=True))]


def _slice(recorder: Recorder, operand: Operand, k: int) -> Operand:
    if not isinstance(operand, Value):
        return operand[k]
    return recorder.picked(operand, np.arange(operand.size).reshape(operand.shape)[k])


def _stacked(recorder: Recorder, column: Sequence[Operand]) -> Operand:
    if not any(isinstance(each, Value) for each in column):
        return jnp.stack(column)
    joined, (first, *_) = recorder.joined(column), column
    shape = first.shape if isinstance(first, Value) else np.shape(first)
    return recorder.picked(joined, np.arange(joined.size).reshape(len(column), *shape))


def _line(equation: Any) -> str:
    """Where a user wrote it: ` (in NAME, FILE:LINE)`; nothing where that is not known."""
    frames = getattr(equation.source_info.traceback, "frames", ())
    for frame in frames:
        inside = ("/jax/", "/flax/", "/equinox/", "/reachjax/loops/", "/optax/", "/jaxlib/")
        if not any(part in frame.file_name.replace("\\", "/") for part in inside):
            return f" (in {frame.function_name}, {frame.file_name}:{frame.line_num})"
    return ""
