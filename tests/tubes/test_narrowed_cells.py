"""Cells that are narrowed: parts of a cell keep its forms where these prove enough."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods import cells
from reachjax.programs.unrolled import subbox_columns, unrolled
from reachjax.sets.cells import from_tree
from reachjax.tubes import repeats

STEPS = 2
LOWER, UPPER = np.array([-0.5, -0.3]), np.array([0.7, 0.6])


def swung(x, u):
    return jnp.array([x[0] + 0.2 * x[1], x[1] + 0.4 * jnp.sin(x[0]) + 0.3 * x[0] * x[1] + u[0]])


def law(x):
    return jnp.tanh(jnp.array([-1.5 * x[0] - x[1]]))


@pytest.fixture(scope="module")
def loop():
    return rj.ClosedLoop(rj.NonlinearPlant(swung, states=2, inputs=1), rj.Network(law, 2, 1))


def reached(loop, **options):
    return rj.reach(loop, rj.Box(LOWER, UPPER), STEPS, rj.Template.box(2), **options)


@pytest.fixture(scope="module")
def tube(loop):
    return reached(loop)


def inherited(proof):
    return int((np.asarray(proof.axes) < -1).sum())


def test_narrowed_cells_take_fewer_forms_and_bounds_are_as_small(loop, tube, monkeypatch):
    """Whatever halves keep the forms of a cell for, no bound is larger than the gap allows."""
    monkeypatch.setattr(cells, "LEFT_ASIDE", 0)
    plain = reached(loop)
    assert inherited(tube.proof(STEPS))
    assert not inherited(plain.proof(STEPS))
    own = tube.proof(STEPS).cells - inherited(tube.proof(STEPS))
    assert own < plain.proof(STEPS).cells
    for k in range(1, STEPS + 1):
        found, before = (np.asarray(each.sets[k].facets[1]) for each in (tube, plain))
        ranges = before.reshape(2, -1).sum(axis=0)
        assert (found - before <= 1e-4 * np.tile(ranges, 2)).all()  # the gap that may stay open


def test_states_are_inside(loop, tube):
    starts = jax.random.uniform(jax.random.key(0), (2000, 2), minval=LOWER, maxval=UPPER)
    runs = np.asarray(loop.simulate(starts, STEPS))
    for k in range(1, STEPS + 1):
        A, b = map(np.asarray, tube.sets[k].facets)
        assert (runs[:, k] @ A.T <= b).all()


def test_proofs_are_rechecked_from_files_too(loop, tube, tmp_path):
    tube.save(tmp_path / "tube.npz")
    for each in (tube, rj.load(tmp_path / "tube.npz", loop=loop)):
        proof = each.proof(STEPS)
        assert inherited(proof)
        assert (proof.recheck() == proof.bounds).all()


def test_a_tube_is_proved_anew_by_as_many_forms_as_it_rests_on(loop, tube, tmp_path, monkeypatch):
    begun = []

    def counted(*given, **options):
        begun.append(given[2])
        return unrolled(*given, **options)

    monkeypatch.setattr(repeats, "unrolled", counted)
    tube.save(tmp_path / "tube.npz")
    again = rj.load(tmp_path / "tube.npz", loop=loop, recheck=True)
    assert isinstance(again, rj.ReachTube)
    for k in range(1, STEPS + 1):
        assert (again.sets[k].b == tube.sets[k].b).all()
        assert (again.proof(k).bounds == tube.proof(k).bounds).all()
    proofs = [tube.proof(k) for k in range(1, STEPS + 1)]
    wholes = [
        {np.asarray(cell.whole.box.lower).tobytes() for cell in from_tree(proof.X0, axes)}
        for proof in proofs
        for axes in [np.asarray(proof.axes).tolist()]
    ]
    assert len(begun) <= sum(map(len, wholes)) < sum(proof.cells for proof in proofs)


def test_forms_over_a_part_hold_there_and_are_no_larger(loop):
    """What forms of the set say of a part is checked by states from the part."""
    rng, X0 = np.random.default_rng(0), rj.Box(LOWER, UPPER)
    directions = rng.normal(size=(STEPS, 12, 2))
    steps = list(unrolled(loop, X0, X0, directions))
    for _ in range(20):
        ends = np.sort(rng.uniform(LOWER, UPPER, size=(2, 2)), axis=0)
        columns = subbox_columns(loop, X0, X0, rj.Box(*ends))
        runs = np.asarray(loop.simulate(rng.uniform(*ends, size=(200, 2)), STEPS))
        for k, step in enumerate(steps):
            over = step.over_part(columns)
            values = runs[:, k + 1] @ directions[k].T
            assert (values <= over.offsets).all()
            assert (over.offsets <= step.offsets).all()
            width = np.ptp(values, axis=0)
            assert (over.offsets - values.max(axis=0)).mean() < width.mean() + 0.3


def test_the_whole_as_a_part_of_itself_has_its_bounds(loop):
    X0 = rj.Box(LOWER, UPPER)
    for step in unrolled(loop, X0, X0, np.tile([[1.0, 0.5], [-0.3, 1.0]], (STEPS, 1, 1))):
        over = step.over_part(subbox_columns(loop, X0, X0, X0))
        np.testing.assert_allclose(over.offsets, step.offsets, rtol=1e-12)


def test_derivatives_are_those_of_the_bounds(loop):
    """The same cells of a set that moves and grows have bounds with these derivatives."""
    directions = jnp.array([1.0, 0.4, -0.7, 0.2])

    def ends(shift, scale):
        return LOWER * scale + shift, UPPER * scale + shift

    def bounds(given):
        X0 = rj.Box(*ends(*given))
        tube = rj.reach(loop, X0, STEPS, rj.Template.box(2), gap=0.02)
        return directions @ tube.sets[STEPS].facets[1]

    proof = reached(loop, gap=0.02).proof(STEPS)
    own = proof.recheck(np.maximum(np.asarray(proof.axes), -1))
    assert (own < proof.bounds - 1e-9).any()  # a cell that keeps other forms decides a facet
    slopes = jax.grad(bounds)((0.0, 1.0))

    def again(*given):
        moved = dataclasses.replace(proof, X0=rj.Box(*map(jnp.asarray, ends(*given))))
        return float(directions @ moved.recheck())

    step = 1e-5
    for slope, (one, other) in zip(
        slopes, (((step, 1.0), (-step, 1.0)), ((0.0, 1 + step), (0.0, 1 - step))), strict=True
    ):
        np.testing.assert_allclose(slope, (again(*one) - again(*other)) / (2 * step), rtol=1e-4)


@pytest.mark.parametrize("axes", [[-2], [0, -3, -1], [0, -2, 1, -1, -4]])
def test_a_cell_keeps_the_forms_of_what_it_is_a_part_of(axes):
    with pytest.raises(ValueError, match="axes must be those of a tree"):
        from_tree(rj.Box([0.0, 0.0], [1.0, 1.0]), axes)
