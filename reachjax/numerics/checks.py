"""Checks of what users pass in: errors name the argument, what was expected and what arrived."""

from __future__ import annotations

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def is_concrete(*trees: Any) -> bool:
    """Whether every leaf holds numbers, and none stands for them inside `jax.jit` or `vmap`."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


class Numbers:
    """Converts what a user passes to a finite floating-point array of an expected shape.

    Args:
        shapes: the shapes that are allowed, in words: each is one axis name for each axis, such as
            `"(time, n)"`. Only the number of axes is checked.
    """

    def __init__(self, *shapes: str):
        self.expected = " or ".join(shapes)
        self.ndims = {shape.count(",") + (not shape.endswith(",)")) for shape in shapes}

    def __call__(self, value: Any, name: str = "value") -> jax.Array:
        """Convert `value`, which errors call `name`.

        Raises:
            TypeError: `value` is not numeric.
            ValueError: `value` has another number of axes, or holds NaN or infinity.
        """
        expected = f"{name} must be an array of shape {self.expected}"
        try:
            if any(_is_complex(leaf) for leaf in jax.tree.leaves(value)):
                raise TypeError("its entries are complex")
            array = jnp.asarray(value, dtype=float)
        except (TypeError, ValueError, RuntimeError) as error:
            kind = type(value).__name__
            raise TypeError(f"{expected}, but a {kind} arrived: {error}") from None
        if array.ndim not in self.ndims or array.size == 0:
            raise ValueError(f"{expected}, but one of shape {array.shape} arrived")
        if is_concrete(array) and not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(np.asarray(array)))[0])
            raise ValueError(f"{name} must be finite, but entry {where} is {array[where]}")
        return array


def _is_complex(leaf: Any) -> bool:
    """A number or an array of complex numbers, which a conversion would cut to their real parts."""
    return isinstance(leaf, complex) or getattr(getattr(leaf, "dtype", None), "kind", "") == "c"


def whole_number(name: str, value: Any, least: int) -> int:
    """`value` as an `int` of at least `least`.

    Raises:
        TypeError: it is no whole number.
        ValueError: it is smaller.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be a whole number, but {value!r} arrived")
    if number < least:
        raise ValueError(f"{name} must be at least {least}, but {number} arrived")
    return number


def real_number(name: str, value: Any, least: float) -> float:
    """`value` as a finite `float` of at least `least`.

    Raises:
        TypeError: it is no number.
        ValueError: it is smaller, NaN or infinite.
    """
    array = np.asarray(value) if is_concrete(value) else None
    if array is None or array.shape != () or array.dtype.kind not in "iuf":
        raise TypeError(f"{name} must be a number, but {described(value)} arrived")
    if not (np.isfinite(array) and array >= least):
        raise ValueError(f"{name} must be finite and at least {least:g}, but {array} arrived")
    return float(array)


def require_kind(name: str, value: Any, kind: type, expected: str) -> None:
    """Raise a `TypeError` that says what was expected if `value` is of another kind."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {expected}, but {described(value)} arrived")


def require_bar(progress: Any) -> None:
    """Check that a progress bar is None or can be called.

    Raises:
        TypeError: it is neither.
    """
    if progress is not None and not callable(progress):
        raise TypeError(
            f"progress must wrap an iterable, as tqdm.tqdm does, but {progress!r} arrived"
        )


def described(value: Any) -> str:
    """A short word for what arrived: classes and plain values as they are, objects by kind."""
    if isinstance(value, type | str | int | float | list | None):
        return repr(value) if len(repr(value)) < 80 else type(value).__name__
    kind = type(value).__name__
    return f"{'an' if kind == 'MLP' or kind[0] in 'AEIO' else 'a'} {kind}"


def same_size(expected: str, arrived: str, sizes: tuple[int | None, int | None]) -> None:
    """Raise a `ValueError` built from both sides when the two sizes differ."""
    if sizes[0] != sizes[1]:
        raise ValueError(f"{arrived} {sizes[1]}, but {expected} {sizes[0]}")


def within_time_axis(name: str, t: Any, steps: int) -> None:
    """Raise a `ValueError` where a number `t` is beyond a time axis: JAX would clamp it."""
    if isinstance(t, int | np.integer) and not 0 <= t < steps:
        raise ValueError(f"{name} is given for times 0 .. {steps - 1}, but {t} was asked for")


def require_double_precision(**arguments: Any) -> None:
    """Certificates need 64-bit floats: say how to turn them on when they are off.

    Raises:
        RuntimeError: JAX's 64-bit mode is off, or an argument was built while it was off.
    """
    remedy = 'call jax.config.update("jax_enable_x64", True) before building networks and sets'
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(f"reachability needs 64-bit floats, but JAX's are off: {remedy}")
    for name, tree in arguments.items():
        for leaf in jax.tree.leaves(tree):
            if jnp.result_type(leaf) != jnp.float64:
                kind = jnp.result_type(leaf)
                raise RuntimeError(f"{name} holds {kind}, but float64 is needed: {remedy}")
