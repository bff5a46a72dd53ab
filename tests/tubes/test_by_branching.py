"""Claims about the default's tubes: sound whatever they may spend, and tight where they may."""

import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.branches import Rung
from tests.closed_loops import initial_set, switching_loop, that_switches

HORIZON = 3

CASES = [
    (1, "box", {"activation": rj.HardTanh()}, 0),
    (2, "polytope", {}, 0),
    (2, "ellipsoid", {"activation": rj.LeakyReLU(0.1)}, 0),
    (3, "box", {"residual": True}, 0),
    (2, "box", {"steps": HORIZON + 2}, 2),
    (6, "box", {}, 0),
]


def made(n_x, kind, options):
    X0 = initial_set(kind, n_x, seed=n_x)
    return that_switches(
        lambda seed: switching_loop(n_x, seed=seed, hidden=(4, 3), **options), X0, n_x + 20
    ), X0


def above_samples(tube, samples=3000):
    """The least that an offset is above what is sampled, over all times."""
    runs = np.asarray(tube.simulate(samples, seed=7))
    rows = np.asarray(tube.template.directions)
    return min(
        float(np.min(X.b - (runs[:, k] @ rows.T).max(axis=0)))
        for k, X in enumerate(tube.sets[1:], start=1)
    )


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}-{case[3]}")
def case(request):
    """(loop, X0, start, tube)."""
    n_x, kind, options, start = request.param
    loop, X0 = made(n_x, kind, options)
    return loop, X0, start, rj.reach(loop, X0, HORIZON, rj.Template.box(n_x), start=start)


def test_a_rung_is_what_a_bound_rests_on(case):
    *_, tube = case
    for k in range(1, HORIZON + 1):
        proof = tube.proof(k)
        _, forms = proof.about.rows.ends(proof.about.start)
        leaves = np.bincount(proof.branches.owner)
        assert np.all(np.asarray(proof.nodes)[leaves > 1] >= 3)
        for i, way in enumerate(proof.ways):
            if way is Rung.AFFINE_FORM:
                assert proof.bounds[i] == forms[i]
            else:
                assert proof.bounds[i] < forms[i]
                assert way is Rung.PRODUCTS or (leaves[i] > 1) == (way is Rung.PHASE_SPLITS)


def test_without_nodes_the_tube_is_that_of_affine_forms(case):
    loop, X0, start, tube = case
    cheap = rj.BranchAndCut(nodes=0)
    template = rj.Template.box(loop.states)
    loose = rj.reach(loop, X0, HORIZON, template, cheap, start=start, gap=1e9)
    assert above_samples(loose) >= -1e-12
    for k in range(1, HORIZON + 1):
        assert set(loose.proof(k).ways) == {Rung.AFFINE_FORM}
        assert not np.asarray(loose.proof(k).nodes).any()
        assert np.all(loose.sets[k].b >= np.asarray(tube.sets[k].b) - 1e-9)
    assert np.max(loose.sets[HORIZON].b - tube.sets[HORIZON].b) > 1e-3


@pytest.mark.costly
def test_a_larger_gap_leaves_no_more_than_that_open(case):
    loop, X0, start, tube = case
    template = rj.Template.box(loop.states)
    loose = rj.reach(loop, X0, HORIZON, template, start=start, gap=0.3)
    runs = np.asarray(tube.simulate(3000, seed=7))
    for k in range(1, HORIZON + 1):
        ranges = np.ptp(runs[:, k] @ np.asarray(tube.template.directions).T, axis=0) / 2
        assert np.all(np.asarray(loose.proof(k).gaps) <= 0.31 * ranges)
        assert np.all(loose.sets[k].b >= np.asarray(tube.sets[k].b) - 2e-4 * ranges)
        assert np.sum(loose.proof(k).nodes) <= np.sum(tube.proof(k).nodes)
    assert above_samples(loose) >= -1e-12


@pytest.fixture(scope="module")
def small():
    """(loop, X0, tube) of two states."""
    loop, X0 = made(2, "box", {})
    return loop, X0, rj.reach(loop, X0, 2, rj.Template.box(2), samples=100)


@pytest.mark.costly
def test_it_is_as_tight_as_products_alone(small):
    loop, X0, tube = small
    other = rj.reach(loop, X0, 2, rj.Template.box(2), rj.CuttingPlanes(), samples=100)
    for ours, theirs in zip(tube.sets[1:], other.sets[1:], strict=True):
        ranges = np.asarray(ours.bounding_box().widths).max()
        assert np.all(np.asarray(ours.b) <= np.asarray(theirs.b) + 1e-4 * ranges)
        assert np.all(abs(np.asarray(ours.b) - np.asarray(theirs.b)) <= 1e-2 * ranges)


@pytest.mark.parametrize("name", ["gap", "time_limit"])
@pytest.mark.parametrize(
    ("value", "kind"),
    [("1", TypeError), ([1.0], TypeError), (True, TypeError)]
    + [(bad, ValueError) for bad in (-1.0, np.nan, np.inf)],
)
def test_limits_that_are_none_are_named(small, name, value, kind):
    loop, X0, _ = small
    with pytest.raises(kind, match=name):
        rj.reach(loop, X0, 2, rj.Template.box(2), **{name: value})


def test_a_gap_of_nothing_at_all_is_named(small):
    loop, X0, _ = small
    with pytest.raises(TypeError, match="gap"):
        rj.reach(loop, X0, 2, rj.Template.box(2), gap=None)


@pytest.mark.parametrize(
    ("options", "kind", "name"),
    [
        ({"nodes": -1}, ValueError, "nodes"),
        ({"nodes": 1.5}, TypeError, "nodes"),
        ({"nodes": None}, TypeError, "nodes"),
        ({"products_by": rj.PaperQC()}, TypeError, "products_by"),
    ],
)
def test_budgets_that_are_none_are_named(options, kind, name):
    with pytest.raises(kind, match=f"BranchAndCut.{name}"):
        rj.BranchAndCut(**options)
