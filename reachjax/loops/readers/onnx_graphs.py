"""ONNX graphs as functions of JAX: their weights are parameters, all else is structure.

What was read is compared once with onnxruntime, where that is installed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from reachjax.loops.readers.arrays import require_finite
from reachjax.loops.readers.kinds import BOOL, KINDS, REAL, WHOLE, kind_name, real
from reachjax.loops.readers.onnx_files import FileNode, NetworkFile, read_file
from reachjax.loops.readers.operators import JUMPS, OPERATORS, SIZES
from reachjax.numerics.pytrees import pytree, static

NETWORK = 32 * float(np.finfo(np.float32).eps)
"""What a runtime may be off by, over the largest number within the network: 4e-6."""

AMPLIFIED = 100.0
"""What it may be off by, over the difference of an evaluation in 32 bits from one in 64."""


def require_same(path: Path, graph: Graph, points: Sequence[np.ndarray]) -> None:
    """Raise an error where onnxruntime computes something else than what was read.

    Raises:
        ValueError: it does, or refuses the graph as invalid; both outputs are shown.
    """
    try:
        import onnxruntime
    except ImportError:
        return
    state: Any = importlib.import_module("onnxruntime.capi.onnxruntime_pybind11_state")
    wanted = graph.structure.wanted
    try:
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        for x in points:
            (found,) = session.run([wanted], _fed(session, graph, x))
            _require_near(graph, x, np.asarray(found, float).ravel())
    except (state.InvalidGraph, state.InvalidProtobuf) as error:
        text = " ".join(str(error).split())[:400]
        raise ValueError(f"onnxruntime refuses it: {text}") from error
    except (state.Fail, state.NotImplemented, state.InvalidArgument, state.RuntimeException):
        return  # an older runtime, or one without this operator in 64 bits, or for a batch of none


def _fed(session: Any, graph: Graph, x: np.ndarray) -> dict[str, np.ndarray]:
    """A point as the inputs of a session; those on which the output does not depend are zero."""
    given = entries(graph.structure.given, x)
    fed = {}
    for each in session.get_inputs():
        kind = RUNTIME_KINDS.get(each.type, np.float32)
        shape = [size if isinstance(size, int) else 1 for size in each.shape]
        fed[each.name] = given.get(each.name, np.zeros(shape)).astype(kind)
    return fed


RUNTIME_KINDS = {
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(bool)": np.bool_,
}
"""Kinds of inputs that a runtime names so; all others are taken for 32-bit floats."""


def _require_near(graph: Graph, x: np.ndarray, found: np.ndarray) -> None:
    """Raise an error where rounding does not explain the difference at a point."""
    x = x.astype(np.float32)  # as the runtime took it
    values = graph.values(x.astype(float))
    own = values[graph.structure.wanted].ravel()
    if own.shape != found.shape:
        raise ValueError(f"onnxruntime finds {len(found)} outputs where {len(own)} were read")
    parameters = tuple(np.asarray(each, np.float32) for each in graph.parameters)
    rounded = np.asarray(Graph(parameters, graph.structure)(x), float)
    outputs = [name for node in graph.structure.nodes for name in node.outputs if name]
    sizes = [
        np.abs(each.astype(float)).max(initial=0.0)
        for each in (x, *(values[name] for name in outputs))
    ]
    room = NETWORK * max(sizes) + AMPLIFIED * np.abs(own - rounded).max(initial=0.0)
    compared = np.isfinite(own) & np.isfinite(found) & np.isfinite(room)
    off = np.where(compared, np.abs(own - found), 0.0)
    if (off > room).any():
        raise ValueError(
            f"onnxruntime computes something else: at {x.tolist()[:8]} it finds "
            f"{found.tolist()[:8]}, and what was read is {own.tolist()[:8]}"
        )


class Constant(NamedTuple):
    """An array that is no weight; hashable."""

    kind: str
    shape: tuple[int, ...]
    data: bytes

    @classmethod
    def of(cls, array: np.ndarray) -> Constant:
        """The constant of an array."""
        return cls(array.dtype.str, array.shape, array.tobytes())

    @property
    def array(self) -> np.ndarray:
        """The array that it was made of."""
        return np.frombuffer(self.data, self.kind).reshape(self.shape)


class Node(NamedTuple):
    """One operator of a graph; hashable.

    Attributes:
        operator: its name.
        name: the node's name, or those of its results.
        inputs: names of values; empty for those that are left out.
        outputs: names of values.
        attributes: by name.
    """

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: tuple[tuple[str, Any], ...]


class Structure(NamedTuple):
    """What of a graph is no weight; hashable.

    Attributes:
        nodes: in an order in which they can be computed.
        weights: names of the parameters.
        constants: by name.
        given: names and shapes of the inputs, whose entries are the vector.
        wanted: the name of the output.
    """

    nodes: tuple[Node, ...]
    weights: tuple[str, ...]
    constants: tuple[tuple[str, Constant], ...]
    given: tuple[tuple[str, tuple[int, ...]], ...]
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
        """The output of one input, flattened; whole numbers as real ones."""
        found = self.values(x)[self.structure.wanted].reshape(-1)
        return found if np.issubdtype(found.dtype, np.floating) else found.astype(x.dtype)

    def values(self, x: Any) -> dict[str, Any]:
        """The values of all nodes, by name."""
        structure = self.structure
        values = {name: _within(each.array, x.dtype) for name, each in structure.constants}
        values |= dict(zip(structure.weights, self.parameters, strict=True))
        values |= entries(structure.given, x)
        for node in structure.nodes:
            attributes = {
                name: value.array if isinstance(value, Constant) else value
                for name, value in node.attributes
            }
            operands = [values[name] if name else None for name in node.inputs]
            values |= _results(node, OPERATORS[node.operator].compute, attributes, operands)
        return values

    def size(self) -> int:
        """The number of inputs."""
        return sum(int(np.prod(shape, dtype=int)) for _, shape in self.structure.given)

    def up_to(self, number: int) -> Graph:
        """The graph that ends with the first result of a node."""
        structure = self.structure
        nodes, wanted = structure.nodes[: number + 1], structure.nodes[number].outputs[0]
        return Graph(self.parameters, structure._replace(nodes=nodes, wanted=wanted))


def _within(array: np.ndarray, kind: Any) -> np.ndarray:
    """Known numbers for a computation in floats of a kind: none is beyond the largest of these."""
    if array.dtype.kind != "f" or kind.itemsize >= array.dtype.itemsize:
        return array
    largest = float(np.finfo(kind).max)
    return np.clip(array, -largest, largest)


def entries(given: Sequence[tuple[str, tuple[int, ...]]], x: Any) -> dict[str, Any]:
    """The entries of a vector as the inputs that it consists of."""
    found, start = {}, 0
    for name, shape in given:
        count = int(np.prod(shape, dtype=int))
        found[name] = x[start : start + count].reshape(shape)
        start += count
    return found


def _results(
    node: Node | FileNode, compute: Callable[..., Any], attributes: dict[str, Any], operands: list
) -> dict[str, Any]:
    """The results of a node by their names."""
    try:
        found = compute(attributes, *operands)
    except Exception as error:  # whatever numpy and JAX raise for operands that do not fit
        text = " ".join(str(error).split())[:400]
        raise ValueError(f"the node {node.name!r} ({node.operator}) is wrong: {text}") from error
    several = found if isinstance(found, list | tuple) else [found]
    if len(several) < len([name for name in node.outputs if name]):
        raise ValueError(
            f"of the results of the node {node.name!r} ({node.operator}) only the first is known"
        )
    return {name: each for name, each in zip(node.outputs, several, strict=False) if name}


def read_graph(
    path: Path, inputs: Sequence[str] | None = None, output: str | None = None
) -> tuple[Graph, int, int]:
    """The graph of an ONNX file, with how many inputs and outputs it has.

    It is evaluated once, node by node: shapes and kinds of numbers must be those that the standard
    tells, some point must have a finite result, and where onnxruntime is installed it must find
    the same.

    Args:
        path: of the file.
        inputs: names of those that make up the vector; None for the only one.
        output: its name; None for the only one.

    Raises:
        ImportError: the package `onnx` is missing.
        ValueError: the file is none of ONNX, against its rules, not understood, or onnxruntime
            computes something else; the error names the file.
    """
    try:
        with np.errstate(all="ignore"):
            file = read_file(path, inputs, output)
            graph, outputs = _built(file)
            points = require_finite(graph, graph.size())
            require_same(path, graph, points)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    return graph, graph.size(), outputs


def culprit(graph: Graph) -> str:
    """The first node of a graph from which it cannot be certified, in words."""
    from reachjax.loops.tracing.functions import Function

    for number, node in enumerate(graph.structure.nodes):
        part = graph.up_to(number)
        value = part(np.zeros(graph.size()))
        try:
            Function.of(part, (graph.size(),), value.size, "the network")
        except (TypeError, ValueError):
            return f"the node {node.name!r} ({node.operator})"
    return "the whole graph"


def _built(file: NetworkFile) -> tuple[Graph, int]:
    """The graph of what is left to compute, once all that is known is, and its size."""
    weights = [
        name
        for name, array in file.arrays.items()
        if name not in _constants(file) and array.dtype.kind not in "iub"
    ]
    for name in weights:
        if not np.isfinite(file.arrays[name].astype(float)).all():
            raise ValueError(f"the weights {name!r} must be finite numbers")
    known = {name: array for name, array in file.arrays.items() if name not in weights}
    parameters = {name: file.arrays[name].astype(float) for name in weights}
    x = np.linspace(0.1, 0.9, sum(int(np.prod(shape, dtype=int)) for _, shape in file.given))
    for name, _ in file.given:
        if file.kinds[name] not in REAL:
            raise ValueError(
                f"the input {name!r} is of {kind_name(file.kinds[name])}: only real numbers of 32 "
                "and 64 bits are known"
            )
    values: dict[str, Any] = {**parameters, **entries(file.given, x)}
    nodes = []
    for node in file.nodes:
        plain = [name in known or not name for name in node.inputs]
        operator = OPERATORS[node.operator]
        if all(plain) or node.operator in SIZES:
            operands = [(known | values)[name] if name else None for name in node.inputs]
            found = _results(node, operator.exact or operator.compute, node.attributes, operands)
            found = {name: np.asarray(each) for name, each in found.items()}
            known |= found
        else:
            for place, name in enumerate(node.inputs):
                if place in operator.known and not plain[place]:
                    raise ValueError(
                        f"the node {node.name!r} ({node.operator}) needs known numbers, but "
                        f"{name!r} depends on the input"
                    )
            operands = [
                (real(known[name]) if name in known else values[name]) if name else None
                for name in node.inputs
            ]
            found = _results(node, operator.compute, node.attributes, operands)
            values |= found
            attributes = tuple(
                (name, Constant.of(value) if isinstance(value, np.ndarray) else value)
                for name, value in node.attributes.items()
            )
            nodes.append(Node(node.operator, node.name, node.inputs, node.outputs, attributes))
        _require_told(file, node, found, known)
    used = {name for node in nodes for name in node.inputs} | {file.wanted}
    constants = tuple(
        (name, Constant.of(real(array))) for name, array in known.items() if name in used
    )
    structure = Structure(tuple(nodes), tuple(weights), constants, file.given, file.wanted)
    outputs = np.size((known | values)[file.wanted])
    if file.kinds[file.wanted] not in (*REAL, *WHOLE):
        raise ValueError(f"the output {file.wanted!r} must be numbers of 32 or 64 bits")
    return Graph(tuple(parameters.values()), structure), outputs


def _constants(file: NetworkFile) -> set[str]:
    """Names of numbers that are no weights, since something needs them known or rounds them.

    What of weights alone becomes another kind than a float of 32 or 64 bits is computed once, and
    so is what jumps where these are rounded.
    """
    moving = {name for name, _ in file.given}
    makers: dict[str, FileNode] = {}
    left: list[str] = []
    for node in file.nodes:
        makers.update(dict.fromkeys(node.outputs, node))
        operator = OPERATORS[node.operator]
        if node.operator not in SIZES and any(name in moving for name in node.inputs):
            moving.update(node.outputs)
        elif node.operator in JUMPS or any(
            file.kinds.get(name) not in REAL for name in node.outputs if name
        ):
            left += [] if node.operator in SIZES else node.inputs
        left += [node.inputs[k] for k in operator.known + operator.fixed if k < len(node.inputs)]
    found: set[str] = set()
    while left:
        name = left.pop()
        if name not in found and name not in moving:
            found.add(name)
            if name in makers and makers[name].operator not in SIZES:
                left += makers[name].inputs
    return found


def _require_told(
    file: NetworkFile, node: FileNode, found: dict[str, Any], known: dict[str, Any]
) -> None:
    """Raise an error for results that are not of the shapes and kinds that the standard tells."""
    for name, value in found.items():
        kind, shape = file.kinds.get(name), file.shapes.get(name)
        told = f"the node {node.name!r} ({node.operator})"
        if shape is not None and np.shape(value) != shape:
            raise ValueError(f"{told} has shape {shape} by ONNX's rules, not {np.shape(value)}")
        if kind is None:
            raise ValueError(f"{told} has a result of no kind, {name!r}")
        if name in known:
            if value.dtype != KINDS[kind]:
                raise ValueError(
                    f"{told} is of {kind_name(kind)} by ONNX's rules, not {value.dtype}"
                )
        elif kind not in (*REAL, *WHOLE, BOOL):
            raise ValueError(
                f"{told} computes in {kind_name(kind)} what depends on the input: only numbers of "
                "32 and 64 bits, and truth values, are known"
            )
        elif value.dtype.kind != KINDS[kind].kind:
            raise ValueError(
                f"{told} is of {kind_name(kind)} by ONNX's rules, and what is known of it here is "
                f"of {value.dtype}: where whole numbers are not meant, cast its operands to FLOAT"
            )
