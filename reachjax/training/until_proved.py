"""Training until the controller is proved, and on from there while its loss falls.

An epoch lowers the task's loss plus an objective over the worst cells of the initial set; then
`decide` says what is proved. What it finds is what is trained on next: cells that it could not
prove, and the initial states of counterexamples. Nothing rests on training: the verdict is that of
`decide`, on the controller that is returned.

The first controller that is proved often gave up more of the task than it had to, as the rest was
learned on the way. So the way back is halved, from it to the one that was given, as long as that
lowers the task's loss and `decide` proves it; and training goes on from there, epoch by epoch, each
of which is halved in the same way where it lost the proof: what is kept is proved, and its loss
falls.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import AbstractNetwork, ClosedLoop
from reachjax.loops.units import UnboundedError
from reachjax.methods.propagation import Progress, known_numbers, require_kinds
from reachjax.numerics.archives import writable
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.checks import (
    real_number,
    require_bar,
    require_double_precision,
    require_kind,
    same_size,
    whole_number,
    wrapped,
)
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.seals import Seal
from reachjax.sets import Box
from reachjax.training.failures import failures, optax_or_error, require_optimizer, skip_failures
from reachjax.training.history import Epoch, TrainingHistory
from reachjax.training.kept import (
    Kept,
    numbers_of,
    read_kept,
    state_from,
    training_seal,
    write_kept,
)
from reachjax.training.objectives import Certified, Simulated, Stage
from reachjax.training.steps import (
    Program,
    Specification,
    TaskLoss,
    compiled_loss,
    compiled_step,
    hashable,
    require_loss,
    under,
    weights_of,
)
from reachjax.training.worst_cells import worst_cells
from reachjax.verdicts.decide import decide
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.grounds import Asked
from reachjax.verdicts.sieve import smallest
from reachjax.verdicts.specification import (
    AvoidSets,
    Region,
    Timed,
    period_of,
    requirements,
)
from reachjax.verdicts.verdict import Verdict, VerdictStatus

if TYPE_CHECKING:
    import optax

STAGES = (
    Stage(Simulated(), cells=16, epochs=5),
    Stage(Certified(), cells=16),
    Stage(Certified(), cells=128),
    Stage(Certified(), cells=1024),
)
"""From what costs least to what proves most: forms over smaller and smaller cells."""

REMEMBERED = 16
"""So many counterexamples are trained on, the last ones that were found."""

QUIET = 5
"""The objective is zero if it is in the last one of so many parts of an epoch."""

LEAST, FIRST = 1.0, 30.0
"""Seconds that a decision may take at least, else it may take as long as the epoch did; and those
of the first one, or a quarter of all."""

FOR_STEPS = 0.5
"""The part of the time left that the steps of an epoch may take: the rest is for its decision."""

PATIENCE = 2.0
"""Where the objective is zero it may take so many times as long; and so many times as long as the
last proof, where one is known."""

HALVINGS = 6
"""So often the way between a controller that is proved and one that is not is halved."""


@dataclasses.dataclass(frozen=True)
class Trained:
    """What came of training.

    Attributes:
        loop: the loop under the trained controller.
        verdict: of `decide` on this loop.
        history: what happened in each epoch.
    """

    loop: ClosedLoop
    verdict: Verdict
    history: TrainingHistory

    @property
    def controller(self) -> AbstractNetwork:
        """The trained controller."""
        return self.loop.controller

    @property
    def proved(self) -> bool:
        """Whether the loop surely does what is required."""
        return self.verdict.proved

    def __repr__(self) -> str:
        return f"Trained({self.verdict.status.name}, epochs={len(self.history)})"


@once_positional("goal", "safe", "avoid")
@logged
@lenient
def train(
    loop: ClosedLoop,
    X0: Box,
    horizon: int,
    task_loss: TaskLoss,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    optimizer: optax.GradientTransformation | None = None,
    stages: Sequence[Stage] = STAGES,
    weight: float = 1.0,
    margin: float = 0.0,
    batch: int = 16,
    samples: int = 64,
    steps: int = 100,
    epochs: int = 100,
    cells: int = 1000,
    start: int = 0,
    seed: int = 0,
    gain: float = 0.02,
    time_limit: float | None = None,
    path: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> Trained:
    """Train a loop's controller until a specification is proved.

    Its loss is that of the task plus a weight times an objective, which is zero where nothing is
    missed. Stages make it sharper: simulated trajectories, then affine forms over few cells of the
    initial set, then over many. Between epochs `decide` looks whether all is proved, and says where
    it is not. A controller that is proved after some epochs is led back to the given one as far as
    that lowers the task's loss and it stays proved, and is trained on while that goes on; one that
    is proved as it was given is not trained.

    Args:
        loop: the closed loop, whose controller is where training begins: an `MLP`, or a `Network`
            around any pytree, such as a module of flax or equinox. Its floating-point arrays are
            trained.
        X0: the box of initial states.
        horizon: the number of steps.
        task_loss: of a loop and initial states `(b, n_x)` one number, in functions of JAX.
        goal: as of `decide`, at the horizon or at the times that it names.
        safe: as of `decide`; of a loop in continuous time it is meant at all times.
        avoid: the same.
        optimizer: of optax, for the list of the controller's arrays; None for Adam with a rate of
            1e-3. Steps without a finite gradient are skipped.
        stages: what is lowered beside the task's loss, one after the other.
        weight: of the objective.
        margin: how far requirements should be from failing, in the units of the state: a little
            more than zero helps `decide`.
        batch: how many cells are trained on at a step, at most.
        samples: how many initial states are drawn from these at each step.
        steps: of an epoch.
        epochs: at most.
        cells: into how many cells `decide` may cut the initial set: few make a controller that is
            proved quickly. The first decision takes half a minute at most, or a quarter of
            `time_limit`; one after an epoch about as long as its steps did. Where the objective is
            zero it takes twice as long, or without `time_limit` as long as it needs.
        start: the time of `X0`, for time-varying loops.
        seed: of all that is drawn.
        gain: a part of the task's loss. What is proved is trained on for as many epochs as its
            first proof took, or until one lowers its loss by less than that. 1 ends training with
            the epoch of the first proof. 0 leaves the end to `epochs` and `time_limit`, also of a
            controller that is proved as it was given, which is not trained else.
        time_limit: seconds for the whole call, decisions and compiling included; a compilation that
            has begun is waited for.
        path: of a file that is written after each epoch, and with the first proof; if it is there,
            the same call goes on from it; for another loss, name another file. What was proved is
            decided anew: where the time is too short for that, or `cells` are too few, nothing is
            trained, and the file stays as it is.
        progress: wraps the iteration over epochs to show a progress bar, such as `tqdm.tqdm`.

    Returns:
        The loop under its controller, its verdict, and what happened: of all that is proved the
        one whose task's loss is least. If nothing is proved by the end, the controller is the last
        one.

    Raises:
        ImportError: optax is not installed.
        Interrupted: Ctrl-C; its `found` is what `train` would return for the last epoch, or for
            the controller as it was given.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError, ValueError: as `decide`, but for bounds that leave a domain, which are a warning
            before training; an argument is of another kind; the controller has no
            arrays; the file is of another training.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax import MLP, AffinePlant
        >>> begun = MLP.from_layers([([[0.0]], [0.0])])  # x+ = x + u, u = -0.5 x is wanted
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), begun)
        >>> def task(loop, states):
        ...     return 0.1 * jnp.mean(loop.simulate(states, 3) ** 2)
        >>> found = train(loop, Box([1.0], [2.0]), 3, task, goal=Box([-0.6], [0.6]), margin=0.05)
        >>> found.proved, len(found.history) > 1
        (True, True)
    """
    require_kinds(loop=loop, X0=X0)
    require_kind("X0", X0, Box, "a Box, whose halves are boxes")
    require_double_precision(loop=loop, X0=X0)
    same_size(
        "the loop's number of states is", "the dimension of X0 is", (loop.states, X0.dimension)
    )
    loop.check_horizon(horizon, start)
    require_loss(task_loss)
    chosen = () if isinstance(stages, Stage) else tuple(stages)
    if not chosen or not all(isinstance(stage, Stage) for stage in chosen):
        raise TypeError(
            f"stages must be a sequence of type Stage, such as [Stage(Certified())], but {stages} "
            "arrived"
        )
    counts = {"batch": batch, "samples": samples, "steps": steps, "epochs": epochs, "cells": cells}
    for name, count in counts.items():
        whole_number(name, count, 1)
    whole_number("seed", seed, 0)
    real_number("weight", weight, 0.0)
    require_bar(progress)
    loop, X0 = known_numbers("train", loop, X0, "X0")
    required = tuple(
        requirements(loop.states, horizon, period_of(loop), goal=goal, safe=safe, avoid=avoid)
    )
    spec = Specification(horizon, start, required, real_number("margin", margin, 0.0))
    gain = real_number("gain", gain, 0.0)
    optimizer = _adam() if optimizer is None else require_optimizer(optimizer)
    file = None if path is None else writable("path", path)
    run = _Run(loop, X0, spec, task_loss, _skipping(optimizer, None), chosen, seed, file)
    budget = Budget.of(time_limit)
    asked = {"goal": goal, "safe": safe, "avoid": avoid, "cells": cells, "start": start}
    sizes = _Sizes(batch, samples, steps, weight)
    try:
        first = min(FIRST, budget.left / 4) if budget.timed else FIRST
        seconds = math.inf if run.proof_seconds else max(LEAST, first)
        run.begin(budget, seconds, asked)
        if run.proof_seconds and not run.found.proved:
            return run.found  # it is proved, as the file says: there is nothing to train
        for _ in wrapped(progress, range(len(run.epochs), epochs)):
            if budget.late or run.over(gain):
                break
            run.epoch(sizes, budget, asked)
            run.keep()
        return run.found
    except KeyboardInterrupt:
        if run.known is None:
            raise
        message = "interrupted: this exception's `found` has the controller of the last epoch"
        raise Interrupted(message, run.found) from None


@functools.lru_cache(maxsize=1)
def _adam() -> Any:
    """The optimizer where none is given; the same one, so that steps are compiled once.

    Raises:
        ImportError: optax is not installed.
    """
    return optax_or_error("train").adam(1e-3)


_skipping = functools.lru_cache(maxsize=64)(skip_failures)


class _Sizes(NamedTuple):
    """How much is done at a step and in an epoch: arguments of `train`."""

    batch: int
    samples: int
    steps: int
    weight: float


def _part(lost: float, whole: float) -> float:
    """What is lost of a loss, as a part of what is left; of nothing all, if any."""
    if not whole:
        return math.inf if lost else 0.0
    return lost / abs(whole)


def _mean(losses: Float[np.ndarray, " s"]) -> float:
    """The mean of those that are known; NaN of none."""
    known = losses[np.isfinite(losses)]
    return float(known.mean()) if len(known) else float("nan")


class _Run:
    """A training as far as it has come.

    Args:
        loop: as it was given.
        X0: the initial set.
        spec: what is required.
        task_loss: of the user.
        optimizer: which skips failures.
        stages: of the training.
        seed: of all that is drawn.
        path: of its file, from which it goes on if it is there; None of one that has none.

    Attributes:
        epochs: so far.
        known: the controller that is kept, with its verdict; None before the first decision.
        proof_seconds: those that the last proof took; zero before.

    Raises:
        UnreadableError: the file is none of such.
        ValueError: the file is of another training, or the controller has no arrays.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        X0: Box,
        spec: Specification,
        task_loss: TaskLoss,
        optimizer: Any,
        stages: tuple[Stage, ...],
        seed: int,
        path: Path | None,
    ):
        self._loop, self._X0, self._spec, self._seed, self._path = loop, X0, spec, seed, path
        self._task_loss, self._optimizer, self._stages = hashable(task_loss), optimizer, stages
        # no controller changes whether the initial set is where it should be
        later = tuple(item for item in spec.required if item.time > 0)
        self._lowered = dataclasses.replace(spec, required=later or spec.required)
        self._weights = weights_of(loop.controller)
        if not self._weights:
            raise ValueError(
                "loop.controller has no floating-point arrays to train: give a Network around a "
                "pytree of parameters, such as jax.tree_util.Partial(f, params)"
            )
        self._state = optimizer.init(self._weights)
        self._examples = np.tile(np.asarray(X0.center), (REMEMBERED, 1))
        self._stage = self._begun = 0
        self._before, self.proof_seconds, self._gained = 0.0, 0.0, math.inf
        self.epochs: list[Epoch] = []
        self.known: Trained | None = None
        if path is not None and path.exists():
            self._resume(read_kept(path, self._seal, len(stages)))

    @functools.cached_property
    def _seal(self) -> Seal:
        return training_seal(self._loop, self._X0, self._spec, self._state)

    @property
    def found(self) -> Trained:
        """The controller that is kept, with its verdict and the history."""
        assert self.known is not None  # it is decided before anything else
        return dataclasses.replace(self.known, history=TrainingHistory(tuple(self.epochs)))

    def over(self, gain: float) -> bool:
        """Whether the controller is proved, and going on is not worth it.

        Args:
            gain: as of `train`.
        """
        if not self.found.proved or gain == 0:
            return False
        took = (k for k, epoch in enumerate(self.epochs, 1) if epoch.status == "PROVED")
        longest = 2 * next(took, len(self.epochs))
        return gain >= 1 or self._gained <= gain or len(self.epochs) >= longest

    def begin(self, budget: Budget, seconds: float, asked: dict[str, Any]) -> None:
        """Decide on the controller as it was given, or as the file has it."""
        self.known = self._judged(budget, seconds, asked, after=len(self.epochs))

    def _judged(self, budget: Budget, seconds: float, asked: dict[str, Any], after: int) -> Trained:
        """The controller as it is with its verdict, whose counterexample is remembered.

        One that the file knows of already is not remembered twice.
        """
        found = self._decided(self._weights, budget, seconds, asked, after)
        seen = found.verdict.counterexample
        if seen is not None and (after == 0 or after > len(self.epochs)):
            begun = np.asarray(seen.states[0])[None]
            self._examples = np.concatenate([self._examples[1:], begun])
        return found

    def _decided(
        self,
        weights: Sequence[Array],
        budget: Budget,
        seconds: float,
        asked: dict[str, Any],
        after: int,
    ) -> Trained:
        """A controller with its verdict, within so many seconds; how long a proof takes is kept."""
        loop = under(self._loop, weights)
        limit = min(seconds, budget.left) if budget.timed else seconds
        given, clock = (loop, self._X0, self._spec.horizon), Budget()
        asked = asked | {"time_limit": limit if math.isfinite(limit) else None}
        try:
            verdict = decide(*given, **asked, seed=self._seed + after)
        except UnboundedError as error:  # over no cell, which training may change
            if self.known is None:
                which = "the controller as given" if not self.epochs else "the file's controller"
                warnings.warn(f"nothing is known of {which}: {error}", stacklevel=3)
            about = Asked(*given, self._spec.start, self._spec.required)
            verdict = Findings(*about).verdict(asked=about)
        except Interrupted as error:
            self.known = self.known or Trained(loop, error.found, TrainingHistory())
            raise
        if verdict.proved:
            self.proof_seconds = clock.elapsed
        return Trained(loop, verdict, TrainingHistory())

    def epoch(self, sizes: _Sizes, budget: Budget, asked: dict[str, Any]) -> None:
        """Some steps on the cells that are worst, and what is decided then."""
        number, stage = len(self.epochs), self._stages[self._stage]
        rng = np.random.default_rng((self._seed, number))
        count = min(sizes.batch, stage.cells)
        corners = worst_cells(self._X0, self.found.verdict.cells, stage.cells, count, rng)
        program = Program(
            self._lowered,
            self._task_loss,
            hashable(stage.objective),
            self._optimizer,
            sizes.samples,
        )
        keys = jax.random.split(jax.random.key(int(rng.integers(2**31))), sizes.steps)
        skipped, losses, clock = failures(self._state), list[list[float]](), Budget()
        share = budget.share(FOR_STEPS)
        for key in keys:
            given = self._weights, self._state, key, *corners, self._examples, sizes.weight
            self._weights, self._state, *found = compiled_step()(program, self._loop, *given)
            losses.append([float(each) for each in found])
            if len(losses) == 1:  # which may have been compiled
                clock = Budget()
            if share.late:
                break
        skipped = failures(self._state) - skipped
        task, missed = np.array(losses).T
        quiet = bool(np.all(missed[-max(1, len(losses) // QUIET) :] <= 0))  # NaN is not
        seconds = clock.elapsed * (PATIENCE if quiet else 1.0)
        if share.late:  # it may be the last one
            seconds = max(seconds, share.elapsed)
        if quiet and not budget.timed:
            seconds = math.inf
        before = self.found
        now = self._judged(budget, max(LEAST, seconds), asked, number + 1)
        if now.proved or before.proved:
            self._lower(before, now, sizes, budget, asked, number + 1)
        else:
            self.known = now
        verdict = self.found.verdict
        proved = sum(cell.status is VerdictStatus.PROVED for cell in verdict.cells)
        self.epochs.append(
            Epoch(
                stage=self._stage,
                steps=len(losses),
                skipped=skipped,
                task=_mean(task),
                penalty=_mean(missed),
                status=verdict.status.name,
                margin=smallest(verdict.margins),
                cells=len(verdict.cells),
                proved=proved,
                seconds=self._before + budget.elapsed,
            )
        )
        ended = quiet or skipped == len(losses) or number + 1 - self._begun >= stage.epochs
        if ended and not verdict.proved and self._stage + 1 < len(self._stages):
            self._stage, self._begun = self._stage + 1, number + 1

    def _lower(
        self,
        before: Trained,
        now: Trained,
        sizes: _Sizes,
        budget: Budget,
        asked: dict[str, Any],
        after: int,
    ) -> None:
        """Keep the proved controller of least loss that is found after an epoch.

        Args:
            before: the controller that the epoch began with.
            now: the one that it ended with; one of the two is proved.
            sizes: how many states the loss is of.
            budget: of the whole call.
            asked: of `decide`.
            after: how many epochs.
        """
        if not before.proved:
            self.known = now
            self.keep()  # what follows may take longer than all so far
        states = self._X0.sample(jax.random.key(self._seed), sizes.samples)

        def loss(weights: Sequence[Array]) -> float:
            return float(compiled_loss()(self._task_loss, self._loop, [*weights], states))

        reached, other = math.inf, weights_of(self._loop.controller)
        if before.proved:
            first, other = weights_of(before.controller), self._weights
            reached = loss(first)
            if now.proved and loss(other) < reached:
                self.known = now
            else:
                self._weights = first
        least = loss(self._weights)
        for _ in range(HALVINGS):
            pairs = zip(self._weights, other, strict=True)
            middle = [(one + another) / 2 for one, another in pairs]
            if budget.late or not (lower := loss(middle)) < least:
                break
            limit = max(LEAST, PATIENCE * self.proof_seconds)
            tried = self._decided(middle, budget, limit, asked, after)
            if tried.proved:
                self.known, self._weights, least = tried, middle, lower
            else:
                other = middle
        self._gained = _part(reached - least, least) if before.proved else math.inf

    def keep(self) -> None:
        """Write what has been done to the file, if there is one."""
        if self._path is None:
            return
        kept = Kept(
            np.asarray(self._seal),
            tuple(self._weights),
            numbers_of(self._state),
            self._examples,
            self._stage,
            self._begun,
            tuple(self.epochs),
            self._gained,
            self.proof_seconds,
        )
        try:
            write_kept(self._path, kept)
        except OSError as error:  # of a full disk: what is known is worth more than its file
            warnings.warn(f"{self._path} was not written, training goes on: {error}", stacklevel=3)

    def _resume(self, kept: Kept) -> None:
        """Go on from what a file holds."""
        self._weights = [jnp.asarray(each) for each in kept.weights]
        self._state = state_from(self._state, kept.optimizer)
        self._examples, self._stage, self._begun = kept.examples, kept.stage, kept.begun
        self._gained, self.proof_seconds = kept.gained, kept.proof_seconds
        self.epochs = [*kept.epochs]
        self._before = self.epochs[-1].seconds if self.epochs else 0.0
