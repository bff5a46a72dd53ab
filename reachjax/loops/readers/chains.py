"""Chains of layers from files of the field's benchmarks: MATLAB's, NNet's, Sherlock's and POLAR's.

Sources: the formats of NNV (`W`, `b`, `act_fcns`), of NNet (Stanford), of Sherlock and of POLAR, as
the competition of closed loops with networks (ARCH-COMP AINNCS) hands controllers around.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.readers.arrays import over, require_finite, sigmoid
from reachjax.loops.readers.matlab import Unread, read_variables
from reachjax.numerics.pytrees import pytree, static

Numbers = Array | np.ndarray
Layers = tuple[tuple[Float[Numbers, "out in"], Float[Numbers, " out"]], ...]

ACTIVATIONS: dict[str, Callable[[Any], Any]] = {
    "affine": lambda y: y,
    "hardtanh": lambda y: over(y).clip(y, -1.0, 1.0),
    "relu": lambda y: over(y).maximum(y, 0.0),
    "sigmoid": sigmoid,
    "step01": lambda y: over(y).clip(y, 0.0, 1.0),
    "tanh": lambda y: over(y).tanh(y),
}

NAMES = {
    "affine": "affine",
    "hardtanh": "hardtanh",
    "identity": "affine",
    "linear": "affine",
    "logsig": "sigmoid",
    "poslin": "relu",
    "purelin": "affine",
    "relu": "relu",
    "relu1": "step01",
    "satlin": "step01",
    "satlins": "hardtanh",
    "sigmoid": "sigmoid",
    "tanh": "tanh",
    "tansig": "tanh",
}
"""What files call activations, in small letters."""

ENDINGS = (".onnx", ".mat", ".nnet", ".txt")
"""Endings of files that say what they are; any other is taken for plain text."""


@pytree
class Chain:
    """Layers with an activation each, between scalers.

    The input is clipped, shifted by means and divided by ranges; the output is
    `factor (y - shift) + offset`. None where a format has no such thing.

    Attributes:
        layers: pairs `(W, b)`.
        activations: of each layer, the last one too.
        limits: pairs of least and largest inputs.
        scaler: means and ranges of the inputs.
        output: shift, factor and offset.
    """

    layers: Layers
    activations: tuple[str, ...] = static()
    limits: tuple[Any, ...] | None = None
    scaler: tuple[Any, ...] | None = None
    output: tuple[Any, ...] | None = None

    def __call__(self, x: Any) -> Any:
        """The output of one input vector."""
        if self.limits is not None:
            lower, upper = self.limits
            x = over(x, upper).minimum(over(x, lower).maximum(x, lower), upper)
        if self.scaler is not None:
            x = (x - self.scaler[0]) / self.scaler[1]
        for (W, b), name in zip(self.layers, self.activations, strict=True):
            x = ACTIVATIONS[name](W @ x + b)
        if self.output is None:
            return x
        shift, factor, offset = self.output
        return factor * (x - shift) + offset

    @property
    def sizes(self) -> tuple[int, int]:
        """The numbers of inputs and of outputs."""
        return self.layers[0][0].shape[1], self.layers[-1][0].shape[0]


def read_chain(path: Path) -> Chain:
    """The chain of a file, by its ending: `.mat`, `.nnet`, or plain text.

    Raises:
        ValueError: it is none of its format, a number in it is not finite, or the network is
            finite at none of a few points.
    """
    content = path.read_bytes()
    try:
        if path.suffix == ".mat":
            found = _matlab(content)
        else:
            text = content.decode()
            found = _nnet(text) if path.suffix == ".nnet" else _text(text)
        require_finite(found, found.sizes[0])
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    return found


def _known(name: Any) -> str:
    word = str(name).strip().lower()
    if word not in NAMES:
        raise ValueError(f"the activation {str(name)!r} is not known: {', '.join(NAMES)} are")
    return NAMES[word]


def _joined(pairs: Sequence[tuple[Any, Any]]) -> Layers:
    """Layers whose shapes chain; all of them transposed if that is how they do."""
    for k, pair in enumerate(pairs):
        for name, array in zip(("weights", "bias"), pair, strict=True):
            if not np.isfinite(array).all():
                raise ValueError(f"the {name} of layer {k + 1} must be finite numbers")
    for turned in (False, True):
        layers = [(W.T if turned else W, b) for W, b in pairs]
        layers = [(W.reshape(len(b), -1) if _is_line(W, b) else W, b) for W, b in layers]
        sizes = [W.ndim == 2 and W.shape[0] == len(b) for W, b in layers]
        chained = [W.shape[1] == len(b) for (W, _), (_, b) in zip(layers[1:], layers, strict=False)]
        if all(sizes) and all(chained):
            return tuple(layers)
    shapes = [(W.shape, len(b)) for W, b in pairs]
    raise ValueError(f"the shapes of weights and biases do not chain: {shapes}")


def _is_line(W: np.ndarray, b: np.ndarray) -> bool:
    """Whether weights are those of one neuron, or of one input, which may lie either way."""
    return W.size > 0 and W.size == max(W.shape) and len(b) in (1, W.size)


VARIABLES = (
    ("W", "weights", "Weights"),
    ("b", "bias", "biases", "Biases"),
    ("act_fcns", "activation_fcns", "activations", "act_fns", "activation"),
)
"""What tools call the weights, biases and activations of all layers."""

COUNTS = "layer_sizes", "layers", "sizes", "number_of_neurons", "number_of_layers"
"""Variables with one number for each layer."""

SCALING = re.compile(
    r"(^|_)(means?|ranges?|scales?|scaling|minimum|maximum|normali[sz]ation)(_|$)", re.I
)
"""Words in the names of what scales numbers, by which single numbers are recognised."""


def _require_unscaled(held: dict[str, Any], chain: Chain) -> None:
    """Raise an error where a file may hold what scales inputs or outputs: it does not say how.

    Raises:
        ValueError: a variable has as many numbers as inputs, outputs or both, or is called so.
    """
    sizes = {*chain.sizes, sum(chain.sizes)} - {1}
    found = [
        name
        for name, value in sorted(held.items())
        if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and name not in COUNTS
        if not any(name in names for names in VARIABLES)
        if value.size in sizes or SCALING.search(name)
    ]
    if found:
        raise ValueError(
            f"it also holds {', '.join(found)}, and does not say whether they scale inputs or "
            "outputs: delete them from the file if they do not; if they do, scale in a function, "
            "reachjax.Network(lambda x: ..., inputs, outputs)"
        )


def _matlab(content: bytes) -> Chain:
    """Variables `W`, `b` and `act_fcns`, or what other tools call these, perhaps in a struct."""
    found = read_variables(content)
    held = dict(found)
    for value in found.values():
        if isinstance(value, dict):
            twice = sorted(held.keys() & value.keys())
            if twice:
                raise ValueError(f"{', '.join(twice)} stand in it at two places")
            held |= value
    weights, biases, activations = (_named(held, *names) for names in VARIABLES)
    names = [*map(_known, _rows(activations))]
    weights, biases = (_cells(each, len(names)) for each in (weights, biases))
    if len(weights) != len(biases) or len(names) != len(weights) or not names:
        counts = f"{len(weights)} weights, {len(biases)} biases and {len(names)} activations"
        raise ValueError(f"each layer must have weights, biases and an activation, but {counts}")
    pairs = [
        (_real(W, f"weights {k + 1}"), _vector(_real(b, f"bias {k + 1}"), f"bias {k + 1}"))
        for k, (W, b) in enumerate(zip(weights, biases, strict=True))
    ]
    chain = Chain(_joined(pairs), tuple(names))
    _require_unscaled(held, chain)
    return chain


def _named(held: dict[str, Any], *names: str) -> Any:
    found = [name for name in names if name in held]
    if not found:
        raise ValueError(f"it holds none of {', '.join(names)}, but {', '.join(sorted(held))}")
    if len(found) > 1:
        raise ValueError(f"it holds {' and '.join(found)}, which stand for the same")
    return held[found[0]]


def _rows(value: Any) -> list[Any]:
    """The rows of a text, or the texts of a cell array."""
    cells = value.ravel() if isinstance(value, np.ndarray) and value.dtype == object else [value]
    return [row for cell in cells for row in (cell if isinstance(cell, list) else [cell])]


def _cells(value: Any, count: int) -> list[Any]:
    """The entries of a cell array; the array itself if there is one layer."""
    if isinstance(value, np.ndarray) and (value.dtype == object or count != 1):
        return list(value.ravel() if value.dtype == object else value)
    return [value]


def _real(value: Any, name: str) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        kind = value.reason if isinstance(value, Unread) else kind
        raise ValueError(f"{name} must be an array of real numbers, but {kind} arrived")
    return value.astype(float)


def _vector(value: np.ndarray, name: str) -> np.ndarray:
    if value.size != max(value.shape):
        raise ValueError(f"{name} must be a vector, but its shape is {value.shape}")
    return value.ravel()


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def _number(word: str) -> float:
    if not NUMBER.fullmatch(word):
        raise ValueError(f"{word[:40]!r} stands where a number should")
    return float(word)


def _count(value: float, what: str, least: int = 1) -> int:
    if not value.is_integer() or value < least:
        raise ValueError(f"{what} must be a whole number from {least}, but {value:g} arrived")
    return int(value)


class _Lines:
    """The lines of an NNet file, each of numbers between commas."""

    def __init__(self, text: str):
        lines = [line.strip(" \t\r") for line in text.split("\n")]
        self.rest = [line for line in lines if line and not line.startswith("//")]
        self.rest.reverse()

    def row(self, what: str, *counts: int) -> list[float]:
        """The numbers of the next line, of which there must be as many as one of the counts."""
        if not self.rest:
            raise ValueError(f"it ends too early, before {what}")
        words = [word.strip(" \t") for word in self.rest.pop().split(",")]
        words = words[:-1] if words[-1] == "" else words
        if counts and len(words) not in counts:
            expected = " or ".join(map(str, dict.fromkeys(counts)))
            raise ValueError(f"{what} must be {expected} numbers, but {len(words)} stand there")
        return [_number(word) for word in words]


def _nnet(text: str) -> Chain:
    """ReLUs but for the last layer; inputs are clipped and scaled, the output scaled back.

    A line of a single 0 stands for no limits, and for no means or ranges. Sizes that stand behind
    the announced number of layers are none.
    """
    lines = _Lines(text)
    count, n, m = (_count(each, "a count") for each in lines.row("the counts", 3, 4)[:3])
    row = lines.row("the sizes of layers")[: count + 1]
    sizes = [_count(each, "the size of a layer") for each in row]
    if len(sizes) <= count or (sizes[0], sizes[-1]) != (n, m):
        raise ValueError(
            f"{count} layers from {n} inputs to {m} outputs are announced, but of the sizes {sizes}"
        )
    lines.row("the flag", 1)  # which no longer means anything
    limits = [lines.row(f"the {end} inputs", n, 1) for end in ("least", "largest")]
    scaler = [lines.row(f"the {what}", n + 1, n, 1) for what in ("means", "ranges")]
    pairs = []
    for k, (into, out) in enumerate(itertools.pairwise(sizes), start=1):
        W = [lines.row(f"a row of the weights of layer {k}", into) for _ in range(out)]
        b = [lines.row(f"a bias of layer {k}", 1) for _ in range(out)]
        pairs.append((np.array(W), np.ravel(b)))
    if lines.rest:
        raise ValueError(f"{len(lines.rest)} lines are left after the last layer")
    lower, upper, means, ranges = map(np.array, (*limits, *scaler))
    scalers = _scalers(means, ranges, n)
    activations = ("relu",) * (count - 1) + ("affine",)
    return Chain(_joined(pairs), activations, _limits(lower, upper, n), *scalers)


def _limits(lower: np.ndarray, upper: np.ndarray, n: int) -> tuple[np.ndarray, ...] | None:
    if lower.tolist() == upper.tolist() == [0.0]:
        return None
    if not len(lower) == len(upper) == n:
        raise ValueError(f"{n} inputs need as many limits, but {len(lower)} and {len(upper)} stand")
    if not (np.isfinite([lower, upper]).all() and (lower <= upper).all()):
        raise ValueError(f"the least inputs {lower} must be below the largest ones {upper}")
    return lower, upper


def _scalers(means: np.ndarray, ranges: np.ndarray, n: int) -> tuple[Any, Any]:
    """The scaler of the inputs, and that of the output, which a file may leave out."""
    if means.tolist() == ranges.tolist() == [0.0]:
        return None, None
    if len(means) != len(ranges) or len(means) not in (n, n + 1):
        raise ValueError(
            f"{n} inputs and the output need as many means and ranges, but {len(means)} and "
            f"{len(ranges)} stand there"
        )
    if not (np.isfinite([means, ranges]).all() and (ranges > 0).all()):
        raise ValueError(f"ranges must be larger than 0, but {ranges} arrived")
    back = (np.zeros(()), ranges[n], means[n]) if len(means) > n else None
    return (means[:n], ranges[:n]), back


def _text(text: str) -> Chain:
    """Counts, sizes, perhaps activations, then weights and the bias of one neuron after the other.

    Without activations all are ReLUs, the last layer's too (Sherlock). With them (POLAR), two more
    numbers may follow: the output is `factor (y - offset)`.
    """
    words = [word for word in re.split(r"[ \t\r\n]+", text) if word]
    if len(words) < 3:
        raise ValueError("it ends too early, before the numbers of inputs, outputs and layers")
    hidden = _count(_number(words[2]), "the number of hidden layers", 0)
    if len(words) < 3 + hidden:
        raise ValueError("it ends too early, before the sizes of all layers")
    layers = [words[0], *words[3 : 3 + hidden], words[1]]
    sizes = [_count(_number(word), "the size of a layer") for word in layers]
    rest = words[3 + hidden :]
    names = [word for word in rest[: hidden + 1] if not NUMBER.fullmatch(word)]
    if names and len(names) != hidden + 1:
        raise ValueError(f"{hidden + 1} layers need as many activations, but {names} are named")
    activations = tuple(map(_known, names)) or ("relu",) * (hidden + 1)
    numbers = np.array([_number(word) for word in rest[len(names) :]])
    needed = [out * (into + 1) for into, out in itertools.pairwise(sizes)]
    left = len(numbers) - sum(needed)
    if left < 0:
        raise ValueError(f"it ends too early: {sum(needed)} weights and biases are announced")
    if left not in (0, 2):
        raise ValueError(f"{left} numbers are left after the last layer")
    parts = np.split(numbers, np.cumsum(needed))
    rows = [part.reshape(out, -1) for part, out in zip(parts[:-1], sizes[1:], strict=True)]
    output = (*map(np.asarray, parts[-1]), np.zeros(())) if left else None
    if not np.isfinite(numbers).all():
        raise ValueError("weights and biases must be finite numbers")
    pairs = [(each[:, :-1], each[:, -1]) for each in rows]
    return Chain(_joined(pairs), activations, output=output)
