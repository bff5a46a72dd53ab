"""Partitions: cells that cover the initial set, tubes whose union holds every state."""

import warnings
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods.cell_tree import CellTree, Node
from reachjax.sets.cells import grid, halves_along
from tests.closed_loops import autonomous, closed_loop, random_loop, recursion

RECURSION = {"relaxation": rj.LocalBounds(), "window": 1}
DIAMOND = rj.Polytope([[1, 1], [1, -1], [-1, 1], [-1, -1]], [1, 1, 1, 1])
SETS = {
    "box": rj.Box([1.0, -0.5], [2.0, 0.5]),
    "flat box": rj.Box([1.0, 0.25], [2.0, 0.25]),
    "diamond": DIAMOND,
    "segment": rj.Polytope([[1, 1], [-1, -1], [1, -1], [-1, 1]], [1, -1, 1, 1]),
    "ellipsoid": rj.Ellipsoid([0.5, 0.0], [[0.5, 0.2], [0.2, 0.4]]),
    "intersection": rj.Intersection(DIAMOND, rj.Ellipsoid([0.0, 0.0], 0.64 * np.eye(2))),
}


@pytest.fixture(scope="module")
def loop():
    return closed_loop(random_loop(2, hidden=(6, 4), seed=3))


@pytest.fixture(scope="module")
def partitioned(loop):
    return rj.reach_partitioned(
        loop, SETS["box"], 3, rj.Template.octagonal(2), cells=(2, 3), **RECURSION
    )


def test_the_union_holds_every_state(loop, partitioned):
    states = SETS["box"].sample(jax.random.key(1), 2000)
    for t, points in enumerate(np.moveaxis(np.asarray(loop.simulate(states, 3)), 1, 0)):
        inside = np.array([region.contains(points, 1e-9) for region in partitioned.sets(t)])
        assert inside.any(axis=0).all()


@pytest.mark.parametrize("name", SETS)
@pytest.mark.costly
def test_cells_cover_the_set(name):
    X = SETS[name]
    points = X.sample(jax.random.key(0), 500)
    # the vertices too, where there are some: cells that only touch the set hold them
    if isinstance(X, rj.PolyhedralSet):
        points = jnp.concatenate([points, X.vertices()])
    for cells in (grid(X, (4, 4)), halves_along(X, X.bounding_box(), 1), grid(X, (1, 1))):
        inside = np.array([cell.part.contains(points, 1e-9) for cell in cells])
        assert inside.any(axis=0).all()


@pytest.mark.costly
def test_cells_beside_the_set_are_left_out():
    # of 8 x 8 cells around a diamond those beyond its sides neither overlap nor touch it
    assert len(grid(DIAMOND, (8, 8))) == 52  # of which 16 meet it in a point
    disk = rj.Ellipsoid([0.0, 0.0], np.eye(2))
    assert len(grid(disk, (8, 8))) == 60  # the distance of a corner cell's corner is 1.06


@pytest.mark.parametrize("name", SETS)
@pytest.mark.costly
def test_every_cell_can_be_sampled(name):
    for cell in grid(SETS[name], (4, 4)):  # the diamond meets corner cells in a point
        points = cell.part.sample(jax.random.key(0), 5)
        assert bool(SETS[name].contains(points, 1e-5).all())


def test_cells_are_cut_in_every_dimension():
    X = rj.Box(np.zeros(3), [1.0, 2.0, 3.0])
    cells = grid(X, (1, 2, 3))
    assert len(cells) == 6
    assert sum(cell.part.volume() for cell in cells) == pytest.approx(6.0)
    lower, upper = halves_along(X, X, 2)
    assert [lower.box.upper.tolist(), upper.box.upper.tolist()] == [[1, 2, 1.5], [1, 2, 3]]
    tree = CellTree.whole(X)
    assert tree.longest(Node(np.zeros(3), np.array([0.6, 1.0, 1.5]))) == 0  # in parts of X's sides


@pytest.mark.costly
def test_cells_of_cells_have_no_more_facets():
    ball = rj.Ellipsoid([0.0, 0.0], np.eye(2))
    half = halves_along(ball, ball.bounding_box(), 0)[0]
    quarter = halves_along(ball, half.box, 1)[0]
    assert len(quarter.part.facts()) == len(half.part.facts()) == 4


