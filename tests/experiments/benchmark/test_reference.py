"""Claims about the reference implementation of the paper, checked on simulated trajectories."""

import numpy as np
import pytest

from experiments.benchmark.reference import (
    facet_matrix,
    paper_E_in,
    paper_E_mid,
    paper_E_out,
    paper_step,
    polytope_qc,
    relu_qc,
)
from tests.networks import (
    LoopData,
    affine_network,
    box_region,
    controller,
    dead_network,
    directions,
    he_network,
    input_box,
    plant,
    saturating_network,
    simplex_region,
    simulate,
)

STATES = [1, 2, 3, 6]
TIME = 2  # the paper's matrices are taken at t = 2 of time-varying loops

# cvxpy warns of a stall before 1e-9; the reference accepts it where 1e-7 holds.
pytestmark = pytest.mark.filterwarnings("ignore:Solution may be inaccurate")


def ltv_loop(n_x, boxed, network=he_network):
    n_u = min(n_x, 2)
    box = input_box(n_u, seed=n_x, steps=3) if boxed else (None, None)
    layers = network((n_x, 6, 4, n_u), seed=10 + n_x)
    return LoopData(layers, *plant(n_x, n_u, seed=n_x, steps=3), *box)


def basis_points(loop, x):
    """Equation proj_NN, layer by layer: rows [x^0, ..., x^l, x^{l+1}, x^{l+2}, 1]."""
    _, _, _, lower, upper = loop.at(TIME)
    blocks = [x]
    for W, b in loop.layers[:-1]:
        blocks.append(np.maximum(blocks[-1] @ W.T + b, 0.0))
    if lower is not None:
        W, b = loop.layers[-1]
        blocks.append(np.maximum(blocks[-1] @ W.T + b - lower, 0.0) + lower)
        blocks.append(-np.maximum(upper - blocks[-1], 0.0) + upper)
    return np.hstack([*blocks, np.ones((len(x), 1))])


def quadratic(M, points):
    """points[k]' M points[k] for each row."""
    return np.einsum("ki,ij,kj->k", points, M, points)


@pytest.fixture(params=[(n_x, boxed) for n_x in STATES for boxed in (True, False)], scope="module")
def case(request):
    n_x, boxed = request.param
    loop = ltv_loop(n_x, boxed)
    region = simplex_region(n_x, seed=n_x)
    x = region.sample(1000, seed=0)
    return loop, region, x, basis_points(loop, x)


def mid_matrix(loop):
    return paper_E_mid(loop.layers, *loop.at(TIME)[3:])


def test_the_two_projection_layers_clip_the_network_to_the_input_box():
    loop = ltv_loop(3, True, saturating_network)
    x = np.random.default_rng(0).normal(size=(1000, 3))
    lower, upper = loop.at(TIME)[3:]
    u = np.clip(controller(loop.layers, x), lower, upper)
    assert (u == lower).any()
    assert (u == upper).any()
    np.testing.assert_allclose(basis_points(loop, x)[:, -3:-1], u, atol=1e-14)


def test_E_in_picks_the_state_and_the_constant(case):
    loop, _, x, xi = case
    E_in = paper_E_in(loop.layers, loop.u_lower is not None)
    np.testing.assert_array_equal(xi @ E_in.T, np.column_stack([x, np.ones(len(x))]))


def test_E_mid_gives_pre_activations_and_their_relu(case):
    loop, _, _, xi = case
    mid = xi @ mid_matrix(loop).T
    d = (mid.shape[1] - 1) // 2
    assert d == 10 + (0 if loop.u_lower is None else 2 * loop.u_lower.shape[1])
    assert (mid[:, :d] < 0).any()
    assert (mid[:, :d] > 0).any()
    np.testing.assert_allclose(mid[:, d:-1], np.maximum(mid[:, :d], 0.0), atol=1e-13)
    np.testing.assert_array_equal(mid[:, -1], 1.0)


