"""ONNX models of a few nodes, and what onnxruntime computes of them."""

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT


def value(name, shape, kind=FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def tensor(name, array):
    return numpy_helper.from_array(np.asarray(array), name)


def make_model(nodes, held=(), shape=(1, 3), opset=18, inputs=None, outputs=None):
    """A model from `x` to `y`, unless other ends are given; `held` are tensors, or arrays."""
    held = [tensor(*each) for each in held.items()] if isinstance(held, dict) else held
    inputs = [value("x", shape)] if inputs is None else inputs
    outputs = [value("y", None)] if outputs is None else outputs
    graph = helper.make_graph(nodes, "network", inputs, outputs, held)
    imports = [helper.make_opsetid("", opset)]
    return helper.make_model(graph, opset_imports=imports, ir_version=10)


def node(operator, inputs, outputs="y", **attributes):
    return helper.make_node(operator, inputs.split(), outputs.split(), **attributes)


def saved(path, *args, **options):
    onnx.save(make_model(*args, **options), path)
    return path


def session(path):
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def run(path, **given):
    """The first output of onnxruntime, flattened."""
    return np.asarray(session(path).run(None, given)[0], float).ravel()
