"""Keras's layers, one by one, in operators that ONNX's graphs have.

The meaning of a layer is what it computes at inference. Numbers of a configuration, such as slopes,
are taken as they are written. A setting that is not known is refused, unless it is left at nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.readers.moving import ROOM, require_room
from reachjax.loops.readers.onnx_graphs import Constant, Graph, Node, Structure
from reachjax.loops.readers.operators import OPERATORS, OPSETS

INPUT = "input"

EPSILON = 1e-7
"""What Keras takes for a standard deviation that is smaller, unless a user's settings say else."""

COMMON = ("name", "trainable", "dtype", "batch_input_shape", "batch_shape", "autocast")
TRAINED = ("_initializer", "_regularizer", "_constraint")
"""Ends of the names of settings that count in training alone."""

MODULES = ("keras.layers", "keras.src.layers", "tf_keras.layers", "tf_keras.src.layers")
"""Where layers of Keras's own are found; a legacy file does not say it."""

POLICIES = ("float32", "float64")
SELU = {"alpha": 1.6732632423543772, "gamma": 1.0507009873554805}


class Builder:
    """Nodes in the order in which they are made, with their values at one point."""

    def __init__(self, shape: tuple[int, ...]):
        require_room(shape)
        self.shape = shape
        self.nodes: list[Node] = []
        self.weights: dict[str, np.ndarray] = {}
        self.constants: dict[str, np.ndarray] = {}
        self.values: dict[str, Any] = {
            INPUT: np.linspace(0.1, 0.9, math.prod(shape)).reshape(shape)
        }
        self.room = ROOM - math.prod(shape)

    def emit(self, name: str, operator: str, *operands: str, **attributes: Any) -> str:
        """The name of the result of one more node."""
        attributes["opset"] = OPSETS[-1]
        held = {**self.weights, **self.constants, **self.values}
        try:
            found = OPERATORS[operator].compute(attributes, *(held[each] for each in operands))
        except Exception as error:  # whatever numpy raises for operands that do not fit
            text = " ".join(str(error).split())[:300]
            raise ValueError(f"shapes do not fit, for {operator}: {text}") from error
        self.room -= np.size(found)
        if self.room < 0:
            raise ValueError(f"arrays within the network have more than {ROOM} entries")
        result = f"value {len(self.nodes)}"
        self.nodes.append(Node(operator, name, operands, (result,), tuple(attributes.items())))
        self.values[result] = found
        return result

    def graph(self, wanted: str) -> Graph:
        """The graph that ends with a value."""
        given = ((INPUT, self.shape),)
        constants = tuple((name, Constant.of(each)) for name, each in self.constants.items())
        structure = Structure(tuple(self.nodes), tuple(self.weights), constants, given, wanted)
        return Graph(tuple(self.weights.values()), structure)


