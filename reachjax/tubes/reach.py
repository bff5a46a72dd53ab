"""Reachable sets, step by step (the paper's section IV).

One step: facts of the set, facts of the units, rows of the successor, the program, a solver, the
recheck. A tube repeats it, each set being the next one's set of states (equation (seq_SDP)).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.methods.affine_forms import spans_by_forms
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.propagation import (
    GAP,
    SAMPLES,
    Options,
    Progress,
    check_problem,
    propagated,
    template_of,
)
from reachjax.methods.witnesses import initial_states
from reachjax.numerics.archives import writable
from reachjax.numerics.budget import Interrupted
from reachjax.numerics.checks import (
    floats_of,
    is_concrete,
    owned,
    require_double_precision,
    whole_number,
)
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.pytrees import Replaceable, pytree, static, unchecked
from reachjax.numerics.seals import Seal, require_sealed, seal_of
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut
from reachjax.proofs.certificates import AbstractProof, told
from reachjax.sets import AbstractSet, AbstractTemplate, Polytope
from reachjax.sets.pictures import Flowpipe, draw_flowpipes
from reachjax.sets.unusable import ThinSetError
from reachjax.solvers import AbstractSolver, Auto
from reachjax.tubes.displays import DRAWN, SHOWN, display, frame, picture, rows, table
from reachjax.tubes.saving import keep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

LINES, LINE_PARTS = 40, 4
"""So many trajectories are drawn as lines, with so many points a period."""


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
    def of(cls, problem: Problem, reached: Sequence[ReachSet]) -> ReachTube:
        """The tube of the sets of a problem."""
        sets = problem.X0, *(each.region for each in reached)
        proofs = None, *(each.proof for each in reached)
        return cls.sealed(problem.loop, problem.template, sets, proofs, problem.start)

    @property
    def reached(self) -> tuple[ReachSet, ...]:
        """What is proved of each sample after the first: a set, its span of time, its proof."""
        pairs = zip(self.sets[1:], self.certificates[1:], strict=True)
        return tuple(
            ReachSet(region, proof, at(k))
            for k, (region, proof) in enumerate(pairs, start=1)
            if proof is not None
        )

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
    def spans(self) -> tuple[Polytope, ...]:
        """Sets that hold all states from each sample to the next one, of a differential equation.

        They have the directions of the tube's own sets, of ellipsoids the axes, and are bounded by
        affine forms of the initial set; of known numbers also by those of the box around the set at
        the sample before, where that is smaller, and they are kept.

        Raises:
            UnboundedError: forms of a period have no bounds.
            RuntimeError: JAX's 64-bit floats are off, or the tube was made while they were.
            TypeError: the plant is one in discrete time, which has no states in between.
        """
        if not self.loop.plant.continuous:
            raise TypeError(
                "a plant in discrete time has no states in between samples: spans are of a "
                "SampledPlant"
            )
        require_double_precision()
        kept = self.__dict__.get("_spans")
        if kept is None:
            require_double_precision(tube=floats_of((self.loop, self.sets, self.template)))
            kept = spans_by_forms(self.loop, self.sets, self.template, self.start)
            if is_concrete(kept):
                object.__setattr__(self, "_spans", kept)
        return kept

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.sets) - 1

    def __len__(self) -> int:
        """The number of sets, that of the initial time included."""
        return len(self.sets)

    def __getitem__(self, t: int | slice) -> Any:
        """The set at a time, or a tuple of them; negative times count from the end."""
        return self.sets[t]

    def __iter__(self) -> Iterator[AbstractSet]:
        return iter(self.sets)

    def to_dataframe(self) -> DataFrame:
        """A row for each step and facet: bound, witness, gap, status, seconds, kind of proof.

        Of an ellipsoid, `facet` and `direction` are missing, and the bound is what its certificate
        says.

        Raises:
            ImportError: pandas is missing; it comes with `pip install 'reachjax[tables]'`.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, Template, reach
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> table = reach(loop, Box([1.0], [2.0]), 2, Template.box(1)).to_dataframe()
            >>> table.groupby("t").bound.max().round(6).to_dict()
            {1: 1.0, 2: 0.5}
        """
        return frame(rows(self.template, self.certificates))

    def plot(
        self, ax: Axes | None = None, samples: int = DRAWN, coordinates: tuple[int, int] = (0, 1)
    ) -> Axes:
        """Draw the sets over simulated states, see `reachjax.plot_tube`."""
        return draw_flowpipes([self.flowpipe(samples)], ax, coordinates)

    def flowpipe(self, samples: int) -> Flowpipe:
        """The sets, with the states of simulated trajectories; none of a set too thin to sample."""
        try:
            states = np.asarray(self.simulate(samples))
        except ThinSetError:
            states = np.zeros((0, self.horizon + 1, self.loop.states))
        if not self.loop.plant.continuous:
            return Flowpipe(self.sets, states)
        lines = None
        if len(states) and not self.loop.is_disturbed:
            given = states[:LINES, 0], self.horizon, self.start
            lines = np.asarray(self.loop.simulate(*given, parts=LINE_PARTS))
        return Flowpipe(self.sets, states, self.spans, lines)

    def _repr_html_(self) -> str:
        steps = [_shown(self, t) for t in range(1, self.horizon + 1)]
        drawn = picture(lambda ax: self.plot(ax, samples=SHOWN)) if self.loop.states > 1 else ""
        head = ["t", "largest gap", "statuses", "seconds", "proof"]
        return display(repr(self), table(head, steps), drawn)

    def proof(self, t: int) -> AbstractProof:
        """The certificate of `sets[t]`.

        Raises:
            ValueError: there is none for this time (the initial set needs none).
        """
        certificate = self.certificates[t] if 0 < t <= self.horizon else None
        if certificate is None:
            raise ValueError(f"certificates are for t = 1 .. {self.horizon}, but {t} was asked for")
        return certificate

    def save(self, path: str | os.PathLike[str]) -> None:
        """Keep the tube in a file, certificates included, from which `reachjax.load` reads it.

        The file is a zip of numpy's arrays with a description in JSON; nothing in it is executed.
        A loop with a function that a user wrote cannot be kept: it is left out, and has to be given
        again to `load`.

        Args:
            path: of the file; one that is there is replaced.

        Raises:
            OSError: it cannot be written.
            ValueError: a part of the tube was changed.
        """
        self.require_sealed()
        keep(writable("path", path), self, self.loop)

    def simulate(self, samples: int = SAMPLES, seed: int = 0) -> Float[Array, "c h+1 n_x"]:
        """Trajectories from corners of the initial set and `samples` points drawn from it.

        Disturbances and noise are drawn as well: extreme ones, and any.

        Raises:
            TypeError, ValueError: `samples` or `seed` is no whole number, or below 0.
        """
        samples = whole_number("samples", samples, 0)
        seed = whole_number("seed", seed, 0)
        states = initial_states(self.sets[0], samples, seed)
        scenarios = Scenarios.of(self.loop, self.sets[0], self.horizon, self.start)
        states, disturbances, noises = self.loop.split(scenarios.drawn(states, seed))
        drawn = {"disturbances": disturbances, "noises": noises}
        return self.loop.simulate(states, self.horizon, self.start, **drawn)

    def extended(self, steps: int, **options: Any) -> ReachTube:
        """The same tube and some steps more.

        With the options that it was computed with, the sets are those of one call for all steps,
        bit for bit but where a time limit, or a trajectory that came with products, had a say.

        Args:
            steps: how many more.
            options: keyword arguments of `reach`, `relaxation` to `time_limit`; those that are not
                given are as `reach` has them, whatever this tube was computed with.

        Raises:
            Interrupted: Ctrl-C; it has the tube of what was proved.
            RuntimeError, TypeError, ValueError: as `reach` does; there is no such option, or
                `steps` is no positive number.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, Template, reach
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> tube = reach(loop, Box([1.0], [2.0]), 1, Template.box(1)).extended(2)
            >>> tube.sets[3].b.round(9).tolist()  # x <= 2 / 8 and -x <= -1 / 8
            [0.25, -0.125]
        """
        self.require_sealed()
        horizon = self.horizon + whole_number("steps", steps, 1)
        problem = Problem(self.loop, self.sets[0], self.template, horizon, self.start)
        proofs = [self.proof(t) for t in range(1, self.horizon + 1)]
        return tube_of(
            problem, Options.named(options), list(zip(self.sets[1:], proofs, strict=True))
        )


def _shown(tube: ReachTube, t: int) -> list[Any]:
    """A step in a notebook's table."""
    proof = tube.proof(t)
    gaps = np.asarray(proof.gaps, float)
    known = gaps[~np.isnan(gaps)]
    widest = float(known.max()) if len(known) else np.nan
    return [
        t,
        widest,
        told(proof.ends),
        float(np.sum(np.asarray(proof.seconds))),
        type(proof).__name__,
    ]


