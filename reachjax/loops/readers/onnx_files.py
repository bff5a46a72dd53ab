"""ONNX files: what of a file a chosen output depends on, checked against ONNX's own rules.

Everything else in the file is left aside. Whatever in it is not understood, or not as the standard
has it, is an error: a graph is read as exactly the function that it holds, or refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.readers.kinds import BOOL, KINDS, is_float, kind_name
from reachjax.loops.readers.moving import ROOM
from reachjax.loops.readers.operators import OPERATORS, OPSETS

BATCH = 1
"""Dimensions that a file leaves open, as exporters do with a batch, are this."""

DEFAULT = ("", "ai.onnx")
"""Names of ONNX's own operators' domain."""

Shape = tuple[int, ...]


class FileNode(NamedTuple):
    """One operator of a file, with defaults filled in.

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
    attributes: dict[str, Any]


class NetworkFile(NamedTuple):
    """What of a file a chosen output depends on.

    Attributes:
        nodes: in an order in which they can be computed.
        arrays: numbers of the file, by name, in its own kinds.
        given: names and shapes of the inputs that make up the vector.
        wanted: the name of the output.
        kinds: kinds of numbers, by the names of values.
        shapes: by the names of values, as far as the standard's rules tell them.
    """

    nodes: tuple[FileNode, ...]
    arrays: dict[str, np.ndarray]
    given: tuple[tuple[str, Shape], ...]
    wanted: str
    kinds: dict[str, int]
    shapes: dict[str, Shape]


def read_file(path: Path, inputs: Sequence[str] | None, output: str | None) -> NetworkFile:
    """The part of an ONNX file on which an output depends.

    Args:
        path: of the file.
        inputs: names of those that make up the vector; None for the only one that is used.
        output: its name; None for the only one.

    Raises:
        ImportError: the package `onnx` is missing.
        ValueError: the file is none of ONNX, against its rules, or not understood.
    """
    model = _loaded(path)
    wanted = _wanted(model.graph, output)
    nodes = _needed(model.graph, wanted)
    used = {wanted, *(name for node in nodes for name in node.input)}
    held = [each for each in model.graph.initializer if each.name in used]
    given = _given(model.graph, used, inputs, {each.name for each in held})
    opset = _opset(model)
    for node in nodes:
        _require_known(node)
    # before the standard's own checks, whose memory grows with what a shape claims
    arrays = {each.name: _array(each, f"the initialiser {each.name!r}") for each in held}
    attributes = [_attributes(node, opset) for node in nodes]
    kinds, shapes = _inferred(_reduced(model, nodes, held, given, wanted))
    for name, kind in kinds.items():
        if kind not in KINDS:
            raise ValueError(f"{name!r} is of {kind_name(kind)}, which is not known")
    room = sum(math.prod(shape) for name, shape in shapes.items() if name not in arrays)
    if room > ROOM:
        raise ValueError(f"arrays within the network have {room} entries, but {ROOM} is the most")
    read = []
    for node, chosen in zip(nodes, attributes, strict=True):
        if node.op_type == "Constant":
            arrays[node.output[0]] = _constant(chosen, _named(node))
        else:
            read.append(_read(node, chosen, kinds))
    ends = tuple((each.name, _shape(each)) for each in given)
    return NetworkFile(tuple(read), arrays, ends, wanted, kinds, shapes)


def _loaded(path: Path) -> Any:
    """The model of a file, with its external data, and its own functions written out."""
    try:
        import onnx
        import onnx.external_data_helper
        import onnx.inliner
    except ImportError:
        raise ImportError(
            "reading ONNX files needs the package onnx: pip install 'reachjax[onnx]'"
        ) from None
    content = path.read_bytes()
    try:
        model = onnx.load_model_from_string(content)
        onnx.external_data_helper.load_external_data_for_model(model, str(path.parent))
        if any(each.domain in DEFAULT for each in model.functions):
            raise ValueError("it defines operators of ONNX's own anew")
        if model.functions:
            model = onnx.inliner.inline_local_functions(model)
    except Exception as error:  # kinds of protobuf's and onnx's own
        raise ValueError(f"it is no ONNX file: {_line(error)}") from error
    if not all(isinstance(text, str) for text in _texts(model)):
        raise ValueError("it holds names that are no text")
    for each in model.graph.node:
        each.domain = "" if each.domain in DEFAULT else each.domain
    if [each.version for each in model.opset_import if each.domain in DEFAULT] == [OLD]:
        _modernise(model)
    return model


