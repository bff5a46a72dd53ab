"""What the library claims holds of loops of every activation, and of residual ones."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.bounds import loop_bounds
from tests.activations import ACTIVATIONS, CONTROLLERS, NAMES, controlled
from tests.closed_loops import step_program
from tests.networks import box_region
from tests.quick_cases import some

STATES = [1, 2, 3, 6]
MIXED = [
    {"activation": rj.LeakyReLU(0.1), "skip": True},
    {"activation": rj.HardTanh(), "boxed": False},
]

each_controller = pytest.mark.parametrize("options", CONTROLLERS, ids=NAMES)


def initial_box(n_x, scale=1.0):
    corners = box_region(n_x, seed=n_x).corners
    middle = corners.mean(axis=0)
    ends = (middle + scale * (end - middle) for end in (corners.min(axis=0), corners.max(axis=0)))
    return rj.Box(*ends)


def samples(X, count=2000):
    return np.vstack([np.asarray(X.sample(jax.random.key(0), count)), np.asarray(X.vertices())])


def basis_points(loop, x):
    """`[x, z, 1]` of points `x`, by the loop's own forward pass."""

    def of(x):
        outputs = []

        def unit(unit, *y):
            outputs.append(unit(*y))
            return outputs[-1]

        loop.step(x, 0, unit)
        return jnp.concatenate([x, *outputs, jnp.ones(1)])

    return np.asarray(jax.jit(jax.vmap(of))(x))


# each controller in two dimensions, stable units removed in one of them
@pytest.mark.parametrize(
    ("place", "n_x"),
    some(
        product(range(len(CONTROLLERS + MIXED)), STATES),
        lambda place, n_x: (n_x in (1, 6)) == bool(place % 2),
    ),
)
@pytest.mark.costly
def test_facts_products_and_successors_hold_on_simulated_trajectories(place, n_x):
    options = (CONTROLLERS + MIXED)[place]
    case, X = controlled(n_x=n_x, seed=n_x, **options), initial_box(n_x)
    loop, x = case.loop, samples(X)
    xi, following = basis_points(loop, x), case.successors(x)
    relaxation = rj.LocalBounds(remove_stable=n_x % 2 == 0)
    program = jax.device_get(step_program(loop, X, X, np.eye(n_x), 0, relaxation))
    used = program.used
    eta = np.zeros_like(xi)
    T = program.transform[np.ix_(used, used)]
    eta[:, used] = np.linalg.solve(T, xi[:, used].T).T
    assert abs(eta).max() <= 1 + 1e-9
    np.testing.assert_allclose(eta @ program.objective.mid.T, following, atol=1e-11)
    facts = eta @ program.facts.mid.T
    assert facts.min() >= -1e-11
    products = facts[:, program.products.left] * facts[:, program.products.right]
    zero = program.products.free[program.products.multiplier]
    assert zero.sum() == loop.units
    assert abs(products[:, zero]).max() <= 1e-11
    assert abs(program.facts.mid[program.products.left[zero]]).max() > 0


@each_controller
def test_the_units_of_a_loop_are_those_that_its_forward_pass_meets(options):
    loop = controlled(n_x=3, **options).loop
    columns = 2 if options["activation"] == rj.HardTanh() else 1  # a neuron
    assert [layer.size for layer in loop.unit_layers] == [4] * columns + [3] * columns + [2, 2]
    assert loop.units == 7 * columns + 4
    assert {type(layer.unit) for layer in loop.unit_layers[-2:]} == {rj.ReLU}
    seen = []
    loop.step(jnp.zeros(3), 0, lambda unit, y: seen.append((unit, len(y), len(y))) or unit(y))
    assert list(loop.unit_layers) == seen


@each_controller
@pytest.mark.costly
def test_intervals_hold_what_is_simulated(options):
    for n_x in STATES:
        case, X = controlled(n_x=n_x, seed=n_x, **options), initial_box(n_x)
        bounds, x = loop_bounds(case.loop, X, 0), samples(X)
        following, z = case.successors(x), basis_points(case.loop, x)[:, n_x:-1]
        for ball, values in ((bounds.successor, following), (bounds.output, z)):
            assert np.all(np.asarray(ball.lower) - 1e-13 <= values)
            assert np.all(values <= np.asarray(ball.upper) + 1e-13)


@each_controller
@pytest.mark.costly
def test_units_that_are_affine_leave_the_basis_and_the_set_is_then_exact(options):
    # no input is near a kink: all units are affine on a tiny set
    case, X = controlled(n_x=2, seed=4, boxed=False, **options), initial_box(2, 1e-4)
    bounds = loop_bounds(case.loop, X, 0)
    assert np.all(bounds.affine)
    slopes = set(np.asarray(bounds.lines.above.slope).tolist())
    low = options["activation"].slope if hasattr(options["activation"], "slope") else 0.0
    assert slopes == {low, 1.0}
    following, certificate = rj.reach_step(case.loop, X, rj.Template.box(2))
    assert int(np.sum(certificate.program.used)) == 3  # two states and the constant
    ends = case.successors(np.asarray(X.vertices())) @ np.asarray(following.A).T
    np.testing.assert_allclose(following.b, ends.max(axis=0), atol=1e-12)


def test_a_residual_network_adds_its_input_and_may_be_nested():
    net = rj.MLP.from_layers([(np.eye(2), [0.0, 0.0]), (np.eye(2), [0.0, 0.0])])  # max(x, 0)
    x = jnp.array([-1.0, 2.0])
    np.testing.assert_array_equal(rj.Residual(net)(x), [-1.0, 4.0])
    np.testing.assert_array_equal(rj.Residual(rj.Residual(net), -np.eye(2))(x), [0.0, 2.0])
    assert (rj.Residual(net).inputs, rj.Residual(net).outputs) == (2, 2)


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (rj.Residual, ValueError, "2 inputs and 1 outputs"),
        (lambda net: rj.Residual(net, np.eye(2)), ValueError, r"shape \(1, 2\).*shape \(2, 2\)"),
        (lambda net: rj.Residual(jax.nn.relu), TypeError, "must be a network such as an MLP"),
    ],
)
def test_a_skip_that_does_not_fit_is_named(build, error, message):
    net = rj.MLP.from_layers([(np.ones((1, 2)), [0.0])])
    with pytest.raises(error, match=message):
        build(net)


def test_every_activation_and_network_is_public():
    assert {type(activation).__name__ for activation in ACTIVATIONS} <= set(rj.__all__)
    assert {"Residual", "AbstractNetwork", "AbstractUnit", "AbstractActivation"} <= set(rj.__all__)