@pytest.mark.costly
def test_a_state_beside_the_set_refutes_nothing():
    # cells that a skewed ellipse barely reaches are made larger, and hold points beside it
    needle = rj.Ellipsoid([0.0, 0.0], [[1.0, 0.95], [0.95, 1.0]])
    template, cells = rj.Template.box(2), (7, 7)
    tube = rj.reach_partitioned(
        autonomous(np.eye(2)), needle, 1, template, cells=cells, **RECURSION
    )
    assert any(not isinstance(cell.part, rj.Intersection) for cell in grid(needle, cells))
    for direction in np.array([[1.0, -1.0], [-0.8, 1.0], [1.0, 0.2]]):
        goal = rj.Polytope(direction[None], needle.support(direction[None]) + 1e-9)
        verdict = rj.verify(tube, goal=goal, samples=50)
        assert verdict.status is not rj.VerdictStatus.REFUTED
        assert np.nanmin(verdict.simulated["goal"]) >= -1e-9
    assert np.all(tube.witnesses(1) <= needle.support(template.directions) + 1e-9)


@pytest.mark.costly
def test_the_union_is_tighter_than_one_cell(loop, partitioned):
    whole = recursion(loop, SETS["box"], 3, rj.Template.octagonal(2))
    for t in (1, 2, 3):
        assert np.all(partitioned.bounds(t) <= whole.proof(t).bounds + 1e-7)
        assert np.all(partitioned.witnesses(t) <= partitioned.bounds(t))
        np.testing.assert_array_equal(
            partitioned.gaps(t), partitioned.bounds(t) - partitioned.witnesses(t)
        )
    assert partitioned.gaps(3).sum() < 0.7 * whole.proof(3).gaps.sum()


@pytest.mark.costly
def test_guided_cells_close_the_gap_faster_than_none(loop):
    template = rj.Template.octagonal(2)
    tubes = [
        rj.reach_partitioned(loop, SETS["box"], 2, template, cells=count, **RECURSION)
        for count in (1, 3, 6)
    ]
    assert [len(tube.tubes) for tube in tubes] == [1, 3, 6]
    worst = [max(tube.gaps(t).max() for t in (1, 2)) for tube in tubes]
    assert worst[2] < worst[1] < worst[0]


@pytest.mark.costly
def test_nothing_is_split_where_no_gap_is_left():
    still, template = autonomous(0.5 * np.eye(2)), rj.Template.box(2)
    tube = rj.reach_partitioned(still, SETS["box"], 1, template, cells=4, **RECURSION)
    assert len(tube.tubes) == 1


def test_verdicts_are_those_of_all_cells(loop, partitioned):
    large = rj.Box([-20.0, -20.0], [20.0, 20.0])
    proved = rj.verify(partitioned, safe=large)
    assert proved.status is rj.VerdictStatus.PROVED
    cells = [rj.verify(tube, safe=large) for tube in partitioned.tubes]
    least = np.min([cell.margins["safe"] for cell in cells], axis=0)
    np.testing.assert_array_equal(proved.margins["safe"], least)
    # a corner of the set is avoided: the cell that holds it is refuted, with its trajectory
    corner = rj.Box([1.9, 0.4], [3.0, 1.0])
    refuted = rj.verify(partitioned, avoid={0: [corner]})
    assert refuted.status is rj.VerdictStatus.REFUTED
    assert bool(corner.contains(refuted.counterexample.states[0]))
    bounds = partitioned.bounds(3)
    value = bounds[0] - 0.5 * partitioned.gaps(3)[0]  # between what is reached and what is proved
    direction = partitioned.tubes[0].template.directions[:1]
    unknown = rj.verify(partitioned, goal=rj.Polytope(direction, value[None]))
    assert unknown.status is rj.VerdictStatus.UNKNOWN


class Immediate(ThreadPoolExecutor):
    """Runs what is submitted at once, and notes what kinds of arrays it was sent."""

    def __init__(self):
        super().__init__(1)
        self.kinds = set()

    def submit(self, fn, /, *args, **kwargs):
        self.kinds |= {type(leaf) for leaf in jax.tree.leaves(args)}
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.mark.costly
def test_any_executor_runs_the_cells(loop, partitioned):
    executor, seen = Immediate(), []

    def bar(cells):
        for cell in cells:
            seen.append(cell)
            yield cell

    tube = rj.reach_partitioned(
        loop,
        SETS["box"],
        3,
        rj.Template.octagonal(2),
        cells=(2, 3),
        executor=executor,
        progress=bar,
        **RECURSION,
    )
    assert len(seen) == 6
    assert not any(issubclass(kind, jax.Array) for kind in executor.kinds)
    for t in (1, 2, 3):
        np.testing.assert_array_equal(tube.bounds(t), partitioned.bounds(t))


