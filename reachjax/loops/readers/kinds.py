"""ONNX's kinds of numbers, and casts between them as its standard has them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

FLOAT, BOOL, FLOAT16, DOUBLE, BFLOAT16 = 1, 9, 10, 11, 16

KINDS: dict[int, np.dtype] = {
    FLOAT: np.dtype("f4"),
    2: np.dtype("u1"),
    3: np.dtype("i1"),
    4: np.dtype("u2"),
    5: np.dtype("i2"),
    6: np.dtype("i4"),
    7: np.dtype("i8"),
    BOOL: np.dtype(bool),
    FLOAT16: np.dtype("f2"),
    DOUBLE: np.dtype("f8"),
    12: np.dtype("u4"),
    13: np.dtype("u8"),
    BFLOAT16: np.dtype(jnp.bfloat16),
}
"""Kinds of numbers by the number that ONNX gives them."""

WHOLE = (6, 7)
"""Whole numbers of 32 and of 64 bits, which are what they are for any network."""

REAL = (FLOAT, DOUBLE)
"""Kinds in which a runtime computes nearly what is certified; 16 bits round by a part in 2,000."""


def is_float(kind: np.dtype) -> bool:
    """Whether numbers of a kind are floats; bfloat16 is none of numpy's own."""
    return kind.kind == "f" or kind == KINDS[BFLOAT16]


def kind_name(number: int) -> str:
    """The name of a kind, also of one that is not known here."""
    import onnx

    known = onnx.TensorProto.DataType.values()
    return onnx.TensorProto.DataType.Name(number) if number in known else f"kind {number}"


def cast(x: np.ndarray, kind: np.dtype) -> np.ndarray:
    """Known numbers in another kind: whole ones wrap, floats are rounded or cut off.

    Raises:
        ValueError: the standard leaves open what becomes of them, as of a float that is too large
            for a whole number.
    """
    if is_float(x.dtype) and kind.kind in "iu":
        cut, limits = np.trunc(x.astype(float)), np.iinfo(kind)
        if not ((cut >= float(limits.min)) & (cut < float(limits.max) + 1.0)).all():
            raise ValueError(f"{x.ravel()[:4]} cannot be cast to {kind}, which has no such number")
        return cut.astype(kind)
    if kind == KINDS[BOOL]:
        return x != 0
    with np.errstate(over="ignore"):
        return x.astype(kind)


def real(x: Any) -> Any:
    """Known numbers for a function of real numbers: floats of 64 bits, all others as they are."""
    return x.astype(float) if is_float(x.dtype) else x


def quotient(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The quotient of known numbers; of whole ones it is cut off towards zero.

    Raises:
        ValueError: whole numbers are divided by zero, or their quotient is too large.
    """
    if is_float(x.dtype):
        return x / y
    if not np.all(y):
        raise ValueError("whole numbers are divided by zero")
    if x.dtype.kind == "i" and np.any((x == np.iinfo(x.dtype).min) & (y == -1)):
        raise ValueError("the quotient of whole numbers is too large for their kind")
    floor = x // y
    return (floor + ((x - floor * y != 0) & ((x < 0) != (y < 0)))).astype(x.dtype)


def power(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Powers of known numbers, of the kind of the base.

    Raises:
        ValueError: a whole number has an exponent that is not whole, or negative.
    """
    if is_float(x.dtype):
        return np.power(x, y.astype(x.dtype))
    if (y != np.trunc(y.astype(float))).any() or (y < 0).any():
        raise ValueError("a power of whole numbers is none")
    return np.power(x, y.astype(x.dtype))
