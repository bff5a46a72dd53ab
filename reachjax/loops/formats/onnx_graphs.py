"""ONNX graphs as functions of JAX: their weights are parameters, all else is structure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from reachjax.loops.formats.operators import FIXED, OPERATORS
from reachjax.numerics.pytrees import pytree, static

BATCH = 1
"""Dimensions that a file leaves open, as exporters do with a batch, are this."""


class Constant(NamedTuple):
    """An array that is no weight; hashable."""

    kind: str
    shape: tuple[int, ...]
    data: bytes

    @classmethod
    def of(cls, array: np.ndarray) -> Constant:
        """From an array."""
        return cls(array.dtype.str, array.shape, array.tobytes())

    @property
    def array(self) -> np.ndarray:
        """As an array."""
        return np.frombuffer(self.data, self.kind).reshape(self.shape)


class Node(NamedTuple):
    """One operator of a graph; hashable.

    Attributes:
        operator: its name.
        inputs: names of values; empty for those that are left out.
        outputs: names of values.
        attributes: by name.
    """

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: tuple[tuple[str, Any], ...]


class Structure(NamedTuple):
    """What of a graph is no weight; hashable.

    Attributes:
        nodes: in an order in which they can be computed.
        weights: names of the parameters.
        constants: by name.
        given: the name of the input.
        shape: of the input.
        wanted: the name of the output.
    """

    nodes: tuple[Node, ...]
    weights: tuple[str, ...]
    constants: tuple[tuple[str, Constant], ...]
    given: str
    shape: tuple[int, ...]
    wanted: str


@pytree
class Graph:
    """A graph of one input and one output, each as a vector.

    Attributes:
        parameters: its weights.
        structure: all else.
    """

    parameters: tuple[Array | np.ndarray, ...]
    structure: Structure = static()

    def __call__(self, x: Any) -> Any:
        """The output of one input, flattened."""
        structure = self.structure
        values = {name: constant.array for name, constant in structure.constants}
        values |= dict(zip(structure.weights, self.parameters, strict=True))
        values[structure.given] = x.reshape(structure.shape)
        for node in structure.nodes:
            attributes = {
                name: value.array if isinstance(value, Constant) else value
                for name, value in node.attributes
            }
            operands = [values[name] if name else None for name in node.inputs]
            found = OPERATORS[node.operator](attributes, *operands)
            several = found if isinstance(found, list | tuple) else [found]
            values.update(zip(node.outputs, several, strict=False))
        return values[structure.wanted].reshape(-1)


def read_graph(path: Path) -> tuple[Graph, int, int]:
    """The graph of an ONNX file, with how many inputs and outputs it has.

    Raises:
        ImportError: the package `onnx` is missing.
        ValueError: the file is none of ONNX, has several inputs or outputs, or an operator that is
            not known.
    """
    try:
        import onnx
    except ImportError:
        raise ImportError(
            "reading ONNX files needs the package onnx: pip install 'reachjax[onnx]'"
        ) from None
    try:
        model = onnx.load(path)
    except OSError:
        raise
    except Exception as error:  # protobuf's own kinds
        raise ValueError(f"{path} cannot be read as an ONNX file: {error}") from error
    graph = model.graph
    arrays = {each.name: onnx.numpy_helper.to_array(each) for each in graph.initializer}
    given = [each for each in graph.input if each.name not in arrays]
    for what, found in (("inputs", given), ("outputs", graph.output)):
        if len(found) != 1:
            names = [each.name for each in found]
            raise ValueError(f"{path} must be a network with one of {what}, but it has {names}")
    nodes = []
    for each in graph.node:
        attributes = {a.name: _plain(onnx.helper.get_attribute_value(a)) for a in each.attribute}
        if each.op_type == "Constant":
            (value,) = attributes.values()
            arrays[each.output[0]] = value.array if isinstance(value, Constant) else np.array(value)
            continue
        if each.op_type not in OPERATORS or each.domain not in ("", "ai.onnx"):
            raise ValueError(
                f"{path} contains the operator {each.op_type!r} (node {each.name!r}), which is not "
                f"known: {', '.join(sorted(OPERATORS))} are"
            )
        if each.op_type == "Split":  # of old: into equal parts, as many as have names
            attributes.setdefault("num_outputs", len(each.output))
        nodes.append(
            Node(each.op_type, tuple(each.input), tuple(each.output), tuple(attributes.items()))
        )
    shape = _shape(given[0])
    if len(shape) == 2 and min(shape) > 1:
        raise ValueError(
            f"{path} takes {shape[0]} inputs at a time, since {given[0].name!r} has shape {shape}: "
            "write it with a batch that is open, or 1"
        )
    kept = _limits(nodes)
    weights = tuple(
        name for name, array in arrays.items() if array.dtype.kind == "f" and name not in kept
    )
    constants = tuple(
        (name, Constant.of(array.astype(float) if array.dtype.kind == "f" else array))
        for name, array in arrays.items()
        if name not in weights
    )
    structure = Structure(
        tuple(nodes), weights, constants, given[0].name, shape, graph.output[0].name
    )
    parameters = tuple(np.asarray(arrays[name], float) for name in weights)
    made, inputs = Graph(parameters, structure), int(np.prod(shape, dtype=int))
    return made, inputs, _outputs(made, inputs, path)


def _outputs(graph: Graph, inputs: int, path: Path) -> int:
    """The number of outputs, which a file may leave open."""
    try:
        found = jax.eval_shape(graph, jax.ShapeDtypeStruct((inputs,), float))
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise ValueError(f"{path} cannot be evaluated for one input vector: {error}") from error
    return found.shape[0]


def _limits(nodes: Sequence[Node]) -> set[str]:
    """Names of numbers that are no weights."""
    found = set()
    for node in nodes:
        places = FIXED.get(node.operator, ())
        found |= {node.inputs[k] for k in places if k < len(node.inputs)}
    return found


def _plain(value: Any) -> Any:
    """An attribute, hashable."""
    import onnx

    if isinstance(value, onnx.TensorProto):
        return Constant.of(onnx.numpy_helper.to_array(value))
    if isinstance(value, list | tuple):
        return tuple(value)
    return value.decode() if isinstance(value, bytes) else value


def _shape(value: Any) -> tuple[int, ...]:
    """The shape of a graph's input or output; what it leaves open is one."""
    sizes = value.type.tensor_type.shape.dim
    return tuple(each.dim_value if each.dim_value > 0 else BATCH for each in sizes)
