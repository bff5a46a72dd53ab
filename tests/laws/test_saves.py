"""Law: a file is read as the tube that was written, and what was changed in it is not believed."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.cases import FEW, HORIZON, Case, each
from tests.closed_loops import autonomous
from tests.laws.changes import (
    CHANGES,
    alike,
    another,
    at,
    changed,
    parts_of,
    same,
    unclaimed,
    wider,
)


def read(path, tube, loop=None):
    """What a file of a tube says once it is proved anew."""
    tube.save(path)
    return rj.load(path, loop, recheck=True)


@each()
def test_a_tube_is_read_as_it_was(case, tmp_path):
    path = tmp_path / "tube.reach"
    again = read(path, case.tube, None if case.of.kept else case.closed_loop)
    compare = same if case.method == "forms" else alike
    assert compare(unclaimed(again), unclaimed(case.tube))
    ends = {status for k in range(1, HORIZON + 1) for status in again.proof(k).statuses}
    assert ends == {rj.SolverStatus.RECHECKED}
    assert str(again) == str(case.tube)
    kinds = [[type(proof) for proof in tube.certificates] for tube in (again, case.tube)]
    assert kinds[0] == kinds[1]
    assert same(rj.load(path, case.closed_loop), case.tube)
    if not case.of.kept:
        with pytest.raises(
            ValueError, match=r"written without its loop.*load\(path, loop=\.\.\.\)"
        ):
            rj.load(path)


@each(lambda case: case.of.n == 2, basic=FEW)
def test_a_file_belongs_to_its_loop(case, tmp_path):
    case.tube.save(tmp_path / "tube.reach")
    rows = Case("relu"), Case("sine"), Case("sine, tanh")
    others = [row.closed_loop for row in rows if row.loop != case.loop]
    for other in (*others, another(case.closed_loop)):
        with pytest.raises(ValueError, match="loop must be that of the tube"):
            rj.load(tmp_path / "tube.reach", other)


@functools.cache
def partition():
    """A tube of cells."""
    case = Case("relu")
    return rj.reach_partitioned(case.closed_loop, case.X0, HORIZON, case.shape, cells=(2, 1))


ATTACKED = {
    "branches": Case("relu", "default", "own", "octagonal"),
    "forms": Case("hard", "forms"),
    "disturbed": Case("disturbed"),
    "pentagon": Case("inputs in a pentagon"),
    "cells": Case("sine, tanh"),
    "cells of branches": Case("sine", "cells of branches"),
    "jumps": Case("argmax"),
    "sampled": Case("sampled"),
    "programs": Case("relu", "programs"),
    "windows": Case("relu", "windows of two"),
    "ellipsoids": Case("relu", "programs", "own", "ellipsoids"),
    "mixed": Case("relu", "programs", "own", "mixed"),
    "cuts": Case("relu", "cuts"),
    "paper": Case("relu", "paper"),
    "smooth": Case("sine", "one cell"),
}
"""Tubes of every kind of proof."""
COSTLY = "windows", "ellipsoids", "mixed", "cuts", "paper"
"""Kinds whose programs take seconds to compile; there are others by programs."""
KINDS = [
    pytest.param(kind, marks=[pytest.mark.costly] * (kind in COSTLY))
    for kind in (*ATTACKED, "partition")
]


def made(kind):
    """A tube, or a partition, of a kind."""
    return partition() if kind == "partition" else ATTACKED[kind].tube


def given(kind):
    """The loop that has to be given with a file of a kind; None where the file has it."""
    case = ATTACKED.get(kind)
    return None if case is None or case.of.kept else case.closed_loop


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_tube_that_was_changed_is_not_read(kind, change, tmp_path):
    tube = changed(made(kind), change)
    loop = None if given(kind) is None else tube.loop
    with pytest.raises((rj.DisagreementError, rj.UnreadableError)):
        read(tmp_path / "tube.reach", tube, loop)


def test_a_partition_is_read_as_it_was(tmp_path):
    again = read(tmp_path / "tube.reach", partition())
    assert alike(unclaimed(again), unclaimed(partition()))


@pytest.mark.costly
def test_cells_that_leave_something_out_are_not_read(tmp_path):
    tube = partition()
    fewer = rj.PartitionedTube.sealed(tube.X0, tube.tubes[:1])
    larger = rj.PartitionedTube.sealed(wider(tube.X0), tube.tubes)
    for spoilt in (fewer, larger):
        with pytest.raises(rj.DisagreementError, match="are not shown to cover the initial set"):
            read(tmp_path / "tube.reach", spoilt)


@pytest.mark.costly
def test_a_disagreement_says_what_was_said_and_what_is_proved(tmp_path):
    """Of the unit ball in eight dimensions the sum of all entries is bounded by the root of 8."""
    A = np.zeros((8, 8))
    A[0] = 1.0
    ball = rj.Ellipsoid(np.zeros(8), np.eye(8))
    tube = rj.reach(autonomous(A), ball, 1, rj.Template.box(8))
    proof, X = tube.proof(1), tube.sets[1]
    facet = int(np.argmax(X.A[:, 0]))
    lower = X.b.at[facet].set(2.7)
    proof = proof.replace(bounds=lower, witnesses=jnp.full(len(lower), -1e300))
    parts = parts_of(tube) | at(tube, 1, X.replace(b=lower), proof)
    forged = rj.ReachTube.sealed(**parts)
    forged.save(tmp_path / "tube.reach")
    rj.load(tmp_path / "tube.reach")  # nothing was asked
    with pytest.raises(rj.DisagreementError, match=r"recheck of step 1 proves 2\.828") as caught:
        read(tmp_path / "tube.reach", forged)
    error = caught.value
    assert (error.step, error.facet, error.said) == (1, facet, 2.7)
    assert error.proved == pytest.approx(np.sqrt(8))


GOING_ON = [case for kind, case in ATTACKED.items() if "cells" not in kind]


@each(rows=GOING_ON, basic=FEW)
def test_a_tube_that_was_read_goes_on_as_the_one_that_was_written(case, tmp_path):
    tube = case.reach(steps=1)
    again = read(tmp_path / "tube.reach", tube, None if case.of.kept else case.closed_loop)
    assert same(tube.extended(1, **case.options).sets, again.extended(1, **case.options).sets)
