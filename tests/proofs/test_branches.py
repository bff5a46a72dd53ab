"""Whatever multipliers, phases and weights arrive, what branches prove holds."""

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax import Box
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon
from reachjax.programs.initial import InitialColumns
from reachjax.proofs.branches import (
    BranchCertificate,
    Branches,
    HorizonFacts,
    Rung,
    bounds_of,
    covered,
    leaf_bounds,
)
from tests.closed_loops import initial_set, on_host, switching_loop, that_switches

HORIZON = 3


def random_tree(rng, pairs, depth):
    """Phases of the leaves of a tree that splits at random."""
    held = np.full(pairs, -1)

    def grown(held, left):
        free = np.flatnonzero(held < 0)
        if not left or not len(free) or rng.uniform() < 0.2:
            return [held]
        pair = rng.choice(free)
        sides = [np.where(np.arange(pairs) == pair, side, held) for side in (0, 1)]
        return [leaf for side in sides for leaf in grown(side, left - 1)]

    return np.array(grown(held, depth))


def leaves_out_nothing(phases):
    """Whether each pattern of all phases is in some leaf."""
    pairs = phases.shape[1]
    patterns = np.array(np.meshgrid(*[[0, 1]] * pairs)).reshape(pairs, -1).T
    fits = (phases[None] < 0) | (phases[None] == patterns[:, None])
    return bool(fits.all(axis=2).any(axis=1).all())


@pytest.mark.parametrize("seed", range(20))
def test_the_leaves_of_a_tree_leave_nothing_out(seed):
    rng = np.random.default_rng(seed)
    phases = random_tree(rng, pairs=5, depth=4)
    assert covered(phases)
    assert covered(rng.permutation(phases))
    assert leaves_out_nothing(phases)


@pytest.mark.parametrize("seed", range(20))
def test_a_tree_without_a_leaf_leaves_something_out(seed):
    rng = np.random.default_rng(seed)
    phases = random_tree(rng, pairs=5, depth=4)
    for leaf in range(len(phases)):
        assert not covered(np.delete(phases, leaf, axis=0))


@pytest.mark.parametrize("seed", range(100))
def test_leaves_that_cover_leave_nothing_out(seed):
    """Leaves at random: few of them cover, and those that do must leave nothing out."""
    rng = np.random.default_rng(seed)
    phases = rng.integers(-1, 2, size=(rng.integers(1, 9), 2))
    assert leaves_out_nothing(phases) or not covered(phases)


@pytest.mark.parametrize(
    ("phases", "expected"),
    {
        "nothing at all": (np.zeros((0, 3)), False),
        "a leaf that holds nothing": ([[-1, -1]], True),
        "no pairs": (np.zeros((1, 0)), True),
        "one side": ([[0, -1]], False),
        "one side twice": ([[0, -1], [0, -1]], False),
        "two pairs, neither split": ([[0, -1], [-1, 1]], False),
        "the same leaf twice in a tree": ([[0, 1], [0, 1], [1, -1]], False),
        "one more than a tree": ([[0, -1], [1, 0], [1, 1], [1, 1]], True),
    }.values(),
)
def test_only_trees_cover(phases, expected):
    assert covered(np.asarray(phases, dtype=int)) is expected


CASES = [
    (1, "box", {"activation": rj.HardTanh()}),
    (2, "polytope", {}),
    (3, "box", {"activation": rj.LeakyReLU(0.1)}),
    (3, "ellipsoid", {}),
    (6, "box", {}),
]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def case(request):
    """(proof of the last step, largest sampled values of its directions)."""
    n_x, kind, options = request.param
    X0, template = initial_set(kind, n_x, seed=n_x), rj.Template.box(n_x)
    loop = that_switches(
        lambda seed: switching_loop(n_x, seed=seed, hidden=(4, 3), **options), X0, n_x + 20
    )
    tube = rj.reach(loop, X0, HORIZON, template, samples=100, gap=0.01)
    proof = tube.proof(HORIZON)
    runs = np.asarray(tube.simulate(3000, seed=5))[:, -1]
    directions = np.asarray(template.directions)
    return proof.replace(products=None, by_products=np.zeros(0, int)), (runs @ directions.T).max(0)


def test_facets_of_several_states_take_linear_programs(case):
    proof, _ = case
    assert proof.about.facts.rows.size
    assert proof.about.start.spread.shape[0] == 1 or max(proof.ways) >= Rung.LINEAR_PROGRAM


def test_the_recheck_is_the_bound(case):
    proof, attained = case
    assert np.all(proof.recheck() >= attained - 1e-12)
    by_branches = np.asarray(proof.rungs) < Rung.PRODUCTS
    assert by_branches.any()
    found = proof.recheck()[by_branches]
    np.testing.assert_allclose(found, np.asarray(proof.bounds)[by_branches], atol=1e-12)
    np.testing.assert_array_equal(proof.recheck(proof.branches.multipliers), proof.recheck())


