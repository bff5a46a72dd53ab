"""One step of an infeasible-start primal-dual method for the program of a facet.

    minimise b   over b, y   with   S = b e' e - C - sum_k y_k G_k >= 0,   y_k >= 0 unless free,
    maximise <C, X>          with   X >= 0,  X_ee = 1,  <G_k, X> = z_k >= 0 (0 where free).

The offset counts as a last, free multiplier with generator `-e' e`. The direction is that of
Helmberg, Rendl, Vanderbei and Wolkowicz (HKM), with Mehrotra's predictor and corrector: with
`W = S^-1`,

    dX = s mu W - X - sym(X dS W),    y_k dz_k + z_k dy_k = s mu - y_k z_k.

Every equation of `X` is relaxed by `kappa mu y_k`: where `X` has no interior (dead neurons, flat
sets, products that others imply), the multipliers of the central path would grow without bound.
What this adds to the objective vanishes with `mu`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.solvers.factorisations import inverse_cholesky, refined_solver
from reachjax.solvers.generators import Generators, symmetric

DAMPING = 1e-4
"""`kappa` of this module's docstring. Measured on degenerate programs: at 1e-3 some stall at the
start, without it some multipliers grow to 1e7 and six digits are lost."""

LEAST = 0.05
"""The target is no smaller a part of `mu`: faster falls cost `X` its last digits."""


class Point(NamedTuple):
    """An iterate.

    Attributes:
        X: `(n, n)`, positive definite.
        S: `(n, n)`, positive definite.
        y: `(K,)`, multipliers.
        z: `(K,)`, their slacks; 0 where free.
    """

    X: Float[Array, "n n"]
    S: Float[Array, "n n"]
    y: Float[Array, " K"]
    z: Float[Array, " K"]


class Residuals(NamedTuple):
    """What an iterate misses.

    Attributes:
        primal: `(K,)`, `target - <G_k, X> + z_k`.
        dual: `(n, n)`, `-C - sum_k y_k G_k - S`.
        complementarity: `mu`, the mean of the products that should vanish.
        merit: the largest of both residuals and of the gap, relative.
    """

    primal: Float[Array, " K"]
    dual: Float[Array, "n n"]
    complementarity: Float[Array, ""]
    merit: Float[Array, ""]


class Plan(NamedTuple):
    """What the next direction aims at, and the last one.

    Attributes:
        target: the complementarity aimed at.
        cross: `(n, n)`, second-order terms of `X S`.
        cross_z: `(K,)`, second-order terms of `y z`.
        share: of the way to the boundary that a step may go.
        lengths: of the last direction's steps, in `X, z` and in `S, y`.
        move: the last direction.
    """

    target: Float[Array, ""]
    cross: Float[Array, "n n"]
    cross_z: Float[Array, " K"]
    share: Float[Array, ""]
    lengths: tuple[Float[Array, ""], Float[Array, ""]]
    move: Point


def start(generators: Generators) -> Point:
    """`X = I`, `S = 10 I`, and multipliers of the same size; free ones are zero."""
    eye, signed = jnp.eye(generators.rows.shape[1]), ~generators.free
    return Point(eye, 10.0 * eye, 1.0 * signed, 1.0 * signed)


def bordered(generators: Generators, row: Float[Array, " n"]) -> Float[Array, "n n"]:
    """`C`: `<C, X> = row . X e`; idle columns have -1 on the diagonal, so that `S` is 1 there."""
    last = generators.rows[-1]
    return symmetric(jnp.outer(row, last)) - jnp.diag(generators.idle)


def residuals(
    generators: Generators,
    row: Float[Array, " n"],
    point: Point,
    paired: Float[Array, " K"],
) -> Residuals:
    """What an iterate misses, given `<G_k, X>`."""
    X, S, y, z = point
    primal = generators.target - paired + z
    dual = -bordered(generators, row) - generators.weighted(y) - S
    products = jnp.sum(X * S) + y @ z
    # the difference of both values alone may vanish before either is optimal
    gap = jnp.maximum(abs(y[-1] - row @ X[:, -1]), products) / (1 + abs(y[-1]))
    missed = jnp.max(abs(primal)) / jnp.maximum(1.0, jnp.linalg.norm(X))
    merit = jnp.maximum(jnp.maximum(missed, jnp.max(abs(dual))), gap)
    return Residuals(primal, dual, products / (X.shape[0] + jnp.sum(~generators.free)), merit)


def step(
    generators: Generators, row: Float[Array, " n"], point: Point
) -> tuple[Point, Residuals, Float[Array, ""]]:
    """The next iterate, what this one misses, and the shorter of the two step lengths."""
    signed = ~generators.free
    X_inverse, X = inverse_cholesky(point.X)
    S_inverse, S = inverse_cholesky(point.S)
    y, z = point.y, point.z
    W = S_inverse.T @ S_inverse
    A, B = generators.gram(X), generators.gram(W)
    X_paired, W_paired = generators.paired_gram(A, X), generators.paired_gram(B, W)
    missed = residuals(generators, row, Point(X, S, y, z), X_paired)
    mu = missed.complementarity
    ratio = jnp.where(signed, z / jnp.where(signed, y, 1.0), 0.0)
    inverse_y = jnp.where(signed, 1 / jnp.where(signed, y, 1.0), 0.0)
    # the offset has no part in the damping: its equation holds the corner of X at one
    damping = DAMPING * mu * (jnp.arange(len(y)) < len(y) - 1)
    schur = generators.schur(X, W, A, B) + jnp.diag(ratio + damping)
    solve = refined_solver(schur)
    constant = missed.primal + X_paired - damping * y - z
    constant += generators.paired(symmetric(X @ missed.dual @ W))

    def direction(plan: Plan) -> Point:
        pushed = (plan.target - plan.cross_z) * inverse_y
        dy = solve(constant - plan.target * W_paired + generators.paired(plan.cross) + pushed)
        dS = missed.dual - generators.weighted(dy)
        dX = plan.target * W - X - symmetric(X @ dS @ W) - plan.cross
        return Point(dX, dS, dy, pushed - z * signed - ratio * dy)

    def lengths(move: Point, share):
        primal = jnp.minimum(_to_boundary(X_inverse, move.X), _to_zero(z, move.z))
        dual = jnp.minimum(
            _to_boundary(S_inverse, move.S), _to_zero(y, jnp.where(signed, move.y, 0))
        )
        return jnp.minimum(1.0, share * primal), jnp.minimum(1.0, share * dual)

    def attempt(_, plan: Plan) -> Plan:
        """A direction and its step lengths; what they leave decides the next one's target."""
        move = direction(plan)
        a, b = lengths(move, plan.share)
        left = jnp.sum((X + a * move.X) * (S + b * move.S))
        left += jnp.sum(jnp.where(signed, (y + b * move.y) * (z + a * move.z), 0.0))
        left = jnp.clip(left / (mu * (X.shape[0] + jnp.sum(signed))), 0.0, 1.0)
        both = jnp.minimum(a, b)
        left = left ** jnp.maximum(1.0, 3 * both**2)
        return Plan(
            target=mu * jnp.maximum(left, jnp.where(both < 0.1, 0.5, LEAST)),
            cross=symmetric(move.X @ move.S @ W),
            cross_z=jnp.where(signed, move.y * move.z, 0.0),
            share=0.9 + 0.09 * both,
            lengths=(a, b),
            move=move,
        )

    zero = jnp.zeros_like(mu)
    nothing = jax.tree.map(jnp.zeros_like, Point(X, S, y, z))
    plan = Plan(zero, nothing.X, nothing.z, zero + 1, (zero, zero), nothing)
    # predictor, then corrector
    plan = jax.lax.fori_loop(0, 2, attempt, plan)
    move, (a, b) = plan.move, plan.lengths
    following = Point(
        symmetric(X + a * move.X), symmetric(S + b * move.S), y + b * move.y, z + a * move.z
    )
    return following, missed, jnp.minimum(a, b)


def _to_boundary(inverse: Float[Array, "n n"], move: Float[Array, "n n"]) -> Float[Array, ""]:
    """The longest step that keeps `M + t dM` semidefinite, given the inverse of `M`'s factor."""
    least = jnp.linalg.eigvalsh(inverse @ move @ inverse.T)[0]
    return jnp.where(least < 0, -1 / jnp.where(least < 0, least, -1.0), jnp.inf)


def _to_zero(value: Float[Array, " K"], move: Float[Array, " K"]) -> Float[Array, ""]:
    """The longest step that keeps a vector nonnegative."""
    falling = move < 0
    return jnp.min(jnp.where(falling, -value / jnp.where(falling, move, -1.0), jnp.inf))
