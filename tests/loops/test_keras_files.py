"""Networks from Keras's files compute what Keras does, and all else is refused by its name."""

import copy
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.special

import reachjax as rj
from reachjax.loops.readers.keras_graphs import read_graph
from reachjax.loops.readers.keras_layers import ACTIVATIONS, LAYERS
from tests.loops.keras_models import (
    dense,
    described,
    functional,
    h5py,
    sequential,
    write_h5,
    write_keras,
)

FOLDER = Path(__file__).parent.parent / "data" / "networks"


def floats(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


W, B = floats(3, 4, seed=1), floats(4, seed=2)
V, C = floats(4, 2, seed=3), floats(2, seed=4)
NET = sequential([3], dense("first", 4, "relu"), dense("last", 2))
WEIGHTS = {"first": {"kernel": W, "bias": B}, "last": {"kernel": V, "bias": C}}


@pytest.mark.parametrize("name", ["keras3.keras", "keras2.h5"])
def test_files_that_keras_wrote_compute_what_it_did(name):
    net, held = rj.Network.from_file(FOLDER / name), np.load(FOLDER / "keras_outputs.npz")
    stem = name.split(".")[0]
    found = [net(x.astype(float)) for x in held[f"{stem}_x"]]
    np.testing.assert_allclose(found, held[f"{stem}_y"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("write", [write_keras, write_h5])
def test_weights_are_those_of_the_file_in_64_bits(write, tmp_path):
    ending = "keras" if write is write_keras else "h5"
    graph, *sizes = read_graph(write(tmp_path / f"net.{ending}", NET, WEIGHTS))
    x = floats(3, seed=5).astype(float)
    W64, V64 = W.astype(float), V.astype(float)
    expected = np.maximum(x @ W64 + B, 0) @ V64 + C
    assert sizes == [3, 2]
    assert graph(x).dtype == np.float64
    np.testing.assert_allclose(graph(x), expected, rtol=1e-13)


def elu(x, alpha=1.0):
    return np.where(x > 0, x, alpha * np.expm1(x))


REFERENCES = {
    "celu": elu,
    "elu": elu,
    "exponential": np.exp,
    "gelu": lambda x: x * scipy.special.ndtr(x),
    "hard_sigmoid": lambda x: np.clip((x + 3) / 6, 0, 1),
    "hard_silu": lambda x: x * np.clip((x + 3) / 6, 0, 1),
    "hard_swish": lambda x: x * np.clip((x + 3) / 6, 0, 1),
    "hard_tanh": lambda x: np.clip(x, -1, 1),
    "leaky_relu": lambda x: np.where(x > 0, x, 0.2 * x),
    "linear": lambda x: x,
    "log_sigmoid": scipy.special.log_expit,
    "log_softmax": scipy.special.log_softmax,
    "mish": lambda x: x * np.tanh(np.log1p(np.exp(x))),
    "relu": lambda x: np.where(x > 0, x, 0),
    "relu6": lambda x: np.clip(x, 0, 6),
    "selu": lambda x: 1.0507009873554805 * elu(x, 1.6732632423543772),
    "sigmoid": scipy.special.expit,
    "silu": lambda x: x * scipy.special.expit(x),
    "softmax": scipy.special.softmax,
    "softplus": lambda x: np.log1p(np.exp(x)),
    "softsign": lambda x: x / (1 + abs(x)),
    "swish": lambda x: x * scipy.special.expit(x),
    "tanh": np.tanh,
    "tanh_shrink": lambda x: x - np.tanh(x),
}


def test_every_activation_and_layer_has_a_case():
    assert set(REFERENCES) == set(ACTIVATIONS)
    assert {kind for kind, *_ in CASES.values()} == set(LAYERS) - {"Dense", *MERGED}


POINTS = [np.array([-4.0, -1.7, -0.3, 0.0, 0.2, 1.4, 3.5, 7.0])]


@pytest.mark.parametrize("name", REFERENCES)
def test_activations_are_those_of_keras(name, tmp_path):
    model = sequential([8], described("Activation", "phi", activation=name))
    graph, *_ = read_graph(write_keras(tmp_path / "net.keras", model, {}))
    for x in POINTS:
        np.testing.assert_allclose(graph(x), REFERENCES[name](x), rtol=1e-12, atol=1e-13)


def test_hard_sigmoids_of_version_2_have_another_slope(tmp_path):
    model = sequential([8], described("Activation", "phi", activation="hard_sigmoid"))
    (x,) = POINTS
    for write, version, slope in ((write_h5, "2.15.0", 0.2), (write_h5, "3.9.0", 1 / 6)):
        graph, *_ = read_graph(write(tmp_path / "net.h5", model, {}, version=version))
        np.testing.assert_allclose(graph(x), np.clip(slope * x + 0.5, 0, 1), rtol=1e-12)


NOISE = {"rate": 0.1, "seed": None}
POOLED = {"padding": "valid", "data_format": "channels_last"}
CONVOLVED = {
    **POOLED,
    **{"filters": 2, "dilation_rate": 1, "groups": 1, "activation": "linear", "use_bias": False},
}
GAMMA, BETA, MEAN = floats(3, seed=6), floats(3, seed=7), floats(3, seed=8)
VARIANCE = np.array([0.5, 1.0, 2.0], np.float32)
BATCH = {"gamma": GAMMA, "beta": BETA, "moving_mean": MEAN, "moving_variance": VARIANCE}
ADAPTED = {"mean": MEAN, "variance": VARIANCE, "count": np.array(3, np.int64)}
KERNEL1, KERNEL2 = floats(2, 3, 2, seed=9), floats(2, 2, 1, 2, seed=10)


def windows(x, k=2):
    """Windows (rows, columns, k, k, channels) of an image."""
    found = np.lib.stride_tricks.sliding_window_view(x, (k, k), axis=(0, 1))
    return np.moveaxis(found, 2, -1)


def layer_normalised(x):
    return (x - x.mean()) / np.sqrt(x.var() + 1e-3) * GAMMA + BETA


def same(x):
    return x


CASES = {
    "activation": ("Activation", [3], {"activation": "tanh"}, {}, np.tanh),
    "regularised": ("ActivityRegularization", [3], {"l1": 0.1, "l2": 0.0}, {}, same),
    "alpha dropout": ("AlphaDropout", [3], NOISE, {}, same),
    "averages": (
        "AveragePooling1D",
        [5, 3],
        {"pool_size": [2], "strides": [2], **POOLED},
        {},
        lambda x: (x[:4:2] + x[1:4:2]) / 2,
    ),
    "averages of images": (
        "AveragePooling2D",
        [4, 4, 2],
        {"pool_size": [2, 2], "strides": [2, 2], **POOLED},
        {},
        lambda x: windows(x)[::2, ::2].mean(axis=(2, 3)),
    ),
    "batch": (
        "BatchNormalization",
        [3],
        {"axis": -1, "epsilon": 1e-3, "center": True, "scale": True, "momentum": 0.9},
        BATCH,
        lambda x: GAMMA * (x - MEAN) / np.sqrt(VARIANCE.astype(float) + 1e-3) + BETA,
    ),
    "line": (
        "Conv1D",
        [5, 3],
        {**CONVOLVED, "kernel_size": [2], "strides": [1]},
        {"kernel": KERNEL1},
        lambda x: np.stack([np.einsum("kc,kco->o", x[t : t + 2], KERNEL1) for t in range(4)]),
    ),
    "line before": (
        "Conv1D",
        [5, 3],
        {**CONVOLVED, "kernel_size": [2], "strides": [1], "padding": "causal"},
        {"kernel": KERNEL1},
        lambda x: np.stack(
            [
                np.einsum("kc,kco->o", np.vstack([0 * x[:1], x])[t : t + 2], KERNEL1)
                for t in range(5)
            ]
        ),
    ),
    "image": (
        "Conv2D",
        [4, 5, 1],
        {**CONVOLVED, "kernel_size": [2, 2], "strides": [1, 1]},
        {"kernel": KERNEL2},
        lambda x: np.einsum("rcijk,ijko->rco", windows(x), KERNEL2),
    ),
    "same image": (
        "Conv2D",
        [4, 4, 1],
        {**CONVOLVED, "kernel_size": [2, 2], "strides": [1, 1], "padding": "same"},
        {"kernel": KERNEL2},
        lambda x: np.einsum(
            "rcijk,ijko->rco", windows(np.pad(x, [(0, 1), (0, 1), (0, 0)])), KERNEL2
        ),
    ),
    "dropout": ("Dropout", [3], NOISE, {}, same),
    "elu": ("ELU", [3], {"alpha": 0.5}, {}, lambda x: elu(x, 0.5)),
    "flat": ("Flatten", [2, 3], {"data_format": "channels_last"}, {}, same),
    "noise": ("GaussianNoise", [3], {"stddev": 0.1}, {}, same),
    "noisy factors": ("GaussianDropout", [3], NOISE, {}, same),
    "mean": (
        "GlobalAveragePooling1D",
        [5, 3],
        {"data_format": "channels_last", "keepdims": False},
        {},
        lambda x: x.mean(axis=0),
    ),
    "mean of image": (
        "GlobalAveragePooling2D",
        [4, 5, 2],
        {"data_format": "channels_last", "keepdims": False},
        {},
        lambda x: x.mean(axis=(0, 1)),
    ),
    "largest": (
        "GlobalMaxPooling1D",
        [5, 3],
        {"data_format": "channels_first"},
        {},
        lambda x: x.max(axis=1),
    ),
    "largest of image": (
        "GlobalMaxPooling2D",
        [4, 5, 2],
        {"data_format": "channels_last"},
        {},
        lambda x: x.max(axis=(0, 1)),
    ),
    "identity": ("Identity", [3], {}, {}, same),
    "layer": (
        "LayerNormalization",
        [3],
        {"axis": -1, "epsilon": 1e-3, "center": True, "scale": True},
        {"gamma": GAMMA, "beta": BETA},
        layer_normalised,
    ),
    "leaky": (
        "LeakyReLU",
        [3],
        {"negative_slope": 0.25},
        {},
        lambda x: np.where(x > 0, x, 0.25 * x),
    ),
    "leaky of version 2": (
        "LeakyReLU",
        [3],
        {"alpha": 2.0},
        {},
        lambda x: np.where(x > 0, x, 2 * x),
    ),
    "maxima": (
        "MaxPooling1D",
        [5, 3],
        {"pool_size": [2], "strides": [1], **POOLED},
        {},
        lambda x: np.maximum(x[:-1], x[1:]),
    ),
    "maxima of images": (
        "MaxPooling2D",
        [5, 5, 2],
        {"pool_size": [3, 3], "strides": [2, 2], **POOLED},
        {},
        lambda x: windows(x, 3)[::2, ::2].max(axis=(2, 3)),
    ),
    "adapted": (
        "Normalization",
        [3],
        {"axis": [-1], "mean": None, "variance": None, "invert": False},
        ADAPTED,
        lambda x: (x - MEAN) / np.sqrt(VARIANCE.astype(float)),
    ),
    "normalised": (
        "Normalization",
        [3],
        {"axis": [-1], "mean": [1, 2, 3], "variance": [4, 4, 1], "invert": True},
        {},
        lambda x: x * [2, 2, 1] + [1, 2, 3],
    ),
    "slopes": (
        "PReLU",
        [3],
        {"shared_axes": None},
        {"alpha": GAMMA},
        lambda x: np.where(x > 0, x, GAMMA * x),
    ),
    "turned": ("Permute", [2, 3], {"dims": [2, 1]}, {}, lambda x: x.T),
    "relu": (
        "ReLU",
        [3],
        {"max_value": 0.5, "negative_slope": 0.1, "threshold": 0.0},
        {},
        lambda x: np.where(x > 0, np.minimum(x, 0.5), 0.1 * x),
    ),
    "relu from a threshold": (
        "ReLU",
        [3],
        {"max_value": None, "negative_slope": 0.5, "threshold": 0.3},
        {},
        lambda x: np.where(x > 0.3, x, 0.5 * (x - 0.3)),
    ),
    "scaled": (
        "Rescaling",
        [3],
        {"scale": 2.0, "offset": [1, 2, 3]},
        {},
        lambda x: 2 * x + [1, 2, 3],
    ),
    "shaped": ("Reshape", [2, 3], {"target_shape": [3, -1]}, {}, same),
    "softmax": ("Softmax", [2, 3], {"axis": 1}, {}, lambda x: scipy.special.softmax(x, axis=0)),
    "lines dropped": ("SpatialDropout1D", [2, 3], {"rate": 0.1}, {}, same),
    "images dropped": (
        "SpatialDropout2D",
        [2, 2, 3],
        {"rate": 0.1, "data_format": "channels_last"},
        {},
        same,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_layers_compute_what_keras_says(name, tmp_path):
    kind, shape, config, weights, expected = CASES[name]
    model = sequential(shape, described(kind, "it", **config))
    for path in (
        write_keras(tmp_path / "net.keras", model, {"it": weights}),
        write_h5(tmp_path / "net.h5", model, {"it": weights}),
    ):
        graph, *sizes = read_graph(path)
        for seed in (1, 2):
            x = floats(*shape, seed=seed).astype(float)
            found, told = graph(x.ravel()), np.ravel(expected(x))
            assert sizes == [x.size, told.size]
            np.testing.assert_allclose(found, told, rtol=1e-6 if weights else 1e-12, atol=1e-7)


MERGED = {
    "Add": lambda a, b: a + b,
    "Average": lambda a, b: (a + b) / 2,
    "Concatenate": lambda a, b: np.concatenate([a, b]),
    "Maximum": np.maximum,
    "Minimum": np.minimum,
    "Multiply": lambda a, b: a * b,
    "Subtract": lambda a, b: a - b,
}


def branched(kind):
    """A model of two branches; the layers of its file stand out of their order."""
    settings = {"axis": -1} if kind == "Concatenate" else {}
    return functional(
        [
            described("InputLayer", "obs", []),
            described(kind, "join", ["b", "a"], **settings),
            described("Dense", "a", ["obs"], units=4, activation="relu", use_bias=True),
            described("Dense", "b", ["obs"], units=4, activation="tanh", use_bias=False),
        ],
        wanted="join",
    )


BRANCHES = {"a": {"kernel": W, "bias": B}, "b": {"kernel": -W}}


@pytest.mark.parametrize("kind", MERGED)
def test_branches_are_joined_in_their_order(kind, tmp_path):
    graph, *_ = read_graph(write_keras(tmp_path / "net.keras", branched(kind), BRANCHES))
    x = floats(3, seed=5).astype(float)
    a, b = np.maximum(x @ W.astype(float) + B, 0), np.tanh(-x @ W.astype(float))
    np.testing.assert_allclose(graph(x), MERGED[kind](b, a), rtol=1e-12)


def test_wires_of_version_2_are_read(tmp_path):
    model = branched("Subtract")
    for each in model["config"]["layers"]:
        del each["module"], each["registered_name"]
        for node in each["inbound_nodes"]:
            taken = node["args"][0] if isinstance(node["args"][0], list) else node["args"]
            histories = [[*one["config"]["keras_history"], {}] for one in taken]
            each["inbound_nodes"] = [histories]
    graph, *_ = read_graph(write_h5(tmp_path / "net.h5", model, BRANCHES))
    expected, *_ = read_graph(write_keras(tmp_path / "net.keras", branched("Subtract"), BRANCHES))
    x = floats(3, seed=5).astype(float)
    np.testing.assert_array_equal(graph(x), expected(x))


def with_first(**config):
    """The plain network, with other settings of its first layer."""
    model = copy.deepcopy(NET)
    model["config"]["layers"][1]["config"] |= config
    return model


def with_described(**told):
    model = copy.deepcopy(NET)
    model["config"]["layers"][1] |= told
    return model


def shared():
    model = branched("Add")
    model["config"]["layers"][2]["inbound_nodes"] *= 2
    return model


def ends(**told):
    model = branched("Add")
    model["config"] |= told
    return model


def circular():
    model = branched("Add")
    model["config"]["layers"][2] = described(
        "Dense", "a", ["join"], units=4, activation="relu", use_bias=True
    )
    return model


def called(**options):
    model = branched("Add")
    model["config"]["layers"][2]["inbound_nodes"][0]["kwargs"] = options
    return model


HALF = {"module": "keras", "class_name": "DTypePolicy", "config": {"name": "mixed_float16"}}
LAMBDA = {"class_name": "__lambda__", "config": {"code": "4wEAAAA="}}

REFUSED = {
    "lora": (with_first(lora_rank=4), WEIGHTS, "'first' .*'lora_rank' is 4"),
    "quantised": (
        with_first(dtype={"class_name": "QuantizedDTypePolicy"}),
        WEIGHTS,
        "'first'.*Quan",
    ),
    "half": (with_first(dtype=HALF), WEIGHTS, "'first'.*'mixed_float16'.*Save the model"),
    "bfloat": (with_first(dtype="bfloat16"), WEIGHTS, "'first'.*'bfloat16'"),
    "activation": (with_first(activation="swoosh"), WEIGHTS, "'first'.*'swoosh' is not known"),
    "pickled": (with_first(activation=LAMBDA), WEIGHTS, "'first'.*activation.*is not known"),
    "units": (with_first(units="4"), WEIGHTS, "'first'.*'units' must be a whole number"),
    "more units": (with_first(units=5), WEIGHTS, r"'first'.*shape \(3, 5\), not \(3, 4\)"),
    "bias": (with_first(use_bias=False), WEIGHTS, "'first'.*more weights than it has"),
    "truth": (with_first(use_bias=1), WEIGHTS, "'first'.*'use_bias' must be one of"),
    "lambda": (with_described(class_name="Lambda"), {}, "'first' .Lambda.*not known"),
    "own layer": (with_described(module="mine"), WEIGHTS, "'first'.*none of Keras's own"),
    "registered": (with_described(registered_name="my>Dense"), WEIGHTS, "none of Keras's own"),
    "told more": (with_described(pruned=0.5), WEIGHTS, "'first'.*'pruned'"),
    "missing": (NET, {"first": WEIGHTS["first"]}, "'last'.*'kernel' are missing"),
    "no bias": (NET, {**WEIGHTS, "first": {"kernel": W}}, "'first'.*'bias' are missing"),
    "transposed": (
        NET,
        {**WEIGHTS, "first": {"kernel": W.T, "bias": B}},
        r"'first'.*shape \(3, 4\), not \(4, 3\)",
    ),
    "infinite": (
        NET,
        {**WEIGHTS, "first": {"kernel": W, "bias": B * np.inf}},
        "'first' must be finite",
    ),
    "16 bits": (
        NET,
        {**WEIGHTS, "first": {"kernel": W, "bias": B.astype(np.float16)}},
        "'first' are of float16",
    ),
    "shared": (shared(), BRANCHES, "'a'.*used once, but 2 uses"),
    "circle": (circular(), BRANCHES, "'a', 'join'.*wait for one another"),
    "training": (called(training=True), BRANCHES, "'a'.*called with {'training': True}"),
    "inputs": (ends(input_layers=[["obs", 0, 0], ["b", 0, 0]]), BRANCHES, "network of one input"),
    "outputs": (ends(output_layers=[["a", 0, 0], ["b", 0, 0]]), BRANCHES, "network of one output"),
    "named outputs": (ends(output_layers={"y": ["a", 0, 0]}), BRANCHES, "network of one output"),
    "no such output": (ends(output_layers=["z", 0, 0]), BRANCHES, "'z' must be among"),
    "second result": (ends(output_layers=["a", 0, 1]), BRANCHES, "not the only result"),
    "own model": ({**NET, "class_name": "MyModel"}, WEIGHTS, "'MyModel', but Sequential"),
    "no layers": ({"class_name": "Sequential", "config": {}}, None, "has no list of layers"),
    "open": (sequential([None, 3], dense("first", 4)), {}, "sizes of its input must be known"),
    "batches": (
        sequential([3], dense("first", 4, batch_shape=[5, 3])),
        {},
        "'kernel' are missing",
    ),
    "twice": (sequential([3], dense("a", 4), dense("a", 4)), {}, "two layers have one name"),
    "sizes": (sequential([2**40], dense("a", 4)), {}, "larger than 16777216 entries"),
    "padded maxima": (
        sequential(
            [5, 3],
            described(
                "MaxPooling1D", "p", pool_size=[2], strides=[2], **{**POOLED, "padding": "same"}
            ),
        ),
        {},
        "'p'.*must be 'valid'",
    ),
    "no variance": (
        sequential(
            [3], described("Normalization", "n", axis=[-1], mean=[0, 0, 0], variance=[1, 0, 1])
        ),
        {},
        "'n'.*its variance is 0",
    ),
    "negative variance": (
        sequential([3], described("BatchNormalization", "n", **CASES["batch"][2])),
        {"n": {**BATCH, "moving_variance": -VARIANCE}},
        "'n'.*moving_variance must not be below 0",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_understood_is_refused_by_its_name(name, tmp_path):
    model, weights, told = REFUSED[name]
    path = tmp_path / "net.keras"
    with np.errstate(all="ignore"):
        if weights is None:
            write_keras(path, NET, WEIGHTS, **{"config.json": json.dumps(model)})
        else:
            write_keras(path, model, weights)
    with pytest.raises(ValueError, match=rf"net\.keras cannot be read: .*{told}"):
        rj.Network.from_file(path)


def test_containers_that_lack_a_part_say_what_to_do(tmp_path):
    path = tmp_path / "net.keras"
    for lost, told in (
        ({"config.json": None}, "holds no config.json"),
        ({"model.weights.h5": None}, "holds no model.weights.h5"),
        ({"metadata.json": "{}"}, "version None of Keras"),
        ({"config.json": "{"}, "is no JSON"),
        ({"config.json": "[" * 100_000}, "is no JSON"),
        ({"model.weights.h5": "none"}, "no file of Keras, or damaged"),
    ):
        with pytest.raises(ValueError, match=told):
            read_graph(write_keras(path, NET, WEIGHTS, **lost))
    with pytest.raises(ValueError, match=r"version '4.0' of Keras"):
        read_graph(write_keras(path, NET, WEIGHTS, version="4.0"))
    with h5py.File(tmp_path / "weights.h5", "w") as file:
        file["layers/dense/vars/0"] = W
    with pytest.raises(ValueError, match=r"has weights alone.*save the whole model"):
        read_graph(tmp_path / "weights.h5")


def test_weights_of_another_name_or_layer_are_refused(tmp_path):
    path = tmp_path / "net.h5"
    other = {**WEIGHTS, "first": {"bias": B, "kernel": W}}
    with pytest.raises(ValueError, match=r"'first'.*'bias' where 'kernel' are expected"):
        read_graph(write_h5(path, NET, other))
    with h5py.File(write_h5(path, NET, WEIGHTS), "r+") as file:
        del file["model_weights/first/first/kernel:0"]
        file["model_weights/first/first/kernel:0"] = h5py.ExternalLink("other.h5", "/kernel")
    with pytest.raises(ValueError, match="is a link, which is not followed"):
        read_graph(path)
    with h5py.File(write_h5(path, NET, WEIGHTS), "r+") as file:
        file["model_weights/first/first/scale:0"] = B
    with pytest.raises(ValueError, match="do not list each array once"):
        read_graph(path)


def test_a_file_that_is_cut_off_or_damaged_is_an_error_of_its_own(tmp_path):
    rng = np.random.default_rng(0)
    for ending, write in (("keras", write_keras), ("h5", write_h5)):
        path = write(tmp_path / f"net.{ending}", NET, WEIGHTS)
        content = path.read_bytes()
        for size in (*rng.integers(0, len(content), 30), len(content) - 1):
            path.write_bytes(content[:size])
            with pytest.raises(ValueError, match="cannot be read"):
                read_graph(path)


def entries(value, place=()):
    """The places of all entries within a configuration."""
    yield place
    if isinstance(value, dict | list):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from entries(each, (*place, key))


JUNK = (None, -1, "junk", [], {}, 2.5, True, "lost", 10**400, "a", "obs")


@pytest.mark.parametrize(
    "shift", [0, *(pytest.param(k, marks=pytest.mark.long) for k in range(1, len(JUNK)))]
)
def test_configurations_that_are_damaged_are_refused_or_mean_the_same(shift, tmp_path):
    """A setting that is accepted in spite of it, such as a name, changes no output."""
    whole = branched("Concatenate")
    expected = read_graph(write_keras(tmp_path / "net.keras", whole, BRANCHES))[0](np.ones(3))
    refused = 0
    for number, place in enumerate(each for each in entries(whole) if each):
        junk = JUNK[(number + shift) % len(JUNK)]
        model = copy.deepcopy(whole)
        held = model
        for key in place[:-1]:
            held = held[key]
        if junk == "lost":
            del held[place[-1]]
        else:
            held[place[-1]] = junk
        path = tmp_path / "net.keras"
        write_keras(path, whole, BRANCHES, **{"config.json": json.dumps(model)})
        try:
            found = read_graph(path)[0](np.ones(3))
        except ValueError as error:
            refused += "net.keras cannot be read" in str(error)
            continue
        allowed = place[-1] == "activation" and junk is None  # which is linear
        assert allowed or np.array_equal(found, expected), place
    assert refused > 30


def test_without_h5py_the_error_says_what_to_install(tmp_path, monkeypatch):
    path = write_keras(tmp_path / "net.keras", NET, WEIGHTS)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"pip install 'reachjax\[keras\]'"):
        rj.Network.from_file(path)
