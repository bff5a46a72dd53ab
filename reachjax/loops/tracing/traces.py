"""What a function was when it was traced: a jaxpr that nothing can change any more.

It is both simulated and certified. Two traces are the same if they describe the same computation,
whatever their functions are called: the same equations, and the same bits of every constant.
"""

from __future__ import annotations

import hashlib
import itertools
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from reachjax.loops.tracing.dependence import rounds_plain, rounds_to_fewer_bits
from reachjax.numerics.checks import is_concrete

Sizes = tuple[int, ...]

SIZE = 32
"""Bytes of a description: two computations never have one."""

PRECISION = r"b?float\d+| at 0x[0-9a-f]+"
"""What names a precision in the parameters of an equation, and addresses of objects."""


class UpdatedError(Exception):
    """A function changes variables of its own when it is called: it is another one afterwards."""


class Kind(NamedTuple):
    """What a parameter is besides its numbers.

    Attributes:
        shape: of the array.
        name: of its precision; None for that of all floats.
        is_weak: whether it takes the precision of others, as numbers of Python's do, and arrays
            that JAX makes of these.
    """

    shape: Sizes
    name: str | None
    is_weak: bool

    @classmethod
    def of(cls, leaf: Any) -> Kind:
        """The kind of an array, or of a number."""
        found = jnp.result_type(leaf)
        name = None if found == jnp.result_type(float) else found.name
        is_weak = type(leaf) is float or getattr(leaf, "weak_type", False)
        return cls(jnp.shape(leaf), name, bool(is_weak))


class _Held:
    """An array that is no number to be differentiated, such as a key."""

    def __init__(self, array: Any):
        self.array = array


class Trace:
    """A function of parameters and vectors, traced.

    Args:
        tree: the structure of the tree that the function is.
        others: its leaves that are no arrays of floats; None for those that are.
        kinds: of the parameters, which are these.
        inputs: the sizes of the vectors.
    """

    def __init__(self, tree: Any, others: tuple[Any, ...], kinds: tuple[Kind, ...], inputs: Sizes):
        self._parts = tree, others, kinds, inputs
        self._closed: dict[bool, core.ClosedJaxpr] = {}
        self._rounds: bool | None = None
        self.described = description(self.closed)

    @classmethod
    def of(cls, function: Callable, inputs: Sizes) -> tuple[Trace, tuple[Any, ...]]:
        """The trace of a function, and the parameters of the tree that it is, which are copied."""
        leaves, tree = jax.tree.flatten(function)
        numbers = [_is_float(leaf) for leaf in leaves]
        mine = [leaf for leaf, own in zip(leaves, numbers, strict=True) if own]
        kinds = tuple(map(Kind.of, mine))
        parameters = tuple(jnp.array(leaf, float) for leaf in mine)
        others = tuple(
            None if own else _Held(leaf) if hasattr(leaf, "dtype") else leaf
            for leaf, own in zip(leaves, numbers, strict=True)
        )
        return cls(tree, others, kinds, inputs), parameters

    @property
    def closed(self) -> core.ClosedJaxpr:
        """The jaxpr over parameters and vectors. Once 64-bit floats are turned on, in these."""
        double = bool(jax.config.read("jax_enable_x64"))
        if double not in self._closed:
            for other in self._closed:
                with jax.enable_x64(other):
                    _require_same(description(self._traced()), self.described)
            self._closed[double] = self._traced()
        return self._closed[double]

    def _traced(self) -> core.ClosedJaxpr:
        """What the function is now.

        Parameters are floats of 64 bits. Where those of fewer bits are computed with in these, so
        that it makes a difference, they are brought back to them.
        """
        _, _, kinds, inputs = self._parts
        vectors = [jax.ShapeDtypeStruct((size,), float) for size in inputs]

        def of(names: Sequence[str | None]) -> list[Any]:
            return [
                jax.ShapeDtypeStruct(each.shape, name or float, weak_type=each.is_weak)
                for each, name in zip(kinds, names, strict=True)
            ]

        def called(parameters: Sequence[Any], *vectors: Any) -> Any:
            function = self.function(parameters)
            before = jax.tree.leaves(function)
            found = function(*vectors)
            after = jax.tree.leaves(function)
            if len(before) != len(after) or any(map(operator.is_not, before, after)):
                raise UpdatedError
            return found

        def brought_back(parameters: Sequence[Any], *vectors: Any) -> Any:
            own = [
                each if name is None else jnp.asarray(each, name)
                for each, name in zip(parameters, names, strict=True)
            ]
            return called(own, *vectors)

        names, whole = [each.name for each in kinds], of([None] * len(kinds))
        own = None
        if any(names):
            own = jax.make_jaxpr(called)(of(names), *vectors)
            varies = [number >= len(kinds) for number in range(len(own.jaxpr.invars))]
            if rounds_plain(own, varies) or _narrows(own) or rounds_to_fewer_bits(own, varies):
                return _owned(jax.make_jaxpr(brought_back)(whole, *vectors))
        found = jax.make_jaxpr(called)(whole, *vectors)
        asks = own is not None and [*_steps(own)] != [*_steps(found)]
        if asks:  # for the precision of a parameter
            found = jax.make_jaxpr(brought_back)(whole, *vectors)
        return _owned(found)

    def function(self, parameters: Sequence[Any]) -> Callable:
        """The function with these parameters, as it is now."""
        tree, others, kinds, _ = self._parts
        numbers = (
            float(number) if each.is_weak and not each.shape and is_concrete(number) else number
            for number, each in zip(parameters, kinds, strict=True)
        )
        leaves = [
            next(numbers) if other is None else other.array if isinstance(other, _Held) else other
            for other in others
        ]
        return jax.tree.unflatten(tree, leaves)

    def __call__(self, parameters: Sequence[Any], *inputs: Any) -> Any:
        """What was traced, evaluated."""
        (found,) = core.jaxpr_as_fun(self.closed)(*parameters, *inputs)
        return found

    @property
    def numbers(self) -> Iterator[Any]:
        """The constants that it closes over, and those that are written in it."""
        yield from (each for each in _constants(self.closed) if _is_float(each))
        for equation in equations(self.closed):
            yield from (each.val for each in equation.invars if isinstance(each, core.Literal))

    @property
    def rounds_constants(self) -> bool:
        """Whether it rounds numbers that depend on parameters or constants alone."""
        if self._rounds is None:
            count = len(self.closed.jaxpr.invars) - len(self._parts[3])
            varies = [number >= count for number in range(len(self.closed.jaxpr.invars))]
            self._rounds = rounds_plain(self.closed, varies)
        return self._rounds

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trace) or self.described is None:
            return self is other
        return self.described == other.described

    def __hash__(self) -> int:
        return object.__hash__(self) if self.described is None else hash(self.described)

    def __repr__(self) -> str:
        return f"Trace({self.described})"

    def __deepcopy__(self, known: Any) -> Trace:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (*self._parts, self.described)