class Layer:
    """One layer that is read: its settings, its weights, and the nodes that it becomes."""

    def __init__(self, builder: Builder, config: dict, name: str, weights: list, version: int):
        self.builder, self.config, self.name, self.version = builder, config, name, version
        self.left = list(weights)

    def emit(self, operator: str, *operands: str, **attributes: Any) -> str:
        """The result of a node of this layer."""
        return self.builder.emit(self.name, operator, *operands, **attributes)

    def constant(self, value: Any) -> str:
        """The name of numbers that are no weights."""
        name = f"constant {len(self.builder.constants)}"
        array = np.asarray(value)
        self.builder.constants[name] = array.astype(np.int64 if array.dtype.kind == "i" else float)
        return name

    def shape(self, x: str) -> tuple[int, ...]:
        """The shape of a value, with a batch of one."""
        return np.shape(self.builder.values[x])

    def array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """The next array of the file, which must be of this name and shape."""
        if not self.left:
            raise ValueError(f"its weights {name!r} are missing: save the whole model once more")
        told, array = self.left.pop(0)
        if told not in (None, name):
            raise ValueError(f"its weights are {told!r} where {name!r} are expected")
        if array.shape != shape:
            raise ValueError(f"its weights {name!r} must be of shape {shape}, not {array.shape}")
        return array

    def held(self, name: str, array: np.ndarray) -> str:
        """The name of weights, as they enter the graph."""
        key = f"{self.name}/{name}"
        self.builder.weights[key] = array
        return key

    def weight(self, name: str, shape: tuple[int, ...], placed: Any = None) -> str:
        """The next array of the file as weights, perhaps in another shape."""
        array = self.array(name, shape)
        return self.held(name, array if placed is None else array.reshape(placed))

    def get(self, key: str, *default: Any) -> Any:
        """A setting, which must be there unless there is a default."""
        if key not in self.config and not default:
            raise ValueError(f"its setting {key!r} is missing")
        return self.config.get(key, *default)

    def number(self, key: str, *default: Any) -> float:
        """A setting that is a finite number."""
        value = self.get(key, *default)
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise ValueError(f"its setting {key!r} must be a finite number, but {value!r} arrived")
        return float(value)

    def whole(self, key: str, *default: Any) -> int:
        """A setting that is a whole number."""
        value = self.get(key, *default)
        if isinstance(value, bool) or not isinstance(value, int) or abs(value) > ROOM:
            raise ValueError(f"its setting {key!r} must be a whole number, but {value!r} arrived")
        return value

    def wholes(self, key: str, count: int, *default: Any) -> tuple[int, ...]:
        """A setting of whole numbers from 1, as many as there are axes; one may stand for all."""
        value = self.get(key, *default)
        values = value if isinstance(value, list) else [value] * count
        fine = all(type(each) is int and 0 < each <= ROOM for each in values)
        if len(values) != count or not fine:
            raise ValueError(f"its setting {key!r} must be {count} sizes, but {value!r} arrived")
        return tuple(values)

    def flag(self, key: str, *default: Any) -> bool:
        """A setting that is true or false."""
        return self.choice(key, (True, False), *default)

    def choice(self, key: str, options: tuple[Any, ...], *default: Any) -> Any:
        """A setting that is one of some."""
        value = self.get(key, *default)
        if not any(value is each or (value == each and isinstance(each, str)) for each in options):
            raise ValueError(f"its setting {key!r} must be one of {options}, but {value!r} arrived")
        return value

    def axis(self, x: str, value: Any) -> int:
        """An axis of a value, counted from the front; none is the batch."""
        value = value[0] if isinstance(value, list) and len(value) == 1 else value
        rank = len(self.shape(x))
        if type(value) is not int or not -rank < value < rank or value == 0:
            raise ValueError(
                f"its setting 'axis' must be one axis of {rank}, none of the batch, but {value!r} "
                "arrived"
            )
        return value % rank

    def per_axis(self, x: str, axis: int) -> tuple[int, ...]:
        """The shape in which numbers of one axis fit a value."""
        return tuple(size if k == axis else 1 for k, size in enumerate(self.shape(x)))


def _hard_sigmoid(layer: Layer, x: str) -> str:
    """Version 2 has `0.2 x + 0.5` between 0 and 1, version 3 `x / 6 + 0.5`."""
    six = layer.constant(5.0 if layer.version == 2 else 6.0)
    shifted = layer.emit("Add", layer.emit("Div", x, six), layer.constant(0.5))
    return layer.emit("Clip", shifted, min=0.0, max=1.0)


def _log_sigmoid(layer: Layer, x: str) -> str:
    return layer.emit("Neg", layer.emit("Softplus", layer.emit("Neg", x)))


def _direct(operator: str, **attributes: Any) -> Callable[[Layer, str], str]:
    return lambda layer, x: layer.emit(operator, x, **attributes)


ACTIVATIONS: dict[str, Callable[[Layer, str], str]] = {
    "celu": _direct("Celu", alpha=1.0),
    "elu": _direct("Elu", alpha=1.0),
    "exponential": _direct("Exp"),
    "gelu": _direct("Gelu", approximate="none"),
    "hard_sigmoid": _hard_sigmoid,
    "hard_silu": _direct("HardSwish"),
    "hard_swish": _direct("HardSwish"),
    "hard_tanh": _direct("Clip", min=-1.0, max=1.0),
    "leaky_relu": _direct("LeakyRelu", alpha=0.2),
    "linear": lambda layer, x: x,
    "log_sigmoid": _log_sigmoid,
    "log_softmax": _direct("LogSoftmax", axis=-1),
    "mish": _direct("Mish"),
    "relu": _direct("Relu"),
    "relu6": _direct("Clip", min=0.0, max=6.0),
    "selu": _direct("Selu", **SELU),
    "sigmoid": _direct("Sigmoid"),
    "silu": _direct("Swish", alpha=1.0),
    "softmax": _direct("Softmax", axis=-1),
    "softplus": _direct("Softplus"),
    "softsign": _direct("Softsign"),
    "swish": _direct("Swish", alpha=1.0),
    "tanh": _direct("Tanh"),
    "tanh_shrink": lambda layer, x: layer.emit("Sub", x, layer.emit("Tanh", x)),
}
"""Activations by the names of Keras."""


