"""One comparison of what was read from an ONNX file with onnxruntime, where it is installed."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from reachjax.loops.readers.onnx_graphs import Graph

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
    from reachjax.loops.readers.onnx_graphs import entries

    given = entries(graph.structure.given, x)
    fed = {}
    for each in session.get_inputs():
        kind = KINDS.get(each.type, np.float32)
        shape = [size if isinstance(size, int) else 1 for size in each.shape]
        fed[each.name] = given.get(each.name, np.zeros(shape)).astype(kind)
    return fed


KINDS = {
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(bool)": np.bool_,
}
"""Kinds of inputs that a runtime names so; all others are taken for 32-bit floats."""


def _require_near(graph: Graph, x: np.ndarray, found: np.ndarray) -> None:
    """Raise an error where rounding does not explain the difference at a point."""
    from reachjax.loops.readers.onnx_graphs import Graph

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
