"""Every operator that is read from ONNX computes what onnxruntime does, in every shape it takes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.readers.onnx_graphs import read_graph
from reachjax.loops.readers.operators import OPERATORS
from tests.loops.onnx_models import node, run, saved

SHAPES = [(1, 3), (1, 2, 3), (3,), (1, 2, 1, 3)]
OPSETS = [11, 13, 18, 21]
POSITIVE = ("Log", "Sqrt", "ReduceLogSum", "Reciprocal")
INSIDE = ("Acos", "Asin")
ALONE = [
    "Abs",
    "Acos",
    "Asin",
    "Asinh",
    "Atan",
    "Cos",
    "Cosh",
    "Erf",
    "Exp",
    "HardSwish",
    "Identity",
    "Log",
    "Mish",
    "Neg",
    "Reciprocal",
    "Relu",
    "Sigmoid",
    "Sin",
    "Sinh",
    "Softplus",
    "Softsign",
    "Sqrt",
    "Tan",
    "Tanh",
]
UNARY = {
    **{name: [{}] for name in ALONE},
    "Celu": [{}, {"alpha": 0.5}],
    "Elu": [{}, {"alpha": 0.5}],
    "Gelu": [{}, {"approximate": "tanh"}],
    "HardSigmoid": [{}, {"alpha": 0.3, "beta": 0.4}],
    "LeakyRelu": [{}, {"alpha": 0.3}],
    "Selu": [{}, {"alpha": 1.5, "gamma": 1.1}],
    "Flatten": [{}, {"axis": 0}, {"axis": -1}],
    "LogSoftmax": [{}, {"axis": 0}],
    "Softmax": [{}, {"axis": 0}],
    "Transpose": [{}],
}
SINCE = {"HardSwish": 14, "Mish": 18, "Gelu": 20, "Celu": 12}
REDUCTIONS = [name for name in OPERATORS if name.startswith("Reduce")]


def entries(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def same(path, x):
    """Compare what was read with onnxruntime at one point."""
    graph, inputs, outputs = read_graph(path)
    expected = run(path, x=x)
    found = graph(x.ravel().astype(float))
    assert (inputs, outputs) == (x.size, expected.size)
    np.testing.assert_allclose(found, expected, rtol=3e-5, atol=3e-6)


@pytest.mark.parametrize("name", UNARY)
def test_an_operator_of_one_operand(name, tmp_path):
    for k, opset in enumerate(OPSETS):
        for seed, attributes in enumerate(UNARY[name]):
            shape = SHAPES[(k + seed) % len(SHAPES)]
            if opset < SINCE.get(name, 0) or (name == "Flatten" and len(shape) < 2):
                continue
            if len(shape) == 1 and name in ("Softmax", "LogSoftmax") and opset < 13:
                shape = (1, 3)  # its first axis is 1 then
            x = entries(shape, seed + k)
            x = abs(x) + 0.2 if name in POSITIVE else np.tanh(x) if name in INSIDE else x
            path = tmp_path / "net.onnx"
            same(saved(path, [node(name, "x", **attributes)], shape=shape, opset=opset), x)


@pytest.mark.parametrize("name", REDUCTIONS)
def test_an_operator_over_axes(name, tmp_path):
    for keep in (0, 1):
        for shape, axes in (((1, 2, 3), [1]), ((1, 4), [-1]), ((1, 2, 3), [0, 2]), ((1, 3), None)):
            x = abs(entries(shape)) + 0.2
            held = {} if axes is None else {"axes": np.array(axes)}
            made = node(name, "x" if axes is None else "x axes", keepdims=keep)
            same(saved(tmp_path / "net.onnx", [made], held, shape=shape), x)
            if name != "ReduceSum":  # of which axes are an operand since version 13
                old = node(name, "x", keepdims=keep, **({} if axes is None else {"axes": axes}))
                same(saved(tmp_path / "net.onnx", [old], shape=shape, opset=13), x)


W = {"w": entries((4, 3), 1), "b": entries(4, 2), "c": entries((1, 4), 3), "s": entries(3, 4)}
SEVERAL = {
    "gemm": ([node("Gemm", "x w b", transB=1, alpha=0.5, beta=2.0)], (1, 3)),
    "gemm of a transposed input": ([node("Gemm", "x w", transA=1, transB=1)], (3, 1)),
    "gemm with a row": ([node("Gemm", "x w c", transB=1)], (1, 3)),
    "matmul": ([node("Transpose", "w", "t"), node("MatMul", "x t")], (1, 2, 3)),
    "matmul of a vector": ([node("MatMul", "w x")], (3,)),
    "einsum": ([node("Einsum", "x w", equation="bi, oi -> bo")], (1, 3)),
    "einsum without an arrow": ([node("Einsum", "x w", equation="ki,oi")], (1, 3)),
    "sums": ([node("Sum", "x s x", "a"), node("Mean", "a s"), node("Mul", "y x", "z")], (1, 3)),
    "largest": ([node("Max", "x s", "a"), node("Min", "a x", "y")], (1, 3)),
    "leaky by comparison": (
        [node("Mul", "x s", "a"), node("Greater", "x k", "g"), node("Where", "g x a")],
        (1, 3),
    ),
    "prelu": ([node("PRelu", "x s")], (1, 3)),
    "layer normalisation": ([node("LayerNormalization", "x s s", epsilon=0.1)], (1, 3)),
    "normalisation over two axes": ([node("LayerNormalization", "x s", axis=1)], (1, 2, 3)),
    "expand": ([node("Expand", "x n", "e"), node("Add", "e x")], (1, 2, 1, 3)),
    "slices backwards": ([node("Slice", "x last first axis back")], (1, 3)),
    "slices beyond the ends": ([node("Slice", "x far near axis ones")], (1, 3)),
    "negative places": ([node("Gather", "x places", axis=-1)], (1, 3)),
    "no known numbers but ranges": (
        [
            node("Shape", "x", "n3", start=-1),
            node("Squeeze", "n3", "n0"),
            node("Range", "zero n0 one", "r"),
            node("Cast", "r", "f", to=1),
            node("Mul", "x f"),
        ],
        (1, 3),
    ),
    "dropout": ([node("Dropout", "x")], (1, 3)),
    "clip": ([node("Clip", "x k k2")], (1, 3)),
    "powers": ([node("Pow", "x three", "p"), node("Add", "p x")], (1, 3)),
    "split": ([node("Split", "x", "a b2 c2", axis=1, num_outputs=3), node("Sub", "c2 a")], (1, 3)),
}
HELD = W | {
    "k": np.float32(0),
    "k2": np.float32(0.5),
    "n": np.array([2, 1, 3]),
    "last": np.array([-1]),
    "first": np.array([-9]),
    "axis": np.array([-1]),
    "back": np.array([-1]),
    "far": np.array([-7]),
    "near": np.array([2**40]),
    "ones": np.array([2]),
    "places": np.array([[-1, 0], [2, -3]]),
    "zero": np.array(0),
    "one": np.array(1),
    "three": np.array(3, np.int32),
}


@pytest.mark.parametrize("name", SEVERAL)
def test_an_operator_of_several_operands(name, tmp_path):
    nodes, shape = SEVERAL[name]
    used = {operand for each in nodes for operand in each.input}
    held = {key: array for key, array in HELD.items() if key in used}
    path = saved(tmp_path / "net.onnx", nodes, held, shape=shape)
    for seed in range(3):
        same(path, entries(shape, 10 + seed))


def test_convolutions_of_any_kernel(tmp_path):
    rng = np.random.default_rng(0)
    for seed in range(12):
        groups, space = int(rng.integers(1, 3)), int(rng.integers(1, 3))
        inputs, outputs = groups * int(rng.integers(1, 3)), groups * int(rng.integers(1, 4))
        shape = (1, inputs, *rng.integers(3, 6, space).tolist())
        kernel = rng.integers(1, 4, space).tolist()
        held = {
            "w": entries((outputs, inputs // groups, *kernel), seed),
            "b": entries(outputs, seed),
        }
        chosen = {
            "group": groups,
            "strides": rng.integers(1, 3, space).tolist(),
            "pads": rng.integers(0, 2, 2 * space).tolist(),
        }
        path = saved(tmp_path / "net.onnx", [node("Conv", "x w b", **chosen)], held, shape=shape)
        same(path, entries(shape, seed))


CERTIFIED = [
    "Softmax",
    "LogSoftmax",
    "Selu",
    "Celu",
    "Mish",
    "HardSwish",
    "Gelu",
    "Elu",
    "Softplus",
    "Softsign",
]


@pytest.mark.parametrize("name", CERTIFIED)
def test_smooth_operators_of_policies_have_bounds(name, tmp_path):
    chosen = {"approximate": "tanh"} if name == "Gelu" else {}
    nodes = [node("Gemm", "x w b", "h", transB=1), node(name, "h", **chosen)]
    held = {"w": W["w"], "b": W["b"]}
    net = rj.Network.from_onnx(saved(tmp_path / "net.onnx", nodes, held, opset=20))
    x = entries((1, 3), 5)
    expected = run(tmp_path / "net.onnx", x=x)
    np.testing.assert_allclose(net(jnp.asarray(x[0], float)), expected, rtol=1e-5, atol=1e-6)
    assert jax.tree.leaves(net)[0].shape == (4, 3)


@pytest.mark.parametrize("name", ["Greater", "GreaterOrEqual", "Less", "LessOrEqual"])
@pytest.mark.parametrize("kind", ["leaky", "held"])
def test_choices_at_known_numbers_have_bounds(name, kind, tmp_path):
    upwards = name.startswith("Greater")
    if kind == "leaky":  # as TensorFlow's exporter writes it
        held, cases = {"s": W["s"], "k": HELD["k"]}, "x a" if upwards else "a x"
        nodes = [node("Mul", "x s", "a"), node(name, "x k", "g"), node("Where", f"g {cases}")]
    else:
        held, cases = {"k": HELD["k2"]}, "x k" if upwards else "k x"
        nodes = [node(name, "x k", "g"), node("Where", f"g {cases}")]
    net = rj.Network.from_onnx(saved(tmp_path / "net.onnx", nodes, held))
    for x in (entries((1, 3), 5), np.zeros((1, 3), np.float32)):
        expected = run(tmp_path / "net.onnx", x=x)
        np.testing.assert_allclose(net(jnp.asarray(x[0], float)), expected.ravel(), rtol=1e-6)
    assert len(jax.tree.leaves(net)) == (kind == "leaky")  # a slope may be learned, no place


SLOPES = {"Celu": 1.0, "Elu": 1.0, "Selu": 1.0507009873554805 * 1.6732632423543772}


@pytest.mark.parametrize("name", SLOPES)
def test_digits_that_a_runtime_loses_near_zero_make_no_other_function(name, tmp_path):
    """It subtracts one from an exponential, and is off by 6e-8 however small the result is."""
    nodes = [node("Mul", "x k", "a"), node(name, "a", "h"), node("Mul", "h l")]
    for size in (1.0, 1e-2, 1e-4):
        held = {"k": np.float32(size), "l": np.float32(1 / size)}
        for inputs in (1, 2, 3):
            path = saved(tmp_path / "net.onnx", nodes, held, shape=(1, inputs))
            found = read_graph(path)[0](np.full(inputs, -0.5))
            expected = SLOPES[name] * np.expm1(-0.5 * size) / size
            np.testing.assert_allclose(found, expected, rtol=1e-6)
