"""The paper's matrices, entry by entry, and the facts they are made of."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from experiments.benchmark.reference import (
    facet_matrix,
    paper_E_in,
    paper_E_mid,
    paper_E_out,
    polytope_qc,
    relu_qc,
)
from reachjax.programs.lmi import weighted_products
from tests.closed_loops import closed_loop, random_loop, step_program
from tests.networks import box_region, dead_network, directions, simplex_region
from tests.quick_cases import some

STATES = [1, 2, 3, 6]


def program_of(data, X, relaxation, t=0):
    template = rj.Template(directions(X.dimension, extra=2))
    return jax.device_get(
        step_program(closed_loop(data), X, X.bounding_box(), template.directions, t, relaxation)
    )


def over_the_paper_basis(program, matrix, E_in, E_mid):
    """`matrix` over the scaled basis as one over `[x^0, x^1, ..., x^{l+2}, 1]`."""
    units = (len(E_mid) - 1) // 2
    from_paper = np.vstack([E_in[:-1], E_mid[units:]])  # [x, z, 1] = from_paper @ paper's basis
    unscaled = np.linalg.inv(program.transform) @ from_paper
    return unscaled.T @ matrix @ unscaled


def trajectory_basis(loop, states, t):
    """`[x, z, 1]` and the successor of each state, by the loop's own forward pass."""

    def simulate(x):
        outputs = []

        def unit(activation, y):
            outputs.append(activation(y))
            return outputs[-1]

        successor = loop.step(x, t, unit)
        return jnp.concatenate([x, *outputs, jnp.ones(1)]), successor

    return map(np.asarray, jax.jit(jax.vmap(simulate))(states))


def random_multipliers(rng, facets, units, repeated):
    """The paper's `Gamma`, `lambda`, `nu`, `eta`, `lambda_ij`, and the same as the library's."""
    Gamma, couplings = rng.uniform(size=(facets, facets)), rng.uniform(size=(units, units))
    Gamma, couplings = np.triu(Gamma, 1) + np.triu(Gamma, 1).T, np.triu(couplings, 1)
    couplings = (couplings + couplings.T) * repeated
    lam, (nu, eta) = rng.normal(size=units), rng.uniform(size=(2, units))
    ours = [
        -2 * (lam + couplings.sum(axis=1)),
        2 * Gamma[np.triu_indices(facets, 1)],
        2 * eta,
        2 * nu,
        2 * couplings[np.triu_indices(units, 1)] if repeated else [],
    ]
    return (Gamma, lam, nu, eta, couplings), np.concatenate(ours)


@pytest.mark.parametrize(
    ("n_x", "boxed", "repeated"),
    some(
        product(STATES, [True, False], [True, False]),
        lambda n_x, boxed, repeated: (n_x in (1, 3)) == (boxed == repeated),
    ),
)
@pytest.mark.costly
def test_paper_qc_is_propositions_one_to_five_and_lemma_one_entry_by_entry(n_x, boxed, repeated):
    steps = None if repeated else 3
    data, region, t = random_loop(n_x, boxed=boxed, steps=steps), simplex_region(n_x, 1), 2
    A, B, c, lower, upper = data.at(t)
    X = rj.Polytope(region.A, region.b)
    program = program_of(data, X, rj.PaperQC(repeated=repeated), t)
    E_in, E_mid = paper_E_in(data.layers, boxed), paper_E_mid(data.layers, lower, upper)
    E_out = paper_E_out(data.layers, A, B, c, boxed)
    units = (len(E_mid) - 1) // 2
    rng = np.random.default_rng(n_x)
    for _ in range(3):
        (Gamma, lam, nu, eta, couplings), ours = random_multipliers(
            rng, len(region.b), units, repeated
        )
        expected = E_in.T @ polytope_qc(region.A, region.b, Gamma) @ E_in
        expected += E_mid.T @ relu_qc(lam, nu, eta, couplings).value @ E_mid
        products = weighted_products(program, ours).mid
        actual = over_the_paper_basis(program, products, E_in, E_mid)
        np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())

    a, b = directions(n_x, extra=2), 0.7
    for i, p in enumerate(program.objective.mid):
        e = np.eye(len(p))[-1]
        bordered = np.outer(p, e) + np.outer(e, p) - 2 * b * np.outer(e, e)
        actual = over_the_paper_basis(program, bordered, E_in, E_mid)
        np.testing.assert_allclose(
            actual, E_out.T @ facet_matrix(a[i], b).value @ E_out, rtol=1e-9, atol=1e-9
        )


