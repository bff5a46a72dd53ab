"""What of a program a solver should see: nothing empty, nothing at rounding level, nothing implied.

Rows whose coefficients are rounding noise are dropped (one of size 1e-16 scaled up to 1 made a
solver report "solved" for an offset below the true support), so are columns that the others use at
that level or not at all. Dropping is masking here: shapes stay, so that the same code serves numpy
arrays on the host and traced arrays inside `jax.jit`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from reachjax.numerics.rounding import Ball
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import Products

NOISE = 16.0
"""Coefficients no larger than this many times the rounding error of their row count as zero."""

TOUCHING = 1e-6
"""A fact negative on an ellipsoid by no more than this part of its size counts as implied by it."""


class Trimmed(NamedTuple):
    """A program's numbers, zero where they say nothing.

    Attributes:
        facts: `(m, n)`.
        objective: `(f, n)`, of unit 1-norm and without a constant.
        centers: `(f,)`, the constants; a facet's offset is `centers + units b`.
        units: `(f,)`, zero where the objective has one value.
        columns: `(n,)`, which are used.
        kept: `(K,)`, which multipliers are.
        sizes: `(K,)`, of the generators: the root of the sum of squares over their pairs.
    """

    facts: Float[Any, "m n"]
    objective: Float[Any, "f n"]
    centers: Float[Any, " f"]
    units: Float[Any, " f"]
    columns: Bool[Any, " n"]
    kept: Bool[Any, " K"]
    sizes: Float[Any, " K"]


def namespace(array: Any) -> Any:
    """`numpy` for its own arrays, `jax.numpy` for others."""
    return np if isinstance(array, np.ndarray) else jnp


def summed(values: Any, owner: Any, count: int) -> Any:
    """Sums `(count,)` of the values that belong to each owner."""
    if isinstance(values, np.ndarray):
        return np.bincount(owner, values, count)
    return jax.ops.segment_sum(values, owner, count)


def trimmed(program: Program) -> Trimmed:
    """Mask what is empty or noise, and bring the objective to unit size."""
    xp = namespace(program.facts.mid)
    solid, wanted = _solid(program.facts), _solid(program.objective)
    columns = solid.any(axis=0) | wanted.any(axis=0)
    facts = xp.where(solid.any(axis=1)[:, None] & columns, program.facts.mid, 0.0)
    products = program.products
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is dropped
        sizes = squared_sizes(products, facts) ** 0.5
    objective = xp.where(columns, program.objective.mid, 0.0)
    centers = objective[:, -1]
    # solvers' tolerances are absolute, objectives come in the size of the set of states
    objective = objective * (xp.arange(objective.shape[1]) < objective.shape[1] - 1)
    units = abs(objective).sum(axis=1)
    return Trimmed(
        facts=facts,
        objective=objective / xp.where(units > 0, units, 1.0)[:, None],
        centers=centers,
        units=units,
        columns=columns,
        kept=(sizes > 0) & xp.isfinite(sizes) & ~implied_by_cone(products, facts),
        sizes=sizes,
    )


def squared_sizes(products: Products, facts: Any) -> Float[Any, " K"]:
    """The sum of `|sym(p' q)|^2` over the pairs of each multiplier."""
    squares = (facts**2).sum(axis=1)
    inner = (facts[products.left] * facts[products.right]).sum(axis=1)
    of_pairs = (squares[products.left] * squares[products.right] + inner**2) / 2
    return summed(of_pairs, products.multiplier, len(products.free))


def _solid(rows: Ball) -> Bool[Any, "k n"]:
    """Which coefficients stand out from the rounding errors of their row."""
    noise = (rows.rad**2).sum(axis=1) ** 0.5
    return abs(rows.mid) > NOISE * noise[:, None]


def implied_by_cone(products: Products, facts: Any) -> Bool[Any, " K"]:
    """Multipliers `(K,)` of products that say nothing beyond an ellipsoid's own fact.

    A quadratic function of the state that is not negative on the ellipsoid is a positive multiple
    of its fact and a positive semidefinite term (the S-lemma loses nothing for one constraint).
    Products of neurons that are affine on the set are of this kind; kept, hundreds of them made a
    solver stall at its second digit. So are those of facets that do not cut the ellipsoid.
    """
    xp = namespace(facts)
    cone, count = products.sign < 0, len(products.free)
    if xp is np and not cone.any():
        return np.zeros(count, dtype=bool)
    own = summed(1.0 * cone, products.multiplier, count) > 0
    holds = _least_on_ellipsoid(products, facts, own) >= 0
    present = (facts != 0).any(axis=1)
    left, right = products.left, products.right
    beyond = ~(holds[left] & holds[right]) & present[left] & present[right]
    says_more = summed(1.0 * beyond, products.multiplier, count) > 0
    return cone.any() & ~says_more & ~own


def _least_on_ellipsoid(products: Products, facts: Any, own: Any) -> Float[Any, " m"]:
    """A lower bound `(m,)` of each fact on the ellipsoid; `-inf` if it is not one of the state.

    Args:
        products: whose negative pairs are those of the rows `R` with `|R x| <= s`.
        facts: `(m, n)`.
        own: `(K,)`, the multiplier of the ellipsoid's own fact.
    """
    xp = namespace(facts)
    cone, (left, right) = products.sign < 0, (facts[products.left], facts[products.right])
    of_level = own[products.multiplier] & ~cone
    level = xp.where(of_level, left[:, -1] * right[:, -1], 0.0).sum() ** 0.5
    R, linear = xp.where(cone[:, None], left, 0.0), facts[:, :-1]
    inverse = xp.linalg.pinv(R[:, :-1].T @ R[:, :-1], hermitian=True)
    middle = facts[:, -1] - linear @ (inverse @ (R[:, :-1].T @ R[:, -1]))
    squares = ((linear @ inverse) * linear).sum(axis=1)
    reach = level * xp.where(squares > 0, squares, 0.0) ** 0.5
    elsewhere = ((linear != 0) & ~(R[:, :-1] != 0).any(axis=0)).any(axis=1)
    least = middle - reach + TOUCHING * (abs(middle) + reach)
    return xp.where(elsewhere, -xp.inf, least)
