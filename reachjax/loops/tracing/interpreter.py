"""A jaxpr, equation by equation: calls, loops and branches are followed where they need to be.

What depends on constants and parameters alone is computed here and nowhere else, in one order, by
everybody who follows a jaxpr: so a function that is simulated has the same numbers in it as one
that is certified, however XLA would have rounded them.
"""

from __future__ import annotations

import abc
import importlib.util
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from reachjax.loops.tracing.dependence import CALLS, OWN_SLOPES, body_of, rounds, rounds_within
from reachjax.loops.tracing.values import Operand, Parameter, UnsupportedError, is_known

TURNS = 1000
"""A loop that takes more turns than this is taken to be endless."""


PASSED = ("copy", "copy_p", "optimization_barrier", "stop_gradient")
"""Primitives whose results are their operands, of whatever kind."""


class Constants:
    """The numbers of a function that depend on its parameters alone and are rounded.

    They are told apart by where they are computed: a reader that knows more of the inputs takes
    other branches, and finds results plain that another one takes to depend on them.

    Args:
        known: those that are known; the others are computed.
        places: where operands depend on no input, whoever reads the function; None if everybody
            who reads finds the same.

    Attributes:
        computed: those that were, and of the known ones those that were asked for.
        visited: the places of all that was asked for.
    """

    def __init__(
        self,
        known: Mapping[str, Sequence[Any]] | None = None,
        places: Collection[str] | None = None,
    ):
        self.computed: dict[str, list[Any]] = {}
        self.visited: set[str] = set()
        self._known, self._places = known or {}, places

    def have(self, equation: Any, place: str) -> bool:
        """Whether what an equation makes of plain operands is the same in a simulation.

        It is none of these constants where a reader has found out that its operands are plain, as
        `jnp.where(x == x, p, 0.0)` is: XLA computes it together with what depends on inputs.
        """
        return self._places is None or place in self._places or not rounds(equation)

    def of(self, equation: Any, operands: Sequence[Any], place: str) -> list[Any]:
        """The results of an equation, at a place, whose operands are plain."""
        self.visited.add(place)
        own = any(isinstance(each, Parameter) or not is_known(each) for each in operands)
        if not own or not rounds(equation):
            return _evaluated(equation, operands)
        if place in self._known:
            found = [*map(Parameter.of, self._known[place])]
        else:
            found = _evaluated(equation, operands)
        self.computed[place] = found
        return found


