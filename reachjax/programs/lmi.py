"""The one formula, as data.

For each facet `a . x+ <= b` the paper's theorem 1 asks for multipliers with

    F' Gamma F  +  p e' + e p'  -  2 b e e'  <=  0        (negative semidefinite)

over the basis: `F` stacks the facts, `Gamma` weighs their products, `p` is the row of `a . x+` and
`e` picks the constant 1. Multiplied from both sides by a trajectory's basis vector it says
`2 (a . x+ - b) <= -(products) <= 0`.

The program is stated in scaled coordinates, `xi = T eta` with `|eta_i| <= 1` on the set, which
keeps multipliers of order one and bounds `|eta|^2` by the number of entries.

For an ellipsoid `|A x+ + b| <= 1` the last three terms are `V' V - e e'`, `V` being the rows of
`A x+ + b`. Its Schur complement is affine in `A`, `b` and the multipliers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float

from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.numerics.rounding import Ball, gamma
from reachjax.programs.basis import Rows
from reachjax.programs.relaxations import Products
from reachjax.sets import NormalForm


class Origin(NamedTuple):
    """What a program was made of, so that it can be made again from the loop and its sets.

    Attributes:
        start: the time of the first set of its window.
        steps: how many the window has.
        prune: whether units that bounds prove to be affine left the basis.
        linear: whether bounds are those of supports and linear relaxations.
        drop_columns: whether units that left the basis take no columns either.
    """

    start: int
    steps: int
    prune: bool
    linear: bool
    drop_columns: bool


@pytree
class Program(Replaceable):
    """The semidefinite programs of one step: one for each facet, all but the objective shared.

    Attributes:
        facts: `(m, n)` rows over the scaled basis, never negative on the set, and the rows of its
            cone fact.
        objective: `(f, n)` rows over the scaled basis: `a . x+` for each facet.
        products: which pairs of facts are multiplied.
        transform: `(n, n)`, `T` with `xi = T eta`: midpoints in the last column, on the diagonal
            radii, zero where the entry is unused or has one value. The states of an ellipsoid are
            those of the unit ball, and the block is its factor.
        origin: of which window it is; None where that is not known.
    """

    facts: Rows
    objective: Rows
    products: Products
    transform: Float[Array, "n n"]
    origin: Origin | None = static(default=None)

    @property
    def used(self) -> Bool[Array, " n"]:
        """Which entries of the scaled basis vary, and the constant."""
        return self.transform.diagonal() > 0

    def with_objective(self, rows: slice | np.ndarray) -> Program:
        """The same program with some of the objective's rows."""
        return self.replace(objective=self.objective[rows])

    def with_midpoints(self, facts: Float[Array, "m n"], objective: Float[Array, "f n"]) -> Program:
        """The same program with other coefficients and the rounding errors of these."""
        return self.replace(
            facts=Rows(facts, self.facts.rad), objective=Rows(objective, self.objective.rad)
        )


def weighted_products(program: Program, multipliers: Float[Array | np.ndarray, " K"]) -> Ball:
    """`F' Gamma F` `(n, n)` with a bound of its rounding error, for one facet's multipliers.

    Works on JAX arrays and on numpy arrays alike.
    """
    products, facts = program.products, program.facts
    weights = (products.sign * multipliers[products.multiplier])[:, None]
    L, dL = facts.mid[products.left], facts.rad[products.left]
    R, dR = facts.mid[products.right], facts.rad[products.right]
    half = (weights * L).T @ R
    size = abs(weights)
    rounding = gamma(len(products.left) + 4) * ((size * abs(L)).T @ abs(R))
    inherited = (size * dL).T @ (abs(R) + dR) + (size * abs(L)).T @ dR
    error = (rounding + inherited) * (1 + gamma(len(products.left) + 4))
    return Ball((half + half.T) / 2, (error + error.T) / 2)


def form_rows(program: Program, form: NormalForm) -> Ball:
    """`V = A x+ + b` as rows `(q, n)`, `x+` being the objective rows.

    Works on JAX arrays and on numpy arrays alike.
    """
    last = np.arange(len(program.transform)) == len(program.transform) - 1
    constant = form.b[:, None] * last
    return form.A @ program.objective + Ball(constant, 0 * constant)


def with_successor(program: Program, form: NormalForm) -> Program:
    """The same program with `A x+ + b` in the place of the successor `x+`."""
    return program.replace(objective=form_rows(program, form))


class Slopes(NamedTuple):
    """The derivative of a number in a program's rows.

    Attributes:
        facts: `(m, n)`.
        objective: `(f, n)`.
    """

    facts: Float[Array | np.ndarray, "m n"]
    objective: Float[Array | np.ndarray, "f n"]


def inequality_slopes(
    program: Program,
    multipliers: Float[Array | np.ndarray, " K"],
    moments: Float[Array | np.ndarray, "N N"],
    where: slice,
) -> Slopes:
    """The derivative of `<X, Z>`, `Z` being what is to be positive semidefinite, on the host.

    Facets have `Z = 2 b e e' - p e' - e p' - F' Gamma F`, ellipsoids
    `Z = [e e' - F' Gamma F, V'; V, I]` with `V = A x+ + b`. With multipliers and moments `X` held
    at their optimal values, this is the derivative of the optimum (the envelope theorem), times
    that of `<X, Z>` in what is sought.

    Args:
        program: of numpy arrays.
        multipliers: of its products.
        moments: `X`, over the basis and what `Z` has beyond it.
        where: the rows of `Z` in which `V` stands, or `-p`.

    Returns:
        The derivative in the facts `F`, and in `V` or `-p`.
    """
    n, products, F = len(program.transform), program.products, program.facts.mid
    weights = products.sign * multipliers[products.multiplier]
    pairs = sp.coo_array((weights, (products.left, products.right)), shape=(len(F), len(F)))
    return Slopes(-((pairs + pairs.T) @ (F @ moments[:n, :n])), 2 * moments[where, :n])
