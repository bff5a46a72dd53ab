"""What is logged, under the name `reachjax`: calls that begin and end, and long compilations.

A library prints nothing: whoever wants lines gives the logger a handler, such as by
`logging.basicConfig(level=logging.INFO)`.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.core import Tracer

LOGGER = logging.getLogger("reachjax")
LOGGER.addHandler(logging.NullHandler())

LONG = 3.0
"""Compilations of fewer seconds are not worth a line."""

COMPILED = "/jax/core/compile/backend_compile_duration"
"""What JAX calls the seconds that a compilation took."""

Called = TypeVar("Called", bound=Callable[..., Any])

_within = ContextVar("_within", default=False)


def logged(function: Called) -> Called:
    """The function, whose calls are logged; those that it makes itself are not.

    Example:
        >>> logged(lambda: 3)()
        3
    """

    @functools.wraps(function)
    def called(*given: Any, **named: Any) -> Any:
        _listen()
        if _within.get():
            return function(*given, **named)
        name, began, how = function.__name__, time.perf_counter(), "was stopped"
        LOGGER.info("%s begins", name)
        token = _within.set(True)
        try:
            found = function(*given, **named)
            how = "ended"
            return found
        finally:
            _within.reset(token)
            LOGGER.info("%s %s after %.1f s", name, how, time.perf_counter() - began)

    return called  # type: ignore[return-value]


def unlogged(function: Called) -> Called:
    """The function, of which only compilations are logged: it is called again and again."""

    @functools.wraps(function)
    def called(*given: Any, **named: Any) -> Any:
        _listen()
        if isinstance(jnp.zeros(()), Tracer):
            LOGGER.info("%s is traced, and then compiled: once for these shapes", function.__name__)
        token = _within.set(True)
        try:
            return function(*given, **named)
        finally:
            _within.reset(token)

    return called  # type: ignore[return-value]


@functools.lru_cache(maxsize=1)
def _listen() -> None:
    """Hear of every compilation from now on."""
    jax.monitoring.register_event_duration_secs_listener(_heard)


def _heard(event: str, duration_secs: float, **about: Any) -> None:
    if event == COMPILED and duration_secs >= LONG:
        name = about.get("fun_name", "a function")
        LOGGER.info("JAX has compiled %s in %.1f s: once for these shapes", name, duration_secs)
