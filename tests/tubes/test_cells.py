"""Sets of smooth loops by cells of the initial set: what they prove, and what cannot fool them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods.cell_tree import Node
from reachjax.methods.cells import affordable, plant_products
from reachjax.numerics.budget import Budget
from tests.quick_cases import some

PERIOD = 0.1


def pendulum(x, u):
    return jnp.array([x[0] + PERIOD * x[1], x[1] + PERIOD * (5 * jnp.sin(x[0]) + u[0])])


def damped(x, u):
    return 0.9 * x + 0.1 * jnp.sin(x) + jnp.ones(len(x)) * u[0]


def loop_of(states: int) -> rj.ClosedLoop:
    rng = np.random.default_rng(states)
    W = [rng.normal(size=(6, states)), rng.normal(size=(1, 6))]
    net = rj.MLP.from_layers([(W[0], np.zeros(6)), (W[1] / 4, [0.0])], activation=rj.Tanh())
    f = pendulum if states == 2 else damped
    return rj.ClosedLoop(rj.NonlinearPlant(f, states, 1), net, rj.Box([-1.0], [1.0]))


STARTS = {
    "one": rj.Box([-0.5], [0.7]),
    "two": rj.Box([0.1, -0.2], [0.5, 0.3]),
    "flat": rj.Box([0.1, 0.2], [0.5, 0.2]),
    "triangle": rj.Polytope([[-1, 0], [0, -1], [1, 1]], [0.0, 0.0, 0.6]),
    "three": rj.Box([-0.3, 0.0, 0.1], [0.3, 0.4, 0.2]),
}


@pytest.fixture(scope="module", params=list(STARTS))
def tube(request) -> rj.ReachTube:
    X0 = STARTS[request.param]
    relaxation = rj.BranchAndCut(cells=24)
    return rj.reach(loop_of(X0.dimension), X0, 3, rj.Template.box(X0.dimension), relaxation)


@pytest.mark.costly
def test_cells_prove_no_less_than_one_cell_does(tube):
    for t in (1, 2, 3):
        proof = tube.proof(t)
        assert isinstance(proof, rj.CellCertificate)
        assert 1 <= proof.cells <= 24
        assert (proof.recheck() == proof.bounds).all()
        assert (proof.recheck([-1]) >= proof.bounds - 1e-12).all()


@pytest.mark.costly
def test_a_gap_that_may_stay_open_takes_fewer_cells():
    given = loop_of(2), STARTS["two"], 3, rj.Template.box(2)
    few, many = (rj.reach(*given, gap=gap).proof(3).cells for gap in (0.1, 1e-4))
    assert few < many


def test_one_cell_climbs_the_ladder():
    tube = rj.reach(
        loop_of(2), STARTS["two"], 2, rj.Template.box(2), rj.BranchAndCut(cells=1, nodes=10)
    )
    assert isinstance(tube.proof(2), rj.BranchCertificate)


@pytest.mark.costly
def test_a_tube_goes_on():
    tube = rj.reach(loop_of(2), STARTS["two"], 2, rj.Template.box(2)).extended(2)
    whole = rj.reach(loop_of(2), STARTS["two"], 4, rj.Template.box(2))
    np.testing.assert_allclose(tube.sets[4].b, whole.sets[4].b, atol=1e-3)


def test_what_is_interrupted_keeps_what_is_proved(monkeypatch):
    def stopped(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("reachjax.methods.cells._Search.run", stopped)
    with pytest.raises(rj.Interrupted) as caught:
        rj.reach(loop_of(2), STARTS["two"], 3, rj.Template.box(2))
    assert caught.value.tube.horizon == 2


@pytest.mark.costly
def test_what_disturbances_leave_open_is_not_halved_for_ever():
    net = rj.MLP.from_layers([([[1.0, 0.5]], [0.0]), ([[-0.5]], [0.0])], activation=rj.Tanh())
    plant = rj.AffinePlant([[1.0, 0.2], [0.0, 1.0]], [[0.0], [0.3]], E=[[1.0], [1.0]])
    loop = rj.ClosedLoop(plant, net, disturbance=rj.Box([-0.1], [0.1]))
    tube = rj.reach(loop, rj.Box([-0.1, -0.2], [0.3, 0.2]), 2, rj.Template.box(2))
    proof = tube.proof(2)
    assert proof.cells < 60
    assert proof.gaps[:3].max() < 1e-4
    assert (proof.recheck() == proof.bounds).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.costly
def test_a_facet_that_never_moves_is_done():
    def f(x, u):
        return jnp.array([x[0] * x[1] + 0 * u[0], 0.0])

    law = rj.Network(lambda x: -jnp.tanh(x[:1]), inputs=2, outputs=1)
    loop = rj.ClosedLoop(rj.NonlinearPlant(f, 2, 1), law)
    tube = rj.reach(loop, rj.Box([100.0, 0.01], [101.0, 0.0101]), 2, rj.Template.box(2))
    assert tube.proof(2).cells < 40
    np.testing.assert_allclose(tube.sets[1].b, [1.0201, -1.0, 0.0, 0.0], rtol=1e-6)


def test_a_tree_may_be_deep():
    axes = [0, -1] * 2000 + [-1]
    root = node = Node(np.zeros(1), np.ones(1))
    for _ in range(2000):
        node.axis, node.halves = 0, [Node(*node.ends, parent=node) for _ in range(2)]
        node = node.halves[1]
    assert root.axes == axes


DIAMOND = np.array([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


@pytest.mark.parametrize(
    ("kind", "cells", "tolerance"),
    some(
        [("polytope", 1000, 3e-3), ("polytope", 1, 3e-3), ("intersection", 1, 2e-2)],
        lambda kind, *_: kind == "intersection",
    ),
    ids=["cells", "programs", "both"],
)
@pytest.mark.costly
def test_derivatives_in_polytopes_are_those_of_their_facets(kind, cells, tolerance):
    plant = rj.NonlinearPlant(
        lambda x, u: jnp.array([x[0] + 0.2 * x[1], x[1] + 0.1 * jnp.sin(x[0]) + 0.2 * u[0]]), 2, 1
    )
    net = rj.MLP.from_layers([([[1.0, 1.2]], [0.0]), ([[-1.0]], [0.0])], activation=rj.Tanh())
    loop, template = rj.ClosedLoop(plant, net), rj.Template([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.1]])

    def offset(normals, offsets):
        X0 = rj.Polytope(normals, offsets)
        if kind == "intersection":
            X0 = rj.Intersection(X0, rj.Ellipsoid([0.01, 0.02], [[0.015, 0.0], [0.0, 0.01]]))
        limits = {"relaxation": rj.BranchAndCut(cells=cells), "gap": 1e-3, "samples": 200}
        return jnp.sum(rj.reach(loop, X0, 1, template, **limits).sets[1].b)

    at, h = (jnp.asarray(DIAMOND), jnp.array([0.1, 0.12, 0.09, 0.1])), 1e-4
    slopes = jax.grad(offset, argnums=(0, 1))(*at)
    for i, j in [(0, 0), (0, 1), (1, 1), (2, 0)]:
        step = jnp.zeros((4, 2)).at[i, j].set(h)
        along = (offset(at[0] + step, at[1]) - offset(at[0] - step, at[1])) / (2 * h)
        np.testing.assert_allclose(slopes[0][i, j], along, atol=tolerance)
    for i in range(4):
        step = h * jnp.eye(4)[i]
        along = (offset(at[0], at[1] + step) - offset(at[0], at[1] - step)) / (2 * h)
        np.testing.assert_allclose(slopes[1][i], along, atol=tolerance)


def test_fewer_cells_are_affordable_where_a_plant_takes_long():
    net = rj.MLP.from_layers([(np.ones((4, 2)), np.zeros(4)), (np.ones((1, 4)), np.zeros(1))])
    plants = (
        rj.NonlinearPlant(lambda x, u: x + 0.1 * jnp.array([x[1], jnp.sin(x[0]) + u[0]]), 2, 1),
        rj.SampledPlant(lambda x, u: jnp.array([x[1], jnp.sin(x[0]) + u[0]]), 2, 1, 0.1),
    )
    for plant in plants:
        loop = rj.ClosedLoop(plant, net)
        products, counted = affordable(loop, 10, Budget()), plant_products(loop)
        assert affordable(loop, 10, Budget(), counted) < products / 2
    affine = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.ones((2, 1))), net)
    assert plant_products(affine) == 0
