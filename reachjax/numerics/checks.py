"""Checks of what users pass in: errors name the argument, what was expected and what arrived."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Kind = TypeVar("Kind")


def is_concrete(*trees: Any) -> bool:
    """Whether every leaf holds numbers, and none stands for them inside `jax.jit` or `vmap`."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def is_staged() -> bool:
    """Whether what is computed now is recorded, to be compiled with what is around it."""
    return isinstance(jnp.zeros(()), Tracer)


def evaluated(*trees: Any) -> AbstractContextManager[Any]:
    """A scope: what is computed in it from known numbers is known, inside `jax.jit` as well."""
    return jax.ensure_compile_time_eval() if is_concrete(*trees) else nullcontext()


def owned(tree: Any) -> Any:
    """The tree with every concrete leaf as an array that shares memory with none that exists.

    `jnp.asarray` and `jax.device_put` keep aligned numpy arrays as they are, so what is written
    into these later would change objects that were built from them. Leaves that are sharded over
    devices come to one of them; traced ones are left alone. A leaf that is there more than once is
    copied once.
    """
    leaves, structure = jax.tree.flatten(tree)
    known = {id(leaf): leaf for leaf in leaves if not isinstance(leaf, Tracer)}
    origins = list(known.values())
    copies = dict(zip(known, _placed([np.array(leaf) for leaf in origins], origins), strict=True))
    return jax.tree.unflatten(structure, [copies.get(id(leaf), leaf) for leaf in leaves])


def _placed(arrays: list[np.ndarray], origins: list[Any]) -> list[jax.Array]:
    """Arrays of JAX's that own their numbers, each on the device that its origin was put on.

    `jnp.array` and `jnp.asarray` compile a copy for each shape; this compiles nothing.
    """
    devices = [_device(origin) for origin in origins]
    with jax.ensure_compile_time_eval():  # a constant stays one inside jax.jit
        if not any(devices):  # all in one call, for each takes its time
            return jax.device_put(arrays)
        return [jax.device_put(*pair) for pair in zip(arrays, devices, strict=True)]


def _device(origin: Any) -> jax.sharding.Sharding | None:
    """Where an array was put; None of one that is nowhere in particular, or on several devices."""
    single = jax.sharding.SingleDeviceSharding
    stays = isinstance(origin, jax.Array) and isinstance(origin.sharding, single)
    return origin.sharding if stays and origin.committed else None


EXACT = 2**53
"""Whole numbers up to this one are numbers of float64."""


class Numbers:
    """Converts what a user passes to a finite floating-point array of an expected shape.

    The array is a copy, on one device, and no number is rounded to become one of float64.

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
            ValueError: `value` has another number of axes, holds NaN or infinity or a number that
                is none of float64, or is traced and sharded over devices.
        """
        expected = f"{name} must be an array of shape {self.expected}"
        try:
            array = as_floats(value, name)
        except (TypeError, RuntimeError) as error:
            kind = type(value).__name__
            raise TypeError(f"{expected}, but a {kind} arrived: {error}") from None
        if array.ndim not in self.ndims or array.size == 0:
            raise ValueError(f"{expected}, but one of shape {array.shape} arrived")
        if is_concrete(array) and not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(np.asarray(array)))[0])
            raise ValueError(f"{name} must be finite, but entry {where} is {array[where]}")
        return array


def as_floats(value: Any, name: str) -> jax.Array:
    """`value` as an array of floats that has its own memory, all numbers as they are.

    Raises:
        TypeError: `value` is not numeric, or it is ragged.
        ValueError: float64 does not hold one of its numbers, or it is traced and sharded.
    """
    require_exact(value, name)
    if isinstance(value, Tracer):
        _require_one_device(value, name)
        return jnp.asarray(value, dtype=float)
    try:
        if is_concrete(value):
            array = np.array(value)
            if array.dtype.kind in "biuf":
                floats = array.astype(jax.dtypes.canonicalize_dtype(float))
                return _placed([floats], [value])[0]
        return jnp.array(value, dtype=float)
    except ValueError as error:
        raise TypeError(str(error)) from None


def require_exact(value: Any, name: str) -> None:
    """Raise an error where a conversion to float64 would change a number.

    Raises:
        TypeError: there is text, a date, or a complex number (it would be cut to its real part).
        ValueError: float64 does not hold a number.
    """
    for leaf in jax.tree.leaves(value):
        changed = _first_changed(leaf)
        if changed is not None:
            number = repr(changed) if len(repr(changed)) < 80 else f"{repr(changed)[:60]}..."
            raise ValueError(
                f"{name} must hold numbers of float64, but {number} is none: the nearest one is "
                f"{_nearest(changed)!r}; give that one if it will do"
            )


