"""Cells cover their set at any moment: no interruption, wherever it comes, loses one."""

import itertools
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods import searches
from reachjax.methods.cell_tree import CellTree
from reachjax.sets.cells import from_tree

ROOM = str(Path(searches.__file__).parent)
WATCHED = ("winning.py", "cell_decisions.py", "cell_tree.py", "searches.py", "cell_jobs.py")


class Pressed:
    """Ctrl-C at some lines of what searches cells, counted from the first question."""

    def __init__(self, *lines):
        self._lines, self._count, self.begun = set(lines), 0, False

    def __enter__(self):
        sys.settrace(self._called)
        return self

    def __exit__(self, *_):
        sys.settrace(None)

    def _called(self, frame, event, _):
        name = frame.f_code.co_filename
        self.begun |= frame.f_code.co_name == "_answers"
        return self._line if name.startswith(ROOM) and name.endswith(WATCHED) else None

    def _line(self, frame, event, _):
        if event == "line" and self.begun:
            self._count += 1
            if self._count in self._lines:
                raise KeyboardInterrupt
        return self._line


@pytest.fixture(scope="module")
def loop():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    return rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net, rj.Box([-1.0], [1.0]))


CALLS = {
    "winning_set": lambda loop: rj.winning_set(
        loop, rj.Box([-8.0], [8.0]), 2, safe=rj.Box([-4.0], [4.0]), cells=24
    ),
    "decide": lambda loop: rj.decide(
        loop, rj.Box([-8.0], [8.0]), 2, safe=rj.Box([-8.001], [8.001]), cells=(9,)
    ),
}


def covers(cells, lower, upper):
    """Whether intervals fill a larger one without overlaps."""
    ends = sorted((float(c.lower[0]), float(c.upper[0])) for c in cells)
    inner = [(a, b) for (_, a), (b, _) in itertools.pairwise(ends)]
    return ends[0][0] == lower and ends[-1][1] == upper and all(a == b for a, b in inner)


def pressed_at(lines, call, loop):
    """What a call had found when it was interrupted at lines; None if it had ended by then."""
    try:
        with Pressed(*lines):
            CALLS[call](loop)
    except KeyboardInterrupt as stopped:
        return getattr(stopped, "found", None)
    return None


@pytest.mark.parametrize("call", CALLS)
def test_ctrl_c_at_any_line_loses_no_cell(loop, call):
    CALLS[call](loop)  # what is compiled is compiled
    lines = np.unique(np.random.default_rng(0).integers(1, 1500, 60))
    found = [pressed_at((int(line),), call, loop) for line in lines]
    found = [each for each in found if each is not None]
    assert len(found) > 5
    for each in found:
        assert covers(each.cells, -8.0, 8.0)
        if call == "winning_set":
            given = loop, rj.Box([-8.0], [8.0]), 2
            on = rj.winning_set(*given, safe=rj.Box([-4.0], [4.0]), cells=24, known=each)
            assert covers(on.cells, -8.0, 8.0)
        else:
            every = all(cell.status is rj.VerdictStatus.PROVED for cell in each.cells)
            assert every or each.status is not rj.VerdictStatus.PROVED


def test_ctrl_c_a_second_time_loses_no_cell_that_is_spoken_of(loop):
    for line in range(40, 400, 30):
        found = pressed_at((line, line + 3, line + 9), "winning_set", loop)
        assert found is None or covers(found.cells, -8.0, 8.0)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_leaves_are_those_that_the_axes_say_and_cover_the_set(n):
    rng = np.random.default_rng(n)
    X = rj.Box(-rng.uniform(1, 2, n), rng.uniform(1, 2, n))
    tree = CellTree.whole(X)
    for _ in range(12):
        node = tree.leaves[rng.integers(len(tree.leaves))]
        axis = int(rng.integers(n))
        tree.replace(node, tree.halved(node, axis), axis)
    cells = from_tree(X, tree.roots[0].axes)
    assert tree.count == len(tree.leaves) == len(cells) == 13
    for node, cell in zip(tree.leaves, cells, strict=True):
        np.testing.assert_array_equal(node.lower, cell.part.lower)
        np.testing.assert_array_equal(node.upper, cell.part.upper)
    points = np.asarray(X.sample(jnp.zeros(2, jnp.uint32), 200))
    ends = np.array([node.ends for node in tree.leaves])
    inside = (ends[:, 0] <= points[:, None]) & (points[:, None] <= ends[:, 1])
    assert inside.all(axis=2).any(axis=1).all()
