"""Feed-forward networks, `x^{k+1} = phi(W^k x^k + b^k)`, `pi(x) = W^l x^l + b^l` (the paper's NN).

The forward pass is written once, for any kind of number: `propagate` is given what to do at a
nonlinear layer. With plain evaluation it is the network; with intervals or rows over a basis it
yields bounds and the program that certifies the loop.

A residual network adds to a linear map of its input, `pi(x) = S x + net(x)`. A switched controller
is a function of JAX: which network acts is a place, such as `jnp.argmax` of the entries of a state
that hold the last decision; a disturbance chooses among some vectors by the largest of as many
numbers.
"""

from __future__ import annotations

import abc
import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from reachjax.loops.tracing.functions import Function, require_own_sizes
from reachjax.loops.units import AbstractActivation, AtUnit, ReLU, evaluate
from reachjax.numerics.archives import existing_file
from reachjax.numerics.checks import Numbers, described, require_kind, same_size, whole_number
from reachjax.numerics.pytrees import Replaceable, converted, pytree, static


class AbstractNetwork(Replaceable, abc.ABC):
    """What a loop needs of its controller: sizes, and a forward pass over any kind of number."""

    @property
    @abc.abstractmethod
    def inputs(self) -> int:
        """The number of inputs."""

    @property
    @abc.abstractmethod
    def outputs(self) -> int:
        """The number of outputs."""

    @abc.abstractmethod
    def propagate(self, x: Any, unit: AtUnit) -> Any:
        """The forward pass over any kind of number, with `unit` at each layer of units."""

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """The output for one input vector; `jax.vmap(net)` takes a batch."""
        x = Numbers("(n,)")(x, "x")
        same_size(
            "the network's number of inputs is", "the dimension of x is", (self.inputs, len(x))
        )
        return self.propagate(x, evaluate)


def _layers(value: Any, name: str = "layers") -> tuple[tuple[Array, Array], ...]:
    """Pairs `(W, b)` whose shapes chain."""
    if isinstance(value, Array | str) or not isinstance(value, Iterable):
        raise TypeError(f"{name} must be pairs (W, b), but a {type(value).__name__} arrived")
    layers = tuple(_layer(pair, f"{name}[{k}]") for k, pair in enumerate(value))
    if not layers:
        raise ValueError(f"{name} must hold at least one pair (W, b), but none arrived")
    for k, ((before, _), (after, _)) in enumerate(itertools.pairwise(layers)):
        if before.shape[0] != after.shape[1]:
            raise ValueError(
                f"{name}[{k + 1}] takes {after.shape[1]} inputs (columns of W), "
                f"but {name}[{k}] has {before.shape[0]} outputs (rows of W)"
            )
    return layers


def _layer(pair: Any, name: str) -> tuple[Array, Array]:
    try:
        W, b = pair
    except (TypeError, ValueError):
        kind = type(pair).__name__
        raise TypeError(f"{name} must be a pair (W, b), but a {kind} arrived") from None
    W = Numbers("(outputs, inputs)")(W, f"W of {name}")
    b = Numbers("(outputs,)")(b, f"b of {name}")
    if W.shape[0] != b.shape[0]:
        raise ValueError(
            f"W of {name} has {W.shape[0]} rows (outputs), but b has length {b.shape[0]}"
        )
    return W, b


