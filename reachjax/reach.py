"""Reachable sets, step by step (the paper's section IV).

One step: facts of the set, facts of the units, rows of the successor, the program, a solver, the
recheck. A tube repeats it, each set being the next one's set of states (equation (seq_SDP)).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.certificates import Certificate
from reachjax.checks import (
    described,
    is_concrete,
    require_double_precision,
    same_size,
    whole_number,
)
from reachjax.lmi import step_program
from reachjax.pytrees import Replaceable, pytree, static
from reachjax.relaxation import AbstractRelaxation, LocalBounds
from reachjax.sets import AbstractSet, Box, Polytope, Template
from reachjax.solvers import AbstractSolver, Clarabel, bounding_box, proved_offsets
from reachjax.systems import ClosedLoop
from reachjax.witnesses import initial_states, proposed_states, witnesses

Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps the iteration over time steps, such as `tqdm.tqdm` or `rich.progress.track`."""

SAMPLES = 1000

EXAMPLES = {
    ClosedLoop: "a ClosedLoop",
    AbstractSet: "a set such as Box(lower, upper) or Polytope(A, b)",
    Template: "a Template, such as Template.box(n)",
    AbstractRelaxation: "a relaxation object, such as LocalBounds()",
    AbstractSolver: "a solver object, such as Clarabel()",
}


@pytree
class ReachTube(Replaceable):
    """Sets that surely contain every state of the loop, one for each time.

    Attributes:
        loop: the loop they were computed for.
        template: the facet directions.
        sets: `sets[t]` for `t = 0 .. horizon`; `sets[0]` is the initial set.
        certificates: `certificates[t]` for `t = 1 .. horizon`; the first entry is `None`.
        start: the time of the initial set, for time-varying loops.
    """

    loop: ClosedLoop
    template: Template
    sets: tuple[AbstractSet, ...]
    certificates: tuple[Certificate | None, ...]
    start: int = static(default=0)

    def __repr__(self) -> str:
        size = f"horizon={self.horizon}, facets={len(self.template)}, states={self.loop.states}"
        return f"ReachTube({size})"

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.sets) - 1

    def proof(self, t: int) -> Certificate:
        """The certificate of `sets[t]`.

        Raises:
            ValueError: there is none for this time (the initial set needs none).
        """
        certificate = self.certificates[t] if 0 < t <= self.horizon else None
        if certificate is None:
            raise ValueError(f"certificates are for t = 1 .. {self.horizon}, but {t} was asked for")
        return certificate

    def simulate(self, samples: int = SAMPLES, seed: int = 0) -> Float[Array, "c h+1 n_x"]:
        """Trajectories from corners of the initial set and `samples` points drawn from it."""
        states = initial_states(self.sets[0], samples, seed)
        return self.loop.simulate(states, self.horizon, self.start)


