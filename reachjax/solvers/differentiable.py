"""The one door out of JAX, and the derivatives of what comes back.

Solvers and linear programs run in numpy on the host. Inside `jax.jit` and `jax.vmap` they are
reached through `jax.pure_callback`; on plain arrays they are called as they are. No JAX call is
made inside a callback, and only arrays cross.

Both results are optimal values, so the envelope theorem gives their derivatives: hold multipliers
and optimal points fixed and differentiate the Lagrangian. For a facet that is

    d b = <X / 2, d(F' Gamma F + p e' + e p')>,

with `X` the dual moment matrix, and ordinary automatic differentiation carries it on through rows,
bounds and earlier steps. What the recheck adds to an offset is not differentiated. Where a solver
failed, the derivative is NaN. It is as accurate as the solver: relative errors of 1e-6 to 5e-4 at
tolerance 1e-9, some 2.5e-3 at 1e-6 and 7e-2 at 1e-4.

Where a facet only touches, or a neuron becomes stable, an offset has a kink: the derivative is then
one of its generalised gradients, and central differences see another. Second derivatives and
forward mode do not exist; JAX raises an error for them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.checks import is_concrete
from reachjax.lmi import Program, lagrangian
from reachjax.sets import AbstractSet, Box, Polytope, polyhedra
from reachjax.solvers.accepted import accepted_offsets
from reachjax.solvers.base import AbstractSolver, Solution


def proved_offsets(program: Program, solver: AbstractSolver) -> tuple[Float[Array, " f"], Solution]:
    """Solve for every facet and prove the offsets; differentiable in the program's rows.

    Returns:
        The proved offsets `(f,)`, and what the solver proposed (which has no derivative).
    """
    return _proved_offsets(solver, program.facts.mid, program.objective.mid, program)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _proved_offsets(solver, facts, objective, program) -> tuple[Array, Solution]:
    facets, size = objective.shape
    shapes = Solution.shapes(facets, program.products.free.shape[0], size)
    offsets = jax.ShapeDtypeStruct((facets,), float)
    return _on_host(partial(_solve, solver), (offsets, shapes), program)


def _forward(solver, facts, objective, program):
    result: Any = _proved_offsets(solver, facts, objective, program)
    return result, (program, result[1])


def _backward(solver, residual, cotangents):
    program, solution = residual

    def value(facts, objective):
        held = program.replace(
            facts=type(program.facts)(facts, program.facts.rad),
            objective=type(program.objective)(objective, program.objective.rad),
        )
        return lagrangian(held, solution.multipliers, solution.moments)

    pull: Any = jax.vjp(value, program.facts.mid, program.objective.mid)[1]
    return *pull(cotangents[0]), None


_proved_offsets.defvjp(_forward, _backward)


def _solve(solver: AbstractSolver, program: Program) -> tuple[np.ndarray, Solution]:
    solution = solver.solve(program)
    return accepted_offsets(program, solution), solution


def bounding_box(X: AbstractSet) -> Box:
    """The smallest box around a set; differentiable, also inside `jax.jit`."""
    if not isinstance(X, Polytope):
        return X.bounding_box()
    lower, upper = _polytope_box(X.A, X.b)
    return Box(lower, upper)


@jax.custom_vjp
def _polytope_box(A, b):
    return _polytope_box_forward(A, b)[0]


def _polytope_box_forward(A, b):
    m, n = A.shape
    shapes = [jax.ShapeDtypeStruct(shape, float) for shape in ((n,), (n,), (2 * n, m), (2 * n, n))]
    lower, upper, Y, points = _on_host(_box, tuple(shapes), (A, b))
    return (lower, upper), (Y, points)


def _polytope_box_backward(residual, cotangents):
    """`max d . x` over `A x <= b` has derivative `y . (db - dA x)`."""
    Y, points = residual
    pull = jnp.concatenate([-cotangents[0], cotangents[1]])[:, None] * Y
    return -pull.T @ points, pull.sum(axis=0)


_polytope_box.defvjp(_polytope_box_forward, _polytope_box_backward)


def _box(facets: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
    return polyhedra.bounding_box_and_multipliers(*facets)


def polytope_volume(X: Polytope) -> Float[Array, ""]:
    """The volume; differentiable: moving facet `i` by `db_i` sweeps `area_i db_i / |a_i|`."""
    return _volume(X.A, X.b)


@jax.custom_vjp
def _volume(A, b):
    return _volume_forward(A, b)[0]


def _volume_forward(A, b):
    shapes = [jax.ShapeDtypeStruct(shape, float) for shape in ((), b.shape, A.shape)]
    volume, areas, centroids = _on_host(lambda facets: _areas(*facets), tuple(shapes), (A, b))
    return volume, (A, areas, centroids)


def _volume_backward(residual, cotangent):
    A, areas, centroids = residual
    pull = cotangent * areas / jnp.linalg.norm(A, axis=1)
    return -pull[:, None] * centroids, pull


_volume.defvjp(_volume_forward, _volume_backward)


def _areas(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    volume, areas, centroids = polyhedra.facet_areas(A, b)
    return np.asarray(volume), areas, centroids


def _on_host(function: Any, shapes: Any, argument: Any) -> Any:
    """`function(argument)` in numpy, for concrete arrays, tracers and batches of either."""
    if is_concrete(argument):
        return jax.tree.map(jnp.asarray, function(jax.device_get(argument)))
    core = [leaf.ndim for leaf in jax.tree.leaves(argument)]
    structure = jax.tree.structure(argument)

    def batched(*leaves):
        leaves = [np.asarray(leaf) for leaf in leaves]
        leads = [leaf.shape[: leaf.ndim - k] for leaf, k in zip(leaves, core, strict=True)]
        batch = np.broadcast_shapes(*leads)
        whole = [
            np.broadcast_to(leaf, batch + leaf.shape[len(lead) :])
            for leaf, lead in zip(leaves, leads, strict=True)
        ]
        results = [
            jax.tree.leaves(function(jax.tree.unflatten(structure, [leaf[i] for leaf in whole])))
            for i in np.ndindex(batch)
        ]
        return [
            np.stack(parts).reshape(batch + np.shape(parts[0]))
            for parts in zip(*results, strict=True)
        ]

    flat = jax.pure_callback(
        batched,
        jax.tree.leaves(shapes),
        *jax.tree.leaves(argument),
        vmap_method="expand_dims",
    )
    return jax.tree.unflatten(jax.tree.structure(shapes), flat)