@pytree
class MLP(AbstractNetwork):
    """A fully connected network with a linear last layer. Build it with `from_layers`.

    Attributes:
        layers: pairs `(W, b)` with `W` of shape `(outputs, inputs)` and `b` of shape `(outputs,)`.
        activation: applied after every layer but the last.

    Example:
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[1.0, 1.0]], [0.0])])
        >>> net([-3.0]).tolist()  # |x|
        [3.0]
    """

    layers: tuple[tuple[Float[Array, "out in"], Float[Array, " out"]], ...] = converted(
        converter=_layers
    )
    activation: AbstractActivation = static(default=ReLU())

    def __post_init__(self):
        if not isinstance(self.activation, AbstractActivation):
            raise TypeError(
                f"MLP.activation must be an activation object such as reachjax.ReLU(), "
                f"but {self.activation!r} arrived"
            )

    @classmethod
    def from_layers(
        cls,
        layers: Sequence[tuple[ArrayLike, ArrayLike]],
        activation: AbstractActivation = ReLU(),  # noqa: B008  (immutable)
    ) -> MLP:
        """A network from pairs `(W, b)`, `W` of shape `(outputs, inputs)`.

        Raises:
            TypeError: the activation is not an activation object, or a layer is not numeric.
            ValueError: shapes do not chain, or an entry is not finite.
        """
        return cls(layers, activation)

    @classmethod
    def from_flax(
        cls,
        source: Any,
        activation: AbstractActivation | Callable | None = None,
        module: Any = None,
    ) -> MLP:
        """A network from a flax nnx module, or from the parameters of a linen module.

        The parameters may be traced, so this may be called inside a loss.

        Args:
            source: an `nnx.Module` whose linear layers are applied in the order in which they
                were assigned, or linen's `{"params": {"Dense_0": {"kernel", "bias"}, ...}}`.
            activation: applied between the layers, as an object or as the flax function that one
                of them computes (`nnx.leaky_relu`). None for ReLU, where what is read can be
                compared with the network's output or the layers stand in an `nnx.Sequential`.
            module: the linen module itself, whose parameters do not tell what is between the
                layers, nor always their order: what is read is then compared with its output.

        Raises:
            TypeError: `source` is neither.
            ValueError: it holds something else than a chain of linear layers, or computes something
                else, or the order of its layers or the activation cannot be told.
        """
        from reachjax.loops.readers.flax_layers import flax_layers, read_activation

        known = read_activation(activation)
        read = flax_layers(source, known, module)
        return cls(read, ReLU() if known is None else known)

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return self.layers[0][0].shape[1]

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return self.layers[-1][0].shape[0]

    def propagate(self, x: Any, unit: AtUnit) -> Any:
        """The forward pass over any kind of number, with `unit` at each layer of units."""
        for W, b in self.layers[:-1]:
            x = self.activation.propagate(W @ x + b, unit)
        W, b = self.layers[-1]
        return W @ x + b


