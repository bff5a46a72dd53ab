"""JAX functions over any kind of number: traced once, and interpreted as often as one likes.

A function's parameters are the arrays of the tree that it is (`jax.tree_util.Partial(f, params)`, a
flax or equinox module); those that it merely closes over are constants, as they are when it is
given. Its jaxpr is what is simulated, and becomes a list of steps (`recording`), affine ones and
layers of units, that any kind of number can be run through.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from reachjax.loops.tracing.interpreter import Constants
from reachjax.loops.tracing.readings import (
    ConstantPart,
    Evaluation,
    Number,
    Recording,
    require_traced,
)
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.picks import as_pick
from reachjax.loops.tracing.rules.picks import number as number_of
from reachjax.loops.tracing.traces import Sizes, Trace, UpdatedError
from reachjax.loops.tracing.values import Choice, Operand, Parameter, UnsupportedError, Value
from reachjax.loops.units import AtUnit, evaluate
from reachjax.numerics.checks import described, is_concrete, is_staged
from reachjax.numerics.compilations import compiler_options
from reachjax.numerics.pytrees import pytree, static, unchecked
from reachjax.numerics.rounding import counting


class Structure(NamedTuple):
    """What of a function is no number: hashable.

    Attributes:
        trace: what it computes.
        inputs: the sizes of its arguments.
        outputs: the size of its result.
    """

    trace: Trace
    inputs: Sizes
    outputs: int


@pytree
class Function:
    """A function of vectors, with one vector for a result.

    Attributes:
        parameters: its arrays.
        structure: all else.
        constants: what is computed of parameters alone and rounded, by its places; None: that is
            still to be done.
    """

    parameters: tuple[Any, ...]
    structure: Structure = static()
    constants: dict[str, list[Any]] | None = None

    @classmethod
    def of(cls, function: Callable, inputs: Sizes, outputs: int, name: str) -> Function:
        """A function as it is now, checked: what changes later changes nothing of it.

        Args:
            function: of as many vectors as there are sizes.
            inputs: these.
            outputs: the size of its result.
            name: what errors call it.

        Raises:
            TypeError: it is no function, or contains what has no bounds.
            ValueError: it cannot be called with such vectors, its result has another shape, or a
                parameter is not finite, or it changes variables of its own.
        """
        if not callable(function):
            raise TypeError(f"{name} must be a function, but {described(function)} arrived")
        _require_bound(function, name)
        try:
            trace, parameters = Trace.of(function, inputs)
        except UpdatedError:
            raise ValueError(
                f"{name} changes variables of its own when it is called, as modules in training "
                "mode do, so that it is no function of its arguments alone: put it into "
                "evaluation mode, as module.eval() of flax does"
            ) from None
        except jax.errors.ConcretizationTypeError as error:
            raise ValueError(
                f"{name} must not branch on values, nor make Python numbers of them, which cannot "
                f"be traced: use jnp.where, jnp.maximum or jnp.clip ({str(error).splitlines()[0]})"
            ) from error
        except jax.errors.TracerArrayConversionError as error:
            raise ValueError(
                f"{name} must be made of JAX's functions, so that it can be traced: use jnp.sin in "
                f"place of np.sin ({str(error).splitlines()[0]})"
            ) from error
        except (TypeError, ValueError, IndexError) as error:
            hint = ", of which one of size 1 has its number at [0]" if 1 in inputs else ""
            raise ValueError(
                f"{name} cannot be called with vectors of sizes {list(inputs)}{hint}: {error}"
            ) from error
        made = cls(parameters, Structure(trace, inputs, outputs))
        made._check(name)
        return made

    def _check(self, name: str) -> None:
        outputs, parameters = self.structure.outputs, self.parameters
        results = self.structure.trace.closed.out_avals
        shapes = [tuple(each.shape) for each in results]
        if shapes != [(outputs,)]:
            arrived = shapes[0] if len(shapes) == 1 else shapes
            raise ValueError(
                f"{name} must return one array of shape ({outputs},), as jnp.array([...]) makes of "
                f"numbers, but {arrived} arrived"
            )
        (kind,) = (each.dtype for each in results)
        if not jnp.issubdtype(kind, jnp.floating) and not jnp.issubdtype(kind, jnp.integer):
            raise ValueError(f"{name} must return real numbers, but {kind} arrived")
        for number, each in enumerate(parameters):
            if is_concrete(each) and not np.isfinite(each).all():
                where = tuple(int(i) for i in np.argwhere(~np.isfinite(np.asarray(each)))[0])
                raise ValueError(
                    f"the parameters of {name} must be finite, but entry {where} of array "
                    f"{number} is {each[where]}"
                )
        jax.eval_shape(lambda function: function._recorded()[0], self)

    @property
    def described(self) -> str:
        """What it computes of its parameters and arguments, as hexadecimal digits.

        They are the same in another process with this version of JAX, and those of two functions
        differ if their equations do, or any bit of a constant that they close over. The values of
        parameters are not part of it.

        Raises:
            ValueError: it closes over traced numbers.

        Example:
            >>> one, same, other = (
            ...     Function.of(f, (2,), 2, "f")
            ...     for f in (lambda x: 2 * x, lambda y: 2 * y, lambda x: 3 * x)
            ... )
            >>> one.described == same.described, one.described == other.described
            (True, False)
        """
        found = self.structure.trace.described
        if found is None:
            raise ValueError(
                "a function that closes over traced numbers cannot be described: give them as "
                "parameters, with jax.tree_util.Partial(f, numbers)"
            )
        return found

    def __call__(self, *inputs: Any) -> Any:
        """The value, for arrays of JAX."""
        trace = self.structure.trace
        vectors = [jnp.asarray(each, float) for each in inputs]
        if not trace.rounds_constants:
            return trace(self.parameters, *vectors)
        given = [*self._given(), *map(Number, vectors)]
        (found,) = Evaluation(Constants(self.constants)).walk(trace.closed, given)
        return found.array if isinstance(found, Number) else jnp.asarray(found)

    def with_constants(self) -> Function:
        """The function with all that is computed of parameters alone; of numbers it is kept."""
        trace = self.structure.trace
        if self.constants is not None or not trace.rounds_constants:
            return self
        kept = self.__dict__.get("_evaluated")
        if kept is not None:
            return kept
        found = unchecked(
            Function,
            parameters=self.parameters,
            structure=self.structure,
            constants=self._constant_part().computed,
        )
        if is_concrete(found):
            object.__setattr__(self, "_evaluated", found)
        return found

    def _constant_part(self) -> Constants:
        """What is computed of parameters and constants alone, and where."""
        found = Constants(self.constants)
        nothing = [None] * len(self.structure.inputs)
        ConstantPart(found).walk(self.structure.trace.closed, [*self._given(), *nothing])
        return found

    def _given(self) -> list[Any]:
        """The parameters, as operands."""
        return [*map(Parameter.of, self.parameters)]

    def stored(self) -> tuple[Callable, Sizes, int]:
        """The function with its parameters, and its sizes: what a file needs."""
        function = self.structure.trace.function(self.parameters)
        return function, self.structure.inputs, self.structure.outputs

    @classmethod
    def restored(cls, parts: tuple[Callable, Sizes, int]) -> Function:
        """From what was stored."""
        return cls.of(*parts, name="the function of a file")

    def propagate(self, inputs: Sequence[Any], unit: AtUnit) -> Any:
        """The value over any kind of number, with `unit` at each layer of units."""
        if unit is evaluate and all(isinstance(each, jax.Array) for each in inputs):
            return self(*inputs)
        recorder, wanted = self.recorded()
        if not isinstance(wanted, Value):  # a constant: as a number of this kind
            nothing = np.zeros((np.size(wanted), self.structure.inputs[0]))
            return nothing @ inputs[0] + wanted
        return recorder.run(inputs, unit, wanted)

    def recorded(self) -> tuple[Recorder, Operand]:
        """The steps; of numpy arrays they are kept."""
        given = jax.tree.leaves((self.parameters, self.constants))
        if not all(isinstance(each, np.ndarray) for each in given):
            return self._recorded()[1]
        kept = self.__dict__.get("_kept")
        if kept is None:
            kept = self._recorded()[1]
            object.__setattr__(self, "_kept", kept)
        return kept

    @counting
    def _recorded(self) -> tuple[Any, tuple[Recorder, Operand]]:
        """The parameters, so that this can be traced, and the steps with what they end in."""
        closed, sizes = self.structure.trace.closed, self.structure.inputs
        recorder = Recorder([(size,) for size in sizes])
        try:
            require_traced(closed)
            seen = self._constant_part()
            reading = Recording(Constants(seen.computed, seen.visited), recorder)
            (wanted,) = reading.walk(closed, [*self._given(), *recorder.inputs])
            if isinstance(wanted, Choice):
                wanted = number_of(recorder, as_pick(recorder, wanted))
            if recorder.required and not isinstance(wanted, Value):  # units are met all the same
                wanted = reading.varying(wanted.astype(float))
        except UnsupportedError as error:
            what = (
                f"the primitive {error.primitive!r}{error.line}"
                if error.primitive
                else "its result"
            )
            raise TypeError(f"{what} cannot be certified: {error}") from None
        return self.parameters, (recorder, wanted)


def require_own_sizes(made: Any, **said: int | None) -> None:
    """Raise an error where what is made of a function is said to have other sizes than it has.

    Args:
        made: a plant or a network, whose function may have been read before.
        said: the sizes that users give, by their names; None for those that they leave out.

    Raises:
        ValueError: one is another.
    """
    for name, size in said.items():
        own = getattr(made, name)
        if size is not None and size != own:
            raise ValueError(
                f"{type(made).__name__}.{name} must be {own}, as f has been read with so many, but "
                f"{size!r} arrived: give f as a function to change that"
            )


def with_constants(tree: Any) -> Any:
    """A tree in which functions have computed what depends on their parameters alone.

    So it is not done again, and rounded otherwise, in what is compiled.
    """
    leaves, structure = jax.tree.flatten(tree, is_leaf=_is_function)
    found = [each.with_constants() if _is_function(each) else each for each in leaves]
    same = all(one is other for one, other in zip(leaves, found, strict=True))
    return tree if same else jax.tree.unflatten(structure, found)


def numbers_within(tree: Any) -> list[Any]:
    """The numbers in the functions of a tree, which are no leaves of it."""
    leaves = filter(_is_function, jax.tree.leaves(tree, is_leaf=_is_function))
    return [number for each in leaves for number in each.structure.trace.numbers]


def _is_function(node: Any) -> bool:
    return isinstance(node, Function)


class Compiled:
    """A function that JAX compiles, of loops whose constants are computed before.

    Args:
        function: which one.
        compiler_options: of JAX, for code that is not within other code; None:
            `compiler_options()`.
        in_reverse: whether derivatives are taken in reverse mode and no other. Outside of compiled
            code they are then compiled apart, with these options: JAX takes none for them.
        **options: of `jax.jit`.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        compiler_options: dict[str, Any] | None = None,
        in_reverse: bool = False,
        **options: Any,
    ):
        self._function, self._options = counting(function), options
        self._own, self._in_reverse = compiler_options, in_reverse
        self._within = jax.jit(self._function, **options)
        functools.update_wrapper(self, function)

    @functools.cached_property
    def _alone(self) -> Any:
        """The function compiled by itself: code within other code takes no compiler's options."""
        return jax.jit(self._function, compiler_options=self._compiler_options, **self._options)

    @property
    def _compiler_options(self) -> dict[str, Any]:
        return compiler_options() if self._own is None else self._own

    def __call__(self, *given: Any, **static: Any) -> Any:
        """The value, of arguments whose constants are computed."""
        given, static = with_constants(given), with_constants(static)
        if is_staged():
            return self._within(*given, **static)
        if is_concrete(given, static):
            return self._alone(*given, **static)
        known = is_concrete(jax.tree.map(_primal, (given, static)))
        if self._in_reverse and known and not _close_over_traced(given):
            return self._differentiated(given, static)
        return self._within(*given, **static)

    def _differentiated(self, given: tuple[Any, ...], static: dict[str, Any]) -> Any:
        """The value of known numbers of which a derivative is being taken."""
        bound = inspect.signature(self._function).bind(*given, **static).arguments
        names = self._options.get("static_argnames", ())
        leaves, structure = jax.tree.flatten({k: v for k, v in bound.items() if k not in names})
        form = structure, tuple((k, v) for k, v in bound.items() if k in names)
        moves = [isinstance(leaf, Tracer) for leaf in leaves]
        moving, held = (
            [leaf if one is own else None for leaf, one in zip(leaves, moves, strict=True)]
            for own in (True, False)
        )

        def forward(moving: list[Any]) -> tuple[Any, Any]:
            return self._with_pullback[_is_alone(moving)](moving, held, form)

        def backward(pull: Any, above: Any) -> tuple[list[Any]]:
            floats = [each for each in jax.tree.leaves(above) if each.dtype != jax.dtypes.float0]
            return (self._pulled_back[_is_alone((pull, floats))](pull, floats),)

        value = jax.custom_vjp(lambda moving: forward(moving)[0])
        value.defvjp(forward, backward)
        return value(moving)

    @functools.cached_property
    def _with_pullback(self) -> tuple[Any, Any]:
        """The value, and the pullback of its floats to the leaves that move: within, and alone."""

        def with_pullback(
            moving: list[Any], held: list[Any], form: tuple[Any, Any]
        ) -> tuple[Any, Any]:
            structure, static = form

            def of(moving: list[Any]) -> tuple[list[Any], Any]:
                pairs = zip(moving, held, strict=True)
                rest = structure.unflatten([b if a is None else a for a, b in pairs])
                found = self._function(**rest, **dict(static))
                return _floats(found), found

            _, pull, found = jax.vjp(of, moving, has_aux=True)
            return found, pull

        return self._compiled_twice(with_pullback, static_argnames="form")

    @functools.cached_property
    def _pulled_back(self) -> tuple[Any, Any]:
        """A pullback, applied to slopes of the floats of a value: within, and alone."""
        return self._compiled_twice(lambda pull, floats: pull(floats)[0])

    def _compiled_twice(self, function: Callable[..., Any], **options: Any) -> tuple[Any, Any]:
        """A function for code within other code, and for code that is not."""
        alone = jax.jit(function, compiler_options=self._compiler_options, **options)
        return jax.jit(function, **options), alone

    def lower(self, *given: Any, **static: Any) -> Any:
        """What is compiled for such arguments."""
        return self._alone.lower(*with_constants(given), **with_constants(static))

    def _cache_size(self) -> int:
        each: Any = self._within, self._alone, *self._with_pullback, *self._pulled_back
        return sum(one._cache_size() for one in each)


