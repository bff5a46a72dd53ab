"""Reachable sets, step by step (the paper's section IV).

One step: facts of the set, facts of the units, rows of the successor, the program, a solver, the
recheck. A tube repeats it, each set being the next one's set of states (equation (seq_SDP)).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.numerics.checks import (
    floats_of,
    is_concrete,
    owned,
    real_number,
    require_bar,
    require_double_precision,
    require_kind,
    same_size,
    whole_number,
    wrapped,
)
from reachjax.numerics.pytrees import Replaceable, pytree, static, unchecked
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut
from reachjax.proofs.certificates import AbstractProof
from reachjax.proofs.witnesses import Simulations, initial_states
from reachjax.sets import AbstractSet, AbstractTemplate, Template
from reachjax.solvers import AbstractSolver, Auto
from reachjax.tubes.by_branching import sets_by_branching
from reachjax.tubes.by_forms import sets_by_forms
from reachjax.tubes.by_programs import sets_by_programs
from reachjax.tubes.seals import Seal, require_sealed, seal_of
from reachjax.tubes.steps import Reached, Setting, boxed

Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps the iteration over time steps, such as `tqdm.tqdm` or `rich.progress.track`."""

SAMPLES = 1000

GAP = 1e-4
"""What may stay open of a facet, as a part of its range."""

LARGEST_WINDOW = 64
"""The most columns of a window whose length is chosen."""

EXAMPLES = {
    ClosedLoop: "a ClosedLoop",
    AbstractSet: "a set such as Box(lower, upper) or Polytope(A, b)",
    AbstractTemplate: "a template, such as Template.box(n) or EllipsoidTemplate()",
    AbstractRelaxation: "a relaxation object, such as BranchAndCut()",
    AbstractSolver: "a solver object, such as Auto()",
}


@pytree
class ReachTube(Replaceable):
    """Sets that surely contain every state of the loop, one for each time.

    Attributes:
        loop: the loop they were computed for.
        template: what the sets look like: facet directions, ellipsoids, or both.
        sets: `sets[t]` for `t = 0 .. horizon`; `sets[0]` is the initial set.
        certificates: `certificates[t]` for `t = 1 .. horizon`; the first entry is `None`.
        start: the time of the initial set, for time-varying loops.
        seal: a hash of all of these, as `reach` returned them: it is what makes the tube a proof.

    Raises:
        ValueError: a part was exchanged for another one. Tubes come from `reach`.
    """

    loop: ClosedLoop
    template: AbstractTemplate
    sets: tuple[AbstractSet, ...]
    certificates: tuple[AbstractProof | None, ...]
    start: int = static(default=0)
    seal: Seal | None = None

    def __post_init__(self):
        self.require_sealed()

    @classmethod
    def sealed(
        cls,
        loop: ClosedLoop,
        template: AbstractTemplate,
        sets: tuple[AbstractSet, ...],
        certificates: tuple[AbstractProof | None, ...],
        start: int,
    ) -> ReachTube:
        """The tube of what was proved together."""
        parts = {"loop": loop, "template": template, "sets": sets, "certificates": certificates}
        require_double_precision(tube=floats_of(tuple(parts.values())))
        return unchecked(cls, **parts, start=start, seal=seal_of(*parts.values(), start=start))

    def require_sealed(self) -> None:
        """Raise an error unless all parts are those that `reach` computed together.

        Raises:
            RuntimeError: numbers were cast to lower precision, or JAX's 64-bit floats are off.
            ValueError: a part was changed, or exchanged for another one.
        """
        parts = self.loop, self.template, self.sets, self.certificates
        require_double_precision(tube=floats_of(parts))
        require_sealed("the tube", self.seal, *parts, start=self.start)

    def __repr__(self) -> str:
        sets = self.template.summary
        return f"ReachTube(horizon={self.horizon}, {sets}, states={self.loop.states})"

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.sets) - 1

    def proof(self, t: int) -> AbstractProof:
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
    template: AbstractTemplate,
    *,
    t: int = 0,
    relaxation: AbstractRelaxation = BranchAndCut(),  # noqa: B008  (immutable)
    solver: AbstractSolver = Auto(),  # noqa: B008
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[AbstractSet, AbstractProof]:
    """A set that surely contains every successor of a set, and its certificate.

    Args:
        loop: the closed loop.
        X: the set of states at time `t`.
        template: what the sets look like: facet directions, ellipsoids, or both.
        t: the time, for time-varying loops.
        relaxation: which products of facts are used.
        solver: what solves the semidefinite programs.
        samples: how many states are simulated for witnesses, besides the corners.
        seed: of the samples.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: dimensions disagree, the set is empty or unbounded, or `t` is beyond the loop.

    Source: theorem 1 and problems (sdp::poly), (sdp::ellips) of Hu, Fazlyab, Morari, Pappas
    (CDC 2020).

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, Template
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> following, certificate = reach_step(loop, Box([1.0], [2.0]), Template.box(1))
        >>> following.b.round(6).tolist()  # x+ = 0.6 x, written as x <= 1.2 and -x <= -0.6
        [1.2, -0.6]
    """
    tube = reach(loop, X, 1, template, relaxation, 1, solver, start=t, samples=samples, seed=seed)
    return tube.sets[1], tube.proof(1)


