"""Networks from files compute what the field's own runtime does, and bad files are named."""

import itertools
from pathlib import Path

import jax
import numpy as np
import onnx
import onnxruntime
import pytest
import scipy.io
from onnx import TensorProto, helper, numpy_helper

import reachjax as rj
from tests.closed_loops import closed_loop, random_loop

EXPORTED = sorted((Path(__file__).parent.parent / "data" / "networks").glob("*.onnx"))
FLOAT = TensorProto.FLOAT


def model(nodes, arrays, shape=(None, 3), domains=(), version=18):
    """A graph from `x` to `y`, in 32-bit floats."""
    ends = [
        helper.make_tensor_value_info(name, FLOAT, s) for name, s in (("x", shape), ("y", None))
    ]
    held = [numpy_helper.from_array(np.asarray(value), name) for name, value in arrays.items()]
    graph = helper.make_graph(nodes, "network", ends[:1], ends[1:], held)
    versions = [
        helper.make_opsetid("", version),
        *(helper.make_opsetid(each, 1) for each in domains),
    ]
    return helper.make_model(graph, opset_imports=versions, ir_version=9)


def written(path, *args, **options):
    onnx.save(model(*args, **options), path)
    return path


def runtime(path):
    """The network in onnxruntime, for points (k, n)."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (given,) = session.get_inputs()
    shape = [size if isinstance(size, int) else 1 for size in given.shape]

    def outputs(points):
        rows = [row.astype(np.float32).reshape(shape) for row in np.asarray(points)]
        return np.stack([session.run(None, {given.name: row})[0].ravel() for row in rows])

    return outputs


def node(operator, inputs, output, **attributes):
    return helper.make_node(operator, inputs.split(), [output], **attributes)


def floats(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


IMAGES = [(1, 4, 1, 1), (1, 1, 4, 1), (1, 1, 1, 4), (None, 4, 1, 1)]


@pytest.mark.parametrize("shape", IMAGES, ids=str)
@pytest.mark.parametrize("version", [9, 13])
def test_layers_that_are_written_as_convolutions_of_images(shape, version, tmp_path):
    """MATLAB's exporter writes what is fully connected with kernels of one, or of the image."""
    kernel = (1, 1) if shape[1] == 4 else shape[2:]
    W, V = floats(8, 4), floats(2, 8, seed=1)
    held = {"m": floats(1, *shape[1:], seed=2), "W": W.reshape(8, shape[1], *kernel)}
    held |= {"b": floats(8, seed=3), "V": V.reshape(2, 8, 1, 1), "c": floats(2, seed=4)}
    nodes = [
        node("Sub", "x m", "s"),
        node("Conv", "s W b", "h", kernel_shape=list(kernel)),
        node("Relu", "h", "r"),
        node("Conv", "r V c", "y", kernel_shape=[1, 1]),
    ]
    path = written(tmp_path / "net.onnx", nodes, held, shape=shape, version=version)
    net, points = rj.Network.from_file(path), floats(20, 4, seed=5).astype(float)
    hidden = np.maximum((points - held["m"].ravel()) @ W.T.astype(float) + held["b"], 0)
    expected = hidden @ V.T.astype(float) + held["c"]
    found = [np.asarray(net(point)) for point in points]
    assert np.allclose(found, expected, atol=1e-12)
    assert np.allclose(found, runtime(path)(points), atol=1e-5)


DENSE = {"W": floats(4, 3), "b": floats(4, seed=1), "V": floats(4, 2, seed=2), "d": floats(2)}


def dense(*between, activation="Relu", **attributes):
    """Two layers with an activation, and what else is between."""
    nodes = [node("Gemm", "x W b", "h0", transB=1), node(activation, "h0", "h1", **attributes)]
    nodes += [node(*each[:-1], f"h{k}", **each[-1]) for k, each in enumerate(between, start=2)]
    return [*nodes, node("MatMul", f"h{len(nodes) - 1} V", "m"), node("Add", "m d", "y")]


