"""Malformed files of networks: bytes that are changed, and parts of files that do not fit.

What is accepted in spite of it is judged by others: ONNX graphs by onnxruntime, MATLAB's files by
scipy in a process of its own, texts by readers that are written here once more.
"""

import itertools
import json
import subprocess
import sys
from collections import Counter

import numpy as np
import onnx
import scipy.io
from onnx import helper

from reachjax.loops.readers import onnx_graphs
from reachjax.loops.readers.chains import read_chain
from reachjax.loops.readers.onnx_graphs import read_graph
from tests.loops.onnx_models import make_model, node, tensor


def entries(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


DENSE = {"w": entries((4, 3), 1), "b": entries(4, 2), "v": entries((4, 2), 3), "d": entries(2, 4)}
GRAPHS = [
    (
        [
            node("Gemm", "x w b", "h", transB=1, alpha=1.0),
            node("LeakyRelu", "h", "g", alpha=0.2),
            node("MatMul", "g v", "m"),
            node("Add", "m d"),
        ],
        DENSE,
    ),
    (
        [
            node("Shape", "x", "n", start=1),
            node("Div", "n two", "q"),
            node("Cast", "q", "f", to=1),
            node("Mul", "x f", "z"),
            node("Softmax", "z", axis=-1),
        ],
        {"two": np.array([2])},
    ),
    (
        [
            node("Slice", "x starts ends axes", "s"),
            node("Concat", "s x", "c", axis=1),
            node("Reshape", "c shape", "r", allowzero=0),
            node("ReduceMean", "r axes", "m", keepdims=1),
            node("Sub", "r m", "e"),
            node("Clip", "e low high"),
        ],
        {
            "starts": np.array([1]),
            "ends": np.array([9]),
            "axes": np.array([1]),
            "shape": np.array([1, -1]),
            "low": np.float32(-1),
            "high": np.float32(1),
        },
    ),
    (
        [
            node("BatchNormalization", "x s p q r", "n", epsilon=0.01),
            node("Split", "n parts", "a c", axis=1),
            node("PRelu", "c s1", "e"),
            node("Tanh", "e", "t"),
            node("Concat", "t a", axis=1),
        ],
        {
            "s": entries(3, 5),
            "p": entries(3, 6),
            "q": entries(3, 7),
            "r": abs(entries(3, 8)),
            "parts": np.array([1, 2]),
            "s1": entries(2, 9),
        },
    ),
    (
        [
            node("Unsqueeze", "x axes", "u"),
            node("Transpose", "u", "t", perm=[0, 2, 1]),
            node("Conv", "t k", "y", strides=[1], pads=[0, 0]),
        ],
        {"axes": np.array([1]), "k": entries((2, 3, 1), 10)},
    ),
]
OPERATORS = [
    "Relu", "Tanh", "Add", "Mul", "Div", "Gemm", "MatMul", "Cast", "Shape", "Reshape", "Gather",
    "ReduceSum", "Flatten", "Exp", "Pow", "Where", "Squeeze", "Expand", "Sigmoid", "Softplus",
]  # fmt: skip
ATTRIBUTES = ["axis", "alpha", "beta", "transA", "transB", "to", "keepdims", "start", "end", "perm"]


def _attribute(rng, model):
    each = rng.choice(len(model.graph.node))
    target = model.graph.node[each]
    if target.attribute and rng.random() < 0.6:
        name = target.attribute[rng.choice(len(target.attribute))].name
    else:
        name = str(rng.choice([*ATTRIBUTES, "mystery"]))
    kept = [a for a in target.attribute if a.name != name]
    del target.attribute[:]
    target.attribute.extend(kept)
    values = [0, 1, -1, 2, 7, -3, 10**12, 0.5, float("nan"), "text", [1], [0, 1], [2, 1, 0], None]
    value = values[rng.choice(len(values))]
    if value is not None:
        target.attribute.append(helper.make_attribute(name, value))


def _shape(rng, model):
    held = model.graph.initializer
    target = held[rng.choice(len(held))]
    change = rng.choice(4)
    if change == 0 and target.dims:
        target.dims[rng.choice(len(target.dims))] = int(rng.choice([0, 1, 2, -1, 10**12]))
    elif change == 1:
        target.dims.append(int(rng.choice([1, 2, 0])))
    elif change == 2:
        target.raw_data = target.raw_data[: rng.choice(len(target.raw_data) + 1)]
    else:
        target.raw_data = target.raw_data + bytes(rng.choice([1, 4, 8]))


def _kind(rng, model):
    held = model.graph.initializer
    held[rng.choice(len(held))].data_type = int(rng.choice([*range(0, 25), 99]))


def _operator(rng, model):
    model.graph.node[rng.choice(len(model.graph.node))].op_type = str(rng.choice(OPERATORS))


def _operands(rng, model):
    target = model.graph.node[rng.choice(len(model.graph.node))]
    names = [each.name for each in model.graph.initializer] + ["x", "", "nowhere"]
    change = rng.choice(3)
    if change == 0:
        target.input[rng.choice(len(target.input))] = str(rng.choice(names))
    elif change == 1:
        target.input.append(str(rng.choice(names)))
    else:
        target.input.pop()


def _version(rng, model):
    model.opset_import[0].version = int(rng.integers(-1, 40))


def _input(rng, model):
    kind = model.graph.input[0].type.tensor_type
    if rng.random() < 0.5:
        kind.elem_type = int(rng.integers(0, 20))
    else:
        kind.shape.dim[rng.choice(len(kind.shape.dim))].dim_value = int(
            rng.choice([0, 1, 2, 4, 10**12])
        )


def _number(rng, model):
    """One entry of an initialiser becomes another."""
    held = model.graph.initializer
    target = held[rng.choice(len(held))]
    array = onnx.numpy_helper.to_array(target).copy().reshape(-1)
    array[rng.choice(array.size)] = rng.choice(
        [0, 1, -1, 3, 100] if array.dtype.kind == "i" else [0, 1e30, np.nan, np.inf, -2]
    )
    fresh = tensor(target.name, array.reshape(tuple(target.dims)))
    target.CopyFrom(fresh)


CHANGES = [_attribute, _shape, _kind, _operator, _operands, _version, _input, _number]


def changed_bytes(rng, content):
    """Content that is cut off, or in which bytes are changed, left out or put in."""
    content, change = bytearray(content), rng.choice(4)
    if change == 0:
        return bytes(content[: rng.choice(len(content))])
    for _ in range(int(rng.choice([1, 1, 2, 5]))):
        place = int(rng.choice(max(len(content), 1)))
        if change == 1 and content:
            content[place % len(content)] = int(rng.integers(256))
        elif change == 2:
            del content[place : place + int(rng.choice([1, 4]))]
        else:
            content[place:place] = rng.bytes(int(rng.choice([1, 4])))
    return bytes(content)


def onnx_file(rng):
    nodes, held = GRAPHS[rng.choice(len(GRAPHS))]
    model = make_model(nodes, held, opset=int(rng.choice([13, 18])))
    model = onnx.ModelProto.FromString(model.SerializeToString())
    if rng.random() < 0.3:
        return changed_bytes(rng, model.SerializeToString())
    for _ in range(int(rng.choice([1, 1, 2]))):
        try:
            CHANGES[rng.choice(len(CHANGES))](rng, model)
        except (ValueError, TypeError, IndexError, KeyError, NotImplementedError):
            continue  # another change has left nothing to change
    return model.SerializeToString()


SIZES = (2, 3, 2)


def _rows(rng):
    return [
        (rng.normal(size=(m, n)).round(3), rng.normal(size=m).round(3))
        for n, m in itertools.pairwise(SIZES)
    ]


TOKENS = ["", "0", "1", "-1", "nan", "inf", "1e400", "x", "1_0", "99999999999", "2.5", "٣"]


def _changed_text(rng, text, between):
    if rng.random() < 0.5:
        return changed_bytes(rng, text.encode())
    words = text.split(between)
    place, change = int(rng.choice(len(words))), rng.choice(4)
    if change == 0:
        words[place] = str(rng.choice(TOKENS))
    elif change == 1:
        del words[place]
    elif change == 2:
        words.insert(place, str(rng.choice(TOKENS)))
    else:
        words = words[:place]
    return between.join(words).encode()


def nnet_file(rng):
    lines = ["// a network", "2,2,2,3,", "2,3,2,", "0,", "-1,-2,", "1,2,", "0.1,0.2,0.3,", "2,3,4,"]
    for W, b in _rows(rng):
        lines += [",".join(map(str, row)) + "," for row in W.tolist()]
        lines += [f"{each}," for each in b.tolist()]
    return _changed_text(rng, "\n".join(lines), str(rng.choice([",", "\n"])))


def text_file(rng):
    named = rng.random() < 0.5
    numbers = [np.column_stack(layer).ravel() for layer in _rows(rng)]
    words = [2, 2, 1, 3, *(["relu", "tanh"] if named else []), *np.concatenate(numbers).tolist()]
    return _changed_text(rng, "\n".join(map(str, words)), "\n")


def cells(arrays):
    found = np.empty((1, len(arrays)), dtype=object)
    found[0, :] = arrays
    return found


def matlab_file(rng, path):
    layers = _rows(rng)
    weights = [W for W, _ in layers]
    change = rng.choice(8)
    if change == 0:
        weights[0] = weights[0] + 1j
    elif change == 1:
        weights[1] = weights[1][:, :-1]
    elif change == 2:
        weights[0] = np.full_like(weights[0], np.nan)
    held = {"W": cells(weights), "b": cells([b[:, None] for _, b in layers])}
    held["act_fcns"] = np.array(["relu  ", "linear"])
    held = {"net": held} if rng.random() < 0.3 else held
    scipy.io.savemat(path, held, do_compression=bool(rng.random() < 0.5))
    content = path.read_bytes()
    if change > 2:
        content = changed_bytes(rng, content)
    path.write_bytes(content)


def nnet_again(text):
    """NNet's format once more, straight through the numbers."""
    lines = [line for line in text.split("\n") if line.strip() and not line.startswith("//")]
    rows = [[float(word) for word in line.split(",") if word.strip()] for line in lines]
    count = int(rows[0][0])
    sizes = [int(each) for each in rows[1]]
    lower, upper, means, ranges = map(np.array, rows[3:7])
    at, layers = 7, []
    for out in sizes[1 : count + 1]:
        W = np.array(rows[at : at + out])
        layers.append((W, np.array(rows[at + out : at + 2 * out])[:, 0]))
        at += 2 * out

    def network(x):
        if (lower != 0).any() or (upper != 0).any():
            x = np.clip(x, lower, upper)
        scaled = (ranges != 0).any()
        x = (x - means[: len(x)]) / ranges[: len(x)] if scaled else x
        for k, (W, b) in enumerate(layers):
            x = W @ x + b
            x = np.maximum(x, 0) if k < len(layers) - 1 else x
        back = scaled and len(means) > sizes[0]
        return x * ranges[-1] + means[-1] if back else x

    return network


def text_again(text):
    """Sherlock's and POLAR's format once more, neuron after neuron."""
    words = text.split()
    n, m, hidden = (int(float(word)) for word in words[:3])
    sizes = [n, *(int(float(word)) for word in words[3 : 3 + hidden]), m]
    rest, names = words[3 + hidden :], []
    while rest and rest[0].isalpha():
        names.append(rest.pop(0).lower())
    numbers = [float(word) for word in rest]

    def network(x):
        left = list(numbers)
        for k, out in enumerate(sizes[1:]):
            found = []
            for _ in range(out):
                row = [left.pop(0) for _ in range(len(x) + 1)]
                found.append(np.dot(row[:-1], x) + row[-1])
            name = names[k] if names else "relu"
            y = np.array(found)
            x = {"relu": np.maximum(y, 0), "tanh": np.tanh(y)}.get(name, y)
        return left[1] * (x - left[0]) if left else x

    return network


SCIPY = """
import json, sys
import numpy as np
import scipy.io
for path in sys.argv[1:]:
    try:
        held = scipy.io.loadmat(path)
        held = held if "W" in held else held["net"][0, 0]
        layers = [
            (np.real_if_close(W).tolist(), np.ravel(b).tolist())
            for W, b in zip(held["W"].ravel(), held["b"].ravel(), strict=True)
        ]
    except Exception as error:
        layers = str(error)
    print(json.dumps(layers), flush=True)
"""


def scipy_reads(paths):
    """Layers of files as scipy reads them, or its error; None where it dies."""
    found = []
    while len(found) < len(paths):
        command = [sys.executable, "-c", SCIPY, *map(str, paths[len(found) :])]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        found += [json.loads(line) for line in done.stdout.splitlines()]
        if len(found) < len(paths):
            found.append(None)
    return found


POINTS = [np.array(x) for x in ([0.3, -0.4], [1.5, 2.5], [-3.0, 0.1])]


def same_chain(chain, network):
    with np.errstate(all="ignore"):
        return all(np.allclose(chain(x), network(x), rtol=1e-9) for x in POINTS)


def judged(folder, count, monkeypatch):
    """How many files of each kind there are of each fate, and descriptions of what must not be."""
    fates, wrong, accepted = Counter(), [], []
    monkeypatch.setattr(onnx_graphs, "require_same", lambda path, graph, points: None)
    for number in range(count):
        rng = np.random.default_rng(number)
        kind = ("onnx", "onnx", "mat", "nnet", "txt")[number % 5]
        path = folder / f"net{number}.{kind}"
        if kind == "mat":
            matlab_file(rng, path)
        else:
            path.write_bytes({"onnx": onnx_file, "nnet": nnet_file, "txt": text_file}[kind](rng))
        try:
            found = read_graph(path)[0] if kind == "onnx" else read_chain(path)
        except ValueError as error:
            fates[kind, "refused"] += 1
            if path.name not in str(error):
                wrong.append((path.name, "an error without the file", str(error)))
            continue
        except Exception as error:  # any other is what must not be
            wrong.append((path.name, "a foreign error", repr(error)))
            continue
        fate = "accepted"
        if kind == "onnx":
            fate = _against_runtime(path, found, wrong)
        elif kind == "mat":
            accepted.append((path, found))
        else:
            again = {"nnet": nnet_again, "txt": text_again}[kind](path.read_text())
            if not same_chain(found, again):
                wrong.append((path.name, "another function", path.read_text()))
        fates[kind, fate] += 1
    for (path, chain), layers in zip(
        accepted, scipy_reads([path for path, _ in accepted]), strict=True
    ):
        if layers is None or isinstance(layers, str):
            fates["mat", "accepted, refused by scipy"] += 1
        elif not all(
            np.array_equal(W, V) and np.array_equal(b, c)
            for (W, b), (V, c) in zip(chain.layers, layers, strict=True)
        ):
            wrong.append((path.name, "another function", str(layers)))
    return fates, wrong


def _against_runtime(path, graph, wrong):
    with np.errstate(all="ignore"):
        try:
            onnx_graphs.require_same(path, graph, onnx_runtime_points(graph))
        except ValueError as error:
            if "refuses" in str(error):
                return "accepted, refused by onnxruntime"
            wrong.append((path.name, "another function", str(error)))
    return "accepted"


def onnx_runtime_points(graph):
    rng = np.random.default_rng(1)
    return [scale * rng.normal(size=graph.size()) for scale in (0.3, 1.0, 1.0, 5.0)]