def _activated(layer: Layer, x: str) -> str:
    """The activation of a layer: a name, or a layer without weights."""
    value = layer.get("activation")
    if value is None:
        return x
    if isinstance(value, str) and value in ACTIVATIONS:
        return ACTIVATIONS[value](layer, x)
    if isinstance(value, dict) and value.get("class_name") in WITHIN:
        require_own(value)
        config = value.get("config")
        if not isinstance(config, dict):
            raise ValueError(f"its activation {value['class_name']} has no config")
        within = Layer(layer.builder, config, layer.name, [], layer.version)
        entry = LAYERS[value["class_name"]]
        require_settings(within, entry)
        return entry.compute(within, x)
    shown = value.get("config", value) if isinstance(value, dict) else value
    raise ValueError(
        f"its activation {shown!r:.80} is not known: {', '.join(ACTIVATIONS)} are. Write the "
        "network as a function of JAX, and give it to Network"
    )


def _dense(layer: Layer, x: str) -> str:
    units, into = layer.whole("units"), layer.shape(x)[-1]
    if len(layer.shape(x)) < 2:
        raise ValueError("it takes numbers behind a batch")
    y = layer.emit("MatMul", x, layer.weight("kernel", (into, units)))
    if layer.flag("use_bias"):
        y = layer.emit("Add", y, layer.weight("bias", (units,)))
    return _activated(layer, y)


def _relu(layer: Layer, x: str) -> str:
    """`x` above the threshold, `slope (x - threshold)` below it, and at most the largest value."""
    slope = layer.number("negative_slope", 0.0)
    threshold = layer.number("threshold", 0.0)
    if threshold < 0:
        raise ValueError(f"its setting 'threshold' must not be below 0, but {threshold} arrived")
    if threshold:
        at = layer.constant(threshold)
        below = layer.emit("Mul", layer.constant(slope), layer.emit("Sub", x, at))
        y = layer.emit("Where", layer.emit("Greater", x, at), x, below)
    else:
        y = layer.emit("LeakyRelu", x, alpha=slope) if slope else layer.emit("Relu", x)
    if layer.get("max_value", None) is None:
        return y
    if layer.number("max_value") < 0:
        raise ValueError("its setting 'max_value' must not be below 0")
    return layer.emit("Clip", y, max=layer.number("max_value"))


def _leaky_relu(layer: Layer, x: str) -> str:
    held = [key for key in ("negative_slope", "alpha") if key in layer.config]
    if len(held) != 1:
        raise ValueError(f"it must have one slope, negative_slope or alpha, but {held} arrived")
    return layer.emit("LeakyRelu", x, alpha=layer.number(held[0]))


def _prelu(layer: Layer, x: str) -> str:
    shared = layer.get("shared_axes", None) or []
    axes = {layer.axis(x, each) for each in (shared if isinstance(shared, list) else [shared])}
    sizes = enumerate(layer.shape(x))
    shape = tuple(1 if k in axes else size for k, size in sizes if k > 0)
    return layer.emit("PRelu", x, layer.weight("alpha", shape, (1, *shape)))


def _normaliser(layer: Layer, x: str) -> str:
    return layer.emit("Softmax", x, axis=layer.axis(x, layer.get("axis", -1)))


