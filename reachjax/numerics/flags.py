"""JAX's strict flags, under which everything here works as it does without them.

With `jax_numpy_rank_promotion="raise"` or `jax_numpy_dtype_promotion="strict"` JAX refuses what
mathematics writes every day: a vector beside a matrix, a whole number beside a real one. They are
meant for the code of those who set them. So whatever is public opens a scope with JAX's own rules;
the flags stay as they are for everybody else. So does `jax_default_matmul_precision`, which may
have products of 64-bit floats computed in a few bits: bounds would be none.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import FunctionType
from typing import Any, TypeVar

import jax

COUNTS = "dimension", "steps", "states", "inputs", "count", "units", "unit_inputs"
"""Properties that count something."""

LOOKED_UP = "parts", "intervals", "alone", "summary", "is_disturbed", "curved", "at", "widths"
"""What says something of an object, or is a part of it, and computes nothing."""

STAGES = "measured", "projected", "pushed", "moved"
"""Stages of a step, which runs them in the scope that it opened."""

EXACT = "highest"
"""The precision of products in which 64-bit floats are not rounded before they are multiplied."""

PLAIN = {*COUNTS, *LOOKED_UP, *STAGES}

Called = TypeVar("Called", bound=Callable[..., Any])


def _as_usual() -> bool:
    """Whether arrays and numbers of all kinds may stand beside one another, and products are exact.

    As exact as 64-bit floats are.
    """
    config: Any = jax.config
    ranks, kinds = config.jax_numpy_rank_promotion, config.jax_numpy_dtype_promotion
    products = config.jax_default_matmul_precision
    return ranks != "raise" and kinds == "standard" and products in (None, EXACT)


def lenient(function: Called) -> Called:
    """The function, in which strict flags of JAX's are off.

    Example:
        >>> import jax.numpy as jnp
        >>> with jax.numpy_rank_promotion("raise"):
        ...     lenient(lambda: jnp.ones((2, 3)) * jnp.ones(3))().shape
        (2, 3)
    """

    @functools.wraps(function)
    def called(*given: Any, **named: Any) -> Any:
        if _as_usual():
            return function(*given, **named)
        with (
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
            jax.default_matmul_precision(EXACT),
        ):
            return function(*given, **named)

    return called  # type: ignore[return-value]


def made_lenient(cls: type) -> None:
    """Let the public methods and properties that a class defines be `lenient`.

    Those need no scope in which no numbers meet, or that run in that of another one.
    """
    for name, value in list(vars(cls).items()):
        if name in PLAIN or (name.startswith("_") and name not in ("__call__", "__post_init__")):
            continue
        if isinstance(value, FunctionType):
            setattr(cls, name, lenient(value))
        elif isinstance(value, classmethod):
            setattr(cls, name, classmethod(lenient(value.__func__)))
        elif isinstance(value, property) and value.fget is not None:
            setattr(cls, name, property(lenient(value.fget), doc=value.__doc__))
