"""Proofs as no search proposes them, of which a file may have any, prove nothing false."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.sets import NormalForm
from reachjax.sets.cells import from_tree
from reachjax.tubes.repeats import Repeat

TEMPLATE = rj.Template.box(2)
INWARDS = 0.1
"""What is claimed of the last set is smaller than the set by this much."""


def forged(loop, X0, proofs, tmp_path, template=TEMPLATE, sets=None):
    """A tube of these proofs, as it is read from its file and proved anew."""
    sets = X0, *(sets or (TEMPLATE.polytope(proof.bounds) for proof in proofs))
    rj.ReachTube.sealed(loop, template, sets, (None, *proofs), 0).save(tmp_path / "forged")
    again = rj.load(tmp_path / "forged", loop, recheck=True)
    assert isinstance(again, rj.ReachTube)
    return again


def by_cells(loop, X0, k, axes, bounds, proofs=(), template=TEMPLATE):
    """A certificate over cells that no search found: it has no witnesses."""
    facets = len(bounds)
    found = {"codes": np.ones(facets, int), "witnesses": np.full(facets, np.nan)}
    found |= {"witness_states": np.full((facets, loop.states), np.nan), "seconds": np.zeros(facets)}
    own = {"directions": template.at(k).directions, "axes": np.array(axes), "proofs": proofs}
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


@pytest.mark.parametrize("level", [-1e-9, 1e300])
def test_facets_are_not_proved_as_if_one_was_an_ellipsoid(level, by_programs, tmp_path):
    """A facet over a level that a file has may be anything."""
    first, honest = by_programs.proof(1), by_programs.proof(2)
    bounds = honest.bounds.at[-1].set(-100.0 if level < 0 else 1e-9)
    common = {
        name: getattr(honest, name)
        for name in ("program", "multipliers", "moments", "codes", "seconds", "witness_states")
    }
    mixed = rj.MixedCertificate(
        **common,
        bounds=bounds,
        witnesses=np.full(4, np.nan),
        solver_offsets=honest.solver_offsets[:-1],
        form=NormalForm(np.eye(1), np.ones(1)),
        level=np.array(level),
    )
    with pytest.raises(rj.DisagreementError, match="MixedCertificate proves no set"):
        forged(by_programs.loop, by_programs.sets[0], [first, mixed], tmp_path)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_level_below_zero_makes_no_ellipsoid_smaller(sign, curved, tmp_path):
    X0, template = rj.Box([-0.5, -0.5], [1.0, 1.0]), rj.EllipsoidTemplate()
    tube = rj.reach(curved, X0, 1, template)
    proof = tube.proof(1)
    claimed = 1.0 if sign > 0 else -INWARDS
    changed = proof.replace(
        level=sign * proof.level,
        bounds=jnp.array([claimed]),
        witnesses=np.full(1, np.nan),
    )
    ball = rj.Ellipsoid.enclosing(proof.form, abs(claimed) * proof.level)
    given = curved, X0, [changed], tmp_path, template, [ball]
    if sign > 0:
        assert (forged(*given).sets[1].shape == tube.sets[1].shape).all()
    else:
        with pytest.raises(rj.DisagreementError, match="recheck of step 1"):
            forged(*given)


def test_forms_of_parts_of_one_box_are_of_each_part():
    """A thin set's half along a coordinate without width has its box, and is not round."""
    axes, c = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2), np.array([0.01, 0.0, 0.0])
    shape = np.diag([0.0, 0.0, 0.1])
    shape[:2, :2] = axes.T @ np.diag([1.4**2, 0.007**2]) @ axes
    needle = rj.Intersection(rj.Box([-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]), rj.Ellipsoid(c, shape))
    tree = [2, -1, 0, -3, -3]
    kinds = {type(cell.whole.part) for cell in from_tree(needle, tree)}
    assert kinds == {rj.Polytope, rj.Intersection}
    plant = rj.NonlinearPlant(lambda x, u: x + 0.01 * jnp.sin(x) + 0 * u, 3, 1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: 0 * x[:1], 3, 1))
    template = rj.Template.box(3)
    proof = by_cells(loop, needle, 1, tree, np.full(6, 9.0), template=template)
    sets = needle, template.polytope(np.full(6, 9.0))
    tube = rj.ReachTube.sealed(loop, template, sets, (None, proof), 0)
    _, found = Repeat(tube, [needle]).of(1, proof)
    np.testing.assert_allclose(found, proof.recheck(), rtol=1e-9)
