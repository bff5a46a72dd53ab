"""Keras's models as graphs: what their layers take, in Sequential and in Functional models.

Everything in a configuration that is not understood is an error, which names the layer: a model is
read as exactly the function that it is at inference, or refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.readers.arrays import require_finite
from reachjax.loops.readers.keras_files import KerasFile, read_file
from reachjax.loops.readers.keras_layers import (
    COMMON,
    INPUT,
    LAYERS,
    Builder,
    Layer,
    require_own,
    require_policy,
    require_settings,
)
from reachjax.loops.readers.onnx_graphs import Graph

TOLD = (
    *("class_name", "config", "module", "registered_name", "name", "inbound_nodes"),
    *("build_config", "compile_config", "shared_object_id"),
)
"""What the description of a layer may hold beside its settings."""


def read_graph(path: Path) -> tuple[Graph, int, int]:
    """The graph of a file of Keras, with how many inputs and outputs it has.

    Raises:
        ImportError: the package `h5py` is missing.
        ValueError: it is none of Keras's files, damaged, or not understood, or its output is finite
            at none of a few points; the error names the file, and the layer.
    """
    try:
        with np.errstate(all="ignore"):
            file = read_file(path)
            graph, outputs = _built(file)
            require_finite(graph, graph.size())
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    return graph, graph.size(), outputs


@contextmanager
def _at(described: dict[str, Any]) -> Iterator[None]:
    """Errors that name the layer."""
    try:
        yield
    except ValueError as error:
        name = described["config"]["name"]
        raise ValueError(f"the layer {name!r} ({described['class_name']}): {error}") from error


def _built(file: KerasFile) -> tuple[Graph, int]:
    """The graph of a model, and the number of its outputs."""
    kind, config = file.model.get("class_name"), file.model["config"]
    if kind not in ("Sequential", "Functional", "Model"):
        raise ValueError(
            f"the model is a {kind!r}, but Sequential and Functional ones are known: write it as a "
            "function of JAX, and give it to Network"
        )
    if file.model.get("registered_name") not in (None, kind):
        raise ValueError(f"the model is registered as {file.model['registered_name']!r}")
    known = ("name", "trainable", "dtype", "layers", "build_input_shape", "input_layers")
    for key, value in config.items():
        if key not in (*known, "output_layers") and value is not None:
            raise ValueError(f"the model's setting {key!r} is {value!r:.80}, which is not known")
    require_policy(config.get("dtype"))
    for each in file.layers:
        with _at(each):
            require_own(each)
            if extra := [key for key in each if key not in TOLD and each[key] is not None]:
                raise ValueError(f"its description holds {extra}, which are not known")
            if each["class_name"] not in (*LAYERS, "InputLayer"):
                raise ValueError(f"it is of a class that is not known: {', '.join(LAYERS)} are")
    wired = _line(file) if kind == "Sequential" else _wired(file)
    builder = Builder(wired.shape)
    values = {wired.given: INPUT}
    left = dict(wired.sources)
    for each in file.layers:
        if each["class_name"] == "InputLayer":
            with _at(each):
                _require_input(each["config"])
    described = {each["config"]["name"]: each for each in file.layers}
    while left:
        ready = [name for name, sources in left.items() if all(s in values for s in sources)]
        if not ready:
            raise ValueError(f"the layers {sorted(left)[:8]} wait for one another, or for none")
        for name in ready:
            with _at(described[name]):
                operands = [values[each] for each in left.pop(name)]
                values[name] = _computed(builder, file, described[name], operands)
    wanted = values[wired.wanted]
    return builder.graph(wanted), np.size(builder.values[wanted])


def _computed(builder: Builder, file: KerasFile, described: dict, operands: list[str]) -> str:
    config, entry = described["config"], LAYERS[described["class_name"]]
    name = config["name"]
    layer = Layer(builder, config, name, file.weights.get(name, []), file.version)
    require_settings(layer, entry)
    if not entry.several and len(operands) != 1:
        raise ValueError(f"it takes one value, but {len(operands)} arrived")
    found = entry.compute(layer, *operands)
    if layer.left:
        shapes = [array.shape for _, array in layer.left]
        raise ValueError(f"it holds more weights than it has, of the shapes {shapes}")
    return found


class Wiring(NamedTuple):
    """What the layers of a model take.

    Attributes:
        shape: of the input, with a batch of one.
        given: the name of the input.
        sources: by the names of layers, the names of those that they take.
        wanted: the name of the output.
    """

    shape: tuple[int, ...]
    given: str
    sources: dict[str, list[str]]
    wanted: str


def _line(file: KerasFile) -> Wiring:
    """The wiring of a Sequential model."""
    names = [each["config"]["name"] for each in file.layers]
    inputs = [k for k, each in enumerate(file.layers) if each["class_name"] == "InputLayer"]
    if inputs not in ([], [0]):
        raise ValueError("an input stands between its layers")
    shapes = [_open(file.layers[0]["config"])]
    if not inputs:
        built = file.layers[0].get("build_config")
        shapes += [built.get("input_shape") if isinstance(built, dict) else None]
        shapes += [file.model["config"].get("build_input_shape")]
        names.insert(0, "")
    sources = {name: [before] for before, name in pairwise(names)}
    shape = next((each for each in shapes if each is not None), None)
    return Wiring(_shape(shape), names[0], sources, names[-1])


def _open(config: dict[str, Any]) -> Any:
    held = [config[key] for key in ("batch_shape", "batch_input_shape") if key in config]
    return held[0] if held else None


def _shape(sizes: Any) -> tuple[int, ...]:
    """The shape of an input, of which the batch is left open, or one."""
    if not isinstance(sizes, list) or len(sizes) < 2:
        raise ValueError(f"its input must have a batch and sizes, but its shape is {sizes!r:.80}")
    batch, *rest = sizes
    if batch is not None and (type(batch) is not int or batch != 1):
        raise ValueError(f"it takes {batch!r} inputs at a time: save it with a batch that is open")
    if not all(type(each) is int and each > 0 for each in rest):
        raise ValueError(f"the sizes of its input must be known, but its shape is {sizes}")
    return (1, *rest)


def _require_input(config: dict[str, Any]) -> None:
    for key in ("sparse", "ragged", "optional"):
        if config.get(key) not in (None, False):
            raise ValueError(f"its setting {key!r} must be false, but {config[key]!r} arrived")
    known = (*COMMON, "sparse", "ragged", "optional")
    if extra := [key for key in config if key not in known and config[key] is not None]:
        raise ValueError(f"its settings {extra} are not known")
    require_policy(config.get("dtype"))


def _wired(file: KerasFile) -> Wiring:
    """The wiring of a Functional model."""
    config = file.model["config"]
    (given,), (wanted,) = (_ends(config.get(f"{end}_layers"), end) for end in ("input", "output"))
    names = [each["config"]["name"] for each in file.layers]
    if given not in names or wanted not in names:
        raise ValueError(f"its input {given!r} and output {wanted!r} must be among {names[:16]}")
    sources = {}
    for each in file.layers:
        with _at(each):
            name = each["config"]["name"]
            if each.get("name", name) != name:
                raise ValueError(f"it has another name too, {each['name']!r}")
            nodes = each.get("inbound_nodes")
            if each["class_name"] == "InputLayer":
                if nodes or name != given:
                    raise ValueError(f"it is another input than {given!r}: one is known")
                continue
            if not isinstance(nodes, list) or len(nodes) != 1:
                count = len(nodes) if isinstance(nodes, list) else "none"
                raise ValueError(
                    f"it must be used once, but {count} uses arrived: layers that are shared are "
                    "not known. Write the network as a function of JAX, and give it to Network"
                )
            sources[name] = _sources(nodes[0])
            if lost := [source for source in sources[name] if source not in names]:
                raise ValueError(f"it takes {lost}, which are no layers of the model")
    used, open_ends = {wanted}, [wanted]
    while open_ends:
        new = [each for each in sources.get(open_ends.pop(), []) if each not in used]
        used.update(new)
        open_ends += new
    if left := [name for name in sources if name not in used]:
        raise ValueError(
            f"nothing takes the layers {left[:8]}, on which its output does not depend"
        )
    if given in sources:
        raise ValueError(f"its input {given!r} is no InputLayer")
    first = next(each for each in file.layers if each["config"]["name"] == given)
    return Wiring(_shape(_open(first["config"])), given, sources, wanted)


def _ends(value: Any, end: str) -> list[str]:
    """The name of the only input or output."""
    if isinstance(value, list) and len(value) == 1 and isinstance(value[0], list):
        value = value[0]
    if not isinstance(value, list) or not (len(value) == 3 and isinstance(value[0], str)):
        raise ValueError(
            f"it must be a network of one {end}, but its {end}s are {value!r:.120}: make a "
            "keras.Model of one of them, and save that"
        )
    return [_first(value)]


def _first(history: Any) -> str:
    """The layer whose first result this is."""
    fine = isinstance(history, list) and len(history) == 3 and isinstance(history[0], str)
    if not fine or any(type(each) is not int or each != 0 for each in history[1:]):
        raise ValueError(f"{history!r:.80} is not the only result of a layer")
    return history[0]


def _sources(node: Any) -> list[str]:
    """The layers that one use of a layer takes, as version 3 or version 2 writes them."""
    if isinstance(node, dict):
        args, kwargs = node.get("args"), node.get("kwargs")
        if not isinstance(args, list) or len(args) != 1 or not isinstance(kwargs, dict):
            raise ValueError(f"it must take one value, or one list of values, but {args!r:.80}")
        taken = args[0] if isinstance(args[0], list) else args
        found = [_first(_history(each)) for each in taken]
        options = [kwargs]
    elif isinstance(node, list):
        node = [node] if node and isinstance(node[0], str) else node
        if not all(isinstance(each, list) and len(each) in (3, 4) for each in node):
            raise ValueError(f"{node!r:.80} does not tell what it takes")
        found = [_first(each[:3]) for each in node]
        options = [each[3] for each in node if len(each) == 4]
    else:
        raise ValueError(f"{node!r:.80} does not tell what it takes")
    for each in options:
        if not isinstance(each, dict) or any(v not in (None, False) for v in each.values()):
            raise ValueError(f"it is called with {each!r:.80}, which is not known")
    if not found:
        raise ValueError("it takes nothing")
    return found


def _history(tensor: Any) -> Any:
    config = tensor.get("config") if isinstance(tensor, dict) else None
    if not isinstance(config, dict) or tensor.get("class_name") != "__keras_tensor__":
        raise ValueError(f"it takes {tensor!r:.80}, which is no value of a layer")
    return config.get("keras_history")