@pytree
class Network(AbstractNetwork):
    """Any JAX function as a controller: skip connections, scalers, several activations.

    The function is traced; its parameters are the arrays of the tree that it is, such as those of
    `jax.tree_util.Partial(f, params)` or of a flax or equinox module, and stay differentiable. What
    is computed of parameters alone is taken as it is computed.

    Args:
        f: of a vector `(inputs,)`, with a vector `(outputs,)` for a result.
        inputs: how many there are.
        outputs: how many there are.

    Raises:
        TypeError: `f` is no function, or contains a primitive that has no bounds, whose line the
            error names.
        ValueError: `f` cannot be called so, or its result has another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> net = Network(lambda x: jnp.tanh(x[:1] - x[1:]), inputs=2, outputs=1)
        >>> net([0.5, 0.5]).tolist()
        [0.0]
    """

    f: Function

    def __init__(self, f: Any, inputs: int | None = None, outputs: int | None = None):
        if not isinstance(f, Function):
            sizes = (whole_number("Network.inputs", inputs, 1),)
            f = Function.of(f, sizes, whole_number("Network.outputs", outputs, 1), "Network.f")
        self._set(f=f)
        require_own_sizes(self, inputs=inputs, outputs=outputs)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Network:
        """A network from a file, by its ending.

        ONNX (`.onnx`, see `from_onnx`); Keras (`.keras`, or the legacy `.h5` or `.hdf5` of a whole
        model), whose layers are read at inference, without Keras; MATLAB (`.mat`, version 7 or
        older) with variables `W`, `b` and `act_fcns`, in a struct or not; NNet (`.nnet`), whose
        inputs are clipped and scaled; and plain text as Sherlock has it, of ReLUs throughout, or as
        POLAR has it, with names of activations.

        Args:
            path: of the file.

        Raises:
            FileNotFoundError: there is no such file.
            ImportError: the package `onnx`, or for Keras `h5py`, is missing.
            TypeError: a layer's function has no bounds.
            ValueError: it cannot be read; the error says where.

        Example:
            >>> import pathlib, tempfile
            >>> path = pathlib.Path(tempfile.mkdtemp()) / "absolute.txt"
            >>> sizes, rows = "1 1 1 2", "1 0  -1 0  1 1 0"  # each row of weights, and its bias
            >>> _ = path.write_text(f"{sizes} relu affine {rows}")
            >>> Network.from_file(path)([-3.0]).tolist()  # |x|
            [3.0]
        """
        from reachjax.loops.readers.chains import ENDINGS, read_chain
        from reachjax.loops.readers.keras_files import ENDINGS as KERAS
        from reachjax.loops.readers.keras_graphs import read_graph as read_keras

        path = existing_file("path", path)
        if path.suffix == ".onnx":
            return cls.from_onnx(path)
        if path.suffix in KERAS:
            return cls._from_graph(path, *read_keras(path))
        try:
            chain = read_chain(path)
        except ValueError as error:
            if path.suffix in ENDINGS:
                raise
            raise ValueError(
                f"{error}. It was read as plain text, since its ending is none of "
                f"{', '.join((*ENDINGS, *KERAS))}"
            ) from error
        return cls(chain, *chain.sizes)

    @classmethod
    def from_onnx(
        cls,
        path: str | os.PathLike[str],
        inputs: str | Sequence[str] | None = None,
        output: str | None = None,
    ) -> Network:
        """A network from an ONNX file, such as `torch.onnx.export` writes them.

        Its weights are taken as they stand, and what is certified is the function of real numbers
        that they define: a runtime in 32-bit floats differs from it by its own rounding, some 1e-7
        of the sizes of numbers within the network. Input and output are flattened; dimensions that
        the file leaves open, as of a batch, are 1. A graph that is against ONNX's rules, or has
        anything that is not understood, is refused; where onnxruntime is installed, both are
        evaluated at a few points and must agree.

        Args:
            path: of the file.
            inputs: names of the inputs whose entries make up the vector, in this order; None for
                the only one that is used.
            output: the name of the output; None for the only one.

        Raises:
            FileNotFoundError: there is no such file.
            ImportError: the package `onnx` is missing.
            TypeError: an operator's function has no bounds, or a name is no text.
            ValueError: it is no ONNX file, or is not understood; the error names the node.
        """
        from reachjax.loops.readers.onnx_graphs import read_graph

        path = existing_file("path", path)
        for name, value in (("inputs", inputs), ("output", output)):
            texts = [value] if value is None or name == "output" else value
            if not all(each is None or isinstance(each, str) for each in texts):
                raise TypeError(f"{name} must be names of the file, but {value!r} arrived")
        return cls._from_graph(path, *read_graph(path, inputs, output))

    @classmethod
    def _from_graph(cls, path: os.PathLike[str], graph: Any, inputs: int, outputs: int) -> Network:
        """The network of a graph; an error names the node from which it cannot be certified."""
        from reachjax.loops.readers.onnx_graphs import culprit

        try:
            return cls(graph, inputs, outputs)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{path}, {culprit(graph)}: {error}") from error

    def __repr__(self) -> str:
        return f"Network(inputs={self.inputs}, outputs={self.outputs})"

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return self.f.structure.inputs[0]

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return self.f.structure.outputs

    def propagate(self, x: Any, unit: AtUnit) -> Any:
        """The forward pass over any kind of number, with `unit` at each layer of units."""
        return self.f.propagate((x,), unit)


