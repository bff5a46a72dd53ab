"""Keras's files: the configuration of a model and the weights of each of its layers.

Sources: the formats of Keras, of `.keras` (a zip of `config.json`, `metadata.json` and
`model.weights.h5`) and of the legacy `.h5` (HDF5 with an attribute `model_config`). No code of a
file is run, no link out of it is followed, and no size is believed before it is checked.
HDF5's own library reads the bytes: of some damaged ones it makes a loop without end, as others do
who read them by it.
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.readers.moving import ROOM

ENDINGS = (".keras", ".h5", ".hdf5")
"""Endings of Keras's files."""

VERSIONS = (2, 3)
"""Versions of Keras whose layers were compared with what is read."""

UNPACKED = 2**29
"""Bytes that a member of a zip may hold once it is unpacked."""

CONTAINERS = ("layers", "_layer_checkpoint_dependencies")
"""What files of weights call the group of a model's layers; the second one is older."""

ASIDE = ("seed_generator",)
"""Groups of a layer that hold states of random numbers, which count in training alone."""


class KerasFile(NamedTuple):
    """What a file holds.

    Attributes:
        model: its configuration, with `class_name` and `config`.
        layers: configurations of the layers, in the order of the file.
        version: the first number of the version of Keras that wrote it.
        weights: by the names of layers: names, where the file has any, and arrays in their order.
    """

    model: dict[str, Any]
    layers: tuple[dict[str, Any], ...]
    version: int
    weights: dict[str, list[tuple[str | None, np.ndarray]]]


def read_file(path: Path) -> KerasFile:
    """The configuration and the weights of a file of Keras.

    Raises:
        ImportError: the package `h5py` is missing.
        ValueError: it is none of Keras's files, damaged, or holds weights that belong to no layer.
    """
    try:
        import h5py
    except ImportError:
        raise ImportError(
            "reading Keras files needs the package h5py: pip install 'reachjax[keras]'"
        ) from None
    content = path.read_bytes()
    try:
        if content[:4] == b"PK\x03\x04":
            return _archive(content)
        with h5py.File(io.BytesIO(content), "r") as file:
            return _legacy(file)
    except (
        OSError,
        RuntimeError,
        KeyError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
    ) as error:
        # h5py's and zipfile's, for what is damaged or cut off
        text = " ".join(str(error).split())[:300]
        raise ValueError(f"it is no file of Keras, or damaged: {text}") from error


def _archive(content: bytes) -> KerasFile:
    """The content of a `.keras` file."""
    import h5py

    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = archive.namelist()
        if len(set(names)) != len(names):
            raise ValueError("two members of the zip have one name")
        texts = [_member(archive, name) for name in ("metadata.json", "config.json")]
        weights = _member(archive, "model.weights.h5")
    metadata, model = (_parsed(text, "the zip's description") for text in texts)
    layers = layers_of(model)
    with h5py.File(io.BytesIO(weights), "r") as file:
        held = [each for each in CONTAINERS if each in file]
        if len(held) > 1:
            raise ValueError(f"its weights lie in {held}, which stand for the same")
        found = _numbered(_group(file, held[0]), layers) if held else {}
    return KerasFile(model, layers, _version(metadata.get("keras_version")), found)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if name not in archive.namelist():
        raise ValueError(
            f"the zip holds no {name}, but {archive.namelist()[:8]}: save it by "
            "model.save('model.keras')"
        )
    info = archive.getinfo(name)
    if info.file_size > UNPACKED:
        raise ValueError(f"{name} holds {info.file_size} bytes, but {UNPACKED} is the most")
    if info.flag_bits & 1:
        raise ValueError(f"{name} is encrypted")
    return archive.read(name)


def _legacy(file: Any) -> KerasFile:
    """The content of a legacy `.h5` file."""
    if "model_config" not in file.attrs or "model_weights" not in file:
        raise ValueError(
            "it holds no model_config with model_weights, so it has weights alone, or is of "
            "another program: save the whole model by model.save('model.keras')"
        )
    model = _parsed(file.attrs["model_config"], "model_config")
    layers = layers_of(model)
    version = file.attrs.get(
        "keras_version", _group(file, "model_weights").attrs.get("keras_version")
    )
    return KerasFile(
        model, layers, _version(version), _named(_group(file, "model_weights"), layers)
    )


