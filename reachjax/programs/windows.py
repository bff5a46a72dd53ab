"""Windows: the loop unrolled over its last steps, from a set of states, over one basis.

The basis is `[x[t], z[t], ..., z[t + w - 1], 1]`: a state and the outputs of the units of `w`
steps. States after `x[t]` are rows over it, and the sets that are known to hold them add facts. A
window of one step is the paper's recursion; one that begins at the initial set forgets nothing.

A window grows by one step at a time, by functions that are compiled once. Units that bounds prove
to be affine leave the basis; outside of `jax.jit` their columns can be left out as well
(`drop_columns`), so that a window of many steps has as many columns as it has units that switch.

**Scaling.** The scaling of a basis: `xi = T eta`, the entries of `eta` being in `[-1, 1]`. The
optimal value of a program does not depend on it, but its derivative at inexact multipliers does:
with the scaling's share, facts of thin sets keep their size and errors cancel.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.units import Facts
from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.numerics.rounding import Ball, settled
from reachjax.programs.basis import Rows, columns, loop_rows, picking
from reachjax.programs.bounds import LoopBounds, loop_bounds
from reachjax.programs.lmi import Origin, Program
from reachjax.programs.preactivations import bounds_over, known_inputs
from reachjax.programs.relaxations import AbstractRelaxation, FactLayout, Kind, StepFacts
from reachjax.sets import AbstractSet, Box, Ellipsoid

CONSTANT = 1e-9
"""An output whose radius is a smaller part than this of its input's size has a single value."""


def scaled_states(box: Box, ball: Ellipsoid | None) -> Float[Array, "n_x+1 n_x+1"]:
    """The scaling of `[x, 1]`.

    Args:
        box: a box around the states.
        ball: an ellipsoid around them, if one fits better.
    """
    n, around = box.dimension, Ball.between(box.lower, box.upper)
    T = jnp.diag(jnp.append(around.rad, 1.0)).at[:-1, -1].set(around.mid)
    if ball is not None:
        T = T.at[:n, :n].set(ball.from_ball()).at[:n, -1].set(ball.center)
    return settled(T)


def scaled_units(
    T: Float[Array, "n n"], places: Int[Array | np.ndarray, " k"], bounds: LoopBounds, prune: bool
) -> Float[Array, "n n"]:
    """The scaling with the outputs of units in it.

    Args:
        T: without them.
        places: the column of each unit; negative for those without one.
        bounds: of the units.
        prune: whether units that the bounds prove to be affine have left the basis.
    """
    here = picking(places, len(T)).mid
    mid, rad = _ranges(bounds, prune)
    T = T.at[:, -1].add(mid @ here) + jnp.diag(rad @ here)
    return settled(T)