def test_E_out_gives_the_simulated_successor(case):
    loop, _, x, xi = case
    A, B, c, lower, upper = loop.at(TIME)
    successor = simulate(LoopData(loop.layers, A, B, c, lower, upper), x, 1)[1]
    out = xi @ paper_E_out(loop.layers, A, B, c, lower is not None).T
    np.testing.assert_allclose(out, np.column_stack([successor, np.ones(len(x))]), atol=1e-13)


def test_the_qc_of_a_polytope_is_nonnegative_on_it(case):
    loop, region, _, xi = case
    rng = np.random.default_rng(1)
    Gamma = rng.exponential(size=(len(region.b),) * 2)
    Gamma = np.triu(Gamma, 1) + np.triu(Gamma, 1).T
    E_in = paper_E_in(loop.layers, loop.u_lower is not None)
    values = quadratic(E_in.T @ polytope_qc(region.A, region.b, Gamma) @ E_in, xi)
    assert values.min() >= -1e-12
    assert values.max() > 1e-3


def test_the_printed_blocks_of_proposition_one_are_the_product_form():
    region, rng = simplex_region(3, seed=0), np.random.default_rng(0)
    A, b, Gamma = region.A, region.b[:, None], rng.normal(size=(4, 4))
    printed = np.block([[A.T @ Gamma @ A, -A.T @ Gamma @ b], [-b.T @ Gamma @ A, b.T @ Gamma @ b]])
    np.testing.assert_allclose(polytope_qc(A, region.b, Gamma), printed, atol=1e-14)


def test_the_qc_of_the_relus_is_nonnegative_on_trajectories_for_any_sign_of_lambda(case):
    loop, _, _, xi = case
    rng = np.random.default_rng(2)
    E_mid = mid_matrix(loop)
    d = (len(E_mid) - 1) // 2
    for _ in range(5):
        lam, (nu, eta) = rng.normal(size=d), rng.exponential(size=(2, d))
        slopes = np.triu(rng.exponential(size=(d, d)), 1)
        Q = relu_qc(lam, nu, eta, slopes + slopes.T).value
        values = quadratic(E_mid.T @ Q @ E_mid, xi)
        assert values.min() >= -1e-11
        assert values.max() > 1e-3


def test_each_multiplier_of_lemma_one_multiplies_its_own_constraint():
    d, rng = 4, np.random.default_rng(3)
    y, z = rng.normal(size=(2, d))  # off the graph of the ReLU, so that nothing cancels
    basis = np.hstack([y, z, 1.0])
    lam, nu, eta = rng.normal(size=(3, d))
    slopes = np.triu(rng.normal(size=(d, d)), 1)
    # Equation relu::cvx_relax, twice; lambda_i has the opposite sign in lemma 1, where it is free.
    expected = np.sum(2 * lam * (y * z - z**2) + 2 * nu * (z - y) + 2 * eta * z)
    for i in range(d):
        for j in range(i + 1, d):
            dy, dz = y[j] - y[i], z[j] - z[i]
            expected += 2 * slopes[i, j] * (dz * dy - dz**2)
    Q = relu_qc(lam, nu, eta, slopes + slopes.T).value
    np.testing.assert_allclose(basis @ Q @ basis, expected, rtol=1e-12)


def test_the_facet_matrix_is_twice_the_distance_over_the_facet():
    a, b, x = np.array([1.0, -2.0, 0.5]), 0.7, np.array([0.3, 0.1, -0.4])
    basis = np.append(x, 1.0)
    np.testing.assert_allclose(basis @ facet_matrix(a, b).value @ basis, 2 * (a @ x - b))


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("network", [he_network, dead_network, saturating_network])
@pytest.mark.parametrize("n_x", STATES)
def test_no_sampled_successor_passes_an_offset(n_x, network, repeated):
    loop = ltv_loop(n_x, True, network)
    region = box_region(n_x, seed=n_x, rotated=True)
    A, B, c, lower, upper = loop.at(TIME)
    a = directions(n_x, extra=2)[-3:]
    offsets, _ = paper_step(
        loop.layers, A, B, c, lower, upper, region.A, region.b, a, repeated=repeated
    )
    x = np.vstack([region.corners, region.sample(20_000, seed=0)])
    successor = simulate(LoopData(loop.layers, A, B, c, lower, upper), x, 1)[1]
    # An LMI whose largest eigenvalue is e, not 0, proves the offset plus e |xi|^2 / 2.
    slack = 1e-8 * np.square(basis_points(loop, x)).sum(axis=1).max()
    assert np.all(offsets >= (successor @ a.T).max(axis=0) - slack)