@pytest.mark.costly
def test_paper_qc_keeps_every_neuron_even_dead_ones():
    data = random_loop(2, network=dead_network)
    X = rj.Box([-0.1, -0.1], [0.1, 0.1])
    assert np.all(program_of(data, X, rj.PaperQC()).used)
    assert np.sum(program_of(data, X, rj.LocalBounds()).used) < 2 + 10 + 4 + 1


RELAXATIONS = [
    rj.PaperQC(repeated=False),
    rj.PaperQC(),
    rj.PaperQC(remove_stable=True),
    rj.LocalBounds(),
    rj.LocalBounds(remove_stable=False),
]


@pytest.mark.parametrize("relaxation", RELAXATIONS, ids=str)
@pytest.mark.parametrize("n_x", STATES)
@pytest.mark.costly
def test_facts_products_and_objectives_hold_on_simulated_trajectories(n_x, relaxation):
    data, region = random_loop(n_x, steps=3), box_region(n_x, seed=2, rotated=True)
    loop, X = closed_loop(data), rj.Polytope(region.A, region.b)
    program = program_of(data, X, relaxation, t=1)
    states = region.sample(500, seed=3)
    basis, successors = trajectory_basis(loop, states, 1)
    T, used = program.transform, program.used
    eta = np.zeros_like(basis)
    eta[:, used] = np.linalg.solve(T[np.ix_(used, used)], basis[:, used].T).T

    assert abs(eta).max() <= 1 + 1e-9
    facts = eta @ program.facts.mid.T
    assert facts.min() >= -1e-9
    products = facts[:, program.products.left] * facts[:, program.products.right]
    complementary = program.products.free[program.products.multiplier]
    assert abs(products[:, complementary]).max() <= 1e-9
    assert not np.any(program.products.left == program.products.right)
    np.testing.assert_allclose(
        eta @ program.objective.mid.T, successors @ directions(n_x, extra=2).T, atol=1e-9
    )


@pytest.mark.costly
def test_the_rounding_bound_of_the_products_covers_exact_arithmetic():
    from fractions import Fraction

    data = random_loop(2, hidden=(3,))
    program = program_of(data, rj.Box([-0.3, -0.2], [0.4, 0.5]), rj.LocalBounds())
    multipliers = np.random.default_rng(0).normal(size=len(program.products.free))
    ball = weighted_products(program, multipliers)
    F = [[Fraction(float(v)) for v in row] for row in program.facts.mid]
    n = len(ball.mid)
    exact = np.zeros((n, n), dtype=object)
    pairs = zip(
        *(
            np.asarray(part)
            for part in (program.products.left, program.products.right, program.products.multiplier)
        ),
        strict=True,
    )
    for left, right, owner in pairs:
        w = Fraction(float(multipliers[owner])) / 2
        for i in range(n):
            for j in range(n):
                exact[i, j] += w * (F[left][i] * F[right][j] + F[left][j] * F[right][i])
    error = np.array(
        [
            [float(abs(exact[i, j] - Fraction(float(ball.mid[i, j])))) for j in range(n)]
            for i in range(n)
        ]
    )
    assert np.all(error <= ball.rad)
    assert ball.rad.max() < 1e-10


@pytest.mark.costly
def test_a_program_compiles_once_for_new_weights_sets_and_times():
    from reachjax.programs.windows import _extended

    data = random_loop(2, hidden=(4,), steps=3)
    template, relaxation = rj.Template.octagonal(2), rj.LocalBounds()
    loop = closed_loop(data)
    step_program(loop, X := rj.Box([0, 0], [1, 1]), X, template.directions, 0, relaxation)
    before = _extended._cache_size()
    other = loop.replace(controller=jax.tree.map(lambda w: 2 * w, loop.controller))
    step_program(other, X := rj.Box([0, 0], [1e-3, 1e-3]), X, template.directions, 1, relaxation)
    assert _extended._cache_size() == before
