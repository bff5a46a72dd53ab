"""Claims about tubes as proofs: they hold for their own loop, set and start only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import own_plant, recursion
from tests.networks import he_network
from tests.numerics.test_checks import aligned

NET = rj.MLP.from_layers(he_network((2, 3, 1), seed=0))
LOOP = rj.ClosedLoop(rj.AffinePlant(0.5 * np.eye(2), 0.1 * np.ones((2, 1))), NET)
OTHER = LOOP.replace(plant=LOOP.plant.replace(A=2 * np.eye(2)))
X0, TEMPLATE = rj.Box([0.0, 0.0], [1.0, 1.0]), rj.Template.box(2)
SAFE = rj.Box([-9.0, -9.0], [9.0, 9.0])
TORN = "not those that were computed together"


def tube_of(loop=LOOP, X=X0):
    return recursion(loop, X, 2, TEMPLATE, samples=10)


@pytest.fixture(scope="module")
def tube():
    return tube_of()


@pytest.fixture(scope="module")
def other():
    return tube_of(OTHER)


def verify(tube):
    return rj.verify(tube, safe=SAFE, samples=10).status


def test_the_start_and_the_seal_cannot_be_exchanged(tube, other):
    for changes in ({"start": 1}, {"seal": other.seal}, {"loop": OTHER, "seal": None}):
        with pytest.raises(ValueError, match=TORN):
            tube.replace(**changes)
    with pytest.raises(ValueError, match=TORN):
        rj.ReachTube(OTHER, tube.template, tube.sets, tube.certificates)


@pytest.mark.parametrize("decide", [verify, lambda tube: rj.shortfall(tube, safe=SAFE)])
def test_a_tube_whose_leaves_were_changed_decides_nothing(tube, decide):
    leaves, structure = jax.tree.flatten(tube)
    position = next(k for k, leaf in enumerate(leaves) if leaf.shape == (2, 2))  # the plant's A
    leaves[position] = 2 * leaves[position]
    with pytest.raises(ValueError, match=TORN):
        decide(jax.tree.unflatten(structure, leaves))
    rounded = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32).astype(float) if leaf.dtype == float else leaf, tube
    )
    with pytest.raises(ValueError, match=TORN):
        decide(rounded)


@pytest.mark.costly
def test_tubes_from_inside_jit_and_vmap_are_proofs_of_their_own_loops(tube):
    compiled = jax.jit(tube_of)
    inside = compiled(LOOP, X0)
    assert verify(inside) is rj.VerdictStatus.PROVED
    with pytest.raises(ValueError, match=TORN):
        inside.replace(loop=OTHER)
    both = jax.tree.map(lambda *sets: jnp.stack(sets), X0, rj.Box([0.0, 0.0], [0.5, 0.5]))
    first, second = (
        jax.tree.map(lambda leaf, i=i: leaf[i], jax.vmap(compiled, (None, 0))(LOOP, both))
        for i in range(2)
    )
    assert verify(second) is rj.VerdictStatus.PROVED
    with pytest.raises(ValueError, match=TORN):
        first.replace(sets=second.sets)


@pytest.mark.costly
def test_derivatives_go_through_a_sealed_tube(tube):
    goal = rj.Box([0.0, 0.0], [0.01, 0.01])
    slope = jax.grad(lambda loop: rj.shortfall(tube_of(loop), goal=goal))(LOOP)
    assert np.isfinite(slope.plant.A).all()
    assert np.any(slope.plant.A != 0)
    slope = jax.jit(jax.grad(lambda t: rj.shortfall(t, goal=goal), allow_int=True))(tube)
    assert np.any(slope.sets[2].b != 0)


@pytest.mark.costly
def test_a_tube_keeps_its_sets_when_the_arrays_that_it_came_from_change():
    upper, weights = aligned([1.0, 1.0]), aligned(0.5 * np.eye(2))
    loop = jax.tree.map(lambda leaf: weights if leaf.shape == (2, 2) else leaf, LOOP)
    box = jax.tree.map(lambda leaf: upper if leaf[0] == 1 else leaf, X0)  # no constructor is called
    tube = tube_of(loop, box)
    upper[:], weights[:] = 100.0, 100.0
    np.testing.assert_array_equal(tube.sets[0].upper, [1.0, 1.0])
    np.testing.assert_array_equal(tube.loop.plant.A, 0.5 * np.eye(2))
    assert verify(tube) is rj.VerdictStatus.PROVED


@pytest.mark.parametrize(
    "template", [TEMPLATE, rj.EllipsoidTemplate()], ids=["facets", "ellipsoid"]
)
@pytest.mark.costly
def test_a_tube_in_32_bits_is_neither_verified_nor_rechecked(template):
    tube = recursion(LOOP, X0, 1, template, samples=10)
    rough = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == float else leaf, tube
    )
    with pytest.raises(RuntimeError, match="tube holds float32, but float64 is needed"):
        verify(rough)
    with pytest.raises(RuntimeError, match="certificate holds float32, but float64 is needed"):
        rough.certificates[1].recheck()
    with jax.enable_x64(False):
        with pytest.raises(RuntimeError, match="needs 64-bit floats"):
            verify(tube)
        with pytest.raises(RuntimeError, match="needs 64-bit floats"):
            tube.certificates[1].recheck()


@pytest.mark.costly
def test_no_cell_of_a_partition_can_be_left_out():
    cells = rj.reach_partitioned(
        LOOP, X0, 1, TEMPLATE, rj.LocalBounds(), 1, cells=(2, 1), samples=10
    )
    assert verify(cells) is rj.VerdictStatus.PROVED
    for changes in ({"tubes": cells.tubes[:1]}, {"X0": SAFE}):
        with pytest.raises(ValueError, match=TORN):
            cells.replace(**changes)
    with pytest.raises(ValueError, match=TORN):
        rj.PartitionedTube(SAFE, cells.tubes)


@pytest.mark.costly
def test_64_bit_floats_may_be_on_in_a_scope_also_inside_jit():
    with jax.enable_x64(False), jax.enable_x64(True):
        expected = tube_of().sets[2].b
    jax.config.update("jax_enable_x64", False)  # callbacks run on threads that see this one
    try:
        with jax.enable_x64(True):
            bounds = jax.jit(lambda loop: tube_of(loop).sets[2].b)(LOOP)
    finally:
        jax.config.update("jax_enable_x64", True)
    np.testing.assert_allclose(bounds, expected, rtol=0, atol=1e-7)


def edited_plant(gain):
    """A user's plant before and after an edit of a constant in its equation."""
    plant = own_plant(gain)(jnp.ones((1, 1)), jnp.ones((1, 1)))
    return rj.ClosedLoop(plant, rj.MLP.from_layers([([[0.0]], [0.0])]))