@pytree
class Residual(AbstractNetwork):
    """`skip x + net(x)`. Networks may be nested: `net` may have such connections itself.

    Args:
        net: the network around which the connection skips.
        skip: `(outputs, inputs)`; the identity when left out.

    Raises:
        TypeError: `net` is no network, or `skip` is not numeric.
        ValueError: `skip` has another shape than the network; left out, the network has another
            number of outputs than of inputs.

    Example:
        >>> from reachjax import MLP
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[1.0, 1.0]], [0.0])])  # |x|
        >>> Residual(net)([-3.0]).tolist(), Residual(net, [[-1.0]])([-3.0]).tolist()
        ([0.0], [6.0])
    """

    net: AbstractNetwork
    skip: Float[Array, "out in"] = converted(converter=Numbers("(outputs, inputs)"), default=None)

    def __post_init__(self):
        require_kind("Residual.net", self.net, AbstractNetwork, "a network such as an MLP")
        sizes = self.net.outputs, self.net.inputs
        if self.skip is None:
            if sizes[0] != sizes[1]:
                raise ValueError(
                    "without skip, the network must have as many outputs as inputs, but one of "
                    f"{sizes[1]} inputs and {sizes[0]} outputs arrived"
                )
            self._set(skip=jnp.eye(sizes[0]))
        elif self.skip.shape != sizes:
            raise ValueError(
                f"Residual.skip must be of shape {sizes}, the network's outputs and inputs, but "
                f"one of shape {self.skip.shape} arrived"
            )

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return self.net.inputs

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return self.net.outputs

    def propagate(self, x: Any, unit: AtUnit) -> Any:
        """The forward pass over any kind of number, with `unit` at each layer of units."""
        return self.skip @ x + self.net.propagate(x, unit)


def Switched(  # noqa: N802  (it stands for a network)
    controllers: Sequence[AbstractNetwork], by: Callable[[Array], Array]
) -> Network:
    """The network that is one of several, whichever the state says.

    Over states of which it is known which one acts, the others are not looked at. Where it is not
    known, all that may act are followed.

    Args:
        controllers: networks of as many inputs, and as many outputs.
        by: the place among them of the one that acts, a function of JAX of what the controller is
            given: `lambda x: jnp.argmax(x[2:])`, or `lambda x: (x[0] > 1.0).astype(int)`.

    Raises:
        TypeError: a controller is none, or `by` is no function.
        ValueError: there are no controllers, or they have different sizes.

    Example:
        >>> from reachjax import MLP
        >>> slow, fast = (MLP.from_layers([([[gain]], [0.0])]) for gain in (-0.5, -2.0))
        >>> net = Switched([slow, fast], by=lambda x: (jnp.abs(x[0]) > 1.0).astype(int))
        >>> net([0.5]).tolist(), net([2.0]).tolist()
        ([-0.25], [-4.0])
    """
    given = tuple(controllers)
    if not given:
        raise ValueError("Switched.controllers must be networks, but none arrived")
    for each in given:
        if not isinstance(each, AbstractNetwork):
            raise TypeError(
                f"Switched.controllers must be networks, but {described(each)} arrived: an "
                "rj.Network makes one of a function"
            )
    if not callable(by):
        raise TypeError(f"Switched.by must be a function, but {described(by)} arrived")
    for each in given[1:]:
        for name in ("inputs", "outputs"):
            same_size(
                f"the first controller's number of {name} is",
                f"the number of {name} of another one is",
                (getattr(given[0], name), getattr(each, name)),
            )

    function = jax.tree_util.Partial(partial(_acting, by), given)
    return Network(function, given[0].inputs, given[0].outputs)


def _acting(by: Callable[[Array], Array], nets: tuple[AbstractNetwork, ...], x: Array) -> Array:
    return jax.lax.switch(by(x), [net.__call__ for net in nets], x)


def one_of(options: Float[ArrayLike, "m n"], w: Float[ArrayLike, " m"]) -> Any:
    """The option whose number is the largest: any of them, if `w` is anything in a box.

    Of a plant with a disturbance in `Box(zeros(m), ones(m))` a person or a pilot may take any of
    `m` options at each step: the worst case is certified.

    Args:
        options: vectors.
        w: as many numbers as there are options.

    Example:
        >>> one_of([[-1.0], [0.0], [1.0]], jnp.array([0.2, 0.9, 0.1])).tolist()
        [0.0]
    """
    options = Numbers("(m, n)")(options, "options")
    same_size("the number of options is", "that of w is", (len(options), jnp.shape(w)[0]))
    return options[jnp.argmax(jnp.asarray(w))]