def reach(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate,
    relaxation: AbstractRelaxation = BranchAndCut(),  # noqa: B008  (immutable)
    window: int | None = None,
    solver: AbstractSolver = Auto(),  # noqa: B008
    *,
    start: int = 0,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Progress | None = None,
    gap: float = GAP,
    time_limit: float | None = None,
) -> ReachTube:
    """Sets that surely contain every state of the loop at times `1 .. horizon`.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number `N` of steps.
        template: what every set looks like: facet directions, ellipsoids, or both.
        relaxation: which products of facts are used.
        window: over how many steps each program reaches back, as far as there are steps: 1 is the
            paper's recursion, the horizon goes back to `X0` in one shot. Longer ones are tighter,
            and their programs larger. None: the longest that the solver bears, chosen from numbers,
            so inside `jax.jit` give one.
        solver: what solves the semidefinite programs.
        start: the time of `X0`, for time-varying loops.
        samples: how many trajectories are simulated for witnesses, besides those from corners. None
            are inside `jax.jit`, or from an `X0` too thin to be sampled: witnesses and gaps are NaN
            there.
        seed: of the samples.
        progress: wraps the iteration over steps to show a progress bar, such as `tqdm.tqdm`; inside
            `jax.jit` it sees them once, while the loop is traced.
        gap: a facet is proved well enough if a trajectory attains its bound but for this part of
            half the facet's simulated range. `LinearBounds` knows neither gaps nor limits.
        time_limit: seconds for the whole call, after which nothing is solved any more: what is
            proved by then is returned. It is shared out among the steps, and takes the place of the
            budgets that end the call without it. None: until gaps are closed or these are used up.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind, or `progress` returns no iterable.
        ValueError: dimensions disagree, `X0` is empty or unbounded, the window is no positive
            number, or None inside `jax.jit`, a time-varying loop ends before the horizon, states
            overflow, or `progress` leaves out steps. What depends on traced values is NaN instead,
            inside `jax.jit`.

    The offsets of the sets have first derivatives (reverse mode) in the loop's weights, plant and
    input box, in a box's ends and in a polytope's normals and offsets; so have centre and shape of
    ellipsoids, also in centre and shape of an ellipsoid `X0`. A derivative is that of the bound
    that is reported: where a program was not solved, of what is proved without its optimum; where
    no trajectory attains a bound of `BranchAndCut`, of its multipliers with the ranges of units
    held. It is NaN where there is no bound. So that bounds are attained, facets climb to a `gap` of
    1e-7 where a derivative is asked for, if theirs is larger.

    Source: equation (seq_SDP) of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, Template
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> tube = reach(loop, Box([1.0], [2.0]), 3, Template.box(1))
        >>> [round(region.volume(), 6) for region in tube.sets[1:]]
        [0.6, 0.36, 0.216]
        >>> bool((tube.proof(3).gaps >= 0).all())
        True
    """
    _check(loop, X0, horizon, template, relaxation, window, solver, start, samples, seed, progress)
    real_number("gap", gap, 0.0)
    deadline = deadline_of(time_limit)
    loop, X0, template = owned((loop, X0, template))
    box = boxed(X0, "X0")
    fixed = jax.lax.stop_gradient((loop, X0))
    simulations = None
    if is_concrete(fixed):
        simulations = simulations_from(*fixed, horizon, start, samples, seed)
    setting = Setting(
        loop=loop,
        start=start,
        relaxation=relaxation,
        solver=solver,
        limit=LARGEST_WINDOW if window is None else None,
        drop_columns=window != 1 and is_concrete(fixed, jax.lax.stop_gradient(template)),
        simulations=simulations,
        gap=gap,
        deadline=deadline,
    )
    if relaxation.by_forms:
        following = sets_by_forms(loop, X0, box, template, horizon, start)
    elif window is None and isinstance(relaxation, BranchAndCut) and isinstance(template, Template):
        following = sets_by_branching(setting, relaxation.nodes, X0, box, template, horizon)
    else:
        following = sets_by_programs(setting, X0, template, horizon, window)
    steps = [step for _, step in zip(wrapped(progress, range(horizon)), following, strict=False)]
    if len(steps) < horizon:
        raise ValueError(
            f"progress must pass on each of the {horizon} steps, but {len(steps)} arrived"
        )
    certificates = [step.proof for step in steps]
    if simulations is not None and is_concrete(certificates):
        certificates = _with_witnesses(steps, simulations)
    sets = X0, *(step.region for step in steps)
    proved = loop, template, sets, (None, *owned(certificates))
    return ReachTube.sealed(*proved, start=start)