class Interpreter(abc.ABC):
    """A way to read a jaxpr.

    Args:
        constants: its numbers that depend on parameters alone.

    Attributes:
        follows_all: whether it reads jaxprs within equations also where these may stay as they are,
            since nothing is rounded in them that depends on no input.
        has_effects: whether equations that no result depends on are evaluated, such as prints.
    """

    follows_all = False
    has_effects = False

    def __init__(self, constants: Constants):
        self._constants = constants
        self._place = ""

    @abc.abstractmethod
    def is_plain(self, operand: Operand) -> bool:
        """Whether an operand depends on no input."""

    @abc.abstractmethod
    def apply(self, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
        """What an equation makes of operands some of which depend on inputs."""

    @abc.abstractmethod
    def entry(self, operand: Operand, k: int) -> Operand:
        """An entry along the first axis of what depends on inputs."""

    @abc.abstractmethod
    def stacked(self, column: Sequence[Operand]) -> Operand:
        """Operands, some of which depend on inputs, as one."""

    def varying(self, operand: Operand) -> Operand:
        """A plain operand as one that depends on inputs, where there are such numbers."""
        return operand

    def whole(self, equation: Any, operands: Sequence[Operand]) -> list[Operand] | None:
        """The results of a call that is known as a whole; None if it is followed."""
        return None

    @abc.abstractmethod
    def either(self, which: Operand, cases: Sequence[Operand]) -> Operand:
        """One of several operands, by a number that depends on inputs."""

    def entering(
        self, which: Operand, count: int, operands: Sequence[Operand]
    ) -> Sequence[Sequence[Operand]]:
        """The operands of each of some branches, by a number that depends on inputs."""
        return [operands] * count

    def walk(self, closed: Any, operands: Sequence[Operand], turn: int = 0) -> list[Operand]:
        """What a jaxpr makes of operands.

        Args:
            closed: the jaxpr.
            operands: as many as it has arguments.
            turn: which one it is, of several within one equation.

        Raises:
            UnsupportedError: some of it is not supported.
        """
        jaxpr = getattr(closed, "jaxpr", closed)
        known: dict[Any, Operand] = {}
        constants = getattr(closed, "consts", ())
        known.update(zip(jaxpr.constvars, map(_plain, constants), strict=True))
        known.update(zip(jaxpr.invars, operands, strict=True))

        def read(variable: Any) -> Operand:
            return _plain(variable.val) if isinstance(variable, core.Literal) else known[variable]

        needed, around = _needed(jaxpr), self._place
        for number, equation in enumerate(jaxpr.eqns):
            if number not in needed and not self.has_effects:
                continue
            given = [read(each) for each in equation.invars]
            self._place = f"{around}/{turn}.{number}"
            try:
                found = (self._made if number in needed else self._beside)(equation, given)
            except UnsupportedError as error:
                raise located(error, equation) from None
            known.update(zip(equation.outvars, found, strict=True))
        self._place = around
        return [read(each) for each in jaxpr.outvars]

    def _made(self, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
        """What one equation makes of its operands."""
        name, params = equation.primitive.name, equation.params
        varies = [not self.is_plain(each) for each in operands]
        if not any(varies) and not self._constants.have(equation, self._place):
            operands = [*map(self.varying, operands)]
            varies = [not self.is_plain(each) for each in operands]
        if not any(varies):
            if name in PASSED:
                return [*operands]
            return self._constants.of(equation, operands, self._place)
        whole = self.whole(equation, operands)
        if whole is not None:
            return whole
        if name not in WAYS or not (self.follows_all or rounds_within(equation, varies)):
            return self.apply(equation, operands)
        if name in OWN_SLOPES and rounds_within(equation, varies):
            raise UnsupportedError(
                "it has a derivative of its own, and computes in it what depends on parameters or "
                "constants alone: compute that before, and give it as an argument"
            )
        return WAYS[name](self, params, operands)

    def _beside(self, equation: Any, operands: Sequence[Operand]) -> list[Operand]:
        """What an equation makes on which no result depends, but what is printed may."""
        plain = all(map(self.is_plain, operands))
        return (_evaluated if plain else self.apply)(equation, operands)

    def _called(self, params: dict[str, Any], operands: Sequence[Operand]) -> list[Operand]:
        """The jaxpr of a call."""
        return self.walk(body_of(params), operands)

    def _unrolled(self, params: dict[str, Any], operands: Sequence[Operand]) -> list[Operand]:
        """A scan, step by step."""
        constants = list(operands[: params["num_consts"]])
        carry = list(operands[params["num_consts"] : params["num_consts"] + params["num_carry"]])
        streams = operands[params["num_consts"] + params["num_carry"] :]
        length, rows = params["length"], []
        order = range(length)[::-1] if params["reverse"] else range(length)
        for k in order:
            given = [
                _row(each, k) if self.is_plain(each) else self.entry(each, k) for each in streams
            ]
            found = self.walk(params["jaxpr"], [*constants, *carry, *given], k)
            carry, row = found[: len(carry)], found[len(carry) :]
            rows.append(row)
        if not rows:
            empty = params["jaxpr"].out_avals[len(carry) :]
            return [*carry, *(np.zeros((0, *each.shape), each.dtype) for each in empty)]
        rows = rows[::-1] if params["reverse"] else rows
        return [*carry, *(self._column(column) for column in zip(*rows, strict=True))]

    def _column(self, column: Sequence[Operand]) -> Operand:
        if not all(map(self.is_plain, column)):
            return self.stacked(column)
        if not all(isinstance(each, np.ndarray | np.generic) for each in column):
            return jnp.stack(column)
        own = any(isinstance(each, Parameter) for each in column)
        found = np.stack([np.asarray(each) for each in column])
        return Parameter.of(found) if own else found

    def _repeated(self, params: dict[str, Any], operands: Sequence[Operand]) -> list[Operand]:
        """A loop whose condition is known."""
        first, second = params["cond_nconsts"], params["body_nconsts"]
        asked, done = operands[:first], operands[first : first + second]
        carry = list(operands[first + second :])
        for turn in range(0, 2 * TURNS, 2):
            (goes_on,) = self.walk(params["cond_jaxpr"], [*asked, *carry], turn)
            if not self.is_plain(goes_on) or not is_known(goes_on):
                raise UnsupportedError(
                    "how often it repeats must not depend on inputs or traced parameters: use "
                    "jax.lax.fori_loop between known numbers, or jax.lax.scan"
                )
            if not bool(np.asarray(goes_on)):
                return carry
            carry = self.walk(params["body_jaxpr"], [*done, *carry], turn + 1)
        raise UnsupportedError(f"it has not ended after {TURNS} turns: use a loop of fewer")

    def _branch(self, params: dict[str, Any], operands: Sequence[Operand]) -> list[Operand]:
        """The one that is taken; where inputs decide, all are, and one of their results."""
        which, *given = operands
        branches = params["branches"]
        if not self.is_plain(which):
            entering = self.entering(which, len(branches), given)
            found = [
                self.walk(branch, own, k)
                for k, (branch, own) in enumerate(zip(branches, entering, strict=True))
            ]
            return [self.either(which, cases) for cases in zip(*found, strict=True)]
        if not is_known(which):
            raise UnsupportedError(
                "which branch is taken must not depend on traced parameters: use jnp.where "
                "between functions that agree where it changes"
            )
        k = int(np.clip(which, 0, len(branches) - 1))
        return self.walk(branches[k], given, k)


WAYS: dict[str, Callable[..., list[Operand]]] = {
    "scan": Interpreter._unrolled,
    "while": Interpreter._repeated,
    "cond": Interpreter._branch,
    **dict.fromkeys((*CALLS, *OWN_SLOPES), Interpreter._called),
}
"""How equations with jaxprs of their own are followed."""


def _needed(jaxpr: Any) -> set[int]:
    """The numbers of the equations that results depend on."""
    used = {each for each in jaxpr.outvars if not isinstance(each, core.Literal)}
    found = set()
    for number, equation in reversed([*enumerate(jaxpr.eqns)]):
        if used.intersection(equation.outvars):
            used.update(each for each in equation.invars if not isinstance(each, core.Literal))
            found.add(number)
    return found


def _plain(value: Any) -> Any:
    """A constant; numpy's if it is known, so that it stays so where others are traced."""
    if isinstance(value, jax.Array):
        is_key = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        return value if is_key or not is_known(value) else np.asarray(value)
    return np.asarray(value)


def _evaluated(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """What an equation makes of plain arrays: in numpy's, if they are."""
    own = any(isinstance(each, Parameter) for each in operands)
    given = [*map(_bare, operands)]
    if not is_known(*given):
        return bound(equation, given)
    with jax.ensure_compile_time_eval():  # known numbers stay known where others are traced
        is_call = equation.primitive.name in OWN_SLOPES  # numbers have no slopes
        body = core.jaxpr_as_fun(body_of(equation.params)) if is_call else None
        found = bound(equation, given) if body is None else body(*given)
    if not all(isinstance(each, np.ndarray | np.generic | float | int) for each in operands):
        return found
    return [Parameter.of(each) if own else np.asarray(each) for each in found]


def _bare(plain: Any) -> Any:
    return np.asarray(plain) if isinstance(plain, Parameter) else plain


def bound(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """The results of an equation for arrays."""
    primitive, params = equation.primitive, equation.params
    if primitive.name in OWN_SLOPES:
        return _with_own_slopes(equation, operands)
    with equation.ctx.manager:
        found = primitive.bind(*operands, **params)
    return list(found) if primitive.multiple_results else [found]


def _with_own_slopes(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """The results of a call that has a derivative of its own."""
    given = {
        each: value
        for each, value in zip(equation.invars, operands, strict=True)
        if not isinstance(each, core.Literal)
    }
    body = body_of(equation.params)
    jaxpr = getattr(body, "jaxpr", body).replace(
        constvars=[], invars=[*given], outvars=equation.outvars, eqns=[equation]
    )
    return core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, []))(*given.values())


def located(error: UnsupportedError, equation: Any) -> UnsupportedError:
    """An error that tells of which equation it speaks."""
    error.primitive = error.primitive or equation.primitive.name
    error.line = error.line or line_of(equation)
    return error


@lru_cache(maxsize=1)
def _folders() -> tuple[Path, ...]:
    """Where packages are whose lines are none of a user's."""
    found = [Path(__file__).parent]
    for name in ("jax", "jaxlib", "flax", "equinox", "optax"):
        spec = importlib.util.find_spec(name)
        found += map(Path, (spec and spec.submodule_search_locations) or ())
    return tuple(found)


@lru_cache(maxsize=1024)
def _is_a_users(file: str) -> bool:
    """Whether a file is in none of these folders."""
    return not any(Path(file).is_relative_to(each) for each in _folders())


def line_of(equation: Any) -> str:
    """Where a user wrote it: ` (in NAME, FILE:LINE)`; nothing where that is not known."""
    frames = getattr(equation.source_info.traceback, "frames", ())
    for frame in frames:
        if _is_a_users(frame.file_name):
            return f" (in {frame.function_name}, {frame.file_name}:{frame.line_num})"
    return ""


def _row(plain: Any, k: int) -> Any:
    """An entry along the first axis; numpy makes a number of an entry, which is marked again."""
    return Parameter.of(plain[k]) if isinstance(plain, Parameter) else plain[k]
