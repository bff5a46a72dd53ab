"""ONNX's operators over numpy and `jax.numpy` alike, with the attributes of each that are known.

Defaults of attributes are the standard's own, of the version that a file is written in; an
attribute that an operator does not list here is refused. Shapes, indices and limits must be known
numbers; numbers that depend on nothing but known ones are computed once, in the file's own kinds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.readers import moving
from reachjax.loops.readers.arrays import erf, over, sigmoid, softplus
from reachjax.loops.readers.kinds import (
    BOOL,
    KINDS,
    REAL,
    WHOLE,
    cast,
    kind_name,
    power,
    quotient,
)
from reachjax.loops.readers.moving import Attributes

Compute = Callable[..., Any]
"""From attributes and operands, None for those left out, to the result, or to a list of several."""

OPSETS = range(7, 29)
"""Versions of ONNX's standard whose operators were compared with a runtime."""


class Operator(NamedTuple):
    """One of ONNX's operators.

    Attributes:
        compute: what it computes of real numbers.
        attributes: names of those that are known.
        known: places of operands that must be known numbers.
        fixed: places of operands that are no weights, wherever they can be known.
        exact: what it computes of known numbers, where that is something else.
    """

    compute: Compute
    attributes: tuple[str, ...] = ()
    known: tuple[int, ...] = ()
    fixed: tuple[int, ...] = ()
    exact: Compute | None = None


def _entrywise(name: str) -> Compute:
    return lambda attributes, *given: getattr(over(*given), name)(*given)


def _folded(name: str) -> Compute:
    """The operator of any number of operands, two at a time."""

    def compute(attributes: Attributes, *given: Any) -> Any:
        found, *rest = given
        for each in rest:
            found = getattr(over(found, each), name)(found, each)
        return found

    return compute


def _mean(attributes: Attributes, *given: Any) -> Any:
    return _folded("add")(attributes, *given) / len(given)


def _gemm(attributes: Attributes, a: Any, b: Any, c: Any = None) -> Any:
    if np.ndim(a) != 2 or np.ndim(b) != 2:
        raise ValueError(f"it takes matrices, but shapes {np.shape(a)} and {np.shape(b)} arrived")
    a = a.T if attributes["transA"] else a
    b = b.T if attributes["transB"] else b
    found = a @ b
    alpha, beta = attributes["alpha"], attributes["beta"]
    found = found if alpha == 1 else alpha * found
    return found if c is None else found + (c if beta == 1 else beta * c)


def _clip(attributes: Attributes, x: Any, low: Any = None, high: Any = None) -> Any:
    low = attributes.get("min") if low is None else low
    high = attributes.get("max") if high is None else high
    for limit in (low, high):
        if np.ndim(limit) != 0:
            raise ValueError(f"its limits must be single numbers, but {np.shape(limit)} arrived")
    x = x if low is None else over(x).maximum(x, low)
    return x if high is None else over(x).minimum(x, high)


def _expm1(x: Any) -> Any:
    """`exp(x) - 1`; in numpy's 32 bits with the digits that runtimes lose near zero."""
    if isinstance(x, np.ndarray) and x.dtype == np.float32:
        return np.exp(x) - 1
    return over(x).expm1(x)


def _elu(attributes: Attributes, x: Any) -> Any:
    return over(x).maximum(x, 0.0) + attributes["alpha"] * _expm1(over(x).minimum(x, 0.0))


def _celu(attributes: Attributes, x: Any) -> Any:
    alpha = attributes["alpha"]
    return over(x).maximum(x, 0.0) + alpha * _expm1(over(x).minimum(x, 0.0) / alpha)


def _gelu(attributes: Attributes, x: Any) -> Any:
    way = attributes["approximate"]
    if way == "tanh":
        return 0.5 * x * (1 + over(x).tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))
    if way == "none":
        return 0.5 * x * (1 + erf(x / math.sqrt(2)))
    raise ValueError(f"its attribute 'approximate' must be 'none' or 'tanh', but {way!r} arrived")


