"""The change of basis: everything affine in the loop as rows over one vector.

The basis is `xi = [x, z, 1]`: the state, the outputs of the units (hidden neurons, then the two
projection layers) and a last 1. A row `r` means the number `r . xi`. The loop's own forward pass
is run over rows, so what is certified is what is simulated.

A unit whose bounds prove it to be affine may leave the basis: its output is then an affine function
of the row of its input, and its column stays empty (so that array shapes never change).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.units import AbstractUnit, Block, Facts, Line, Lines, Mark
from reachjax.numerics.checks import require_double_precision, require_kind
from reachjax.numerics.flags import lenient
from reachjax.numerics.pytrees import pytree
from reachjax.numerics.rounding import Ball, settled
from reachjax.programs.bounds import LoopBounds
from reachjax.sets import Box

STEADY = 1e-6
"""An input that varies by no more than this part of itself has no caps among its facts: they would
be as small, their multipliers as large as its inverse, and derivatives would lose those digits."""


@pytree
class Rows(Ball):
    """`k` rows over the basis, `(k, n)`, with a bound of the rounding error of each coefficient."""

    def lift(self, other: Any) -> Ball:
        """A plain vector `(k,)`, or a number, is a constant: entries in the last column only."""
        if isinstance(other, Ball):
            return other
        return Rows.exact(jnp.zeros_like(self.mid).at[:, -1].set(other))

    def widened(self, by: Array) -> Rows:
        """Rows whose values may be off by so much."""
        return Rows(self.mid, self.rad.at[:, -1].add(by))

    def flowed(self, flow: Any, given: tuple[Any, ...], unit: Any) -> Any:
        """Nothing: what a flow makes of rows is none.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            "the flow of a differential equation has no rows over a basis: give "
            "relaxation=LinearBounds() or BranchAndCut(), and a template of facets"
        )

    def met(self, held: Any, *given: Any) -> Rows:
        """The rows: what numbers are between is no matter of theirs."""
        return self

    def where(self, mask: Array) -> Rows:
        """Keep the rows in which the mask is true; the others are zero."""
        keep = jnp.asarray(mask, self.mid.dtype)[:, None]
        return Rows(self.mid * keep, self.rad * keep)


@pytree
class LoopRows:
    """Rows of one step of the loop over the basis.

    Attributes:
        state: `(n_x, n)`.
        preactivation: inputs `y` of the units, one or two of each.
        output: `(k, n)`, outputs `z` of the units.
        facts: what holds of the units, those of one kind together, in the order in which the loop
            meets the kinds.
        successor: `(n_x, n)`, the state one step later.
    """

    state: Rows
    preactivation: Rows
    output: Rows
    facts: tuple[Facts, ...]
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
    loop.require_units(len(places))
    size, done, seen = state.mid.shape[1], 0, 0
    none = columns(0, 0, size)
    inputs, outputs = [none], [none]
    facts: dict[AbstractUnit, list[Facts]] = {}

    def unit(unit: AbstractUnit, *given: Rows) -> Rows:
        nonlocal done, seen
        y = Rows.joined(given)
        of_inputs, seen = slice(seen, seen + len(y)), seen + len(y)
        here, done = slice(done, done + len(y) // unit.inputs), done + len(y) // unit.inputs
        z = picking(places[here], size)
        gone = bounds.affine[here] & prune
        if prune:
            slope = jnp.where(jnp.tile(gone, unit.inputs), bounds.lines.above.slope[of_inputs], 0.0)
            offset = jnp.where(gone, bounds.lines.above.offset[here], 0.0)
            kept = z.where(~gone)  # zero where offsets are not, so that they are added exactly
            line = Rows.exact(kept.mid.at[:, -1].add(offset)) + unit.combined(slope * y)
            z = line.widened(bounds.excess[here])
        interval = bounds.preactivation[of_inputs]
        stated = unit.facts(y, z, *settled((interval.lower, interval.upper)))
        telling = interval.rad > STEADY * abs(interval.mid)
        telling = unit.combined(1.0 * ~telling) == 0
        facts.setdefault(unit, []).append(stated.map(partial(_said, gone=gone, telling=telling)))
        inputs.append(y)
        outputs.append(z)
        return z

    successor = loop.step(state, t, unit)
    together = tuple(_joined(*parts) for parts in facts.values())
    return LoopRows(state, _joined(*inputs), _joined(*outputs), together, successor)


def _said(block: Block, gone: Bool[Array, " k"], telling: Bool[Array, " k"]) -> Rows:
    """A block's rows, zero where they say nothing.

    That is where the input varies by next to nothing, of facts that rest on its bounds, and where
    rounding alone may have left something of a fact of a unit that has left the basis.
    """
    rows = block.rows
    empty = settled(gone & jnp.all(abs(rows.mid) <= rows.rad, axis=1))
    return rows.where(~empty & telling if block.mark is Mark.BOUND else ~empty)


def _joined(*parts: Any) -> Any:
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *parts)