def garbage(kind, own, rng):
    return {
        "normal": lambda: rng.normal(size=own.shape),
        "positive": lambda: rng.exponential(size=own.shape),
        "wrong signs": lambda: -own,
        "three times": lambda: 3 * own,
        "permuted": lambda: rng.permuted(own, axis=1),
        "of other leaves": lambda: own[::-1],
        "huge": lambda: 1e200 * rng.normal(size=own.shape),
        "beyond all numbers": lambda: 1e308 * rng.choice([-1.0, 1.0], size=own.shape),
        "tiny": lambda: 1e-300 * rng.normal(size=own.shape),
        "zero": lambda: np.zeros_like(own),
    }[kind]()


KINDS = [
    "normal",
    "positive",
    "wrong signs",
    "three times",
    "permuted",
    "of other leaves",
    "huge",
    "beyond all numbers",
    "tiny",
    "zero",
]


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_by_garbage_hold(case, kind):
    proof, attained = case
    own = np.asarray(proof.branches.multipliers)
    found = proof.recheck(garbage(kind, own, np.random.default_rng(0)))
    assert np.all(found >= attained - 1e-12)
    _, upper = proof.about.rows.ends(proof.about.start)
    assert np.all(found <= np.asarray(upper) + 1e-12)


def test_without_multipliers_forms_bound_the_facets(case):
    proof, _ = case
    found = proof.recheck(np.zeros_like(proof.branches.multipliers))
    np.testing.assert_allclose(found, proof.about.rows.ends(proof.about.start)[1], atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_multipliers_that_are_no_numbers_are_named(case, bad):
    proof, _ = case
    multipliers = np.array(proof.branches.multipliers)
    multipliers[0, 0] = bad
    with pytest.raises(ValueError, match="multipliers must be finite"):
        proof.recheck(multipliers)


@pytest.mark.parametrize("shape", [lambda m: m[:, :-1], lambda m: m[0], lambda m: m[None], len])
def test_multipliers_of_another_shape_are_named(case, shape):
    proof, _ = case
    with pytest.raises(ValueError, match=r"shape .*\(leaves, facts\)"):
        proof.recheck(shape(np.asarray(proof.branches.multipliers)))


@pytest.fixture(scope="module")
def split():
    """A proof of which most facets have several leaves, and sampled values."""
    loop, X0 = switching_loop(3, seed=4, hidden=(4, 3)), initial_set("box", 3, seed=4)
    tube = rj.reach(loop, X0, 2, rj.Template.box(3), gap=1e-6, samples=100)
    proof, runs = jax.device_get(tube.proof(2)), np.asarray(tube.simulate(5000, seed=5))[:, -1]
    assert np.median(np.bincount(proof.branches.owner)) >= 2
    return proof, (runs @ np.asarray(tube.template.directions).T).max(axis=0)


def without(branches, leaf):
    """All leaves but one."""
    parts = branches.owner, branches.phases, branches.multipliers, branches.weights
    return Branches(*(np.delete(part, leaf, axis=0) for part in parts))


def test_a_facet_without_one_of_its_leaves_is_bounded_by_its_form_alone(split):
    proof, _ = split
    _, upper = proof.about.rows.ends(proof.about.start)
    plain = proof.recheck()
    for leaf, owner in enumerate(proof.branches.owner):
        rest = without(proof.branches, leaf)
        assert bounds_of(rest, leaf_bounds(proof.about, rest), 6)[owner] == np.inf
        found = proof.replace(branches=rest).recheck()
        assert found[owner] == upper[owner] > plain[owner] + 1e-6
        others = np.delete(found, owner), np.delete(plain, owner)
        np.testing.assert_allclose(*others, rtol=1e-12)  # sums of other lengths round otherwise


def test_a_leaf_of_another_facet_covers_nothing(split):
    proof, attained = split
    owner = np.roll(proof.branches.owner, 1)  # with its phases, multipliers and weights
    moved = proof.replace(branches=proof.branches.replace(owner=owner))
    assert np.all(moved.recheck() >= attained - 1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_exchanged_phases_prove_what_holds(split, seed):
    proof, attained = split
    rng, phases = np.random.default_rng(seed), np.asarray(proof.branches.phases)
    flipped = np.where(phases >= 0, 1 - phases, phases)
    somewhere = np.where(rng.uniform(size=phases.shape) < 0.02, rng.integers(-1, 2), phases)
    for other in (flipped, rng.permutation(phases, axis=1), somewhere, np.full_like(phases, -1)):
        branches = proof.branches.replace(phases=other)
        assert np.all(proof.replace(branches=branches).recheck() >= attained - 1e-12)


def test_leaves_rest_on_their_phases(split):
    """Else multipliers of any sign would be taken everywhere."""
    proof, _ = split
    branches = proof.branches.replace(phases=np.full_like(proof.branches.phases, -1))
    given, taken = leaf_bounds(proof.about, branches), leaf_bounds(proof.about, proof.branches)
    assert np.all(given >= taken - 1e-12)
    assert np.any(given > taken + 1e-3)


@pytest.fixture(scope="module")
def several():
    """(facts with three rows, the least of which is bounded, its sampled values)."""
    loop, X0 = switching_loop(2, seed=2), initial_set("box", 2, seed=2)
    horizon = Horizon(*on_host(loop, X0))
    for _ in range(2):
        horizon.advance()
    C = np.array([[1.0, 0.2], [-0.7, 1.0], [-0.3, -1.0]])
    rows = C @ horizon.state
    states = np.random.default_rng(0).uniform(X0.lower, X0.upper, size=(5000, 2))
    runs = np.asarray(loop.simulate(states, 2))
    return HorizonFacts(horizon.start, horizon.facts, horizon.zero, rows), runs[:, -1] @ C.T


def one_leaf(about, weights, multipliers=None):
    shape = (1, len(about.facts.rows))
    multipliers = np.zeros(shape) if multipliers is None else multipliers
    none = np.full((1, len(about.zero)), -1)
    return Branches(np.zeros(1, int), none, multipliers, np.asarray(weights, float)[None])


@pytest.mark.parametrize("seed", range(10))
def test_any_weights_bound_the_least_of_several_rows(several, seed):
    about, values = several
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=3) * 10.0 ** rng.uniform(-3, 3)
    multipliers = rng.exponential(size=(1, len(about.facts.rows))) * (seed % 2)
    found = leaf_bounds(about, one_leaf(about, weights, multipliers))
    assert found[0] >= values.min(axis=1).max() - 1e-12


def test_negative_weights_count_as_none(several):
    about, _ = several
    found = leaf_bounds(about, one_leaf(about, [0.5, -2.0, 0.5]))
    np.testing.assert_array_equal(found, leaf_bounds(about, one_leaf(about, [1.0, 0.0, 1.0])))


@pytest.mark.parametrize("weights", [[0.0, 0.0, 0.0], [-1.0, 0.0, -3.0], [np.nan] * 3])
def test_weights_that_weigh_nothing_prove_nothing(several, weights):
    about, values = several
    found = leaf_bounds(about, one_leaf(about, weights))
    assert found[0] >= values.min(axis=1).max()
    assert np.isinf(found[0])


@pytest.mark.parametrize("weights", [[1e308] * 3, [1e308, 1e-308, 0.0], [5e-324] * 3])
def test_weights_of_any_size_bound_the_least_of_several_rows(several, weights):
    about, values = several
    found = leaf_bounds(about, one_leaf(about, weights))
    assert values.min(axis=1).max() <= found[0] < np.inf


@pytest.mark.parametrize("weights", [[np.inf, 1.0, 1.0], [np.inf] * 3])
def test_infinite_weights_prove_nothing(several, weights):
    about, _ = several
    assert np.isinf(leaf_bounds(about, one_leaf(about, weights))[0])


@pytest.mark.costly
def test_shares_that_are_rounded_bound_the_least_all_the_same():
    """Of three rows that are the same constant: a third thrice is not quite one."""
    start = InitialColumns.of(Box([0.0], [1.0]), Box([0.0], [1.0]))
    state = jax.device_get(AffineForms.beginning(start))
    for constant in (1e6, -1e6):
        rows = np.zeros((7, 1)) @ state + constant
        about = HorizonFacts(start, state[:0], np.zeros((0, 2), dtype=int), rows)
        for weights in np.random.default_rng(0).exponential(size=(200, 7)):
            leaf = Branches(
                np.zeros(1, int), np.zeros((1, 0), int), np.zeros((1, 0)), weights[None]
            )
            assert constant <= leaf_bounds(about, leaf)[0] <= constant + 1e-13 * abs(constant)


def test_a_proof_has_as_many_bounds_as_rows(split):
    proof, _ = split
    with pytest.raises(ValueError, match=r"BranchCertificate\.bounds must be 6 of 6 rows, but 1"):
        proof.replace(bounds=proof.bounds[:1])
    with pytest.raises(ValueError, match="must be 1 of 6 rows, but 6 arrived"):
        proof.replace(least=True)


def test_leaves_of_a_thousand_splits_cover_everything():
    count = 1200
    leaf, pair = np.indices((count + 1, count))
    phases = np.where(pair < leaf, 0, np.where(pair == leaf, 1, -1))
    assert covered(phases)
    assert not covered(np.delete(phases, 700, axis=0))


def test_the_best_of_several_rows_bounds_the_least(several):
    about, values = several
    _, upper = about.rows.ends(about.start)
    nothing = one_leaf(about, [0.0, 0.0, 0.0])
    one = np.zeros(1)
    proof = BranchCertificate(
        codes=one.astype(int),
        bounds=one,
        witnesses=one,
        witness_states=np.zeros((1, 2)),
        seconds=one,
        about=about,
        branches=nothing,
        products=None,
        by_products=np.zeros(0, int),
        rungs=one.astype(int),
        nodes=one.astype(int),
        least=True,
    )
    assert proof.recheck() == [upper.min()]
    assert upper.min() >= values.min(axis=1).max()


def test_the_ways_are_counted_where_a_proof_is_shown(split):
    proof, _ = split
    splits = proof.ways.count(Rung.PHASE_SPLITS)
    assert splits >= 3
    assert f"phase_splits={splits}" in repr(proof)
    assert "products" not in repr(proof)
