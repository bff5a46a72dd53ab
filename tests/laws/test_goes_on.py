"""Law: what was proved is not lost: a tube that was interrupted goes on as if it had not been."""

import pickle

import numpy as np
import pytest

import reachjax as rj
from tests.cases import FEW, HORIZON, Case, each
from tests.laws.changes import same

GAP = 1e-4
"""What `reach` may leave open by default, as a part of a facet's range."""


EXACT = "forms", "programs", "paper", "paper, plain", "windows of two"
"""Methods without a search: what they go on from is all that they know of former steps."""


class Stopping:
    """A progress bar whose user presses Ctrl-C when so many steps are done."""

    def __init__(self, after):
        self.after = after

    def __call__(self, steps):
        for step in steps:
            if step == self.after:
                raise KeyboardInterrupt
            yield step


def claims(tube):
    """Sets, bounds and witnesses."""
    return tube.sets, [(proof.bounds, proof.witnesses) for proof in tube.certificates[1:]]


def bounds(tube):
    """Sets and bounds, to the last digit.

    Witnesses are of the trajectories that were found on the way, in batches of other sizes.
    """
    return tube.sets, [proof.bounds for proof in tube.certificates[1:]]


def as_tight(one, other):
    """Whether sets are the same, but for what a search may leave open whose witnesses differ."""
    pairs = zip(one.certificates[1:], other.certificates[1:], strict=True)
    return all(
        np.all(abs(a.bounds - b.bounds) <= GAP * (1e-3 + abs(a.bounds) + abs(b.bounds)))
        for a, b in pairs
    )


@each(lambda case: not case.searches_cells, basic=FEW, every=3)
def test_a_tube_that_was_interrupted_goes_on_as_if_it_had_not_been(case):
    with pytest.raises(rj.Interrupted, match=rf"after 1 of {HORIZON} steps") as stopped:
        case.reach(progress=Stopping(1))
    tube = stopped.value.tube
    assert tube.horizon == 1
    tube.require_sealed()
    assert same(claims(pickle.loads(pickle.dumps(stopped.value)).tube), claims(tube))
    rest = tube.extended(HORIZON - 1, **case.options)
    if case.method in EXACT:
        assert same(bounds(rest), bounds(case.tube))
    else:
        assert as_tight(rest, case.tube)


@each(basic=FEW, every=3)
def test_nothing_is_left_of_a_call_that_proved_nothing(case):
    with pytest.raises(KeyboardInterrupt) as stopped:
        case.reach(progress=Stopping(0))
    assert not isinstance(stopped.value, rj.Interrupted)


@each(basic=FEW, every=3)
def test_the_same_call_gives_the_same_tube(case):
    assert same(claims(case.reach()), claims(case.tube))


@each(lambda case: case.template != "varying" and not case.searches_cells, basic=FEW, every=3)
def test_the_first_step_is_that_of_a_call_for_one_step(case):
    assert same(claims(case.reach(steps=1))[0][1], case.tube.sets[1])


def test_a_tube_goes_on_to_where_its_loop_ends():
    case = Case("varying")
    with pytest.raises(ValueError, match="horizon"):
        case.tube.extended(1)