def _texts(model: Any) -> Iterator[Any]:
    """The names in a model, which are bytes where they are no text."""
    for each in (*model.graph.input, *model.graph.output):
        yield each.name
        yield from (dim.dim_param for dim in each.type.tensor_type.shape.dim)
    yield from (each.name for each in model.graph.initializer)
    yield from (each.domain for each in model.opset_import)
    for node in model.graph.node:
        yield from (node.name, node.op_type, node.domain, *node.input, *node.output)
        yield from (attribute.name for attribute in node.attribute)


OLD = 6
"""The version of MATLAB's older exporter, in which broadcasting was asked for."""

BROADCAST = ("Add", "Div", "Gemm", "Mul", "Sub")


def _modernise(model: Any) -> None:
    """Write a model of version 6 as one of version 7, where they say the same.

    A Gemm of old took what is no matrix as one of rows for a batch (MATLAB's images of one row).
    """
    import onnx

    nodes = []
    for node in model.graph.node:
        _require_known(node)
        schemas = [onnx.defs.get_schema(node.op_type, version, "") for version in (OLD, OLD + 1)]
        asked = [each for each in node.attribute if each.name == "broadcast" and each.i == 1]
        if node.op_type in BROADCAST and len(asked) == 1:
            node.attribute.remove(asked[0])
        elif schemas[0].since_version != schemas[1].since_version:
            raise ValueError(
                f"{_named(node)} is written in version {OLD} of ONNX's operators, where it means "
                "something else than today: change it by onnx.version_converter.convert_version"
            )
        if node.op_type == "Gemm":
            rows = f"{node.input[0]}, as rows for {node.output[0]}"
            nodes.append(onnx.helper.make_node("Flatten", [node.input[0]], [rows], axis=1))
            node.input[0] = rows
        nodes.append(node)
    nodes = [onnx.NodeProto.FromString(each.SerializeToString()) for each in nodes]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    for each in model.graph.output:  # an image of one row is a row now
        each.type.tensor_type.ClearField("shape")
    for each in model.opset_import:
        each.version = OLD + 1 if each.domain in DEFAULT else each.version


def _opset(model: Any) -> int:
    found = [each.version for each in model.opset_import if each.domain in DEFAULT]
    if len(found) != 1 or found[0] not in OPSETS:
        raise ValueError(
            f"it is written in the versions {found} of ONNX's operators, but one from {OPSETS[0]} "
            f"to {OPSETS[-1]} is known: change it by onnx.version_converter.convert_version"
        )
    return found[0]


def _wanted(graph: Any, output: str | None) -> str:
    names = [each.name for each in graph.output]
    if output is None and len(names) != 1:
        raise ValueError(
            f"it must be a network with one of outputs, but it has {names}: choose one of them by "
            "Network.from_onnx(path, output=...)"
        )
    if output is not None and output not in names:
        raise ValueError(f"output must be one of {names}, but {output!r} arrived")
    return names[0] if output is None else output


def _needed(graph: Any, wanted: str) -> list[Any]:
    """The nodes on which a value depends."""
    makers: dict[str, Any] = {}
    for node in graph.node:
        for name in node.output:
            if name and name in makers:
                raise ValueError(f"two nodes compute {name!r}")
            makers[name] = node
    given = {each.name for each in (*graph.initializer, *graph.input)}
    if fixed := given & makers.keys() - {""}:
        raise ValueError(f"nodes compute {sorted(fixed)}, which are given")
    found: set[int] = set()
    left = [wanted]
    while left:
        node = makers.get(left.pop())
        if node is not None and id(node) not in found:
            found.add(id(node))
            left.extend(name for name in node.input if name)
            if lost := [name for name in node.input if name and name not in given | makers.keys()]:
                raise ValueError(
                    f"{_named(node)} takes {lost}, which are neither in the file nor inputs of "
                    "it: export it with its weights"
                )
    return [node for node in graph.node if id(node) in found]


def _given(graph: Any, used: set[str], inputs: Sequence[str] | None, held: set[str]) -> list[Any]:
    """The inputs that make up the vector."""
    ends = {each.name: each for each in graph.input if each.name not in held}
    needed = [name for name in ends if name in used]
    if inputs is None:
        chosen = needed or list(ends)
        if len(chosen) != 1:
            described = ", ".join(f"{name!r} {_sizes(ends[name])}" for name in chosen)
            raise ValueError(
                f"it must be a network with one of inputs, but it has {described or 'none'}: name "
                "those that make up the vector, in their order, by Network.from_onnx(path, "
                "inputs=[...])"
            )
    else:
        chosen = [inputs] if isinstance(inputs, str) else list(inputs)
        unknown = [name for name in chosen if name not in ends]
        missing = [name for name in needed if name not in chosen]
        if unknown or missing or len(set(chosen)) != len(chosen) or not chosen:
            raise ValueError(
                f"inputs must be names from {list(ends)}, each once, with {needed} among them, on "
                f"which the output depends, but {chosen} arrived"
            )
    found = [ends[name] for name in chosen]
    for each in found:
        sizes = _sizes(each)
        if sizes is None or (sizes and not isinstance(sizes[-1], int)):
            raise ValueError(
                f"the input {each.name!r} has the shape {sizes}: its last dimension must be a "
                "number. Write it by onnx.tools.update_model_dims"
            )
        shape = _shape(each)
        if len(shape) == 2 and min(shape) > 1:
            raise ValueError(
                f"it takes {shape[0]} inputs at a time, since {each.name!r} has shape {shape}: "
                "write it with a batch that is open, or 1"
            )
    return found