def _ranges(bounds: LoopBounds, prune: bool) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Midpoint and radius of the output of each unit.

    A unit that has left the basis gets radius zero. One that stays although its output has a single
    value (a dead neuron that the paper keeps) is scaled by its input, so that it does stay: a
    radius at rounding level would tell the solver what the paper's constraints do not.
    """
    y, z = bounds.preactivation, bounds.output
    if prune:
        return jnp.where(bounds.affine, 0.0, z.mid), jnp.where(bounds.affine, 0.0, z.rad)
    size = abs(y.mid) + y.rad
    constant = z.rad <= CONSTANT * size
    # a tenth of the input's size: measured, solvers lose digits at the whole and at a hundredth
    return z.mid, jnp.where(constant, jnp.where(size > 0, size / 10, 1.0), z.rad)


COLUMNS = 16
"""Where columns are dropped, those that stay come in multiples of this many."""


@pytree
class Window(Replaceable):
    """Some steps of the loop from a set of states, as rows over the scaled basis.

    Attributes:
        facts: those of each step: of its set, then of its units.
        cone: `(r, n)`, rows of the first set's cone fact.
        state: `(n_x, n)`, the state after these steps, over the basis itself.
        transform: `(n, n)`, `T` with `xi = T eta`, the entries of `eta` being in `[-1, 1]`.
        steps: what the facts of each step are.
        units: how many there are in a step.
        start: the time of the first set.
        taken: how many columns are.
        prune: whether units that bounds prove to be affine leave the basis.
        linear: whether bounds are those of supports and linear relaxations.
        drop_columns: whether units that left the basis take no columns either.
    """

    facts: tuple[Rows, ...]
    cone: Rows
    state: Rows
    transform: Float[Array, "n n"]
    steps: tuple[StepFacts, ...] = static()
    units: int = static()
    start: int = static()
    taken: int = static()
    prune: bool = static()
    linear: bool = static()
    drop_columns: bool = static()

    @classmethod
    def beginning(
        cls,
        loop: ClosedLoop,
        X: AbstractSet,
        box: Box,
        t: int,
        relaxation: AbstractRelaxation,
        drop_columns: bool = False,
    ) -> Window:
        """No step yet.

        Args:
            loop: the closed loop.
            X: the set of states at time `t`.
            box: a box around it.
            t: the time.
            relaxation: whether units that bounds prove to be affine leave the basis, and by which
                bounds.
            drop_columns: whether their columns are left out as well, which needs concrete numbers.
        """
        (_, ball), prune, linear = X.parts, relaxation.remove_stable, relaxation.linear_bounds
        state, cone, T = _first(X.cone_facts(), box, ball)
        return cls(
            facts=(),
            cone=cone,
            state=state,
            transform=T,
            steps=(),
            units=loop.units,
            start=int(t),
            taken=loop.states,
            prune=prune,
            linear=linear,
            drop_columns=drop_columns and prune,
        )

    def __len__(self) -> int:
        return len(self.facts)

    @property
    def layout(self) -> FactLayout:
        """Where each kind of fact stands among those of the program."""
        return FactLayout(self.steps, len(self.cone.mid))

    def extended(
        self, loop: ClosedLoop, X: AbstractSet, box: Box, known: Ball | None = None
    ) -> Window:
        """One step more.

        Args:
            loop: the closed loop.
            X: a set that surely holds the state after the steps so far; the first set at first.
            box: a box around it.
            known: bounds of the inputs of the first units, if there are any besides these.
        """
        t = self.start + len(self)
        _, ball = X.parts
        supports = self.prune and (self.linear or ball is not None)
        around = X.closed_form(box) if supports else None
        bounds = _bounds(loop, around, box, t, known_inputs(loop.unit_inputs, known))
        places, taken = self._places(bounds)
        grown = self._padded(taken + 1)
        units, state, T = _extended(
            loop, grown.state, grown.transform, bounds, t, places, self.prune
        )
        facets, facts = _facts(X, grown.state, units, T)
        step = StepFacts(len(facets.mid), tuple(map(Kind.of, units)))
        return grown.replace(
            facts=(*grown.facts, facts),
            state=state,
            transform=T,
            steps=(*self.steps, step),
            taken=taken,
        )

    def program(self, directions: Float[Array, "f n_x"], relaxation: AbstractRelaxation) -> Program:
        """Theorem 1 for every facet of the states after these steps.

        With the identity for directions, the objective rows are the state: the program of an
        ellipsoid.

        Args:
            directions: one row for each facet.
            relaxation: which products of facts are used.
        """
        one, objective = _ends(directions, self.state, self.transform)
        facts = _joined(one, *self.facts, self.cone)
        products, flags = relaxation.products(self.layout), (self.prune, self.linear)
        origin = Origin(self.start, len(self), *flags, self.drop_columns)
        return Program(facts, objective, products, self.transform, origin)

    def _places(self, bounds: LoopBounds) -> tuple[Int[np.ndarray, " k"], int]:
        """The column of each unit of one more step, and how many are taken then."""
        if not self.drop_columns:
            return self.taken + np.arange(self.units), self.taken + self.units
        stays = ~jax.device_get(jax.lax.stop_gradient(bounds.affine))
        places = np.where(stays, self.taken + np.cumsum(stays) - 1, -1)
        return places, self.taken + int(stays.sum())

    def _padded(self, needed: int) -> Window:
        """The window with at least so many columns; new ones are empty."""
        if self.drop_columns:
            needed = -(-needed // COLUMNS) * COLUMNS
        more = needed - len(self.transform)
        if more <= 0:
            return self
        rows = self.facts, self.cone, self.state
        (facts, cone, state), T = _widened(rows, self.transform, more)
        return self.replace(facts=facts, cone=cone, state=state, transform=T)


@jax.jit
def _first(
    cone_facts: Float[Array, "r n_x+1"], box: Box, ball: Ellipsoid | None
) -> tuple[Rows, Rows, Float[Array, "n_x+1 n_x+1"]]:
    """Rows of the state, scaled rows of its cone fact, and the scaling."""
    state, T = columns(0, box.dimension, box.dimension + 1), scaled_states(box, ball)
    return state, _holding(cone_facts, state) @ T, T


@Compiled
def _bounds(
    loop: ClosedLoop,
    around: AbstractSet | None,
    box: Box,
    t: int,
    known: Ball,
) -> LoopBounds:
    """Bounds of one step: by intervals alone, or by supports of a set and linear relaxations."""
    if around is None:
        return loop_bounds(loop, box, t)
    return bounds_over(loop, around, box, t, known)


@partial(Compiled, static_argnames="prune")
def _extended(
    loop: ClosedLoop,
    state: Rows,
    T: Float[Array, "n n"],
    bounds: LoopBounds,
    t: int,
    places: Int[Array | np.ndarray, " k"],
    prune: bool,
) -> tuple[tuple[Facts, ...], Rows, Float[Array, "n n"]]:
    """Scaled facts of the units of one step, the state after it, and the scaling with these."""
    rows = loop_rows(loop, state, places, t, bounds, prune)
    T = scaled_units(T, places, bounds, prune)
    scaled = tuple(facts.map(lambda block: block.rows @ T) for facts in rows.facts)
    return scaled, rows.successor, T


@jax.jit
def _facts(
    X: AbstractSet, state: Rows, units: tuple[Facts, ...], T: Float[Array, "n n"]
) -> tuple[Rows, Rows]:
    """Scaled facts of a step's set, and with those of its units, block after block, behind them."""
    facets = _holding(X.facts(), state) @ T
    return facets, _joined(facets, *(block.rows for facts in units for block in facts.blocks))


@jax.jit
def _ends(
    directions: Float[Array, "f n_x"], state: Rows, T: Float[Array, "n n"]
) -> tuple[Rows, Rows]:
    """The constant, which is the first fact, and the objective, over the scaled basis."""
    return columns(len(T) - 1, 1, len(T)), (directions @ state) @ T


def _joined(*parts: Rows) -> Rows:
    return jax.tree.map(lambda *part: jnp.concatenate(part), *parts)


def _holding(facts: Float[Array, "m n_x+1"], state: Rows) -> Rows:
    """Facts of states as rows over the basis."""
    return facts[:, :-1] @ state + facts[:, -1]


@partial(jax.jit, static_argnames="more")
def _widened(rows: Any, T: Float[Array, "n n"], more: int) -> tuple[Any, Float[Array, "n+m n+m"]]:
    """All rows and the scaling, with empty columns before the last."""

    def wider(part: Float[Array, "k n"]) -> Float[Array, "k n+m"]:
        empty = jnp.zeros((len(part), more))
        return jnp.concatenate([part[:, :-1], empty, part[:, -1:]], axis=1)

    return jax.tree.map(wider, rows), wider(wider(T).T).T