def _first_changed(leaf: Any) -> Any:
    """The first number that a conversion to float64 would change; None if it changes none."""
    if isinstance(leaf, float | Tracer):
        return None
    if isinstance(leaf, str | bytes):
        raise TypeError("it is text")
    if isinstance(leaf, complex):
        raise TypeError("its entries are complex")
    if np.ma.is_masked(leaf):
        raise TypeError("some of its entries are masked")
    kind = getattr(leaf, "dtype", None)
    foreign = not isinstance(kind, np.dtype) and not isinstance(leaf, int | jax.Array)
    if foreign and hasattr(leaf, "__array__"):  # such as a tensor, whose dtype is its own
        leaf = np.asarray(leaf)
        kind = leaf.dtype
    if kind is None:
        return None if _held(leaf) else leaf
    if jnp.issubdtype(kind, jnp.complexfloating):
        raise TypeError("its entries are complex")
    code, size = getattr(kind, "kind", ""), kind.itemsize
    if code in "USMm":
        raise TypeError(f"its entries are of type {kind}, which are no numbers")
    if code == "O":
        found = (_first_changed(entry) for entry in np.asarray(leaf).ravel())
        return next((entry for entry in found if entry is not None), None)
    if code in "iu" and size == 8:
        array = np.asarray(leaf)
        large = array[(array > EXACT) | (array < -EXACT)].tolist()
        return next((entry for entry in large if not _held(entry)), None)
    if code == "f" and size > 8:
        array = np.asarray(leaf)
        with np.errstate(over="ignore"):
            changed = array[(array.astype(float) != array) & (array == array)]
        return changed.flat[0] if changed.size else None
    return None


def _held(number: Any) -> bool:
    """Whether float64 holds a number such as an `int` or a `Fraction`; True of what is none."""
    try:
        return bool(float(number) == number)
    except OverflowError:
        return False
    except (TypeError, ValueError):
        return True  # the conversion will say what it is


def _nearest(number: Any) -> float:
    try:
        return float(number)
    except OverflowError:
        return float("inf" if number > 0 else "-inf")


def _require_one_device(value: Tracer, name: str) -> None:
    """Inside `jax.jit` an array that is sharded explicitly cannot be brought to one device."""
    over = [axis for axis in jax.typeof(value).sharding.spec if axis is not None]
    if over:
        raise ValueError(
            f"{name} must not be sharded, but it is over the mesh axes {over}: gather it before, "
            "by jax.device_get, or inside jax.jit by jax.sharding.reshard"
        )


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
    require_exact(value, name)
    return float(array)


def require_kind(
    name: str, value: Any, kind: type[Kind] | tuple[type[Kind], ...], expected: str
) -> Kind:
    """The value; a `TypeError` that says what was expected if it is of another kind."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {expected}, but {described(value)} arrived")
    return value


def wrapped(progress: Any, items: Iterable[Any]) -> Iterable[Any]:
    """The items as a progress bar passes them on; as they are where there is none.

    The bar itself is returned, which may show notes: an iterator over it does not.

    Raises:
        TypeError: the bar returns nothing that can be iterated over.
    """
    if progress is None:
        return items
    shown = progress(items)
    if not (hasattr(shown, "__iter__") or hasattr(shown, "__getitem__")):
        raise TypeError(
            "progress must return an iterable over what it wraps, as tqdm.tqdm does, but "
            f"{described(shown)} arrived"
        )
    return shown


def require_bar(progress: Any) -> None:
    """Check that a progress bar is None or can be called.

    Raises:
        TypeError: it is neither.
    """
    if progress is not None and not callable(progress):
        raise TypeError(
            f"progress must wrap an iterable, as tqdm.tqdm does, but {progress!r} arrived"
        )


def require_executor(executor: Any) -> None:
    """Check that an executor is None or has the interface of those of `concurrent.futures`.

    Raises:
        TypeError: it is neither.
    """
    if executor is not None and (
        isinstance(executor, type) or not callable(getattr(executor, "submit", None))
    ):
        raise TypeError(
            "executor must be an object with a method submit, as those of concurrent.futures are, "
            f"but {described(executor)} arrived"
        )


def described(value: Any) -> str:
    """A short word for what arrived: classes and plain values as they are, objects by kind."""
    if isinstance(value, type | str | int | float | list | None):
        return repr(value) if len(repr(value)) < 80 else type(value).__name__
    kind, library = type(value).__name__, type(value).__module__
    article = "an" if kind == "MLP" or kind[0] in "AEIO" else "a"
    known = library.partition(".")[0] in ("reachjax", "builtins", "jax", "jaxlib", "numpy")
    return f"{article} {kind}" + ("" if known else f" of {library}")


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
            kind = getattr(leaf, "dtype", None) or jnp.result_type(leaf)
            if kind != jnp.float64:
                raise RuntimeError(
                    f"{name} holds {kind}, but float64 is needed: {remedy}, and build it again if "
                    "it was built before"
                )


def floats_of(tree: Any) -> list[Any]:
    """The leaves that hold no whole numbers."""
    leaves = jax.tree.leaves(tree)
    return [leaf for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]