def _is_alone(tree: Any) -> bool:
    """Whether numbers are known, and what is computed of them now is no part of other code."""
    return is_concrete(tree) and not is_staged()


def _close_over_traced(tree: Any) -> bool:
    """Whether a function in a tree closes over traced numbers, which are no leaves of it."""
    parts = jax.tree.leaves(tree, is_leaf=lambda part: isinstance(part, Function))
    functions = (part for part in parts if isinstance(part, Function))
    return any(each.structure.trace.described is None for each in functions)


def _primal(leaf: Any) -> Any:
    """The number of which a derivative is being taken, if one is."""
    return getattr(leaf, "primal", leaf) if isinstance(leaf, Tracer) else leaf


def _floats(tree: Any) -> list[Any]:
    """The floats of a tree, of which derivatives are taken."""
    kinds = ((leaf, jnp.result_type(leaf)) for leaf in jax.tree.leaves(tree))
    return [leaf for leaf, kind in kinds if jnp.issubdtype(kind, jnp.floating)]


def _require_bound(function: Any, name: str) -> None:
    """Raise an error for a module of flax linen whose parameters are elsewhere."""
    kinds = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(function).__mro__)
    if "flax.linen.module.Module" in kinds and getattr(function, "scope", True) is None:
        raise TypeError(
            f"{name} must be a function, but a linen module without its parameters arrived: give "
            "jax.tree_util.Partial(module.apply, params)"
        )