def reach_step(
    loop: ClosedLoop,
    X: AbstractSet,
    template: Template,
    *,
    t: int = 0,
    relaxation: AbstractRelaxation = LocalBounds(),  # noqa: B008  (immutable)
    solver: AbstractSolver = Clarabel(),  # noqa: B008
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[Polytope, Certificate]:
    """The polytope that contains every successor of a set, and its certificate.

    Args:
        loop: the closed loop.
        X: the set of states at time `t`.
        template: the facet directions.
        t: the time, for time-varying loops.
        relaxation: which products of facts are used.
        solver: what solves the semidefinite programs.
        samples: how many states are simulated for witnesses, besides the corners.
        seed: of the samples.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: dimensions disagree, the set is empty or unbounded, or `t` is beyond the loop.

    Source: theorem 1 and problem (sdp::poly) of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> following, certificate = reach_step(loop, Box([1.0], [2.0]), Template.box(1))
        >>> following.b.round(6).tolist()  # x+ = 0.6 x, written as x <= 1.2 and -x <= -0.6
        [1.2, -0.6]
    """
    tube = reach(loop, X, 1, template, relaxation, 1, solver, start=t, samples=samples, seed=seed)
    following = tube.sets[1]
    assert isinstance(following, Polytope)
    return following, tube.proof(1)


def reach(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: Template,
    relaxation: AbstractRelaxation = LocalBounds(),  # noqa: B008  (immutable)
    window: int = 1,
    solver: AbstractSolver = Clarabel(),  # noqa: B008
    *,
    start: int = 0,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Progress | None = None,
) -> ReachTube:
    """Sets that surely contain every state of the loop at times `1 .. horizon`.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number `N` of steps.
        template: the facet directions of every set.
        relaxation: which products of facts are used.
        window: over how many steps each program reaches back; 1 is the paper's recursion.
        solver: what solves the semidefinite programs.
        start: the time of `X0`, for time-varying loops.
        samples: how many trajectories are simulated for witnesses, besides those from corners.
        seed: of the samples.
        progress: wraps the iteration over steps to show a progress bar, such as `tqdm.tqdm`; inside
            `jax.jit` it sees them once, while the loop is traced.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: dimensions disagree, `X0` is empty or unbounded, the window is not supported,
            a time-varying loop ends before the horizon, or states overflow. What depends on traced
            values is NaN instead, inside `jax.jit`.

    The offsets of the sets have first derivatives in everything but facet normals (reverse mode):
    in the loop's weights, plant and input box, and in a box's ends or a polytope's offsets. In the
    normals of `X0` and of the template the derivative is NaN where a bound of a coordinate is
    attained on a whole face.

    Source: equation (seq_SDP) of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> tube = reach(loop, Box([1.0], [2.0]), 3, Template.box(1))
        >>> [round(region.volume(), 6) for region in tube.sets[1:]]
        [0.6, 0.36, 0.216]
        >>> bool((tube.proof(3).gaps >= 0).all())
        True
    """
    _check(loop, X0, horizon, template, relaxation, window, solver, start, samples, seed, progress)
    sets: list[AbstractSet] = [X0]
    certificates: list[Certificate] = []
    steps = range(horizon)
    for k in steps if progress is None else progress(steps):
        box = _bounded(sets[-1], "X0" if k == 0 else f"the certified set at t = {start + k}")
        program = step_program(loop, sets[-1], box, template, start + k, relaxation)
        bounds, solution = proved_offsets(program, solver)
        if is_concrete(bounds) and not np.isfinite(bounds).all():
            raise ValueError(
                f"the loop's states at t = {start + k + 1} overflow or are not numbers: check the "
                "weights of loop.controller and the entries of loop.plant"
            )
        certificates.append(Certificate.from_solution(program, bounds, solution))
        sets.append(template.polytope(bounds))
    if is_concrete(loop, X0, certificates):
        certificates = _with_witnesses(certificates, loop, X0, template, start, samples, seed)
    return ReachTube(loop, template, tuple(sets), (None, *certificates), start)


def _bounded(X: AbstractSet, name: str) -> Box:
    """The box around a set.

    Raises:
        ValueError: the set is empty or unbounded, or seems so because its numbers are so large.
    """
    try:
        return bounding_box(X)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{name} cannot be used: {error}") from None


def _with_witnesses(certificates, loop, X0, template, start, samples, seed) -> list[Certificate]:
    """Simulate what the certificates bound, from the initial set."""
    states = initial_states(X0, samples, seed)
    states = jnp.concatenate([states, proposed_states(X0, certificates[0].moments)])
    values, origins = witnesses(loop, states, template.directions, len(certificates), start)
    return [
        certificate.replace(witnesses=values[k], witness_states=origins[k])
        for k, certificate in enumerate(certificates)
    ]


def _check(
    loop, X0, horizon, template, relaxation, window, solver, start, samples, seed, progress
) -> None:
    for name, value, kind in (
        ("loop", loop, ClosedLoop),
        ("X0", X0, AbstractSet),
        ("template", template, Template),
        ("relaxation", relaxation, AbstractRelaxation),
        ("solver", solver, AbstractSolver),
    ):
        if not isinstance(value, kind):
            raise TypeError(f"{name} must be {EXAMPLES[kind]}, but {described(value)} arrived")
    require_double_precision(loop=loop, X0=X0, template=template)
    same_size(
        "the loop's number of states is", "the dimension of X0 is", (loop.states, X0.dimension)
    )
    same_size(
        "the loop's number of states is",
        "the dimension of template is",
        (loop.states, template.dimension),
    )
    loop.check_horizon(horizon, start)
    if progress is not None and not callable(progress):
        raise TypeError(
            f"progress must wrap an iterable, as tqdm.tqdm does, but {progress!r} arrived"
        )
    whole_number("samples", samples, 1)
    whole_number("seed", seed, 0)
    if whole_number("window", window, 1) != 1:
        raise ValueError(f"window must be 1 (one step at a time), but {window!r} arrived")
