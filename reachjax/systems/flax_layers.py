"""Reading the weights of flax networks, nnx modules and linen parameters alike.

flax keeps kernels as `(inputs, outputs)`; here a layer is `(W, b)` with `W = kernel.T`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import jax.numpy as jnp
from flax import nnx


def flax_layers(source: Any) -> list[tuple[Any, Any]]:
    """The pairs `(W, b)` of a flax network in the order of the forward pass.

    Raises:
        TypeError: `source` is neither an nnx module nor a mapping of linen parameters.
        ValueError: a parameter does not belong to a linear layer.
    """
    if isinstance(source, nnx.Module):
        return [_layer(linear.kernel[...], _bias(linear)) for linear in _linears(source, set())]
    if isinstance(source, Mapping):
        params = source.get("params", source)
        return [_linen_layer(name, params[name]) for name in sorted(params, key=_natural)]
    raise TypeError(
        "source must be a flax nnx module or the parameters of a linen module, "
        f"but {type(source).__name__} arrived"
    )


def _layer(kernel: Any, bias: Any) -> tuple[Any, Any]:
    return kernel.T, jnp.zeros(kernel.shape[1], kernel.dtype) if bias is None else bias


def _bias(linear: nnx.Linear) -> Any:
    return None if linear.bias is None else linear.bias[...]


def _linears(node: Any, seen: set[int]) -> Iterator[nnx.Linear]:
    """Linear layers in the order of assignment, through lists and submodules."""
    if id(node) in seen:
        raise ValueError("source uses one layer more than once; give its layers by from_layers")
    if isinstance(node, nnx.Linear):
        seen.add(id(node))
        yield node
    elif isinstance(node, nnx.Module):
        seen.add(id(node))
        for name, child in vars(node).items():
            if isinstance(child, nnx.Variable):
                raise ValueError(
                    f"source holds the parameter {name!r} in {type(node).__name__}, "
                    "which is not a linear layer; give its layers by from_layers"
                )
            yield from _linears(child, seen)
    elif isinstance(node, list | tuple | nnx.List):
        for child in node:
            yield from _linears(child, seen)


def _natural(name: str) -> tuple[Any, ...]:
    """Order `Dense_10` behind `Dense_2`."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name))


def _linen_layer(name: str, layer: Any) -> tuple[Any, Any]:
    if not isinstance(layer, Mapping) or not set(layer) <= {"kernel", "bias"}:
        held = sorted(layer) if isinstance(layer, Mapping) else type(layer).__name__
        raise ValueError(
            f"linen layer {name!r} must hold a kernel and perhaps a bias, but it holds {held}"
        )
    return _layer(layer["kernel"], layer.get("bias"))
