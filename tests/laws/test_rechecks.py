"""Law: a bound is proved anew by its proof, and a witness is a scenario that attains its value."""

import jax
import numpy as np

import reachjax as rj
from reachjax.proofs.branches import Rung
from reachjax.proofs.recheck import interval_offsets
from tests.cases import HORIZON, ROUNDING, each

SOLVED_TO = 1e-6
"""What a program's multipliers may prove less than its bound, as a part of it or of one.

A bound stays at the optimum that a solver found, which its multipliers attain to its accuracy only,
and what they miss of the matrix inequality is paid for by each entry of the program.
"""


def least(proof):
    """What a proof's own recheck gives at least: its bounds, but for rounding.

    A bound by products stays at its relaxation's optimum where interval arithmetic proves less.
    """
    bounds, part = np.asarray(proof.bounds), 1e-9
    if isinstance(proof, rj.AbstractCertificate):
        part, facets = SOLVED_TO, len(getattr(proof, "solver_offsets", ()))
        by_intervals = interval_offsets(jax.device_get(proof.program))[:facets]
        bounds = np.r_[np.fmin(bounds[:facets], by_intervals), bounds[facets:]]
    elif any(isinstance(each, rj.AbstractCertificate) for each in parts_of(proof)):
        part = SOLVED_TO  # bounds of cells are such bounds
    return bounds - part * np.maximum(1.0, abs(bounds))


def parts_of(proof):
    """The proofs over cells that a proof is made of."""
    return [each for own in getattr(proof, "proofs", ()) for each in own]


@each()
def test_a_proof_repeats_the_bounds_of_its_set(case):
    tube = case.tube
    assert tube.certificates[0] is None
    for k, reached in enumerate(tube.reached, start=1):
        bounds, proof = np.asarray(reached.proof.bounds), tube.proof(k)
        assert isinstance(proof, rj.AbstractProof)
        assert reached.span == (k, k)
        np.testing.assert_allclose(bounds, tube.sets[k].limits, rtol=1e-12)
        again, sizes = np.asarray(proof.recheck()), np.maximum(1.0, abs(bounds))
        assert np.all(again <= bounds + 1e-9 * sizes)
        assert np.all(again >= least(proof)), "an unsound recheck, or a loose bound"
        assert len(proof.statuses) == len(bounds)
        if isinstance(proof, rj.LinearCertificate):
            np.testing.assert_array_equal(again, bounds)
        elif isinstance(proof, rj.BranchCertificate) and case.of.plain is not None:
            own = np.asarray(proof.rungs) < Rung.PRODUCTS
            assert np.all(abs(again - bounds)[own] <= ROUNDING * sizes[own])


@each()
def test_no_witness_exceeds_its_bound(case):
    for k in range(1, HORIZON + 1):
        proof = case.tube.proof(k)
        gaps, bounds = np.asarray(proof.gaps), np.asarray(proof.bounds)
        np.testing.assert_array_equal(gaps, bounds - np.asarray(proof.witnesses))
        assert np.all(gaps >= -ROUNDING * np.maximum(1.0, abs(bounds)))


@each()
def test_witnesses_are_scenarios_of_the_loop_that_attain_their_values(case):
    tube, loop = case.tube, case.closed_loop
    near = ROUNDING if case.of.plain is not None else 1e-9
    for k in range(1, HORIZON + 1):
        proof = tube.proof(k)
        states, w, v = loop.split(np.asarray(proof.witness_states))
        drawn = {"disturbances": (loop.disturbance, w), "noises": (loop.noise, v)}
        for X, points in ((tube.sets[0], states), *drawn.values()):
            if X is not None and X.steps is None:
                assert np.all(X.contains(points, near))
        given = {name: points for name, (X, points) in drawn.items() if X is not None}
        steps = HORIZON if not given else next(iter(given.values())).shape[1]
        runs = loop.simulate(states, steps, case.of.start, **given)
        values = np.diag(tube.sets[k].bounded_values(runs[:, k]))
        np.testing.assert_allclose(values, proof.witnesses, rtol=near, atol=1e-12)