def simulations_from(
    loop: ClosedLoop, X0: AbstractSet, horizon: int, start: int, samples: int, seed: int
) -> Simulations | None:
    """Trajectories from the initial set; None if it is too thin for states to be drawn from it.

    Raises:
        ValueError: it surely is empty.
    """
    try:
        return Simulations(loop, X0, horizon, start, samples, seed)
    except ValueError as error:
        raise ValueError(f"X0 cannot be used: {error}") from None
    except RuntimeError:
        if X0.surely_empty():
            raise ValueError(
                "X0 is empty: its polytope and its ellipsoid have no point in common"
            ) from None
    return None


def _with_witnesses(steps: list[Reached], simulations: Simulations) -> list[AbstractProof]:
    """Simulate what the certificates bound, from the initial set."""
    simulated = [step.states for step in steps if not step.climb]
    if simulated:
        simulations.include(np.concatenate(simulated))
    for k, step in enumerate(steps, start=1):
        if step.climb and len(step.states):
            simulations.climb(k, step.region, np.arange(len(step.states)), step.states)
    found = [simulations.attained(k, step.region) for k, step in enumerate(steps, start=1)]
    return [
        step.proof.replace(witnesses=values, witness_states=states)
        for step, (values, states) in zip(steps, found, strict=True)
    ]


def deadline_of(time_limit: float | None) -> float:
    """When to stop, as `time.monotonic` says it.

    Raises:
        TypeError: the limit is no number.
        ValueError: it is negative.
    """
    if time_limit is None:
        return np.inf
    return time.monotonic() + real_number("time_limit", time_limit, 0.0)


def _check(
    loop, X0, horizon, template, relaxation, window, solver, start, samples, seed, progress
) -> None:
    for name, value, kind in (
        ("loop", loop, ClosedLoop),
        ("X0", X0, AbstractSet),
        ("template", template, AbstractTemplate),
        ("relaxation", relaxation, AbstractRelaxation),
        ("solver", solver, AbstractSolver),
    ):
        require_kind(name, value, kind, EXAMPLES[kind])
    require_double_precision(loop=loop, X0=X0, template=template)
    same_size(
        "the loop's number of states is", "the dimension of X0 is", (loop.states, X0.dimension)
    )
    same_size(
        "the loop's number of states is",
        "the dimension of template is",
        (loop.states, template.dimension or loop.states),
    )
    loop.check_horizon(horizon, start)
    if template.steps is not None and template.steps < horizon:
        raise ValueError(f"template is given for {template.steps} steps, but horizon is {horizon}")
    require_bar(progress)
    whole_number("samples", samples, 1)
    whole_number("seed", seed, 0)
    if window is not None:
        whole_number("window", window, 1)
    elif not (relaxation.by_forms or is_concrete(jax.lax.stop_gradient((loop, X0, template)))):
        raise ValueError(
            "window=None is chosen from numbers: inside jax.jit, vmap or scan give a number, such "
            "as window=1"
        )
