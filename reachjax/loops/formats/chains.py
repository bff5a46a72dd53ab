"""Chains of layers from files of the field's benchmarks: MATLAB's, NNet's, Sherlock's and POLAR's.

Sources: the formats of NNV (`W`, `b`, `act_fcns`), of NNet (Stanford), of Sherlock and of POLAR, as
the competition of closed loops with networks (ARCH-COMP AINNCS) hands controllers around.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import pytree, static

Numbers = Array | np.ndarray
Layers = tuple[tuple[Float[Numbers, "out in"], Float[Numbers, " out"]], ...]

ACTIVATIONS: dict[str, Callable[[Any], Any]] = {
    "affine": lambda y: y,
    "hardtanh": lambda y: jnp.clip(y, -1.0, 1.0),
    "relu": lambda y: jnp.maximum(y, 0.0),
    "sigmoid": jax.nn.sigmoid,
    "step01": lambda y: jnp.clip(y, 0.0, 1.0),
    "tanh": jnp.tanh,
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
"""Of files that say what they are; any other is taken for plain text."""


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
            x = jnp.minimum(jnp.maximum(x, self.limits[0]), self.limits[1])
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
        ValueError: it is none of its format.
    """
    try:
        if path.suffix == ".mat":
            return _matlab(path)
        text = path.read_text()
        return _nnet(text) if path.suffix == ".nnet" else _text(text)
    except (StopIteration, IndexError):
        raise ValueError(f"{path} cannot be read: it ends too early") from None
    except (ValueError, TypeError, NotImplementedError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def _known(name: Any) -> str:
    word = str(name).strip().lower()
    if word not in NAMES:
        raise ValueError(f"the activation {str(name)!r} is not known: {', '.join(NAMES)} are")
    return NAMES[word]


def _joined(pairs: Sequence[tuple[Any, Any]]) -> Layers:
    """Layers whose shapes chain; all of them transposed if that is how they do."""
    found = [(np.asarray(W, float), np.asarray(b, float).ravel()) for W, b in pairs]
    for turned in (False, True):
        layers = [(W.T if turned else W, b) for W, b in found]  # a vector stays one
        layers = [(W.reshape(len(b), -1) if W.ndim < 2 else W, b) for W, b in layers]
        sizes = [W.shape[0] == len(b) for W, b in layers]
        chained = [W.shape[1] == len(b) for (W, _), (_, b) in zip(layers[1:], layers, strict=False)]
        if all(sizes) and all(chained):
            return tuple(layers)
    shapes = [(W.shape, len(b)) for W, b in found]
    raise ValueError(f"the shapes of weights and biases do not chain: {shapes}")


def _matlab(path: Path) -> Chain:
    """Variables `W`, `b` and `act_fcns`, or what other tools call these, perhaps in a struct."""
    import scipy.io

    try:
        found = scipy.io.loadmat(str(path), squeeze_me=True, chars_as_strings=True)
    except scipy.io.matlab.MatReadError as error:
        raise ValueError(f"it is no MATLAB file: {error}") from error
    held = {name: value for name, value in found.items() if not name.startswith("__")}
    for value in [*held.values()]:
        if getattr(value, "dtype", None) is not None and value.dtype.names:
            held |= {name: value[name].item() for name in value.dtype.names}
    weights = _named(held, "W", "weights", "Weights")
    biases = _named(held, "b", "bias", "biases", "Biases")
    names = [
        _known(name)
        for name in np.atleast_1d(
            _named(held, "act_fcns", "activation_fcns", "activations", "act_fns", "activation")
        )
    ]
    weights, biases = (_cells(each, len(names)) for each in (weights, biases))
    if len(weights) != len(biases) or len(names) != len(weights):
        counts = f"{len(weights)} weights, {len(biases)} biases and {len(names)} activations"
        raise ValueError(f"each layer must have weights, biases and an activation, but {counts}")
    return Chain(_joined(list(zip(weights, biases, strict=True))), tuple(names))


def _named(held: dict[str, Any], *names: str) -> Any:
    for name in names:
        if name in held:
            return held[name]
    raise ValueError(f"it holds none of {', '.join(names)}, but {', '.join(sorted(held))}")


def _cells(value: Any, count: int) -> list[Any]:
    """The entries of a cell array; of one layer it is squeezed away."""
    array = np.asarray(value)
    return list(array) if array.dtype == object else [array] if count == 1 else list(array)


def _nnet(text: str) -> Chain:
    """ReLUs but for the last layer; inputs are clipped and scaled, the output scaled back."""
    lines = (line for line in text.splitlines() if not line.startswith("//"))
    rows = ([part for part in line.split(",") if part.strip()] for line in lines)
    count = int(next(rows)[0])
    sizes = [int(part) for part in next(rows)]
    next(rows)  # a flag that is no longer used
    lower, upper, means, ranges = (np.array([float(part) for part in next(rows)]) for _ in range(4))
    pairs = []
    for into, out in itertools.pairwise(sizes):
        W = [[float(part) for part in next(rows)] for _ in range(out)]
        b = [float(next(rows)[0]) for _ in range(out)]
        pairs.append((np.array(W).reshape(out, into), b))
    if len(pairs) != count:
        raise ValueError(f"{count} layers are announced, but {len(pairs)} have a size")
    n = sizes[0]
    back = (np.zeros(()), ranges[n], means[n]) if len(means) > n else None
    activations = ("relu",) * (count - 1) + ("affine",)
    scaler = (means[:n], ranges[:n])
    return Chain(_joined(pairs), activations, (lower[:n], upper[:n]), scaler, back)


def _text(text: str) -> Chain:
    """Counts, sizes, perhaps activations, then weights and the bias of one neuron after the other.

    Without activations all are ReLUs, the last layer's too (Sherlock). With them (POLAR), two more
    numbers may follow: the output is `factor (y - offset)`.
    """
    words = iter(text.split())
    inputs, outputs, hidden = (int(next(words)) for _ in range(3))
    sizes = [inputs, *(int(next(words)) for _ in range(hidden)), outputs]
    rest = list(words)
    names = [word for word in rest[: hidden + 1] if not _is_number(word)]
    if names and len(names) != hidden + 1:
        raise ValueError(f"{hidden + 1} layers need as many activations, but {names} are named")
    activations = tuple(map(_known, names)) or ("relu",) * (hidden + 1)
    numbers = iter([float(word) for word in rest[len(names) :]])
    pairs = []
    for into, out in itertools.pairwise(sizes):
        rows = np.array([[next(numbers) for _ in range(into + 1)] for _ in range(out)])
        pairs.append((rows[:, :-1], rows[:, -1]))
    left = list(numbers)
    if len(left) not in (0, 2):
        raise ValueError(f"{len(left)} numbers are left after the last layer")
    output = (*map(np.asarray, left), np.zeros(())) if left else None
    return Chain(_joined(pairs), activations, output=output)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
