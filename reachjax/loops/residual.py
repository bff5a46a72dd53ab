"""Residual networks, `pi(x) = S x + net(x)`: what a network adds to a linear map of its input."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.loops.networks import AbstractNetwork
from reachjax.loops.units import AtUnit
from reachjax.numerics.checks import Numbers, require_kind
from reachjax.numerics.pytrees import converted, pytree


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
