"""Cells, and bounds of them, as no search proposes them: a file may have any."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

TEMPLATE = rj.Template.box(2)
INWARDS = 0.1
"""What is claimed of the last set is smaller than the set by this much."""


def forged(loop, X0, proofs, tmp_path):
    """A tube of these proofs, as it is read from its file and proved anew."""
    sets = X0, *(TEMPLATE.polytope(proof.bounds) for proof in proofs)
    rj.ReachTube.sealed(loop, TEMPLATE, sets, (None, *proofs), 0).save(tmp_path / "forged")
    again = rj.load(tmp_path / "forged", loop, recheck=True)
    assert isinstance(again, rj.ReachTube)
    return again


def by_cells(loop, X0, k, axes, bounds, proofs=()):
    """A certificate over cells that no search found: it has no witnesses."""
    facets = len(bounds)
    found = {"codes": np.ones(facets, int), "witnesses": np.full(facets, np.nan)}
    found |= {"witness_states": np.full((facets, 2), np.nan), "seconds": np.zeros(facets)}
    own = {"directions": TEMPLATE.at(k).directions, "axes": np.array(axes), "proofs": proofs}
    return rj.CellCertificate(
        loop=loop, X0=X0, k=k, start=0, bounds=jnp.asarray(bounds), **own, **found
    )


@pytest.mark.parametrize(("claimed", "holds"), [(0.0, True), (INWARDS, False)])
def test_cells_of_one_box_are_proved_step_by_step_as_others(claimed, holds, tmp_path):
    """Halves of a coordinate without width are the same box twice."""
    X0 = rj.Box([0.0, 1.0], [1.0, 1.0])
    plant = rj.AffinePlant([[0.5, 0.0], [0.0, 1.0]], [[0.0], [0.0]])
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers([([[0.0, 0.0]], [0.0])]))
    proofs = []
    for k in range(1, 6):
        bounds = np.array([0.5**k, 0.0, 1.0, -1.0]) + 1e-9
        bounds[0] -= claimed * 0.5**k * (k == 3)
        proofs.append(by_cells(loop, X0, k, [1, -1, -1] if k <= 3 else [0, -1, -1], bounds))
    if holds:
        assert (forged(loop, X0, proofs, tmp_path).sets[3].b == proofs[2].bounds).all()
    else:
        with pytest.raises(rj.DisagreementError, match=r"of step 3 proves 0\.125 for facet 0"):
            forged(loop, X0, proofs, tmp_path)


@pytest.fixture(scope="module")
def curved():
    def f(x, u):
        return jnp.array([0.5 * x[0] + 0.1 * x[0] * x[0] + 0.1 * x[1], 0.5 * x[1]]) + 0 * u

    return rj.ClosedLoop(rj.NonlinearPlant(f, 2, 1), rj.Network(lambda x: 0 * x[:1], 2, 1))


@pytest.fixture(scope="module")
def by_programs(curved):
    """A tube by programs, each step's over the set before."""
    X0, method = rj.Box([-0.5, -0.5], [1.0, 1.0]), rj.Recursion(rj.LocalBounds(), 1)
    return rj.reach(curved, X0, 2, TEMPLATE, method)


def over_one_cell(tube, first, last):
    """The proofs of two steps over the whole as a cell: what is said of the cell's own sets."""
    proofs, said = [], (first, last)
    for k in (1, 2):
        own = tube.proof(k).replace(bounds=jnp.asarray(said[k - 1]))
        outer = tube.proof(1).bounds if k == 1 else own.bounds
        proofs.append(by_cells(tube.loop, tube.sets[0], k, [-1], outer, ((own,),)))
    return proofs


def test_sets_that_a_cell_rests_on_may_be_larger_and_are_told_as_they_are(by_programs, tmp_path):
    """A first set as large as its proof says is what the second step is proved over."""
    first, last = (np.asarray(by_programs.proof(k).bounds) for k in (1, 2))
    X0, corners = by_programs.sets[0], jnp.array([[-0.5, -0.5], [1.0, 1.0]])
    again = forged(by_programs.loop, X0, over_one_cell(by_programs, first - 5.0, last), tmp_path)
    ((told,),) = again.proof(1).proofs
    reached = np.asarray(by_programs.loop.simulate(corners, 1))[:, 1]
    assert (told.bounds >= (reached @ TEMPLATE.at(1).directions.T).max(axis=0) - 1e-9).all()
    proofs = over_one_cell(by_programs, first + 1.0, last - INWARDS)
    with pytest.raises(rj.DisagreementError, match="recheck of step 2"):
        forged(by_programs.loop, X0, proofs, tmp_path)


@pytest.mark.parametrize("huge", [1e155, 1e308, np.inf, np.nan])
def test_a_cell_whose_numbers_overflow_proves_nothing(huge, by_programs, tmp_path):
    """From sets so large that programs have no finite numbers nothing follows of the next one."""
    last = np.asarray(by_programs.proof(2).bounds)
    proofs = over_one_cell(by_programs, np.full(4, huge), last - INWARDS)
    with pytest.raises(rj.DisagreementError, match="recheck of step"):
        forged(by_programs.loop, by_programs.sets[0], proofs, tmp_path)