def tube_of(
    problem: Problem, options: Options, known: Sequence[tuple[AbstractSet, AbstractProof]] = ()
) -> ReachTube:
    """The tube of a problem, some of whose first sets may be known."""
    check_problem(problem, options)
    loop, X0, template = owned(problem.parts)
    own = dataclasses.replace(problem, loop=loop, X0=X0, template=template)
    found = propagated(own, options, known)
    tube = ReachTube.of(own, found.sets)
    if found.interrupted:
        done, left = tube.horizon, problem.horizon - tube.horizon
        message = (
            f"interrupted after {done} of {problem.horizon} steps. They are proved: this "
            f"exception's `tube` has them, and tube.extended({left}) goes on"
        )
        raise Interrupted(message, tube)
    return tube


@lenient
def reach_step(
    loop: ClosedLoop,
    X: AbstractSet,
    template: AbstractTemplate | None = None,
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
        template: what the sets look like: facet directions, ellipsoids, or both. None: octagons in
            two dimensions, boxes in others (`Template.default`).
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


@logged
@lenient
def reach(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate | None = None,
    relaxation: AbstractRelaxation | AbstractMethod = BranchAndCut(),  # noqa: B008  (immutable)
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
        template: what every set looks like: facet directions, ellipsoids, or both. None: octagons
            in two dimensions, boxes in others (`Template.default`).
        relaxation: which products of facts are used; or a method of its own (`AbstractMethod`).
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
            `jax.jit` it sees them once, while the loop is traced. A bar that shows notes, as tqdm's
            do (`set_postfix_str`), is told what happens within a step.
        gap: a facet is proved well enough if a trajectory attains its bound but for this part of
            half the facet's simulated range. `LinearBounds` knows neither gaps nor limits.
        time_limit: seconds for the whole call, after which nothing is solved any more: what is
            proved by then is returned. It is shared out among the steps, and takes the place of the
            budgets that end the call without it. Steps that have no time left for programs are
            bounded by affine forms, and say so: their status is `TIME`. None: until gaps are closed
            or these budgets are used up.

    Raises:
        Interrupted: Ctrl-C, a `KeyboardInterrupt` whose `tube` has the steps that were done.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind, or `progress` returns no iterable.
        ValueError: dimensions disagree, `X0` is empty or unbounded, the window is no positive
            number, or None inside `jax.jit`, a time-varying loop ends before the horizon, states
            overflow, or `progress` leaves out steps. What depends on traced values is NaN instead,
            inside `jax.jit`.

    The offsets of the sets have first derivatives (reverse mode) in the loop's weights, plant and
    input box, in a box's ends and in a polytope's normals and offsets; so have centre and shape of
    ellipsoids, also in centre and shape of an ellipsoid `X0`. A derivative is that of the bound
    that is reported, which the same `gap` ends with and without derivatives: where a program was
    not solved, of what is proved without its optimum; where no trajectory attains a bound of
    `BranchAndCut`, of what its multipliers prove. It is NaN where there is no bound. Sets in
    between samples (`ReachTube.spans`) are wider where derivatives are taken.

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
    options = Options(relaxation, window, solver, samples, seed, progress, gap, time_limit)
    problem = Problem(loop, X0, template_of(loop, template), horizon, start)
    return tube_of(problem, options)