def _batch_normalisation(layer: Layer, x: str) -> str:
    """`(x - mean) gamma / sqrt(variance + epsilon) + beta`, with statistics of the training."""
    layer.choice("renorm", (False,), False)
    axis = layer.axis(x, layer.get("axis"))
    shape, placed = (layer.shape(x)[axis],), layer.per_axis(x, axis)
    gamma = layer.weight("gamma", shape, placed) if layer.flag("scale") else layer.constant(1.0)
    beta = layer.weight("beta", shape, placed) if layer.flag("center") else None
    mean, variance = (
        layer.weight(name, shape, placed) for name in ("moving_mean", "moving_variance")
    )
    if (layer.builder.weights[variance] < 0).any():
        raise ValueError("its moving_variance must not be below 0")
    epsilon = layer.number("epsilon")
    if epsilon < 0 or (layer.builder.weights[variance] + epsilon == 0).any():
        raise ValueError("it divides by zero: its moving_variance and its epsilon are 0")
    deviation = layer.emit("Sqrt", layer.emit("Add", variance, layer.constant(epsilon)))
    factor = layer.emit("Div", gamma, deviation)
    y = layer.emit("Mul", layer.emit("Sub", x, mean), factor)
    return y if beta is None else layer.emit("Add", y, beta)


def _layer_normalisation(layer: Layer, x: str) -> str:
    layer.choice("rms_scaling", (False,), False)
    axis = layer.axis(x, layer.get("axis"))
    if axis != len(layer.shape(x)) - 1:
        raise ValueError(f"its setting 'axis' must be the last one, but {axis} arrived")
    size = (layer.shape(x)[axis],)
    ends = [
        layer.weight(name, size) if layer.flag(flag) else layer.constant(np.full(size, value))
        for name, flag, value in (("gamma", "scale", 1.0), ("beta", "center", 0.0))
    ]
    epsilon = layer.number("epsilon")
    if epsilon <= 0:
        raise ValueError(f"its setting 'epsilon' must be above 0, but {epsilon} arrived")
    return layer.emit("LayerNormalization", x, *ends, axis=axis, epsilon=epsilon)


def _normalisation(layer: Layer, x: str) -> str:
    """`(x - mean) / sqrt(variance)`, or back; the statistics are weights, or settings."""
    value = layer.get("axis")
    axis = None if value is None or value == [] else layer.axis(x, value)
    told = [layer.get(key, None) for key in ("mean", "variance")]
    if told == [None, None]:
        shape = () if axis is None else (layer.shape(x)[axis],)
        found = [layer.array(name, shape) for name in ("mean", "variance")]
        layer.array("count", ())
    else:
        found = [
            _numbers(each, name) for each, name in zip(told, ("mean", "variance"), strict=True)
        ]
    placed = () if axis is None else layer.per_axis(x, axis)
    sizes = {each.size for each in found} - {1}
    if sizes - {math.prod(placed)}:
        raise ValueError(f"its mean and variance must have {math.prod(placed)} entries")
    arrays = [np.broadcast_to(each.ravel(), math.prod(placed)).reshape(placed) for each in found]
    if not (np.sqrt(np.maximum(arrays[1], 0.0)) > EPSILON).all():
        raise ValueError(
            f"its variance is {arrays[1].min():g} somewhere, where Keras divides by a number of "
            "its own settings: adapt it to data that varies, or leave the entry away"
        )
    mean = layer.held("mean", np.array(arrays[0]))
    deviation = layer.emit("Sqrt", layer.held("variance", np.array(arrays[1])))
    if layer.flag("invert", False):
        return layer.emit("Add", layer.emit("Mul", x, deviation), mean)
    return layer.emit("Div", layer.emit("Sub", x, mean), deviation)


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "if" or not np.isfinite(array).all() or not array.size:
        raise ValueError(f"its setting {name!r} must be finite numbers, but {value!r:.80} arrived")
    return array.astype(float)


def _rescaling(layer: Layer, x: str) -> str:
    factor, offset = (_numbers(layer.get(key), key) for key in ("scale", "offset"))
    fits = {factor.size, offset.size} <= {1, layer.shape(x)[-1]}
    if not fits or factor.ndim > 1 or offset.ndim > 1:
        raise ValueError("its scale and offset must be one number, or as many as the last axis has")
    scaled = layer.emit("Mul", x, layer.constant(factor))
    return layer.emit("Add", scaled, layer.constant(offset))


