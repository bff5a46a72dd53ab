"""Files of Keras, as its versions 2 and 3 write them, of a few layers and without Keras."""

import io
import json
import re
import zipfile

import numpy as np

h5py = __import__("pytest").importorskip("h5py")

FLOAT32 = {"module": "keras", "class_name": "DTypePolicy", "config": {"name": "float32"}}


def described(kind, name, sources=None, **config):
    """The description of a layer, with what it takes in a functional model."""
    shape = {"batch_shape": [None, 3], "dtype": "float32"} if kind == "InputLayer" else {}
    settings = {"name": name, "trainable": True, "dtype": FLOAT32, **shape, **config}
    found = {"module": "keras.layers", "class_name": kind, "config": settings}
    found |= {"registered_name": None}
    if sources is None:
        return found
    taken = [
        {"class_name": "__keras_tensor__", "config": {"keras_history": [each, 0, 0]}}
        for each in sources
    ]
    args = [taken if len(taken) > 1 else taken[0]] if taken else []
    nodes = [{"args": args, "kwargs": {}}] if taken else []
    return found | {"name": name, "inbound_nodes": nodes}


def sequential(shape, *layers):
    """The configuration of a Sequential model."""
    first = described("InputLayer", "obs", batch_shape=[None, *shape])
    config = {"name": "net", "trainable": True, "layers": [first, *layers]}
    return {"module": "keras", "class_name": "Sequential", "config": config}


def functional(layers, given="obs", wanted=None):
    """The configuration of a Functional model, whose output is that of the last layer."""
    wanted = layers[-1]["name"] if wanted is None else wanted
    config = {"name": "net", "layers": layers, "input_layers": [[given, 0, 0]]}
    config |= {"output_layers": [[wanted, 0, 0]]}
    return {"module": "keras.src.models.functional", "class_name": "Functional", "config": config}


def dense(name, units, activation="linear", bias=True, **config):
    """The description of a layer that is fully connected."""
    return described(
        "Dense",
        name,
        units=units,
        activation=activation,
        use_bias=bias,
        bias_constraint=None,
        **config,
    )


def snake(name):
    """The name of a class as groups of weights have it."""
    name = re.sub("(.)([A-Z][a-z]+)", r"\1_\2", name)
    return re.sub("([a-z])([A-Z])", r"\1_\2", name).lower()


def write_keras(path, model, weights, version="3.9.0", **members):
    """Write a zip as version 3 does: weights are `{layer: {name: array}}`."""
    held = io.BytesIO()
    with h5py.File(held, "w") as file:
        counts = {}
        for each in model["config"]["layers"]:
            key, name = snake(each["class_name"]), each["config"]["name"]
            counts[key] = counts.get(key, -1) + 1
            group = file.create_group(
                f"layers/{key}_{counts[key]}" if counts[key] else f"layers/{key}"
            )
            group = group.create_group("vars")
            group.attrs["name"] = name
            for k, array in enumerate(weights.get(name, {}).values()):
                group[str(k)] = array
    texts = {
        "metadata.json": json.dumps({"keras_version": version}),
        "config.json": json.dumps(model),
        "model.weights.h5": held.getvalue(),
    }
    texts |= members
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in texts.items():
            if text is not None:
                archive.writestr(name, text)
    return path


def write_h5(path, model, weights, version="2.15.0"):
    """Write a legacy file as version 2 does."""
    with h5py.File(path, "w") as file:
        file.attrs["keras_version"] = version
        file.attrs["model_config"] = json.dumps(model)
        names = [each["config"]["name"] for each in model["config"]["layers"]]
        held = file.create_group("model_weights")
        held.attrs["layer_names"] = [each.encode() for each in names]
        for name in names:
            group = held.create_group(name)
            arrays = weights.get(name, {})
            texts = [f"{name}/{each}:0".encode() for each in arrays]
            group.attrs["weight_names"] = texts if texts else np.zeros(0)
            for text, array in zip(texts, arrays.values(), strict=True):
                group[text.decode()] = array
    return path
