"""Activations, and what is known about their inputs `y` and outputs `z`.

A ReLU `z = max(y, 0)` satisfies the paper's (relu::sector): `z >= 0`, `z - y >= 0` and
`z (z - y) = 0`. When bounds `l <= y <= u` are known, `z <= max(u, 0)` and `z - y <= max(-l, 0)`
as well, and a neuron with `l >= 0` or `u <= 0` is affine.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Bool, Float


class UnitFacts(NamedTuple):
    """Rows that are never negative; `output` and `slack` complement each other.

    `output * slack = 0` on every trajectory. The caps are what local bounds add.
    """

    output: Any
    slack: Any
    output_cap: Any
    slack_cap: Any

    def capped_where(self, mask: Bool[Array, " k"]) -> UnitFacts:
        """The caps only of some units; those of the others become `0 >= 0`."""
        output_cap, slack_cap = self.output_cap.where(mask), self.slack_cap.where(mask)
        return self._replace(output_cap=output_cap, slack_cap=slack_cap)


class AbstractActivation(abc.ABC):
    """A scalar nonlinearity applied entry by entry. Hashable: it is part of a network's structure.

    The methods on rows take anything with affine arithmetic: numbers or rows over a basis.
    """

    @abc.abstractmethod
    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value of the nonlinearity."""

    @abc.abstractmethod
    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bounds of the output for inputs in `[lower, upper]`."""

    @abc.abstractmethod
    def phases(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Masks of the units that are surely the identity, and of those that are surely zero."""

    @abc.abstractmethod
    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> UnitFacts:
        """What holds for inputs `y`, outputs `z` and bounds `lower <= y <= upper`."""


@dataclasses.dataclass(frozen=True)
class ReLU(AbstractActivation):
    """`max(y, 0)`.

    Example:
        >>> ReLU()(jax.numpy.array([-1.0, 2.0])).tolist()
        [0.0, 2.0]
    """

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`max(y, 0)`, with derivative 0 at 0."""
        return jax.nn.relu(y)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """A monotone function maps bounds to bounds."""
        return jax.nn.relu(lower), jax.nn.relu(upper)

    def phases(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Active where `lower >= 0`, inactive where `upper <= 0`."""
        return lower >= 0, (upper <= 0) & (lower < 0)

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> UnitFacts:
        """Equation (relu::sector) and, from the bounds, the caps of `z` and of `z - y`."""
        slack = z - y
        return UnitFacts(z, slack, jax.nn.relu(upper) - z, jax.nn.relu(-lower) - slack)


def evaluate(activation: AbstractActivation, y: Float[Array, " k"]) -> Float[Array, " k"]:
    """Apply an activation to numbers: what a loop does with its units when it is simulated."""
    return activation(y)