def _reshaped(layer: Layer, x: str, shape: Iterable[int]) -> str:
    return layer.emit("Reshape", x, layer.constant(np.array([1, *shape])), allowzero=1)


def _flatten(layer: Layer, x: str) -> str:
    if layer.choice("data_format", FORMATS, None) == FORMATS[1] and len(layer.shape(x)) > 2:
        raise ValueError("its setting 'data_format' must be 'channels_last'")
    return _reshaped(layer, x, [-1])


def _reshape(layer: Layer, x: str) -> str:
    shape = layer.get("target_shape")
    fine = isinstance(shape, list) and all(type(each) is int and each >= -1 for each in shape)
    if not fine or 0 in shape or shape.count(-1) > 1:
        raise ValueError(f"its setting 'target_shape' must be sizes, but {shape!r} arrived")
    return _reshaped(layer, x, shape)


def _permute(layer: Layer, x: str) -> str:
    dims, rank = layer.get("dims"), len(layer.shape(x))
    if not isinstance(dims, list) or sorted(map(str, dims)) != [str(k) for k in range(1, rank)]:
        raise ValueError(f"its setting 'dims' must be an order of the axes, but {dims!r} arrived")
    return layer.emit("Transpose", x, perm=(0, *dims))


FORMATS = ("channels_last", "channels_first", None)


def _channels_first(layer: Layer, x: str, n: int) -> tuple[str, Callable[[str], str]]:
    """A value with its channels in front, and the way back."""
    if len(layer.shape(x)) != n + 2:
        raise ValueError(f"it takes {n} axes and channels, but {layer.shape(x)[1:]} arrived")
    if layer.choice("data_format", FORMATS[:2]) == FORMATS[1]:
        return x, lambda y: y
    back = (0, *range(2, n + 2), 1)
    turned = layer.emit("Transpose", x, perm=(0, n + 1, *range(1, n + 1)))
    return turned, lambda y: layer.emit("Transpose", y, perm=back)