class Gained(rj.AbstractActivation):
    """A user's activation, with a number that is no leaf."""

    def __init__(self, gain):
        self.gain = gain

    def propagate(self, y, unit):
        return self.gain * unit(rj.ReLU(), y)


def edited_activation(gain):
    layers = [([[1.0]], [0.0]), ([[1.0]], [0.0])]
    net = rj.MLP.from_layers(layers, activation=Gained(gain))
    return rj.ClosedLoop(rj.AffinePlant([[0.5]], [[0.0]]), net)


@pytest.mark.parametrize("edited", [edited_plant, edited_activation])
def test_what_is_proved_is_of_the_equations_that_a_user_wrote_then(edited, tmp_path):
    before, after, box = edited(0.5), edited(5.0), rj.Box([1.0], [2.0])
    proved = rj.decide(before, box, 2, goal=rj.Box([0.0], [2.0]), samples=10)
    tube = recursion(before, box, 1, rj.Template.box(1), samples=10)
    assert proved.proved
    proved.save(tmp_path / "kept.verdict")
    tube.save(tmp_path / "kept.reach")
    same = edited(0.5)  # another class, the same equations
    assert rj.load(tmp_path / "kept.verdict", same).proved
    for name in ("kept.verdict", "kept.reach"):
        with pytest.raises(ValueError, match="another one arrived"):
            rj.load(tmp_path / name, after)
    with pytest.raises(ValueError, match=TORN):
        tube.replace(loop=after)