def _again(*parts: Any) -> Trace:
    """A trace in another process, where its function is traced once more.

    Raises:
        ValueError: that is another one.
    """
    *given, described = parts
    found = Trace(*given)
    _require_same(found.described, described)
    return found


def _require_same(now: str | None, before: str | None) -> None:
    """Raise an error unless two descriptions of a function are one.

    Raises:
        ValueError: they differ.
    """
    if now != before:
        raise ValueError(
            "a function that was given to a network or a plant computes something else than when "
            "it was given: it, or what it closes over, has changed since"
        )


def _is_float(leaf: Any) -> bool:
    if not (isinstance(leaf, jax.Array | np.ndarray | np.generic | float)):
        return False
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


def subjaxprs(value: Any) -> Iterator[Any]:
    """The jaxprs that a parameter of an equation is, or holds."""
    if isinstance(value, core.ClosedJaxpr | core.Jaxpr):
        yield value
    elif isinstance(value, tuple | list):
        for each in value:
            yield from subjaxprs(each)


def equations(jaxpr: Any) -> Iterator[Any]:
    """All equations, those of inner jaxprs too."""
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        yield equation
        for value in equation.params.values():
            for inner in subjaxprs(value):
                yield from equations(inner)


def _narrows(closed: core.ClosedJaxpr) -> bool:
    """Whether it brings floats to fewer bits."""
    return any(
        _bits(each.invars[0]) > _bits(each.outvars[0]) > 0
        for each in equations(closed)
        if each.primitive.name == "convert_element_type"
    )


def _bits(atom: Any) -> int:
    """The bits of a float; 0 of what is none."""
    kind = atom.aval.dtype
    return jnp.finfo(kind).bits if jnp.issubdtype(kind, jnp.floating) else 0


def _steps(closed: core.ClosedJaxpr) -> Iterator[Any]:
    """What a jaxpr does, whatever the precision of its floats is."""
    for each in _constants(closed):
        if is_concrete(each) and not jnp.issubdtype(each.dtype, jax.dtypes.extended):
            yield np.asarray(each, bool if each.dtype == bool else float).tobytes()
    yield from _wired(closed.jaxpr, {}, itertools.count())


def _wired(jaxpr: core.Jaxpr, known: dict[Any, int], count: Iterator[int]) -> Iterator[Any]:
    """What a jaxpr does, and to which numbers: these are counted, conversions of floats aside."""

    def number(atom: Any) -> Any:
        is_literal = isinstance(atom, core.Literal)
        return repr(np.asarray(atom.val).tolist()) if is_literal else known[atom]

    known.update(zip((*jaxpr.constvars, *jaxpr.invars), count, strict=False))
    for equation in jaxpr.eqns:
        operands = [number(each) for each in equation.invars]
        if equation.primitive.name == "convert_element_type":
            (operand,), (result,) = equation.invars, equation.outvars
            if _bits(operand) and _bits(result):
                known[result] = operands[0]
                continue
        yield equation.primitive.name, operands
        for name, value in sorted(equation.params.items()):
            inner = [*subjaxprs(value)]
            for each in inner:
                yield from _wired(getattr(each, "jaxpr", each), known, count)
            if name not in NAMES and not inner:
                yield name, re.sub(PRECISION, "float", str(value))
        known.update(zip(equation.outvars, count, strict=False))
    yield [number(each) for each in jaxpr.outvars]