@pytest.mark.costly
def test_a_cluster_runs_the_cells(loop, partitioned):
    from distributed import Client, LocalCluster

    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        tube = rj.reach_partitioned(
            loop,
            SETS["box"],
            3,
            rj.Template.octagonal(2),
            cells=(2, 3),
            executor=client.get_executor(),
            **RECURSION,
        )
    for t in (1, 2, 3):
        np.testing.assert_allclose(tube.bounds(t), partitioned.bounds(t), atol=1e-9)


@pytest.mark.parametrize("cells", [np.array([2, 1]), jnp.array([2, 1]), np.array(2), np.int64(2)])
@pytest.mark.costly
def test_cells_may_be_counted_by_arrays(loop, cells):
    given = loop, SETS["box"], 1, rj.Template.box(2)
    tube = rj.reach_partitioned(*given, cells=cells, gap=0.0, **RECURSION)
    assert len(tube.tubes) == 2


@pytest.mark.costly
def test_a_gap_ends_the_halving_of_cells(loop):
    given = loop, SETS["box"], 3, rj.Template.octagonal(2)
    few, more = (
        rj.reach_partitioned(*given, cells=6, gap=gap, samples=100, **RECURSION)
        for gap in (0.5, 1e-4)
    )
    assert len(few.tubes) < len(more.tubes) == 6
    plain = rj.reach_partitioned(*given, cells=6, samples=100)
    assert len(plain.tubes) == 1  # the default closes the gaps of the whole set


@pytest.mark.costly
def test_threads_leave_the_filters_of_warnings_alone(loop):
    before = list(warnings.filters)
    rj.reach_partitioned(loop, SETS["box"], 2, rj.Template.box(2), cells=(3, 2), **RECURSION)
    assert warnings.filters == before


@pytest.mark.costly
def test_an_error_in_a_cell_ends_the_run(loop):
    class Broken(rj.Clarabel):
        def solve(self, program, goal):
            raise KeyboardInterrupt("stopped")  # what else a solver raises is a failed proposal

    with pytest.raises(KeyboardInterrupt, match="stopped"):
        rj.reach_partitioned(
            loop, SETS["box"], 1, rj.Template.box(2), rj.LocalBounds(), 1, Broken(), cells=2
        )


BAD = {
    "cells must be a number for each of 2 coordinates": (ValueError, {"cells": (2,)}),
    r"cells\[1\] must be at least 1, but 0": (ValueError, {"cells": (2, 0)}),
    "cells must be at least 1, but 0": (ValueError, {"cells": 0}),
    r"cells must be a whole number, or one for each coordinate, but 2\.5": (
        TypeError,
        {"cells": 2.5},
    ),
    r"cells must be a whole number, or one for each coordinate, but 'ab'": (
        TypeError,
        {"cells": "ab"},
    ),
    r"cells must be a whole number, or one for each .*ndarray arrived": (
        TypeError,
        {"cells": np.array([[2, 2]])},
    ),
    r"cells\[0\] must be a whole number, but 1\.5": (TypeError, {"cells": np.array([1.5, 2])}),
    r"cells\[1\] must be a whole number, but 2\.5": (TypeError, {"cells": (2, 2.5)}),
    r"cells\[1\] must be a whole number, but True": (TypeError, {"cells": (2, True)}),
    r"cells must be a whole number, but True": (TypeError, {"cells": True}),
    "executor must be an object with a method submit.*class": (
        TypeError,
        {"cells": 2, "executor": ThreadPoolExecutor},
    ),
    "progress must wrap an iterable": (TypeError, {"cells": 2, "progress": 3}),
    "template must be a template of facets": (
        TypeError,
        {"cells": 2, "template": rj.EllipsoidTemplate()},
    ),
    "horizon must be at least 1, but 0": (ValueError, {"cells": 2, "horizon": 0}),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named(loop, message):
    kind, changes = BAD[message]
    arguments = {"horizon": 1, "template": rj.Template.box(2)} | changes
    with pytest.raises(kind, match=message):
        rj.reach_partitioned(loop, SETS["box"], **arguments, **RECURSION)


def test_a_traced_set_is_refused(loop):
    def total(upper):
        X0 = rj.Box([1.0, -0.5], upper)
        return rj.reach_partitioned(loop, X0, 1, rj.Template.box(2), cells=2).bounds(1).sum()

    with pytest.raises(ValueError, match=r"call reach_partitioned outside of jax\.jit"):
        jax.jit(total)(jnp.ones(2))
