"""What callers wrote before is read as before, with a warning that says what to write."""

import pytest

import reachjax as rj
from reachjax.numerics.deprecations import once_positional


def test_requirements_by_position_are_read_in_the_order_that_they_had():
    plant = rj.AffinePlant([[1.0]], [[1.0]])
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers([([[-0.5]], [0.0])]))  # x+ = x / 2
    tube = rj.reach(loop, rj.Box([1.0], [2.0]), 1, rj.Template.box(1))
    goal, wall, room = rj.Box([0.4], [1.1]), rj.Box([3.0], [4.0]), rj.Box([0.6], [2.5])
    with pytest.warns(DeprecationWarning, match="goal, avoid, safe by keyword"):
        before = rj.verify(tube, goal, [wall], room)
    now = rj.verify(tube, goal=goal, safe=room, avoid=[wall])
    assert before.margins.keys() == now.margins.keys()
    assert (before.proved, before.refuted) == (now.proved, now.refuted) == (False, True)
    with pytest.warns(DeprecationWarning, match="goal, safe by keyword"):
        assert rj.decide(loop, rj.Box([1.5], [2.0]), 1, goal, room).proved


def test_what_is_given_twice_or_too_much_is_an_error():
    @once_positional("high")
    def between(x, *, low=0, high=1):
        return low <= x <= high

    assert between(2, high=3)
    with pytest.warns(DeprecationWarning, match="high by keyword"):
        assert between(2, 3)
    with pytest.raises(TypeError, match="high twice"):
        between(2, 3, high=3)
    with (
        pytest.warns(DeprecationWarning, match="by keyword"),
        pytest.raises(TypeError, match="positional"),
    ):
        between(2, 3, 4)
