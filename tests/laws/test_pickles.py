"""Law: a tube that is copied in any way is the same proof, and no part of it can be exchanged."""

import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.cases import FEW, LOOPS, Case, each
from tests.laws.changes import another, same

COPIES = {
    "pickled": lambda tube: pickle.loads(pickle.dumps(tube)),
    "on the host": jax.device_get,
    "mapped": lambda tube: jax.tree.map(lambda leaf: leaf, tube),
    "replaced": dataclasses.replace,
    "copied": copy.deepcopy,
}


@each(every=2)
def test_a_copy_of_a_tube_is_the_same_proof(case):
    for change in COPIES.values():
        again = change(case.tube)
        again.require_sealed()
        assert same(again, case.tube)
        assert repr(again) == repr(case.tube)
        np.testing.assert_array_equal(again.proof(2).recheck(), case.tube.proof(2).recheck())


@each(basic=FEW)
def test_no_part_of_a_tube_can_be_exchanged(case):
    tube, loop = case.tube, case.closed_loop
    other = rj.reach(
        another(loop), case.X0, 3, case.shape, rj.LinearBounds(), start=case.of.start, samples=10
    ) if not case.round else None  # fmt: skip
    changes = [{"loop": another(loop)}, {"start": tube.start + 1}, {"sets": tube.sets[::-1]}]
    if isinstance(case.shape, rj.Template):
        changes += [{"template": case.shape.replace(directions=2 * case.shape.directions)}]
    changes += [{"certificates": (None, *tube.certificates[:0:-1])}, {"seal": tube.seal[::-1]}]
    if other is not None:
        changes += [{"certificates": other.certificates}, {"seal": other.seal}]
    for each_change in changes:
        for replace in (type(tube).replace, dataclasses.replace):
            with pytest.raises(ValueError, match="not those that were computed together"):
                replace(tube, **each_change)


@each()
def test_no_array_of_a_tube_can_be_written(case):
    assert not any(np.asarray(leaf).flags.writeable for leaf in jax.tree.leaves(case.tube))


@each()
def test_a_tube_whose_numbers_were_changed_is_no_proof(case):
    leaves, structure = jax.tree.flatten(case.tube)
    numbers = [k for k, leaf in enumerate(leaves) if leaf.dtype == float and leaf.size]
    for position in np.random.default_rng(0).choice(numbers, 3, replace=False):
        spoilt = list(leaves)
        spoilt[position] = jnp.nextafter(jnp.asarray(spoilt[position]), jnp.inf)
        if np.array_equal(spoilt[position], leaves[position], equal_nan=True):
            continue
        with pytest.raises(ValueError, match="not those that were computed together"):
            jax.tree.unflatten(structure, spoilt).require_sealed()


@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_that_is_pickled_is_the_same_loop(name):
    case = Case(name, "forms")
    again = pickle.loads(pickle.dumps(case.closed_loop))
    states = case.runs[:5, 0]
    one, other = (loop.simulate(states, 2, case.of.start) for loop in (again, case.closed_loop))
    np.testing.assert_array_equal(one, other)