def _owned(value: Any) -> Any:
    """A jaxpr, or what holds some, with copies of all constants: nobody else can change these."""
    if isinstance(value, core.ClosedJaxpr):
        return core.ClosedJaxpr(_owned(value.jaxpr), [_copied(each) for each in value.consts])
    if isinstance(value, core.Jaxpr):
        if not any(True for each in value.eqns for v in each.params.values() for _ in subjaxprs(v)):
            return value
        return value.replace(
            eqns=[
                each.replace(params={name: _owned(v) for name, v in each.params.items()})
                for each in value.eqns
            ]
        )
    if type(value) in (tuple, list) and any(True for _ in subjaxprs(value)):
        return type(value)(map(_owned, value))
    return value


def _copied(constant: Any) -> Any:
    if not isinstance(constant, jax.Array):
        return np.array(constant)
    is_key = jnp.issubdtype(constant.dtype, jax.dtypes.extended)
    return jnp.array(constant, copy=True) if not is_key and is_concrete(constant) else constant


def description(closed: core.ClosedJaxpr) -> str | None:
    """What a jaxpr computes, as a hash; None if it holds numbers that are traced.

    It is the same in another process, and says nothing of names and places of functions.
    """
    if not is_concrete(list(_constants(closed))):
        return None
    found = hashlib.blake2b(digest_size=SIZE)
    for part in itertools.chain(_told(closed), _told(_slopes(closed))):
        found.update(part)
        found.update(b"\0")
    return found.hexdigest()


def _slopes(closed: core.ClosedJaxpr) -> core.ClosedJaxpr | None:
    """The derivative, if a function has rules of its own for it."""
    if not any(each.primitive.name.startswith("custom_") for each in equations(closed.jaxpr)):
        return None

    def pulled(given: Sequence[Any], slopes: Sequence[Any]) -> Any:
        return jax.vjp(core.jaxpr_as_fun(closed), *given)[1](slopes)

    given, slopes = (
        [jax.ShapeDtypeStruct(each.aval.shape, each.aval.dtype) for each in variables]
        for variables in (closed.jaxpr.invars, closed.jaxpr.outvars)
    )
    try:
        return jax.make_jaxpr(pulled)(given, slopes)
    except (TypeError, ValueError, NotImplementedError):  # it has none
        return None


def _constants(closed: Any) -> Iterator[Any]:
    yield from getattr(closed, "consts", ())
    for equation in getattr(closed, "jaxpr", closed).eqns:
        for value in equation.params.values():
            for inner in subjaxprs(value):
                yield from _constants(inner)


def _told(value: Any) -> Iterator[bytes]:
    """A value as bytes: jaxprs by their equations, arrays by their bits, all else by its words."""
    if isinstance(value, core.ClosedJaxpr):
        yield from _told(value.jaxpr)
        for each in value.consts:
            yield from _told_array(each)
    elif isinstance(value, core.Jaxpr):
        numbers: dict[Any, int] = {}
        for variable in (*value.constvars, *value.invars):
            numbers[variable] = len(numbers)
            yield _kind(variable)
        for equation in value.eqns:
            yield equation.primitive.name.encode()
            for each in equation.invars:
                yield from _told_atom(each, numbers)
            for name, parameter in sorted(equation.params.items()):
                if name not in NAMES:
                    yield name.encode()
                    yield from _told(parameter)
            for variable in equation.outvars:
                numbers[variable] = len(numbers)
                yield _kind(variable)
        for each in value.outvars:
            yield from _told_atom(each, numbers)
    elif isinstance(value, jax.Array | np.ndarray | np.generic):
        yield from _told_array(value)
    elif isinstance(value, tuple | list):
        yield f"{type(value).__name__} {len(value)}".encode()
        for each in value:
            yield from _told(each)
    elif callable(value) and not isinstance(value, type):
        yield b"function"  # a rule for derivatives: `_slopes` tells what it says
    else:
        yield re.sub(r" at 0x[0-9a-f]+", "", repr(value)).encode()


NAMES = ("name", "ctx_mesh", "debug_info")
"""Parameters that say nothing of what is computed."""


def _told_atom(atom: Any, numbers: dict[Any, int]) -> Iterator[bytes]:
    """An operand: a constant, or the number of a variable."""
    if isinstance(atom, core.Literal):
        yield from _told_array(atom.val)
    else:
        yield f"of {numbers[atom]}".encode()


def _kind(variable: Any) -> bytes:
    return f"{variable.aval.str_short()} {getattr(variable.aval, 'weak_type', False)}".encode()


def _told_array(array: Any) -> Iterator[bytes]:
    if jnp.issubdtype(getattr(array, "dtype", np.float64), jax.dtypes.prng_key):
        array = jax.random.key_data(array)
    array = np.asarray(array)
    yield f"{array.dtype.str}{array.shape}".encode()
    yield array.tobytes()
