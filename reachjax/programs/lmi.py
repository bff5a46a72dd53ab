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

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.numerics.rounding import Ball, gamma
from reachjax.programs.basis import Rows
from reachjax.programs.relaxations import Products
from reachjax.sets import NormalForm


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
    """

    facts: Rows
    objective: Rows
    products: Products
    transform: Float[Array, "n n"]

    @property
    def used(self) -> Bool[Array, " n"]:
        """Which entries of the scaled basis vary, and the constant."""
        return self.transform.diagonal() > 0

    def seeking(self, rows: slice | np.ndarray) -> Program:
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


def lagrangian(
    program: Program, multipliers: Float[Array, "f K"], moments: Float[Array, "f n n"]
) -> Float[Array, " f"]:
    """`<X / 2, F' Gamma F + p e' + e p'>` of each facet, over the scaled basis.

    With multipliers and moments held at their optimal values, its derivative is that of the optimal
    offset (the envelope theorem).
    """
    F, products = program.facts.mid, program.products
    values = F @ moments @ F.T
    pairs = values[:, products.left, products.right]
    weights = products.sign * multipliers[:, products.multiplier]
    weighted = jnp.sum(weights * pairs, axis=1) / 2
    return weighted + jnp.einsum("fi,fi->f", program.objective.mid, moments[:, :, -1])


def schur_lagrangian(
    program: Program,
    multipliers: Float[Array, " K"],
    form: NormalForm,
    moments: Float[Array, "n+q n+q"],
) -> Float[Array, ""]:
    """`<X, [e e' - F' Gamma F, V'; V, I]>` less what does not depend on rows, `V = A x+ + b`.

    That matrix is positive semidefinite where `V' V - e e' + F' Gamma F <= 0`, which is theorem 1
    for the ellipsoid `|A x + b| <= 1`; it is affine in the multipliers, `A` and `b`.
    """
    F, products, n = program.facts.mid, program.products, len(program.transform)
    pairs = (F @ moments[:n, :n] @ F.T)[products.left, products.right]
    weights = products.sign * multipliers[products.multiplier]
    V = form_rows(program, form).mid
    return 2 * jnp.sum(moments[n:, :n] * V) - jnp.sum(weights * pairs)