def _raised(attributes: Attributes, x: Any, exponent: Any) -> Any:
    """Powers; of one whole exponent, also those of negative numbers."""
    if isinstance(exponent, np.ndarray) and exponent.size > 0:
        first = exponent.ravel()[0]
        if (exponent == first).all() and float(first).is_integer() and abs(first) < 1000:
            spread = np.broadcast_shapes(np.shape(x), exponent.shape)
            return over(x).broadcast_to(x, spread) ** int(first)
    return over(x, exponent).power(x, exponent)


def _sloped(attributes: Attributes, x: Any, slope: Any) -> Any:
    return over(x, slope).where(x >= 0, x, slope * x)


def _dropped(attributes: Attributes, x: Any, ratio: Any = None, training: Any = None) -> Any:
    if training is not None and np.any(training):
        raise ValueError("it is in training mode, and leaves out entries at random")
    return x


def _kept(attributes: Attributes, x: Any) -> Any:
    """A cast: real numbers stay as they are between 32 and 64 bits, whole ones are cut off."""
    to = attributes["to"]
    if to in REAL:
        return x if np.issubdtype(x.dtype, np.floating) else x.astype(float)
    if to not in (*WHOLE, BOOL):
        raise ValueError(
            f"numbers that depend on the input are cast to {kind_name(to)}: only floats and whole "
            "numbers of 32 and 64 bits, and truth values, are known"
        )
    return x != 0 if to == BOOL else x.astype(KINDS[to])


def _divided(attributes: Attributes, x: Any, y: Any) -> Any:
    """A quotient; of whole numbers it is cut off towards zero."""
    if not np.issubdtype(x.dtype, np.integer):
        return over(x, y).divide(x, y)
    if over(x, y) is np:
        return quotient(x, y)
    x, y = jnp.broadcast_arrays(x, y)
    return jax.lax.div(x, y.astype(x.dtype))


def _winner(name: str) -> Compute:
    """The place of the largest or the smallest entry along an axis: the first, or the last one."""

    def compute(attributes: Attributes, x: Any) -> Any:
        axis, xp = attributes["axis"], over(x)
        if attributes.get("select_last_index", 0):
            found = np.shape(x)[axis] - 1 - getattr(xp, name)(xp.flip(x, axis), axis=axis)
        else:
            found = getattr(xp, name)(x, axis=axis)
        return xp.expand_dims(found, axis) if attributes["keepdims"] else found

    return compute


def _one_hot(attributes: Attributes, places: Any, depth: Any, values: Any) -> Any:
    """One value at a place, counted from the end if it is negative, and another one elsewhere."""
    if places.dtype.kind == "f":
        raise ValueError("its places must be whole numbers: cast them to INT64 before")
    count, xp = int(np.ravel(depth)[0]), over(places)
    places = xp.where(places < 0, places + count, places)
    off, on = np.ravel(values)
    found = xp.where(xp.expand_dims(places, -1) == np.arange(count), on, off)
    return xp.moveaxis(found, -1, attributes["axis"])


def _hardmax(attributes: Attributes, x: Any) -> Any:
    """One at the first of the largest entries, and zero elsewhere."""
    axis, xp, shape = attributes["axis"], over(x), np.shape(x)
    if attributes["opset"] < 13:  # over an axis and all behind it
        axis %= x.ndim
        x = x.reshape(math.prod(shape[:axis]), -1)
        axis = -1
    last = xp.moveaxis(x, axis, -1)
    hit = xp.expand_dims(xp.argmax(last, axis=-1), -1) == np.arange(last.shape[-1])
    return xp.moveaxis(xp.where(hit, 1.0, 0.0), -1, axis).reshape(shape)


def _einsum(attributes: Attributes, *given: Any) -> Any:
    return over(*given).einsum(attributes["equation"].replace(" ", ""), *given)