@pytest.mark.parametrize("boxed", [True, False])
@pytest.mark.parametrize("n_x", STATES)
def test_the_offsets_are_tight_where_the_network_is_affine(n_x, boxed):
    n_u = min(n_x, 2)
    box = (np.full(n_u, -30.0), np.full(n_u, 30.0)) if boxed else (None, None)
    loop = LoopData(affine_network((n_x, 3, n_u), seed=n_x), *plant(n_x, n_u, seed=n_x), *box)
    region = box_region(n_x, seed=n_x)
    a = directions(n_x, extra=2)[-3:]
    offsets, _ = paper_step(loop.layers, *loop.at(0), region.A, region.b, a)
    exact = (simulate(loop, region.corners, 1)[1] @ a.T).max(axis=0)
    np.testing.assert_allclose(offsets, exact, atol=1e-5)


@pytest.mark.parametrize("bias", [1.0, 2.0, 5.0])
def test_the_slack_of_one_active_neuron_has_its_closed_form(bias):
    """x+ = relu(x + k) - x on |x| <= r < k is k, and the relaxation gives k + r^2 / (4 k).

    The multipliers allow any moments with E z^2 = E z y, E z >= E y, E x^2 <= r^2. With E x = m and
    E z = k + m + s they give s (k + m + s) <= (r^2 - m^2) / 4, largest at m = -r^2 / (2 k).
    """
    r, one = 0.5, np.ones((1, 1))
    layers = [(one, np.array([bias])), (one, np.zeros(1))]
    offsets, _ = paper_step(
        layers, -one, one, np.zeros(1), None, None, np.vstack([one, -one]), np.array([r, r]), one
    )
    np.testing.assert_allclose(offsets, bias + r**2 / (4 * bias), rtol=1e-7)


def test_the_printed_relaxation_keeps_the_upper_input_limit_and_loses_the_lower_one():
    """x+ = u: u <= u_upper is a fact of the last layer; no product printed gives u >= u_lower."""
    region, one = box_region(2, seed=2), np.ones(1)
    matrices = (np.zeros((2, 2)), np.array([[1.0], [0.0]]), np.zeros(2))
    a = np.array([[1.0, 0.0], [-1.0, 0.0]])
    lost = 0.0
    for seed in range(22, 32):
        layers = saturating_network((2, 5, 3, 1), seed=seed)
        (upper, lower), _ = paper_step(
            layers, *matrices, -one, one, region.A, region.b, a, repeated=True
        )
        assert upper <= 1.0 + 1e-7
        lost = max(lost, lower)
    assert lost > 1.5


def test_repeated_slopes_never_loosen_an_offset_and_tighten_some():
    loop, region = ltv_loop(2, True), box_region(2, seed=2)
    a = directions(2, extra=4)
    step = (loop.layers, *loop.at(TIME), region.A, region.b, a)
    plain, repeated = paper_step(*step)[0], paper_step(*step, repeated=True)[0]
    assert np.all(repeated <= plain + 1e-7)
    assert np.any(repeated < plain - 1e-4)


def test_a_solver_that_gives_up_is_an_error_and_not_an_offset():
    loop, region = ltv_loop(2, True), box_region(2, seed=2)
    with pytest.raises(RuntimeError, match="facet 0: expected status 'optimal'"):
        paper_step(
            loop.layers,
            *loop.at(TIME),
            region.A,
            region.b,
            directions(2),
            options={"solver": "CLARABEL", "max_iter": 3},
        )


def test_an_affine_loop_is_refused():
    with pytest.raises(ValueError, match="the loop is affine"):
        paper_E_mid([(np.eye(2), np.zeros(2))], None, None)
