"""Methods are objects: each yields sets that hold, and cells take any of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods.affine_forms import AffineForms
from reachjax.methods.branch_and_cut import Branching
from reachjax.methods.cells import Cells
from reachjax.methods.problem import AbstractMethod
from reachjax.methods.recursion import Recursion
from reachjax.tubes.repeats import DisagreementError
from tests.networks import he_network

HORIZON, FEW = 3, 3
X0, TEMPLATE = rj.Box([-0.6, -0.4], [0.5, 0.6]), rj.Template.box(2)


def swing(x, u):
    return jnp.array([x[0] + 0.2 * x[1], x[1] + 0.2 * (jnp.sin(x[0]) + 2 * u[0])])


@pytest.fixture(scope="module")
def switching():
    net = rj.MLP.from_layers(he_network((2, 6, 1), 5))
    return rj.ClosedLoop(rj.NonlinearPlant(swing, 2, 1), net, rj.Box([-1.0], [1.0]))


@pytest.fixture(scope="module")
def affine():
    plant = rj.AffinePlant([[1.0, 0.2], [0.0, 1.0]], [[0.0], [0.4]])
    net = rj.MLP.from_layers(he_network((2, 6, 1), 5))
    return rj.ClosedLoop(plant, net, rj.Box([-1.0], [1.0]))


def branching(nodes: int = 20) -> Branching:
    return Branching(rj.BranchAndCut(nodes=nodes))


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (AffineForms(), {"relaxation": rj.LinearBounds()}),
        (Recursion(rj.PaperQC(), 1), {"relaxation": rj.PaperQC(), "window": 1}),
        (Branching(rj.BranchAndCut()), {"relaxation": rj.BranchAndCut()}),
    ],
)
def test_relaxations_stand_for_methods(affine, method, options):
    one, other = (
        rj.reach(affine, X0, 2, TEMPLATE, **each) for each in ({"relaxation": method}, options)
    )
    for t in (1, 2):
        np.testing.assert_array_equal(one.sets[t].b, other.sets[t].b)


@pytest.fixture(scope="module")
def by_cells(switching):
    return rj.reach(switching, X0, HORIZON, TEMPLATE, Cells(branching(), FEW), gap=1e-6)


def test_cells_of_branches_are_tighter_than_both(switching, by_cells):
    for other in (AffineForms(), branching(), Cells(AffineForms(), FEW)):
        tube = rj.reach(switching, X0, HORIZON, TEMPLATE, other, gap=1e-6)
        assert (np.asarray(by_cells.sets[3].b) <= np.asarray(tube.sets[3].b) + 1e-9).all()
    assert any(by_cells.proof(3).proofs)
    own = np.sum(np.asarray(by_cells.proof(3).axes) == -1)
    assert 1 < own <= FEW


def test_cells_say_what_they_take():
    with pytest.raises(TypeError, match="inner must be a method"):
        Cells(rj.LinearBounds())  # ty: ignore[invalid-argument-type]
    with pytest.raises(ValueError, match="most must be"):
        Cells(most=0)


def test_tubes_by_cells_that_went_on_are_proved_again(switching, tmp_path):
    """Proofs of the first steps over later cells are kept as well."""
    options = {"relaxation": Cells(branching(), FEW), "gap": 1e-6}
    tube = rj.reach(switching, X0, 1, TEMPLATE, **options).extended(2, **options)
    assert len(tube.proof(2).proofs[0]) == 2 or not tube.proof(2).proofs[0]
    tube.save(tmp_path / "tube")
    again = rj.load(tmp_path / "tube", switching, recheck=True)
    assert isinstance(again, rj.ReachTube)
    for t in (1, 2, 3):
        np.testing.assert_allclose(again.sets[t].b, tube.sets[t].b, rtol=0, atol=1e-9)


def test_proofs_of_other_cells_prove_nothing_of_use(by_cells, tmp_path):
    """A file may say anything: proofs that change places belong to other cells."""
    proofs = list(by_cells.certificates)
    proofs[3] = proofs[3].replace(proofs=proofs[3].proofs[::-1], bounds=proofs[3].bounds - 0.05)
    sets = (*by_cells.sets[:3], TEMPLATE.polytope(proofs[3].bounds))
    forged = rj.ReachTube.sealed(by_cells.loop, TEMPLATE, sets, tuple(proofs), 0)
    forged.save(tmp_path / "forged")
    with pytest.raises(DisagreementError):
        rj.load(tmp_path / "forged", by_cells.loop, recheck=True)


@pytest.mark.costly
def test_derivatives_of_cells_of_branches_are_those_of_what_decides(switching):
    def size(upper):
        start = rj.Box([-0.6, -0.4], upper)
        tube = rj.reach(switching, start, 2, TEMPLATE, Cells(branching(), 2), gap=1e-6)
        return jnp.sum(tube.sets[2].b)

    at, step = jnp.array([0.5, 0.6]), 1e-5
    slopes = jax.grad(size)(at)
    for i in range(2):
        along = step * jnp.eye(2)[i]
        difference = (size(at + along) - size(at - along)) / (2 * step)
        np.testing.assert_allclose(slopes[i], difference, rtol=2e-2, atol=1e-3)


class Intervals(AbstractMethod):
    """Boxes around the successors of boxes, as a user may write them: by forms of one step each."""

    def sets(self, problem, known=()):
        given = problem.template, AffineForms()
        X = problem.X0
        for k in range(len(known), problem.horizon):
            tube = rj.reach(problem.loop, X, 1, *given, start=problem.start + k)
            X = tube.sets[1]
            yield tube.reached[0]


def test_a_method_of_a_users_own_is_one_class(affine):
    tube = rj.reach(affine, X0, HORIZON, TEMPLATE, Intervals())
    forms = rj.reach(affine, X0, HORIZON, TEMPLATE, AffineForms())
    np.testing.assert_array_equal(tube.sets[1].b, forms.sets[1].b)
    states = np.asarray(tube.simulate(500))
    for t in (1, 2, 3):
        assert bool(tube.sets[t].contains(states[:, t], 1e-9).all())


@pytest.mark.parametrize("method", [Cells(AffineForms(), 2), Recursion(rj.LocalBounds())])
def test_methods_that_need_numbers_say_so(affine, method):
    def size(upper):
        return jnp.sum(rj.reach(affine, rj.Box([-1.0, -1.0], upper), 1, TEMPLATE, method).sets[1].b)

    with pytest.raises(ValueError, match=r"chosen from numbers"):
        jax.jit(size)(jnp.ones(2))
