"""Offsets on the central path: looser than optimal ones, and without their kinks.

An optimal offset has kinks where a facet only touches, or an optimal point is not unique. That of
the minimiser `y` of a barrier function `f` (`facet_barrier`) has none. With `Z` and its generators
as there, `H` the Hessian of `f` and `e_b` the unit vector of the offset, it moves by

    y' = H^-1 e_b,    Z' = sum_k y'_k dZ / dy_k,    A = Z^-1 Z' Z^-1,
    d b = mu <A, d(F' Gamma F + p e' + e p')> - mu <Z^-1, d(F' Gamma' F)>
          - kappa mu sum_k y_k y'_k d|G_k|^2,

the multipliers in `Gamma` and `Gamma'` being those of `y` and `y'`.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.numerics.host import on_host, shapes_of
from reachjax.programs.lmi import Program, lagrangian
from reachjax.programs.trimming import squared_sizes
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver, require_positive
from reachjax.solvers.centring import enclosed
from reachjax.solvers.cotangents import asked_for
from reachjax.solvers.facet_centres import Centres, facet_centres
from reachjax.solvers.interior_point import InteriorPoint
from reachjax.solvers.primal_dual import DAMPING
from reachjax.solvers.proposals import Enclosure, Solution


@dataclasses.dataclass(frozen=True)
class CentralPath(AbstractSolver):
    """Offsets that are looser by about `weight` and smooth, for training.

    Optimal offsets have kinks, at which a gradient step may be of little use. The offsets of the
    central path are smooth as long as the same neurons are stable: where one joins or leaves the
    basis they jump, by less than `weight` in the same units. They are proved as all others are.
    Ellipsoids are on their own path in any case, as those of `InteriorPoint`.

    Args:
        weight: how much looser, about, in units of the 2-norm of each facet's row over the scaled
            basis: a number that does not change inside `jax.jit`. The barrier weight is this over
            the number of basis entries and multipliers. From 1e-4 to 1 is sensible: at larger ones
            offsets are looser than interval bounds, at smaller ones some paths are lost (status
            `INACCURATE`, and what is proved with its own derivative).

    Programs of more than 1500 multipliers are refused (status `FAILED`, interval bounds).

    Raises:
        TypeError: the weight is no number.
        ValueError: it is not positive, or not finite.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach_step
        >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
        >>> box, facets = Box([1.0], [2.0]), Template.box(1)
        >>> following, _ = reach_step(loop, box, facets, solver=CentralPath(weight=1e-2))
        >>> [round(float(offset), 1) for offset in following.b]
        [1.0, -0.5]
    """

    weight: float = 1e-3

    def __post_init__(self):
        require_positive(self)
        if not math.isfinite(self.weight):
            raise ValueError(f"CentralPath.weight must be finite, but {self.weight!r} arrived")

    @property
    def for_rounds(self) -> AbstractSolver:
        """One that goes to the end of the path, where products that are missing show."""
        return InteriorPoint()

    def solve(self, program: Program) -> Solution:
        """Propose the multipliers of the centres."""
        return facet_centres(program, self.weight).solution

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers."""
        return enclosed(program, form)


def smoothed_offsets(program: Program, weight: float) -> tuple[Float[Array, " f"], Solution]:
    """The offsets of the centres, proved; differentiable in the program's rows.

    Args:
        program: the facets of one step.
        weight: as `CentralPath` has it.

    Returns:
        The offsets `(f,)`, and what is proposed (which has no derivative). Where a centre is not
        found the derivative is that of what is proved instead.
    """
    found: Any = _smoothed(weight, program.facts.mid, program.objective.mid, program)
    return found.offsets, found.solution


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _smoothed(weight, facts, objective, program) -> Any:
    return on_host(
        partial(facet_centres, weight=weight), shapes_of(Centres.unknown(program)), program
    )


def _forward(weight, facts, objective, program):
    found = _smoothed(weight, facts, objective, program)
    return found, (program, found)


def _backward(weight, residual, cotangents):
    program, found = residual
    known = jnp.isfinite(found.centres)
    slopes = jax.tree.map(
        lambda part: jnp.where(known.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0),
        found.slopes,
    )
    centres = jnp.where(known, found.centres, 0.0)

    def value(facts, objective):
        center, linear = objective[:, -1], objective.at[:, -1].set(0.0)
        squares = jnp.sum(linear**2, axis=1)
        varies = squares > 0
        size = jnp.where(varies, squares, 1.0) ** 0.5
        rows = program.with_midpoints(facts, linear / size[:, None])
        flat = program.with_midpoints(facts, 0 * linear)
        # of the slope only the derivative counts
        slope = lagrangian(rows, slopes.multipliers, slopes.moments) - lagrangian(
            flat, slopes.multipliers_slope, slopes.moments_slope
        )
        # damping is of multipliers of generators of unit size
        together = slopes.multipliers * slopes.multipliers_slope
        slope -= DAMPING * found.weights * (together @ squared_sizes(program.products, facts))
        held = jax.lax.stop_gradient(size)
        centre = (
            center
            + jnp.where(varies, size * centres, 0.0)
            + held * (slope - jax.lax.stop_gradient(slope))
        )
        proved = lagrangian(program.with_midpoints(facts, objective), *found.held)
        return jnp.where(known, centre, proved)

    pull: Any = jax.vjp(value, program.facts.mid, program.objective.mid)[1]
    asked = asked_for((cotangents.slopes, cotangents.solution))
    return *pull(jnp.where(asked, jnp.nan, cotangents.offsets)), None


_smoothed.defvjp(_forward, _backward)