WHOLE = {
    "rows": np.array([1, 4]),
    "two": np.array([2]),
    "one": np.array([1]),
    "zero": np.array([0]),
}
GRAPHS = {
    "gemm, matmul, add, relu": (dense(), DENSE),
    "leaky": (dense(activation="LeakyRelu", alpha=0.2), DENSE),
    "tanh": (dense(activation="Tanh"), DENSE),
    "sigmoid": (dense(activation="Sigmoid"), DENSE),
    "hard sigmoid": (dense(activation="HardSigmoid", alpha=0.3), DENSE),
    "clip": (
        dense(("Clip", "h1 low high", {})),
        DENSE | {"low": np.float32(0.1), "high": np.float32(0.5)},
    ),
    "flatten, reshape, transposes": (
        dense(
            ("Reshape", "h1 shape", {}),
            ("Transpose", "h2", {"perm": [0, 2, 1]}),
            ("Flatten", "h3", {}),
        ),
        DENSE | {"shape": np.array([0, 2, -1])},
    ),
    "squeezes": (
        dense(("Unsqueeze", "h1 two", {}), ("Squeeze", "h2 two", {}), ("Identity", "h3", {})),
        DENSE | WHOLE,
    ),
    "mul, sub, div, neg, concat": (
        [
            node("Sub", "x b", "s"),
            node("Div", "s c", "q"),
            node("Neg", "q", "n"),
            node("Abs", "n", "a"),
            node("Mul", "a q", "p"),
            node("Concat", "p x", "y", axis=1),
        ],
        {"b": floats(3), "c": floats(3, seed=1)},
    ),
    "a shape that is computed": (
        [
            node("Shape", "x", "sizes"),
            node("Gather", "sizes zero", "batch", axis=0),
            node("Concat", "batch rest", "shape", axis=0),
            node("Relu", "x", "r"),
            node("Reshape", "r shape", "y"),
        ],
        WHOLE | {"rest": np.array([3, 1])},
    ),
    "slices, splits, sums": (
        [
            node("Slice", "x zero two one", "first"),
            helper.make_node("Split", ["x", "parts"], ["left", "right"], axis=1),
            node("Mul", "left right", "m"),
            node("ReduceSum", "first one", "s", keepdims=1),
            node("Max", "m s", "largest"),
            node("Min", "largest cap", "y"),
        ],
        WHOLE | {"parts": np.array([1, 2]), "cap": floats(1)},
    ),
    "powers, roots": (
        [
            node("Pow", "x square", "p"),
            node("Add", "p one", "q"),
            node("Sqrt", "q", "r"),
            node("Log", "r", "l"),
            node("Exp", "l", "e"),
            node("Reciprocal", "e", "y"),
        ],
        {"square": np.float32(2), "one": np.float32(1)},
    ),
    "batch normalisation": (
        [node("BatchNormalization", "x s b m v", "n"), node("Sin", "n", "y")],
        {"s": floats(3), "b": floats(3, seed=1), "m": floats(3, seed=2), "v": abs(floats(3))},
    ),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_a_graph_computes_what_onnxruntime_does(name, tmp_path):
    path = written(tmp_path / "net.onnx", *GRAPHS[name])
    net = rj.Network.from_onnx(path)
    points = floats(50, net.inputs, seed=7)
    expected = runtime(path)(points)
    assert net.outputs == expected.shape[1]
    found = jax.vmap(net)(points.astype(float))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


PARTS = [f"part{k}" for k in range(4)]
AXES = {"axes": np.array([], np.int64)}
TURNS = {
    "parts of seven": ([helper.make_node("Split", ["x"], PARTS[:3], axis=1, num_outputs=3)], 18, 7),
    "equal parts": ([helper.make_node("Split", ["x"], PARTS[:3], axis=1)], 13, 6),
    "sum over no axes": ([helper.make_node("ReduceSum", ["x", "axes"], PARTS[:1])], 18, 3),
    "mean over no axes": ([helper.make_node("ReduceMean", ["x", "axes"], PARTS[:1])], 18, 3),
    "no sum over no axes": (
        [helper.make_node("ReduceSum", ["x", "axes"], PARTS[:1], noop_with_empty_axes=1)],
        18,
        3,
    ),
    "elu": ([helper.make_node("Elu", ["x"], PARTS[:1], alpha=0.5)], 18, 3),
    "softplus": ([helper.make_node("Softplus", ["x"], PARTS[:1])], 18, 3),
    "softsign": ([helper.make_node("Softsign", ["x"], PARTS[:1])], 18, 3),
    "hyperbolic": (
        [helper.make_node("Sinh", ["x"], PARTS[:1]), helper.make_node("Cosh", ["x"], PARTS[1:2])],
        18,
        3,
    ),
}


@pytest.mark.parametrize("name", TURNS)
def test_every_result_of_an_operator_is_that_of_onnxruntime(name, tmp_path):
    nodes, version, inputs = TURNS[name]
    held = AXES if "axes" in name else {}
    for part in (each for node in nodes for each in node.output):
        wanted = helper.make_node("Identity", [part], ["y"])
        path = written(
            tmp_path / "net.onnx", [*nodes, wanted], held, shape=(None, inputs), version=version
        )
        x = floats(1, inputs)
        expected = np.ravel(runtime(path)(x))
        np.testing.assert_allclose(rj.Network.from_onnx(path)(x[0]), expected, rtol=1e-6)


@pytest.mark.parametrize("path", EXPORTED, ids=lambda path: path.stem)
@pytest.mark.costly
def test_what_exporters_write_computes_what_onnxruntime_does(path):
    net = rj.Network.from_file(path)
    points = 3 * floats(200, net.inputs, seed=7)
    found = jax.vmap(net)(points.astype(float))
    np.testing.assert_allclose(found, runtime(path)(points), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("path", EXPORTED, ids=lambda path: path.stem)
@pytest.mark.costly
def test_certified_sets_hold_the_trajectories_of_onnxruntime(path):
    net = rj.Network.from_onnx(path)
    n, m = net.inputs, net.outputs
    rng = np.random.default_rng(0)
    A, B = 0.8 * np.linalg.qr(rng.normal(size=(n, n)))[0], 0.1 * rng.normal(size=(n, m))
    loop = rj.ClosedLoop(rj.AffinePlant(A, B), net)
    X0 = rj.Box(np.full(n, 0.4), np.full(n, 0.6))
    tube = rj.reach(loop, X0, 5, rj.Template.box(n))
    control, states = runtime(path), np.asarray(X0.sample(jax.random.key(0), 300))
    for region in tube.sets[1:]:
        states = states @ A.T + control(states) @ B.T
        room = region.b - states @ region.A.T
        assert room.min() > -1e-5  # a runtime's own rounding
        assert room.min(axis=0).max() < 0.05  # and the sets are no larger than they must be


@pytest.mark.costly
def test_weights_of_a_file_have_derivatives(tmp_path):
    path = written(tmp_path / "net.onnx", dense(), DENSE)
    net = rj.Network.from_onnx(path)
    slopes = jax.grad(lambda net: net(np.ones(3)).sum())(net)
    assert {np.shape(leaf) for leaf in jax.tree.leaves(slopes)} == {(4, 3), (4,), (4, 2), (2,)}
    ends = [float(net.f.parameters[3].sum()) for net in (net, slopes)]
    assert ends[1] == 2.0 != ends[0]  # the last bias


def test_an_operator_that_is_not_known_is_named(tmp_path):
    path = written(
        tmp_path / "net.onnx",
        [helper.make_node("NonMaxSuppression", ["x"], ["y"], name="bump")],
        {},
    )
    with pytest.raises(
        ValueError, match=r"net\.onnx .* operator 'NonMaxSuppression' \(node 'bump'\)"
    ):
        rj.Network.from_onnx(path)
    other = helper.make_node("Relu", ["x"], ["y"], domain="mine")
    with pytest.raises(ValueError, match="'Relu'"):
        rj.Network.from_onnx(written(path, [other], {}, domains=["mine"]))


def test_a_function_without_bounds_is_refused(tmp_path):
    path = written(tmp_path / "net.onnx", [node("Pow", "x half", "y")], {"half": np.float32(0.3)})
    assert rj.Network.from_onnx(path).inputs == 3
    path = written(path, [node("Pow", "two x", "y")], {"two": np.float32(2)})
    with pytest.raises(TypeError, match="cannot be certified"):
        rj.Network.from_onnx(path)


def test_what_is_no_network_of_one_input_is_refused(tmp_path):
    path = tmp_path / "net.onnx"
    with pytest.raises(FileNotFoundError, match="path must be that of a file"):
        rj.Network.from_onnx(path)
    with pytest.raises(TypeError, match="path must be the path of a file, but 3 arrived"):
        rj.Network.from_file(3)
    path.write_bytes(b"no protobuf at all")
    with pytest.raises(ValueError, match=r"net\.onnx cannot be read: it is no ONNX file"):
        rj.Network.from_onnx(path)
    both = model([node("Relu", "x", "y")], {})
    both.graph.output.append(both.graph.input[0])
    onnx.save(both, path)
    with pytest.raises(ValueError, match=r"one of outputs, but it has \['y', 'x'\]"):
        rj.Network.from_onnx(path)
    wrong = {"shape": np.array([7, 5])}
    written(path, [node("Reshape", "x shape", "y")], wrong)
    with pytest.raises(ValueError, match=r"net\.onnx cannot be read: the node 'y' \(Reshape\)"):
        rj.Network.from_onnx(path)


def test_without_the_package_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    (tmp_path / "net.onnx").write_bytes(b"")
    with pytest.raises(ImportError, match=r"pip install 'reachjax\[onnx\]'"):
        rj.Network.from_onnx(tmp_path / "net.onnx")


# chains of layers ------------------------------------------------------------------------------

SIZES = (2, 4, 3, 1)
VALUES = {
    "relu": lambda y: np.maximum(y, 0),
    "tanh": np.tanh,
    "sigmoid": lambda y: 1 / (1 + np.exp(-y)),
    "linear": lambda y: y,
}


@pytest.fixture
def layers():
    rng = np.random.default_rng(3)
    return [(rng.normal(size=(m, n)), rng.normal(size=m)) for n, m in itertools.pairwise(SIZES)]


@pytest.fixture
def points():
    return np.random.default_rng(4).normal(size=(20, 2))


def forward(layers, names, x):
    for (W, b), name in zip(layers, names, strict=True):
        x = VALUES[name](x @ W.T + b)
    return x


def same(net, expected, points):
    np.testing.assert_allclose(jax.vmap(net)(points), expected, rtol=1e-12)


def cells(arrays):
    found = np.empty(len(arrays), dtype=object)
    found[:] = arrays
    return found


MATLAB = {
    "arch-comp": ("W", "b", "act_fcns", ["relu  ", "tanh  ", "linear"]),
    "nnmt": ("W", "b", "activation_fcns", cells(["poslin", "tansig", "purelin"])),
    "others": ("weights", "bias", "activations", cells(["ReLU", "tanh", "linear"])),
}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("kind", MATLAB)
@pytest.mark.parametrize("inside", [False, True])
def test_a_matlab_file(kind, turned, inside, layers, points, tmp_path):
    W, b, names, activations = MATLAB[kind]
    weights = cells([V.T if turned else V for V, _ in layers])
    held = {W: weights, b: cells([d[:, None] for _, d in layers]), names: activations}
    path = tmp_path / "controller.mat"
    scipy.io.savemat(path, {"network": held} if inside else held)
    net = rj.Network.from_file(path)
    same(net, forward(layers, ["relu", "tanh", "linear"], points), points)


def test_an_nnet_file(layers, points, tmp_path):
    rows = ["// a header", "3,2,1,4,", "2,4,3,1,", "0,", "-0.5,-1,", "0.5,1,"]
    rows += ["0.1,0.2,7,", "2,3,5,"]
    for W, b in layers:
        rows += [",".join(map(repr, row.tolist())) + "," for row in W]
        rows += [f"{each!r}," for each in b.tolist()]
    path = tmp_path / "controller.nnet"
    path.write_text("\n".join(rows))
    x = (np.clip(points, [-0.5, -1], [0.5, 1]) - [0.1, 0.2]) / [2, 3]
    same(rj.Network.from_file(path), 7 + 5 * forward(layers, ["relu", "relu", "linear"], x), points)


def text(layers, names=(), after=()):
    numbers = [np.column_stack(layer).ravel() for layer in layers]
    sizes = [SIZES[0], SIZES[-1], len(SIZES) - 2, *SIZES[1:-1]]
    return "\n".join(map(str, [*sizes, *names, *np.concatenate(numbers).tolist(), *after]))


def test_plain_text(layers, points, tmp_path):
    path = tmp_path / "controller.txt"
    path.write_text(text(layers))
    same(rj.Network.from_file(path), forward(layers, ["relu"] * 3, points), points)
    path.write_text(text(layers, ["ReLU", "sigmoid", "Affine"], [0.5, 4.0]))
    expected = 4 * (forward(layers, ["relu", "sigmoid", "linear"], points) - 0.5)
    same(rj.Network.from_file(path), expected, points)


@pytest.mark.costly
def test_a_chain_from_a_file_is_bounded_as_the_network_that_it_is(tmp_path):
    data = random_loop(2, (4, 3), seed=2)
    loop, path = closed_loop(data), tmp_path / "controller.mat"
    W, b = zip(*data.layers, strict=True)
    names = ["relu", "relu", "linear"]
    scipy.io.savemat(path, {"W": cells(W), "b": cells(b), "act_fcns": names})
    X0 = rj.Box([-0.2, -0.2], [0.2, 0.2])
    tubes = [
        rj.reach(each, X0, 3, rj.Template.box(2))
        for each in (loop, loop.replace(controller=rj.Network.from_file(path)))
    ]
    np.testing.assert_allclose(tubes[0].sets[3].b, tubes[1].sets[3].b, rtol=1e-6)


BAD = {
    "early.txt": ("2 1 1 3 1 2", "ends too early"),
    "words.txt": ("two 1 1", "cannot be read"),
    "left.txt": ("1 1 0 1 0 5 5 5", "3 numbers are left"),
    "names.txt": ("1 1 1 1 relu 1 0 1 0", "2 layers need as many activations"),
    "unknown.txt": ("1 1 0 swish 1 0", "the activation 'swish' is not known"),
    "early.nnet": ("// x\n1,1,1,1\n1,1\n0\n0\n1\n0,0\n1,1\n", "ends too early"),
    "none.mat": ("no matlab", "cannot be read"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_named(name, tmp_path):
    content, said = BAD[name]
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ValueError, match=f"{name} cannot be read.*{said}|{said}"):
        rj.Network.from_file(path)


def test_a_matlab_file_without_a_network(layers, tmp_path):
    path = tmp_path / "other.mat"
    scipy.io.savemat(path, {"W": cells([W for W, _ in layers]), "x": 1})
    with pytest.raises(ValueError, match="it holds none of b, bias, biases"):
        rj.Network.from_file(path)
    held = {"W": cells([np.ones((2, 3)), np.ones((2, 3))]), "b": cells([[1], [1]])}
    scipy.io.savemat(path, held | {"act_fcns": ["relu", "relu"]})
    with pytest.raises(ValueError, match="do not chain"):
        rj.Network.from_file(path)


BESIDE = {
    "means_for_scaling": np.ones(4),
    "Maximum_of_Inputs": 1.0,
    "xoffset": np.zeros((2, 1)),
    "limits": np.ones(3),
}
HARMLESS = {
    "dt": 0.1,
    "mu": 2.0,
    "max_iter": 100,
    "number_of_inputs": 2,
    "layer_sizes": np.array([4, 3, 1]),
    "history": np.zeros((7, 9)),
    "author": "a name",
}


def with_more(layers, path, **more):
    W, b = zip(*layers, strict=True)
    held = {"W": cells(W), "b": cells(b), "act_fcns": ["relu"] * len(W)}
    scipy.io.savemat(path, held | more)
    return rj.Network.from_file(path)


@pytest.mark.parametrize("name", BESIDE)
def test_a_matlab_file_with_what_may_be_scaling_is_refused(name, layers, tmp_path):
    """The file does not say how it is applied."""
    with pytest.raises(ValueError, match=f"it also holds {name}, and does not say whether"):
        with_more(layers, tmp_path / "scaled.mat", **{name: BESIDE[name]})


def test_a_matlab_file_with_what_scales_nothing_is_read(layers, points, tmp_path):
    net = with_more(layers, tmp_path / "more.mat", **HARMLESS)
    same(net, forward(layers, ["relu"] * 3, points), points)


def test_a_row_of_weights_is_of_one_neuron_or_of_one_input(tmp_path):
    """Four numbers for two neurons may be two of each, but which ones the file does not say."""
    path = tmp_path / "row.mat"
    held = {"W": cells([np.ones((1, 4)), np.ones((1, 2))]), "b": cells([[1, 1], [1]])}
    scipy.io.savemat(path, held | {"act_fcns": ["relu", "relu"]})
    with pytest.raises(ValueError, match="do not chain"):
        rj.Network.from_file(path)


def test_an_ending_that_is_not_known_names_those_that_are(tmp_path):
    path = tmp_path / "net.pt"
    path.write_bytes(b"PK\x03\x04\x80\xff")
    with pytest.raises(ValueError, match=r"net\.pt cannot be read.*none of \.onnx, \.mat, \.nnet"):
        rj.Network.from_file(path)