@pytree
class ChangeOfBasis:
    """The paper's change-of-basis matrices over `[x^0, x^1, ..., x^{l+2}, 1]`.

    Attributes:
        E_in: `(n_x + 1, n)`, proposition 3.
        E_mid: `(2 k + 1, n)`, proposition 5: inputs `y`, outputs `z` of the units, and 1.
        E_out: `(n_x + 1, n)`, proposition 4.
    """

    E_in: Float[Array, "n_x+1 n"]
    E_mid: Float[Array, "2k+1 n"]
    E_out: Float[Array, "n_x+1 n"]


@lenient
def change_of_basis(loop: ClosedLoop, t: int = 0) -> ChangeOfBasis:
    """The paper's `E_in`, `E_mid`, `E_out` of one step at time `t`, every neuron kept.

    Without an input box there are no projection layers: the basis ends with `x^l` and 1.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: the loop has disturbances or noise, or its inputs are projected onto a polytope:
            the paper's basis has no place for these.
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
    if loop.is_disturbed:
        raise TypeError(
            "change_of_basis is of loops without disturbances and noise, but loop has some: "
            "the paper's basis has no place for them"
        )
    if loop.input_box is not None:
        require_kind("loop.input_box", loop.input_box, Box, "a Box, as the paper has it")
    loop.check_horizon(1, t)
    return _change_of_basis(loop, t)


@Compiled
def _change_of_basis(loop: ClosedLoop, t: int) -> ChangeOfBasis:
    n, k = loop.states, loop.units
    size = n + k + 1
    none, nothing = jnp.zeros(k), jnp.zeros(loop.unit_inputs)
    any_ball, line = Ball(none, none), Line(nothing, none)
    inputs = Ball(nothing, nothing)
    bounds = LoopBounds(any_ball, inputs, any_ball, Lines(line, line), none > 0, none, any_ball)
    rows = loop_rows(loop, columns(0, n, size), n + jnp.arange(k), t, bounds, prune=False)
    one = columns(size - 1, 1, size).mid
    # the paper keeps x^{l+1} = z + u_low and x^{l+2} = u_high - z in place of the last outputs
    S = jnp.eye(size)
    if loop.input_box is not None:
        box, m = loop.input_box.at(t), loop.plant.inputs  # type: ignore[union-attr]
        lower, upper = slice(size - 1 - 2 * m, size - 1 - m), slice(size - 1 - m, size - 1)
        S = S.at[lower, -1].set(-box.lower)
        S = S.at[upper, upper].set(-jnp.eye(m)).at[upper, -1].set(box.upper)
    return ChangeOfBasis(
        E_in=jnp.vstack([rows.state.mid, one]) @ S,
        E_mid=jnp.vstack([rows.preactivation.mid, rows.output.mid, one]) @ S,
        E_out=jnp.vstack([rows.successor.mid, one]) @ S,
    )