def _convolved(attributes: Attributes, x: Any, W: Any, b: Any = None) -> Any:
    """A convolution: the sum over the kernel's places of matrices times shifted inputs."""
    n, space, groups = np.ndim(x) - 2, np.shape(W)[2:], attributes["group"]
    strides, dilations = (attributes.get(k) or (1,) * n for k in ("strides", "dilations"))
    pads = attributes.get("pads") or (0,) * 2 * n
    if attributes["auto_pad"] not in ("NOTSET", "VALID"):
        raise ValueError(f"its attribute 'auto_pad' is {attributes['auto_pad']!r}: give 'pads'")
    sizes = (len(space), len(strides), len(dilations), len(pads) // 2, len(pads) - len(pads) // 2)
    if n < 1 or set(sizes) != {n} or attributes.get("kernel_shape", space) != space:
        raise ValueError("its kernel, strides, dilations and pads do not fit its operand")
    if min(*strides, *dilations, *space, groups) < 1 or min(pads) < 0:
        raise ValueError("its strides, dilations and pads must be positive")
    if np.shape(x)[1] != groups * np.shape(W)[1] or np.shape(W)[0] % groups:
        raise ValueError("the channels of its kernel do not fit its operand")
    if any(pads):
        x = over(x).pad(x, [(0, 0), (0, 0), *zip(pads[:n], pads[n:], strict=True)])
    reach = [d * (k - 1) + 1 for d, k in zip(dilations, space, strict=True)]
    counts = [
        (size - r) // s + 1 for size, r, s in zip(np.shape(x)[2:], reach, strides, strict=True)
    ]
    if min(counts) < 1:
        raise ValueError("its kernel is larger than its operand")
    moving.require_room([*counts, *np.shape(W)])
    found = []
    for inputs, kernel in zip(
        over(x).split(x, groups, 1), over(W).split(W, groups, 0), strict=True
    ):
        total = 0.0
        for place in itertools.product(*map(range, space)):
            taken = tuple(
                slice(d * k, d * k + s * (c - 1) + 1, s)
                for d, k, s, c in zip(dilations, place, strides, counts, strict=True)
            )
            part = inputs[(slice(None), slice(None), *taken)]
            matrix = kernel[(slice(None), slice(None), *place)]
            total = total + over(part, matrix).einsum("oc,bc...->bo...", matrix, part)
        found.append(total)
    joined = found[0] if groups == 1 else over(*found).concatenate(found, axis=1)
    return joined if b is None else joined + b.reshape(-1, *([1] * n))


FOLLOWED = {
    "Abs": "abs",
    "Acos": "arccos",
    "Add": "add",
    "And": "logical_and",
    "Asin": "arcsin",
    "Asinh": "arcsinh",
    "Atan": "arctan",
    "Ceil": "ceil",
    "Cos": "cos",
    "Cosh": "cosh",
    "Equal": "equal",
    "Exp": "exp",
    "Floor": "floor",
    "Log": "log",
    "MatMul": "matmul",
    "Mul": "multiply",
    "Neg": "negative",
    "Not": "logical_not",
    "Or": "logical_or",
    "Round": "round",
    "Sign": "sign",
    "Sin": "sin",
    "Sinh": "sinh",
    "Sqrt": "sqrt",
    "Sub": "subtract",
    "Tan": "tan",
    "Tanh": "tanh",
    "Xor": "logical_xor",
}
"""Operators without attributes that numpy and JAX have, and what these call them."""

REDUCED = ("axes", "keepdims", "noop_with_empty_axes")
NORMALISED = ("axis", "epsilon", "stash_type")
WINNING = ("axis", "keepdims", "select_last_index")

COMPARED = {
    "Greater": "greater",
    "GreaterOrEqual": "greater_equal",
    "Less": "less",
    "LessOrEqual": "less_equal",
}
"""Operators that choose: where they change must be known, for values to be seen to agree there."""

OPERATORS: dict[str, Operator] = {
    **{name: Operator(_entrywise(twin)) for name, twin in FOLLOWED.items()},
    **{name: Operator(_entrywise(twin), fixed=(0, 1)) for name, twin in COMPARED.items()},
    **{name: Operator(each, REDUCED, known=(1,)) for name, each in moving.REDUCTIONS.items()},
    **{name: Operator(_winner(name.lower()), WINNING) for name in ("ArgMax", "ArgMin")},
    "BatchNormalization": Operator(
        moving.batch_normalised, ("epsilon", "momentum", "training_mode", "spatial")
    ),
    "Cast": Operator(
        _kept,
        ("to", "saturate", "round_mode"),  # the last two speak of kinds of 8 bits alone
        exact=lambda attributes, x: cast(x, KINDS[attributes["to"]]),
    ),
    "Celu": Operator(_celu, ("alpha",)),
    "Clip": Operator(_clip, ("min", "max"), known=(1, 2)),
    "Concat": Operator(moving.concatenated, ("axis",)),
    "ConstantOfShape": Operator(moving.filled, ("value",), known=(0,)),
    "Conv": Operator(
        _convolved, ("auto_pad", "dilations", "group", "kernel_shape", "pads", "strides")
    ),
    "Div": Operator(_divided, exact=lambda attributes, x, y: quotient(x, y)),
    "Dropout": Operator(_dropped, ("ratio", "seed"), known=(1, 2)),
    "Einsum": Operator(_einsum, ("equation",)),
    "Elu": Operator(_elu, ("alpha",)),
    "Erf": Operator(lambda attributes, x: erf(x)),
    "Expand": Operator(moving.expanded, known=(1,)),
    "Flatten": Operator(moving.flattened, ("axis",)),
    "Gather": Operator(moving.gathered, ("axis",), fixed=(1,)),
    "Gelu": Operator(_gelu, ("approximate",)),
    "Gemm": Operator(_gemm, ("alpha", "beta", "transA", "transB")),
    "HardSigmoid": Operator(
        lambda a, x: over(x).clip(a["alpha"] * x + a["beta"], 0.0, 1.0), ("alpha", "beta")
    ),
    "Hardmax": Operator(_hardmax, ("axis",)),
    "HardSwish": Operator(lambda a, x: x * over(x).clip(x / 6 + 0.5, 0.0, 1.0)),
    "Identity": Operator(lambda attributes, x: x),
    "LayerNormalization": Operator(moving.layer_normalised, NORMALISED),
    "LeakyRelu": Operator(lambda a, x: over(x).where(x >= 0, x, a["alpha"] * x), ("alpha",)),
    "LogSoftmax": Operator(moving.LOG_SOFTMAX, ("axis",)),
    "Max": Operator(_folded("maximum")),
    "Mean": Operator(_mean),
    "Min": Operator(_folded("minimum")),
    "Mish": Operator(lambda attributes, x: x * over(x).tanh(softplus(x))),
    "OneHot": Operator(_one_hot, ("axis",), known=(1, 2)),
    "PRelu": Operator(_sloped),
    "Pow": Operator(_raised, fixed=(1,), exact=lambda attributes, x, y: power(x, y)),
    "RMSNormalization": Operator(moving.rms_normalised, NORMALISED),
    "Range": Operator(moving.ranged, known=(0, 1, 2)),
    "Reciprocal": Operator(lambda attributes, x: 1.0 / x),
    "Relu": Operator(lambda attributes, x: over(x).maximum(x, np.zeros((), x.dtype))),
    "Reshape": Operator(moving.reshaped, ("allowzero",), known=(1,)),
    "Selu": Operator(
        lambda a, x: a["gamma"] * _elu(a, x),
        ("alpha", "gamma"),
    ),
    "Shape": Operator(moving.shape_of, ("start", "end")),
    "Sigmoid": Operator(lambda attributes, x: sigmoid(x)),
    "Size": Operator(lambda attributes, x: np.array(np.size(x), np.int64)),
    "Slice": Operator(moving.sliced, ("starts", "ends", "axes"), known=(1, 2, 3, 4)),
    "Softmax": Operator(moving.SOFTMAX, ("axis",)),
    "Softplus": Operator(lambda attributes, x: softplus(x)),
    "Softsign": Operator(lambda attributes, x: x / (1 + over(x).abs(x))),
    "Split": Operator(moving.split, ("axis", "split", "num_outputs"), known=(1,)),
    "Squeeze": Operator(moving.squeezed, ("axes",), known=(1,)),
    "Sum": Operator(_folded("add")),
    "Swish": Operator(lambda a, x: x * sigmoid(a["alpha"] * x), ("alpha",)),
    "Transpose": Operator(moving.transposed, ("perm",)),
    "Unsqueeze": Operator(moving.unsqueezed, ("axes",), known=(1,)),
    "Where": Operator(_entrywise("where"), fixed=(1, 2)),
}

JUMPS = ("Ceil", "Floor", "Hardmax", "Mod", "Round", "Shrink", "Sign", "ThresholdedRelu")
"""Operators whose results jump where their operands are rounded."""

SIZES = ("Shape", "Size")
"""Operators whose results are known, whatever their operands are."""