def _pads(layer: Layer, sizes: Any, kernel: Any, strides: Any, dilations: Any) -> tuple[int, ...]:
    """How many zeros stand in front of each axis, and then behind each."""
    way = layer.choice("padding", ("valid", "same", "causal"))
    reach = [d * (k - 1) + 1 for d, k in zip(dilations, kernel, strict=True)]
    if way == "valid":
        return (0,) * (2 * len(kernel))
    if way == "causal":
        if len(kernel) != 1:
            raise ValueError("its setting 'padding' is 'causal', which is of one axis")
        return (reach[0] - 1, 0)
    totals = [
        max((-(-size // s) - 1) * s + r - size, 0)
        for size, s, r in zip(sizes, strides, reach, strict=True)
    ]
    return (*(t // 2 for t in totals), *(t - t // 2 for t in totals))


def _convolution(n: int) -> Callable[[Layer, str], str]:
    """A convolution along as many axes."""

    def compute(layer: Layer, x: str) -> str:
        y, back = _channels_first(layer, x, n)
        space = layer.wholes("kernel_size", n)
        strides, dilations = layer.wholes("strides", n), layer.wholes("dilation_rate", n)
        filters, groups = layer.whole("filters"), layer.whole("groups", 1)
        channels, *sizes = layer.shape(y)[1:]
        if filters < 1 or groups < 1 or channels % groups or filters % groups:
            raise ValueError(f"{channels} channels do not fit {groups} groups of {filters} filters")
        kernel = layer.array("kernel", (*space, channels // groups, filters))
        held = layer.held("kernel", kernel.transpose(n + 1, n, *range(n)).copy())
        pads = _pads(layer, sizes, space, strides, dilations)
        attributes = {"strides": strides, "dilations": dilations, "pads": pads, "group": groups}
        operands = [y, held]
        if layer.flag("use_bias"):
            operands.append(layer.weight("bias", (filters,)))
        y = layer.emit("Conv", *operands, auto_pad="NOTSET", **attributes)
        return _activated(layer, back(y))

    return compute


def _pooling(n: int, operator: str) -> Callable[[Layer, str], str]:
    """The largest or the mean of the entries in windows, which lie within their operand."""

    def compute(layer: Layer, x: str) -> str:
        y, back = _channels_first(layer, x, n)
        space = layer.wholes("pool_size", n)
        strides = layer.wholes("strides", n) if layer.get("strides", None) is not None else space
        sizes = layer.shape(y)[2:]
        if any(_pads(layer, sizes, space, strides, (1,) * n)):
            raise ValueError("its setting 'padding' must be 'valid' where windows do not fit")
        counts = [(size - k) // s + 1 for size, k, s in zip(sizes, space, strides, strict=True)]
        if min(counts) < 1:
            raise ValueError(f"its windows {space} are larger than its operand {sizes}")
        require_room((*counts, *space, layer.shape(y)[1]))
        axes, steps = (layer.constant(np.array(each)) for each in (range(2, n + 2), strides))
        parts = []
        for place in product(*map(range, space)):
            ends = [p + s * (c - 1) + 1 for p, s, c in zip(place, strides, counts, strict=True)]
            limits = (layer.constant(np.array(each)) for each in (place, ends))
            parts.append(layer.emit("Slice", y, *limits, axes, steps))
        y = layer.emit(operator, *parts)
        if operator == "Sum":
            y = layer.emit("Div", y, layer.constant(float(len(parts))))
        return back(y)

    return compute


def _global(n: int, operator: str) -> Callable[[Layer, str], str]:
    def compute(layer: Layer, x: str) -> str:
        if len(layer.shape(x)) != n + 2:
            raise ValueError(f"it takes {n} axes and channels, but {layer.shape(x)[1:]} arrived")
        first = 1 if layer.choice("data_format", FORMATS[:2]) == FORMATS[0] else 2
        axes = layer.constant(np.arange(first, first + n))
        return layer.emit(operator, x, axes, keepdims=int(layer.flag("keepdims", False)))

    return compute


def _merged(operator: str) -> Callable[..., str]:
    """Values of one shape, entry by entry."""

    def compute(layer: Layer, *values: str) -> str:
        shapes = [layer.shape(each) for each in values]
        if len(values) < 2 or len(set(shapes)) != 1:
            raise ValueError(f"it takes two or more values of one shape, but {shapes} arrived")
        if operator == "Sub" and len(values) != 2:
            raise ValueError(f"it takes two values, but {len(values)} arrived")
        if operator != "Mul":
            return layer.emit(operator, *values)
        found, *rest = values
        for each in rest:
            found = layer.emit("Mul", found, each)
        return found

    return compute


def _concatenated(layer: Layer, *values: str) -> str:
    if len(values) < 2:
        raise ValueError(f"it takes two or more values, but {len(values)} arrived")
    axis = layer.axis(values[0], layer.get("axis"))
    return layer.emit("Concat", *values, axis=axis)


def _same(layer: Layer, x: str) -> str:
    return x


class Entry(NamedTuple):
    """How a layer is read.

    Attributes:
        compute: from the layer and the names of its operands to the name of its result.
        settings: those that are known, beside what all layers have.
        several: whether it takes a list of values.
    """

    compute: Callable[..., str]
    settings: tuple[str, ...] = ()
    several: bool = False


_CONVOLVED = (
    *("filters", "kernel_size", "strides", "padding", "data_format", "dilation_rate", "groups"),
    *("activation", "use_bias", "rank"),
)
_POOLED = ("pool_size", "strides", "padding", "data_format")
_STATISTICS = ("axis", "epsilon", "center", "scale")

LAYERS: dict[str, Entry] = {
    "Activation": Entry(_activated, ("activation",)),
    "ActivityRegularization": Entry(_same, ("l1", "l2")),
    "Add": Entry(_merged("Sum"), several=True),
    "AlphaDropout": Entry(_same, ("rate", "seed", "noise_shape")),
    "Average": Entry(_merged("Mean"), several=True),
    "AveragePooling1D": Entry(_pooling(1, "Sum"), _POOLED),
    "AveragePooling2D": Entry(_pooling(2, "Sum"), _POOLED),
    "BatchNormalization": Entry(
        _batch_normalisation,
        (*_STATISTICS, "momentum", "synchronized", "renorm", "renorm_clipping", "renorm_momentum"),
    ),
    "Concatenate": Entry(_concatenated, ("axis",), several=True),
    "Conv1D": Entry(_convolution(1), _CONVOLVED),
    "Conv2D": Entry(_convolution(2), _CONVOLVED),
    "Dense": Entry(_dense, ("units", "activation", "use_bias")),
    "Dropout": Entry(_same, ("rate", "seed", "noise_shape")),
    "ELU": Entry(lambda layer, x: layer.emit("Elu", x, alpha=layer.number("alpha")), ("alpha",)),
    "Flatten": Entry(_flatten, ("data_format",)),
    "GaussianDropout": Entry(_same, ("rate", "seed")),
    "GaussianNoise": Entry(_same, ("stddev", "seed")),
    "GlobalAveragePooling1D": Entry(_global(1, "ReduceMean"), ("data_format", "keepdims")),
    "GlobalAveragePooling2D": Entry(_global(2, "ReduceMean"), ("data_format", "keepdims")),
    "GlobalMaxPooling1D": Entry(_global(1, "ReduceMax"), ("data_format", "keepdims")),
    "GlobalMaxPooling2D": Entry(_global(2, "ReduceMax"), ("data_format", "keepdims")),
    "Identity": Entry(_same),
    "LayerNormalization": Entry(_layer_normalisation, (*_STATISTICS, "rms_scaling")),
    "LeakyReLU": Entry(_leaky_relu, ("negative_slope", "alpha")),
    "MaxPooling1D": Entry(_pooling(1, "Max"), _POOLED),
    "MaxPooling2D": Entry(_pooling(2, "Max"), _POOLED),
    "Maximum": Entry(_merged("Max"), several=True),
    "Minimum": Entry(_merged("Min"), several=True),
    "Multiply": Entry(_merged("Mul"), several=True),
    "Normalization": Entry(_normalisation, ("axis", "mean", "variance", "invert")),
    "PReLU": Entry(_prelu, ("shared_axes",)),
    "Permute": Entry(_permute, ("dims",)),
    "ReLU": Entry(_relu, ("max_value", "negative_slope", "threshold")),
    "Rescaling": Entry(_rescaling, ("scale", "offset")),
    "Reshape": Entry(_reshape, ("target_shape",)),
    "Softmax": Entry(_normaliser, ("axis",)),
    "SpatialDropout1D": Entry(_same, ("rate", "seed", "name")),
    "SpatialDropout2D": Entry(_same, ("rate", "seed", "data_format")),
    "Subtract": Entry(_merged("Sub"), several=True),
}
"""Layers by the names of Keras."""

WITHIN = ("ELU", "Identity", "LeakyReLU", "ReLU", "Softmax")
"""Layers that may stand for the activation of another one."""


def require_own(described: dict[str, Any]) -> None:
    """Raise an error for a layer that is a user's."""
    module, kind = described.get("module"), described["class_name"]
    own = module is None or any(
        module == each or str(module).startswith(f"{each}.") for each in MODULES
    )
    if not own or described.get("registered_name") not in (None, kind):
        raise ValueError(
            f"it is of {module!r}, registered as {described.get('registered_name')!r}, and none of "
            "Keras's own layers: write it as a function of JAX, and give it to Network"
        )


def require_settings(layer: Layer, entry: Entry) -> None:
    """Raise an error for settings that are not known, or for numbers of 16 bits."""
    for key, value in layer.config.items():
        known = key in COMMON or key in entry.settings or key.endswith(TRAINED)
        if not known and value is not None:
            raise ValueError(
                f"its setting {key!r} is {value!r:.80}, which is not known: "
                f"{', '.join(entry.settings) or 'none'} are, or None"
            )
    require_policy(layer.config.get("dtype"))


def require_policy(value: Any) -> None:
    """Raise an error for a policy of numbers that round by more than those of 32 bits."""
    name = value
    if isinstance(value, dict):
        within = value.get("config")
        own = value.get("class_name") in ("DTypePolicy", "Policy")
        name = within.get("name") if own and isinstance(within, dict) else value.get("class_name")
    if name is not None and name not in POLICIES:
        raise ValueError(
            f"it computes in {name!r:.80}: only {' and '.join(POLICIES)} are known, others round "
            "by far more. Save the model with the policy 'float32'"
        )