def _sizes(end: Any) -> list[Any] | None:
    """The sizes of an input, with names where they are open; None without a shape."""
    kind = end.type.tensor_type
    if not end.type.HasField("tensor_type") or not kind.HasField("shape"):
        return None
    return [
        each.dim_value if each.dim_value > 0 else each.dim_param or "?" for each in kind.shape.dim
    ]


def _shape(end: Any) -> Shape:
    """The shape of an input; what it leaves open is one."""
    return tuple(each if isinstance(each, int) else BATCH for each in _sizes(end) or ())


def _require_known(node: Any) -> None:
    if node.domain != "" or node.op_type not in (*OPERATORS, "Constant", "CastLike"):
        domain = f" of {node.domain!r}" if node.domain else ""
        raise ValueError(
            f"it contains the operator {node.op_type!r}{domain} (node {node.name!r}), which is not "
            f"known: {', '.join(sorted(OPERATORS))} are"
        )


def _reduced(model: Any, nodes: list[Any], held: list[Any], given: list[Any], wanted: str) -> Any:
    """The model of what is needed alone, for one input, as the standard's checks take it."""
    import onnx

    (end,) = (each for each in model.graph.output if each.name == wanted)
    graph = onnx.helper.make_graph(nodes, "network", [], [end], held)
    for each in given:
        graph.input.add().CopyFrom(each)
        for dim, size in zip(graph.input[-1].type.tensor_type.shape.dim, _shape(each), strict=True):
            dim.dim_value = size
    versions = [onnx.helper.make_opsetid("", _opset(model))]
    reduced = onnx.helper.make_model(graph, opset_imports=versions)
    reduced.ir_version = max(model.ir_version, 4)  # from which on initialisers are no inputs
    return reduced


def _inferred(model: Any) -> tuple[dict[str, int], dict[str, Shape]]:
    """The kinds and the shapes of values, by the standard's rules."""
    import onnx

    try:
        found = onnx.shape_inference.infer_shapes(
            model, check_type=True, strict_mode=True, data_prop=True
        )
        onnx.checker.check_model(found)  # once outputs have shapes, which a file may leave out
    except Exception as error:  # kinds of onnx's and protobuf's own
        raise ValueError(f"it is against ONNX's rules: {_line(error)}") from error
    kinds = {each.name: each.data_type for each in model.graph.initializer}
    shapes = {each.name: tuple(each.dims) for each in model.graph.initializer}
    for each in (*found.graph.input, *found.graph.output, *found.graph.value_info):
        kinds[each.name] = each.type.tensor_type.elem_type
        sizes = _sizes(each)
        if sizes is not None and all(isinstance(size, int) for size in sizes):
            shapes[each.name] = tuple(sizes)
    return kinds, shapes


def _line(error: Exception) -> str:
    """An error's text in one line."""
    return " ".join(str(error).split())[:600]


def _named(node: Any) -> str:
    name = node.name or ", ".join(node.output)
    return f"the node {name!r} ({node.op_type})"


def _attributes(node: Any, opset: int) -> dict[str, Any]:
    """The attributes of a node, with the standard's defaults; errors for those not understood."""
    import onnx

    try:
        schema: Any = onnx.defs.get_schema(node.op_type, opset, "")
    except onnx.defs.SchemaError:
        raise ValueError(f"{_named(node)} is no operator of version {opset}") from None
    known = OPERATORS[node.op_type].attributes if node.op_type in OPERATORS else schema.attributes
    found = {"opset": opset, "parts": len(node.output)}
    for name, each in schema.attributes.items():
        if each.default_value.name:
            found[name] = _plain(each.default_value, node)
    given = set()
    for each in node.attribute:
        if each.name not in known or each.name not in schema.attributes or each.ref_attr_name:
            raise ValueError(
                f"{_named(node)} has the attribute {each.name!r}, which is not known: "
                f"{', '.join(known) or 'none'} are"
            )
        if each.name in given:
            raise ValueError(f"{_named(node)} has the attribute {each.name!r} twice")
        if each.type != int(schema.attributes[each.name].type.value):
            raise ValueError(f"{_named(node)} has the attribute {each.name!r} of another type")
        given.add(each.name)
        found[each.name] = _plain(each, node)
    if found.get("num_outputs", len(node.output)) != len(node.output):
        raise ValueError(
            f"{_named(node)} announces {found['num_outputs']} parts, but {len(node.output)} of "
            "them have names"
        )
    return found