def _parsed(text: Any, what: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{what} is no JSON: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{what} must be an object of JSON, but a {type(found).__name__} arrived")
    return found


def _version(value: Any) -> int:
    text = value.decode(errors="replace") if isinstance(value, bytes) else value
    found = re.match(r"(\d+)\.", text) if isinstance(text, str) else None
    if found is None or int(found.group(1)) not in VERSIONS:
        raise ValueError(
            f"it was written by version {text!r} of Keras, but {VERSIONS} are known: load it "
            "there, and save it by a newer version"
        )
    return int(found.group(1))


def layers_of(model: dict[str, Any]) -> tuple[dict[str, Any], ...]:
    """The configurations of a model's layers, each with a class, a name of its own and settings.

    Raises:
        ValueError: one of them is not so.
    """
    config = model.get("config")
    layers = config.get("layers") if isinstance(config, dict) else None
    if not isinstance(layers, list) or not layers:
        raise ValueError(
            f"the model, a {model.get('class_name')!r}, has no list of layers: models of Keras "
            "that are Sequential or Functional are known"
        )
    for place, each in enumerate(layers):
        settings = each.get("config") if isinstance(each, dict) else None
        if not isinstance(settings, dict) or not isinstance(each.get("class_name"), str):
            raise ValueError(f"layer {place} has no class_name and config, but it is {each!r:.80}")
        if not isinstance(settings.get("name"), str):
            raise ValueError(f"layer {place} ({each['class_name']}) has no name")
    names = [each["config"]["name"] for each in layers]
    if len(set(names)) != len(names):
        raise ValueError(f"two layers have one name: {sorted(names)}")
    return tuple(layers)


def _snake(name: str) -> str:
    """The name of a class as Keras writes it for groups of weights."""
    name = re.sub(r"\W+", "", name)
    name = re.sub("(.)([A-Z][a-z]+)", r"\1_\2", name)
    return re.sub("([a-z])([A-Z])", r"\1_\2", name).lower()


def _numbered(
    group: Any, layers: tuple[dict[str, Any], ...]
) -> dict[str, list[tuple[str | None, np.ndarray]]]:
    """Weights of a `.keras` file: groups are counted by classes, and arrays have numbers."""
    found: dict[str, list[tuple[str | None, np.ndarray]]] = {}
    counts: dict[str, int] = {}
    known = set()
    room = ROOM
    for each in layers:
        name, kind = each["config"]["name"], _snake(each["class_name"])
        counts[kind] = counts.get(kind, -1) + 1
        key = f"{kind}_{counts[kind]}" if counts[kind] else kind
        known.add(key)
        if key not in group:
            found[name] = []
            continue
        held = _group(group, key)
        for other in set(held) - {"vars", *ASIDE}:
            if next(_datasets(_group(held, other)), None) is not None:
                raise ValueError(
                    f"the layer {name!r} ({each['class_name']}) holds weights of {other!r}, which "
                    "are not known"
                )
        variables: Any = _group(held, "vars") if "vars" in held else {}
        told = variables.attrs.get("name", name) if "vars" in held else name
        if told != name:
            raise ValueError(f"the weights of {told!r} stand where those of {name!r} should")
        numbers = sorted(variables, key=lambda text: (len(text), text))
        if numbers != [str(k) for k in range(len(numbers))]:
            raise ValueError(f"the weights of the layer {name!r} have the names {numbers[:8]}")
        found[name] = []
        for number in numbers:
            found[name].append((None, _array(variables, number, name, room)))
            room -= found[name][-1][1].size
    if lost := [key for key in group if key not in known]:
        raise ValueError(
            f"it holds weights of {sorted(lost)[:8]}, which are no layers of the model"
        )
    return found


def _named(
    group: Any, layers: tuple[dict[str, Any], ...]
) -> dict[str, list[tuple[str | None, np.ndarray]]]:
    """Weights of a legacy file: groups and arrays have names, which attributes put in order."""
    found: dict[str, list[tuple[str | None, np.ndarray]]] = {
        each["config"]["name"]: [] for each in layers
    }
    listed = _texts(group, "layer_names")
    if len(set(listed)) != len(listed):
        raise ValueError(f"model_weights lists a layer twice: {listed[:8]}")
    room = ROOM
    for name in (*listed, *(each for each in group if each not in listed)):
        held = _group(group, name)
        texts = _texts(held, "weight_names")
        if name not in found or name not in listed:
            if texts or next(_datasets(held), None) is not None:
                raise ValueError(f"it holds weights of {name!r}, which is no layer of the model")
            continue
        for text in texts:
            *folders, last = text.split("/")
            place = held
            for folder in folders:
                place = _group(place, folder)
            found[name].append((last.split(":")[0], _array(place, last, name, room)))
            room -= found[name][-1][1].size
        if sum(1 for _ in _datasets(held)) != len(set(texts)) or len(set(texts)) != len(texts):
            raise ValueError(f"weight_names of the layer {name!r} do not list each array once")
    return found


def _texts(group: Any, name: str) -> list[str]:
    """An attribute of texts, which Keras cuts into numbered ones where it is long."""
    parts = [name] if name in group.attrs else []
    while not parts or parts[0] != name:
        if f"{name}{len(parts)}" not in group.attrs:
            break
        parts.append(f"{name}{len(parts)}")
    if not parts:
        raise ValueError(f"the group {group.name!r} has no attribute {name}")
    values = [each for part in parts for each in np.ravel(group.attrs[part])]
    texts = [each.decode(errors="replace") if isinstance(each, bytes) else each for each in values]
    if not all(isinstance(each, str) and each for each in texts):
        raise ValueError(f"the attribute {name} of {group.name!r} must be texts")
    return [str(each) for each in texts]


def _child(group: Any, name: str) -> Any:
    """What a group holds itself; links to elsewhere may be to another file."""
    import h5py

    if name not in ("", ".", "..") and "/" not in name and name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            return group[name]
        raise ValueError(f"{name!r} in {group.name!r} is a link, which is not followed")
    raise ValueError(f"{group.name!r} holds no {name!r}: the file is damaged, or cut off")


def _group(group: Any, name: str) -> Any:
    import h5py

    found = _child(group, name)
    if not isinstance(found, h5py.Group):
        raise ValueError(f"{found.name!r} must be a group, but it is an array")
    return found


def _datasets(group: Any, depth: int = 0) -> Iterator[str]:
    """The names of all arrays within a group."""
    import h5py

    if depth > 16:
        raise ValueError("groups stand in one another, more than 16 deep")
    for name in group:
        held = _child(group, name)
        if isinstance(held, h5py.Group):
            yield from _datasets(held, depth + 1)
        else:
            yield held.name


def _array(group: Any, name: str, layer: str, room: int) -> np.ndarray:
    """The numbers of an array in 64 bits, in which those of 32 bits are exact."""
    import h5py

    found = _child(group, name)
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"the weights {name!r} of the layer {layer!r} are no array")
    if found.is_virtual or found.external:
        raise ValueError(f"the weights {name!r} of the layer {layer!r} lie in another file")
    if found.shape is None or found.dtype.kind not in "iuf" or found.dtype == np.float16:
        raise ValueError(
            f"the weights {name!r} of the layer {layer!r} are of {found.dtype}: only numbers of 32 "
            "and 64 bits are known. Save the model in float32"
        )
    if math.prod(found.shape) > room:
        raise ValueError(f"the weights of all layers together have more than {ROOM} entries")
    array = np.asarray(found[()], float)
    if not np.isfinite(array).all():
        raise ValueError(f"the weights {name!r} of the layer {layer!r} must be finite numbers")
    return array
