"""Sets of a template around the states of each step by semidefinite programs, step by step."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from reachjax.numerics.checks import is_concrete
from reachjax.programs.relaxations import LocalBounds
from reachjax.proofs.certificates import AbstractCertificate, AbstractProof
from reachjax.sets import AbstractSet, AbstractTemplate
from reachjax.tubes.steps import Reached, Setting, Step
from reachjax.tubes.successors import successors

LATE = LocalBounds(repeated=False)
"""The relaxation of a step for which there is no time left, and which no solver sees."""


def sets_by_programs(
    setting: Setting,
    X0: AbstractSet,
    template: AbstractTemplate,
    horizon: int,
    window: int | None,
    known: Sequence[Reached] = (),
) -> Iterator[Reached]:
    """The smallest sets that are proved, each being the next one's set of states.

    Source: equation (seq_SDP) of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Args:
        setting: what all steps have in common.
        X0: the initial set.
        template: what the sets look like.
        horizon: how many steps there are.
        window: over how many of them a program reaches back; None for as many as may be.
        known: the first ones.
    """
    X, proof, steps = X0, None, []
    # what is traced is not compiled otherwise for having been traced slowly
    known_numbers = is_concrete(jax.lax.stop_gradient((setting.loop, X0, template)))
    for k in range(horizon):
        before = steps if window is None else steps[max(0, k + 1 - window) :]
        if known_numbers and setting.budget.late:
            step = Step(dataclasses.replace(setting, relaxation=LATE), X, k, (), proof)
        else:
            step = Step(setting, X, k, tuple(before), proof)
        steps.append(step)
        if k < len(known):
            X, proof = known[k].region, _of_programs(known[k].proof)
            continue
        setting.note("semidefinite programs")
        share = setting.budget.share(1 / (horizon - k))
        X, proof = successors(step, template.at(k + 1), share)
        states = np.zeros((0, X0.dimension))
        if len(step.window) == k + 1 and is_concrete(proof.moments):
            states = np.asarray(proof.moments)[:, : X0.dimension, -1]
        yield Reached(X, proof, states, climb=True)


def _of_programs(proof: AbstractProof) -> AbstractCertificate | None:
    """A proof by programs, whose products the next one may begin with; None if it is another."""
    return proof if isinstance(proof, AbstractCertificate) else None
