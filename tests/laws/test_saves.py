"""Law: a file is read as the tube that was written, and what was changed in it is not believed."""

import functools

import numpy as np
import pytest

import reachjax as rj
from tests.cases import HORIZON, Case, each
from tests.laws.changes import CHANGES, changed, same, wider


def read(path, tube, loop=None):
    """What a file of a tube says once it is proved anew."""
    tube.save(path)
    return rj.load(path, loop, recheck=True)


@each()
def test_a_tube_is_read_as_it_was(case, tmp_path):
    path = tmp_path / "tube.reach"
    again = read(path, case.tube, None if case.of.kept else case.closed_loop)
    assert same(again, case.tube)
    assert str(again) == str(case.tube)
    kinds = [[type(proof) for proof in tube.certificates] for tube in (again, case.tube)]
    assert kinds[0] == kinds[1]
    assert same(rj.load(path, case.closed_loop), case.tube)
    if not case.of.kept:
        with pytest.raises(
            ValueError, match=r"written without its loop.*load\(path, loop=\.\.\.\)"
        ):
            rj.load(path)


@each()
def test_a_file_belongs_to_its_loop(case, tmp_path):
    case.tube.save(tmp_path / "tube.reach")
    others = Case("relu"), Case("one state"), Case("sine"), Case("sine, tanh")
    for other in others:
        if other.loop != case.loop:
            with pytest.raises(ValueError, match="loop must be that of the tube"):
                rj.load(tmp_path / "tube.reach", other.closed_loop)


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
}
"""Tubes of every kind of proof."""
COSTLY = "windows", "ellipsoids", "mixed"
"""Kinds whose programs take seconds to compile; there are others by programs."""
KINDS = [
    pytest.param(kind, marks=[pytest.mark.costly] * (kind in COSTLY))
    for kind in (*ATTACKED, "partition")
]


def made(kind):
    """A tube, or a partition, of a kind."""
    return partition() if kind == "partition" else ATTACKED[kind].tube


def loop_of(tube):
    """The loop of a tube or a partition."""
    return tube[0].loop if isinstance(tube, rj.PartitionedTube) else tube.loop


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_tube_that_was_changed_is_not_read(kind, change, tmp_path):
    tube = changed(made(kind), change)
    with pytest.raises((rj.DisagreementError, rj.UnreadableError)):
        read(tmp_path / "tube.reach", tube, loop_of(tube))


def test_a_partition_is_read_as_it_was(tmp_path):
    assert same(read(tmp_path / "tube.reach", partition()), partition())


@pytest.mark.costly
def test_cells_that_leave_something_out_are_not_read(tmp_path):
    tube = partition()
    fewer = rj.PartitionedTube.sealed(tube.X0, tube.tubes[:1])
    larger = rj.PartitionedTube.sealed(wider(tube.X0), tube.tubes)
    for spoilt in (fewer, larger):
        with pytest.raises(rj.DisagreementError, match="are not shown to cover the initial set"):
            read(tmp_path / "tube.reach", spoilt)


@pytest.mark.parametrize("kind", ["branches", "programs", "ellipsoids"])
def test_a_bound_that_is_not_proved_is_named(kind, tmp_path):
    tube = changed(made(kind), "lower bounds and no witnesses")
    tube.save(tmp_path / "tube.reach")
    rj.load(tmp_path / "tube.reach")  # nothing was asked
    with pytest.raises(rj.DisagreementError, match="the recheck of step 3 proves") as caught:
        rj.load(tmp_path / "tube.reach", recheck=True)
    error = caught.value
    assert error.step == 3
    assert error.said < error.proved
    assert error.said == np.asarray(tube.proof(3).bounds)[error.facet] or kind == "ellipsoids"
