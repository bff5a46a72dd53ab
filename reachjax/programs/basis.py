"""The change of basis: everything affine in the loop as rows over one vector.

The basis is `xi = [x, z, 1]`: the state, the outputs of the units (hidden neurons, then the two
projection layers) and a last 1. A row `r` means the number `r . xi`. The loop's own forward pass
is run over rows, so what is certified is what is simulated.

A unit whose bounds prove it to be affine may leave the basis: its output is then the row of its
input, or zero, and its column stays empty (so that array shapes never change).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import AbstractActivation, ClosedLoop
from reachjax.loops.activations import UnitFacts
from reachjax.numerics.checks import require_double_precision
from reachjax.numerics.pytrees import pytree
from reachjax.numerics.rounding import Ball
from reachjax.programs.bounds import LoopBounds

STEADY = 1e-6
"""An input that varies by no more than this part of itself has no caps among its facts: they would
be as small, their multipliers as large as its inverse, and derivatives would lose those digits."""


@pytree
class Rows(Ball):
    """`k` rows over the basis, `(k, n)`, with a bound of the rounding error of each coefficient."""

    def lift(self, other: Any) -> Ball:
        """A plain vector `(k,)` is a constant: rows with entries in the last column only."""
        if isinstance(other, Ball):
            return other
        last = jnp.zeros((other.shape[0], self.mid.shape[1])).at[:, -1].set(other)
        return Rows.exact(last)

    def widened(self, by: Array) -> Rows:
        """Rows whose values may be off by so much."""
        return Rows(self.mid, self.rad.at[:, -1].add(by))

    def where(self, mask: Array) -> Rows:
        """Keep the rows in which the mask is true; the others are zero."""
        keep = jnp.asarray(mask, self.mid.dtype)[:, None]
        return Rows(self.mid * keep, self.rad * keep)


@pytree
class LoopRows:
    """Rows of one step of the loop over the basis.

    Attributes:
        state: `(n_x, n)`.
        preactivation: `(k, n)`, inputs `y` of the units.
        output: `(k, n)`, outputs `z` of the units.
        facts: what holds of the units, each `(k, n)`.
        successor: `(n_x, n)`, the state one step later.
    """

    state: Rows
    preactivation: Rows
    output: Rows
    facts: UnitFacts
    successor: Rows


def columns(first: int, count: int, size: int) -> Rows:
    """The rows that pick `count` entries of the basis, beginning with entry `first`."""
    return Rows.exact(jnp.eye(count, size, k=first))


def picking(places: Int[Array | np.ndarray, " k"], size: int) -> Rows:
    """The rows that pick these entries of the basis; zero where a place is negative."""
    return Rows.exact(jax.nn.one_hot(places, size, dtype=float))


def loop_rows(
    loop: ClosedLoop,
    state: Rows,
    places: Int[Array | np.ndarray, " k"],
    t: int | jax.Array,
    bounds: LoopBounds,
    prune: bool,
) -> LoopRows:
    """One step of the loop, from rows of the state.

    Args:
        loop: the closed loop.
        state: rows of the state at time `t`.
        places: the column of each unit; negative for those that `prune` does away with.
        t: the time.
        bounds: of this step's units.
        prune: whether units that the bounds prove to be affine leave their columns empty.
    """
    size = state.mid.shape[1]
    units: list[tuple[Rows, Rows, UnitFacts]] = []

    def unit(activation: AbstractActivation, y: Rows) -> Rows:
        done = sum(z.mid.shape[0] for _, z, _ in units)
        here = slice(done, done + y.mid.shape[0])
        z = picking(places[here], size)
        if prune:
            passing, blocking = bounds.passing[here], bounds.blocking[here]
            z = (z.where(~passing & ~blocking) + y.where(passing)).widened(bounds.excess[here])
        interval = bounds.preactivation[here]
        facts = activation.facts(y, z, interval.lower, interval.upper)
        telling = interval.rad > STEADY * abs(interval.mid)
        units.append((y, z, facts.capped_where(telling)))
        return z

    successor = loop.step(state, t, unit)
    none = columns(0, 0, size)
    units.insert(0, (none, none, UnitFacts(none, none, none, none)))
    y, z, facts = jax.tree.map(lambda *rows: jnp.concatenate(rows), *units)
    return LoopRows(state, y, z, facts, successor)


@pytree
class ChangeOfBasis:
    """The paper's change-of-basis matrices over `[x^0, x^1, ..., x^{l+2}, 1]`.

    Attributes:
        E_in: `(n_x + 1, n)`, proposition 3.
        E_mid: `(2 k + 1, n)`, proposition 5: inputs `y`, outputs `z` of the ReLUs, and 1.
        E_out: `(n_x + 1, n)`, proposition 4.
    """

    E_in: Float[Array, "n_x+1 n"]
    E_mid: Float[Array, "2k+1 n"]
    E_out: Float[Array, "n_x+1 n"]


def change_of_basis(loop: ClosedLoop, t: int = 0) -> ChangeOfBasis:
    """The paper's `E_in`, `E_mid`, `E_out` of one step at time `t`, every neuron kept.

    Without an input box there are no projection layers: the basis ends with `x^l` and 1.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        ValueError: a time-varying loop ends before `t`.

    Source: propositions 3, 4 and 5 of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> change_of_basis(loop).E_out.tolist()  # over x, two neurons, two projections, 1
        [[1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]
    """
    require_double_precision(loop=loop)
    loop.check_horizon(1, t)
    return _change_of_basis(loop, t)


@jax.jit
def _change_of_basis(loop: ClosedLoop, t: int) -> ChangeOfBasis:
    n, k = loop.states, loop.units
    size = n + k + 1
    anything = Ball(jnp.zeros(k), jnp.zeros(k))
    none = jnp.zeros(k)
    bounds = LoopBounds(anything, anything, anything, none, none, none, anything)
    rows = loop_rows(loop, columns(0, n, size), n + jnp.arange(k), t, bounds, prune=False)
    one = columns(size - 1, 1, size).mid
    # the paper keeps x^{l+1} = z + u_low and x^{l+2} = u_high - z in place of the last outputs
    S = jnp.eye(size)
    if loop.input_box is not None:
        box, m = loop.input_box.at(t), loop.plant.inputs
        lower, upper = slice(size - 1 - 2 * m, size - 1 - m), slice(size - 1 - m, size - 1)
        S = S.at[lower, -1].set(-box.lower)
        S = S.at[upper, upper].set(-jnp.eye(m)).at[upper, -1].set(box.upper)
    return ChangeOfBasis(
        E_in=jnp.vstack([rows.state.mid, one]) @ S,
        E_mid=jnp.vstack([rows.preactivation.mid, rows.output.mid, one]) @ S,
        E_out=jnp.vstack([rows.successor.mid, one]) @ S,
    )
