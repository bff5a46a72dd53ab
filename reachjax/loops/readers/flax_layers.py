"""Reading the weights of flax networks, nnx modules and linen parameters alike.

flax keeps kernels as `(inputs, outputs)`; here a layer is `(W, b)` with `W = kernel.T`.

A module does not say in which order it applies its layers, nor what it does between them. Lists and
`nnx.Sequential` do; attributes only seem to, for nnx sorts them by name when it rebuilds a module.
So a module that can be evaluated is compared with the network read from it, and one whose order
cannot be trusted is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from reachjax.loops.units import AbstractActivation, HardTanh, LeakyReLU, ReLU, Sigmoid, Tanh
from reachjax.numerics.checks import is_concrete

ADVICE = (
    "give its layers by MLP.from_layers, or the module itself to "
    "reachjax.Network(module, inputs, outputs), which takes any function of JAX that has bounds"
)

SIZES = 10.0 ** np.arange(-6, 31, 0.125)
POINTS = np.concatenate([-SIZES[::-1], [0.0], SIZES])
"""Where activations are compared: one that saturates, such as relu6, differs far out only."""

SCALES = 10.0 ** np.array([-3, 0, 1, 2, 3, 6])
"""Sizes of the inputs on which networks are compared, for the same reason."""

ROUNDED = 4e-6
"""By this part of what a layer adds up 32-bit floats may round it: some sixty roundings."""

LEAST = 1e-30
"""What is smaller than this is lost in 32-bit floats."""


def read_activation(activation: Any) -> Any:
    """The activation object that computes what a flax function does; objects are left as they are.

    Raises:
        ValueError: none of them does.
    """
    if isinstance(activation, AbstractActivation | type) or not callable(activation):
        return activation
    with jax.ensure_compile_time_eval():
        leak = -float(np.asarray(activation(jnp.asarray(-1.0))))
        known = [ReLU(), HardTanh(), Tanh(), Sigmoid()]
        if 0 <= leak < 1:
            known.append(LeakyReLU(leak))
        for each in known:
            if _agree(activation, each):
                return each
    raise ValueError(
        f"activation must compute what one of {', '.join(type(each).__name__ for each in known)} "
        f"does, but {activation!r} arrived: a module with others is a network as it is, "
        "reachjax.Network(module, inputs, outputs)"
    )


def _agree(first: Callable, second: Callable) -> bool:
    """Whether two activations compute the same."""
    with jax.ensure_compile_time_eval():
        values, others = (np.asarray(f(jnp.asarray(POINTS)), float) for f in (first, second))
    # a sigmoid is made of a tangent, so it is off by roundings of 1 where it is next to 0
    near = 1e-12 if jnp.result_type(float) == jnp.float64 else 1e-6
    return values.shape == others.shape and np.allclose(values, others, rtol=1e-6, atol=near)


def flax_layers(
    source: Any, activation: Callable | None, module: Any = None
) -> list[tuple[Any, Any]]:
    """The pairs `(W, b)` of a flax network in the order of the forward pass.

    Without an activation it is ReLU, where that is compared with what the network does.

    Raises:
        TypeError: `source` is neither an nnx module nor a mapping of linen parameters.
        ValueError: it holds other parameters than those of linear layers, or their order or what
            is between them cannot be told.
    """
    given, activation = activation is not None, ReLU() if activation is None else activation
    if isinstance(source, nnx.State) or not isinstance(source, nnx.Module | Mapping):
        raise TypeError(
            "source must be a flax nnx module or the parameters of a linen module, "
            f"but {type(source).__name__} arrived"
        )
    if isinstance(source, Mapping):
        pairs = _linen_layers(source.get("params", source))
        if module is not None:
            _require_same_module(module, pairs, activation)
        elif not given and len(pairs) > 1:
            raise ValueError(
                "linen's parameters do not tell what is between the layers: give activation=, such "
                "as reachjax.ReLU(), or module=, the linen module, to have it compared"
            )
        elif _orders(pairs) > 1:
            raise ValueError(
                "the layers chain in more than one order, and linen numbers them as they are "
                "constructed, not as they are applied: pass module=, the linen module, to have "
                f"the order checked, or {ADVICE}"
            )
        return pairs
    linears = list(_linears(source, activation, set()))
    pairs = [_layer(linear.kernel[...], _bias(linear)) for linear in linears]
    if is_concrete(pairs) and callable(source):
        _require_same_outputs(source, pairs, activation)
    elif not _ordered(source):
        raise ValueError(
            "source keeps its layers as attributes, whose order is lost inside jit: "
            f"keep them in nnx.List or nnx.Sequential, or {ADVICE}"
        )
    elif not given and len(pairs) > 1 and type(source) is not nnx.Sequential:
        raise ValueError(
            "what source does between its layers cannot be seen where it is traced, or cannot be "
            "called: give activation=, such as reachjax.ReLU(), or keep all of it in nnx.Sequential"
        )
    return pairs


def _layer(kernel: Any, bias: Any) -> tuple[Any, Any]:
    return kernel.T, jnp.zeros(kernel.shape[1], kernel.dtype) if bias is None else bias


def _bias(linear: nnx.Linear) -> Any:
    return None if linear.bias is None else linear.bias[...]


def _linears(node: Any, activation: Callable, seen: set[int]) -> Iterator[nnx.Linear]:
    """Linear layers as lists, `nnx.Sequential` and attributes hold them."""
    if id(node) in seen:
        raise ValueError(f"source uses one layer more than once; {ADVICE}")
    if type(node) is nnx.Linear:
        seen.add(id(node))
        yield node
    elif isinstance(node, list | tuple | nnx.List):
        for child in node:
            yield from _linears(child, activation, seen)
    elif isinstance(node, Mapping) and any(isinstance(v, nnx.Module) for v in node.values()):
        raise ValueError(f"source keeps layers in a mapping, which has no order; {ADVICE}")
    elif isinstance(node, nnx.Module):
        seen.add(id(node))
        if isinstance(node, nnx.Sequential):
            _require_alternating(list(node.layers), activation)
        for name, child in vars(node).items():
            if isinstance(child, nnx.Param):
                raise ValueError(
                    f"source holds the parameter {name!r} in {type(node).__name__}, "
                    f"which is not a linear layer; {ADVICE}"
                )
            yield from _linears(child, activation, seen)


def _require_alternating(layers: list[Any], activation: Callable) -> None:
    """Linear layers with the activation between them, and nothing else."""
    for k, layer in enumerate(layers):
        if k % 2 == 0:
            fits = type(layer) is nnx.Linear
        else:
            fits = not isinstance(layer, nnx.Module) and _agree(layer, activation)
        if not fits or len(layers) % 2 == 0:
            raise ValueError(
                f"source must alternate nnx.Linear and {activation}, ending with nnx.Linear, "
                f"but entry {k} of its {len(layers)} layers is {layer!r}; {ADVICE}"
            )


def _ordered(node: Any) -> bool:
    """Whether the linear layers stand in one list, or there is but one."""
    holders = [child for child in vars(node).values() if _holds_layers(child)]
    if len(holders) != 1 or type(node) is nnx.Linear:
        return len(holders) == 0
    return (
        not isinstance(holders[0], nnx.Module)
        or isinstance(holders[0], nnx.List)
        or _ordered(holders[0])
    )


def _holds_layers(value: Any) -> bool:
    return isinstance(value, nnx.Module | nnx.List) or (
        isinstance(value, list | tuple) and any(map(_holds_layers, value))
    )


def _require_same_outputs(source: Callable, pairs: list[tuple[Any, Any]], activation) -> None:
    """Compare the module with the network read from it on a few inputs."""
    inputs = pairs[0][0].shape[1] if pairs else 1
    draws = np.random.default_rng(0).normal(size=(len(SCALES), 8, inputs))
    sizes = np.repeat(SCALES, 8)[:, None]
    points = (draws.reshape(-1, inputs) * sizes).astype(np.float32)
    try:
        with jax.default_matmul_precision("highest"):
            expected = np.asarray(source(jnp.asarray(points)), dtype=float)
    except Exception as error:
        raise ValueError(f"source cannot be evaluated, so it cannot be read: {error}") from error
    z, near = points.astype(float), np.zeros_like(points, float)
    for k, (W, b) in enumerate(pairs):
        weights, shift = np.asarray(W, float).T, np.asarray(b, float)
        near = near @ abs(weights) + ROUNDED * (abs(z) @ abs(weights) + abs(shift))
        z = z @ weights + shift
        z = np.asarray(activation(jnp.asarray(z))) if k < len(pairs) - 1 else z
    if expected.shape != z.shape or not (abs(z - expected) <= near + LEAST).all():
        raise ValueError(
            "source computes something else than its linear layers in the order in which they "
            f"were found, with {activation} between them; {ADVICE}"
        )


def _linen_layers(params: Mapping[str, Any]) -> list[tuple[Any, Any]]:
    """Layers named `Dense_0`, `Dense_1`, ...: the names must tell the order."""
    names = {re.sub(r"\d+$", "", name) for name in params}
    numbered = all(re.search(r"\d+$", name) for name in params)
    if len(params) > 1 and not (numbered and len(names) == 1):
        raise ValueError(
            "linen layers must be named by one word and a number, such as Dense_0, for their order "
            f"to be known, but {sorted(params)} arrived; {ADVICE}"
        )
    return [_linen_layer(name, params[name]) for name in sorted(params, key=_number)]


def _orders(pairs: list[tuple[Any, Any]]) -> int:
    """In how many orders the layers chain, by their shapes; two stands for more."""
    shapes = [W.shape[::-1] for W, _ in pairs if W.ndim == 2]

    def count(last: int | None, left: list[tuple[int, int]]) -> int:
        if not left:
            return 1
        total = 0
        for k, (inputs, outputs) in enumerate(left):
            if last in (None, inputs):
                total += count(outputs, left[:k] + left[k + 1 :])
            if total > 1:
                return 2
        return total

    return count(None, shapes)


def _require_same_module(module: Any, pairs: list[tuple[Any, Any]], activation: Callable) -> None:
    """Read a fresh set of weights of the linen module and compare outputs: values do not matter."""
    with jax.ensure_compile_time_eval():
        key, x = jax.random.key(0), jnp.zeros(pairs[0][0].shape[1], jnp.float32)
        fresh = module.init(key, x)
        leaves, structure = jax.tree.flatten(fresh)
        keys = jax.random.split(key, len(leaves))  # biases are zero at first: make them count
        drawn = [jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
        fresh = jax.tree.unflatten(structure, drawn)
        read = _linen_layers(fresh["params"])
        if [W.shape for W, _ in read] != [W.shape for W, _ in pairs]:
            raise ValueError(
                f"module of {pairs[0][0].shape[1]} inputs has other layers than source holds. "
                "linen numbers layers as they are constructed: in Dense(1)(relu(Dense(3)(x))) the "
                f"last one is the first. Then {ADVICE}"
            )
        _require_same_outputs(lambda points: module.apply(fresh, points), read, activation)


def _number(name: str) -> int:
    """Order `Dense_10` behind `Dense_2`."""
    found = re.search(r"\d+$", name)
    return int(found.group()) if found else 0


def _linen_layer(name: str, layer: Any) -> tuple[Any, Any]:
    if not isinstance(layer, Mapping) or not {"kernel"} <= set(layer) <= {"kernel", "bias"}:
        held = sorted(layer) if isinstance(layer, Mapping) else type(layer).__name__
        raise ValueError(
            f"linen layer {name!r} must hold a kernel and perhaps a bias, but it holds {held}"
        )
    return _layer(layer["kernel"], layer.get("bias"))