NUMBERS = (1, 2, 6, 7)
"""Types of attributes that are numbers: floats, whole ones, and rows of both."""

SMALL = 2**31
"""The largest whole number that an axis, a count or a flag may be."""


def _plain(attribute: Any, node: Any) -> Any:
    """The value of an attribute: numbers, texts, tuples of them, or an array."""
    import onnx

    what = f"the attribute {attribute.name!r} of {_named(node)}"
    if attribute.type == onnx.AttributeProto.TENSOR:
        return _array(attribute.t, what)
    value = onnx.helper.get_attribute_value(attribute)
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    if attribute.type not in NUMBERS:
        raise ValueError(f"{what} is of a type that is not known")
    if attribute.name not in ("value_int", "to") and isinstance(value, int) and abs(value) > SMALL:
        raise ValueError(f"{what} is {value}, which is too large")
    found = tuple(value) if not isinstance(value, int | float) else value
    numbers = found if isinstance(found, tuple) else (found,)
    if not all(isinstance(each, int) or np.isfinite(each) for each in numbers):
        raise ValueError(f"{what} must be finite numbers, but {found} arrived")
    return found


def _constant(attributes: dict[str, Any], name: str) -> np.ndarray:
    """The array of a node that is a constant."""
    kinds = {
        "value": None,
        "value_float": np.float32,
        "value_floats": np.float32,
        "value_int": np.int64,
        "value_ints": np.int64,
    }
    held = [each for each in kinds if each in attributes]
    if len(held) != 1:
        raise ValueError(f"{name} has no value, of {', '.join(kinds)}")
    value = attributes[held[0]]
    return value if held == ["value"] else np.array(value, kinds[held[0]])


def _read(node: Any, attributes: dict[str, Any], kinds: dict[str, int]) -> FileNode:
    operator, inputs, name = node.op_type, tuple(node.input), node.name or ", ".join(node.output)
    if operator == "CastLike":  # a cast to what the other operand is
        operator, attributes, inputs = "Cast", {"to": kinds[inputs[1]]}, inputs[:1]
    return FileNode(operator, name, inputs, tuple(node.output), attributes)


STORED = {  # fields of a tensor by the kinds of numbers that they hold, but for raw data
    "float_data": (1,),
    "int32_data": (2, 3, 4, 5, 6, BOOL, 10, 16),
    "int64_data": (7,),
    "double_data": (11,),
    "uint64_data": (12, 13),
}


def _array(tensor: Any, what: str) -> np.ndarray:
    """The numbers of a tensor: as many as its shape has, each one of its kind, and finite."""
    import onnx

    if tensor.data_type not in KINDS:
        raise ValueError(
            f"{what} is of {kind_name(tensor.data_type)}: only real and whole numbers are known"
        )
    kind, count = KINDS[tensor.data_type], math.prod(tensor.dims)
    held = [(name, len(getattr(tensor, name))) for name in STORED if len(getattr(tensor, name))]
    if tensor.HasField("raw_data"):
        held.append(("raw_data", len(tensor.raw_data) // kind.itemsize))
        whole = len(tensor.raw_data) % kind.itemsize == 0
    else:
        whole = all(tensor.data_type in STORED[name] for name, _ in held)
    if min(tensor.dims, default=0) < 0 or not whole or [n for _, n in held if n] != [count][:count]:
        raise ValueError(
            f"{what} must hold {count} numbers of {kind_name(tensor.data_type)}, since its shape "
            f"is {list(tensor.dims)}, but {dict(held)} arrived"
        )
    if held and held[0][0] == "int32_data":
        width = 8 * kind.itemsize
        least = np.iinfo(kind).min if kind.kind in "iu" else 0
        limit = 2 if tensor.data_type == BOOL else least + 2**width
        if not all(least <= each < limit for each in tensor.int32_data):
            raise ValueError(f"{what} holds numbers that are none of {kind}")
    try:
        array = np.asarray(onnx.numpy_helper.to_array(tensor)).astype(kind)
    except Exception as error:
        raise ValueError(f"{what} cannot be read: {_line(error)}") from error
    if tensor.data_type == BOOL and tensor.raw_data.strip(b"\0\1"):
        raise ValueError(f"{what} holds numbers that are none of {kind}")
    if is_float(kind) and np.isnan(array).any():
        raise ValueError(f"{what} holds numbers that are none (NaN)")
    return array
