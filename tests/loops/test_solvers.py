"""Inverses and solves of matrices that depend on states: values, bounds and errors.

Widths are those of linear bounds, compared with what was sampled, and every sample is inside.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy import linalg

import reachjax as rj
from reachjax.loops.units import UnboundedError
from tests.loops.traced import assert_sound, network
from tests.loops.widths import widths

Partial = jax.tree_util.Partial
RNG = np.random.default_rng(0)
DENSE, TURNS = RNG.normal(size=(6, 6)), RNG.normal(size=(6, 6, 2))
BOX = rj.Box([-0.5, -0.5], [0.5, 0.5])
MASSES = np.array([[6.0 - max(i, j) for j in range(6)] for i in range(6)])


def mass(x):
    return jnp.array([[2 + jnp.cos(x[0]), 0.3], [0.3, 1.0]])


def force(x):
    return jnp.array([x[1], -x[0]])


def full(n, x):
    """A matrix without symmetry."""
    return DENSE[:n, :n] + 3 * np.eye(n) + 0.2 * jnp.sin(TURNS[:n, :n] @ x[:2])


def links(n, q):
    """Masses of an arm, in absolute angles."""
    return MASSES[6 - n :, 6 - n :] * jnp.cos(q[:, None] - q) + 0.1 * np.eye(n)


def repeated(n, x):
    return jnp.tile(x, 3)[:n]


def split(x):
    """A matrix of blocks, whose first pivot is zero."""
    return jnp.array([[0.0, 0.0, 2 + x[0]], [jnp.exp(x[1]), x[0], 0.0], [0.3, 1.0, x[1]]])


def double_pendulum(x, u):
    angles, (first, second) = x[:2], x[2:]
    bend, turn = angles[1], angles[0] + angles[1]
    M = jnp.array([[3 + 2 * jnp.cos(bend), 1 + jnp.cos(bend)], [1 + jnp.cos(bend), 1.0]])
    h = jnp.sin(bend) * jnp.array([-second * (2 * first + second), first**2])
    g = 9.8 * jnp.array([2 * jnp.sin(angles[0]) + jnp.sin(turn), jnp.sin(turn)])
    push = jnp.array([u[0], 0.0])
    return jnp.concatenate([angles, x[2:]]) + 0.05 * jnp.concatenate(
        [x[2:], jnp.linalg.solve(M, push - h - g)]
    )


def arm(n, x, u):
    """The accelerations of an arm, after its speeds."""
    q, w = x[:n], x[n:]
    weights = 9.8 * MASSES[0, 6 - n :] * jnp.sin(q)
    h = (MASSES[6 - n :, 6 - n :] * jnp.sin(q[:, None] - q)) @ w**2 + weights
    return jnp.concatenate([w, jnp.linalg.solve(links(n, q), jnp.zeros(n).at[0].set(u[0]) - h)])


def alone(function):
    return lambda x, u: function(x)


VALUES = {
    "inverse": lambda x: jnp.linalg.inv(mass(x)).ravel(),
    "solve": lambda x: jnp.linalg.solve(mass(x), force(x)),
    "solve of columns": lambda x: jnp.linalg.solve(mass(x), jnp.stack([x, force(x)])).ravel(),
    "solve of a positive definite matrix": lambda x: linalg.solve(mass(x), x, assume_a="pos"),
    "Cholesky": lambda x: jnp.linalg.cholesky(mass(x)).ravel(),
    "Cholesky of three": lambda x: jnp.linalg.cholesky(links(3, repeated(3, x))).ravel(),
    "solve by Cholesky": lambda x: linalg.cho_solve(linalg.cho_factor(mass(x)), force(x)),
    "triangular": lambda x: linalg.solve_triangular(mass(x), x, lower=True),
    "triangular from the right": lambda x: jax.lax.linalg.triangular_solve(
        mass(x), x[None] + 1, transpose_a=True
    )[0],
    "unit diagonal": lambda x: linalg.solve_triangular(mass(x), x, unit_diagonal=True, trans=1),
    "of constants": lambda x: jnp.linalg.solve(np.array([[2.0, 0.3], [0.7, 1.1]]), x),
    "of parameters": Partial(jnp.linalg.solve, DENSE[:2, :2]),
    "of parameters and states": Partial(
        lambda p, x: jnp.linalg.solve(p + jnp.diag(jnp.cos(x)), x), 3 * jnp.ones((2, 2))
    ),
    "of a constant": lambda x: jnp.linalg.solve(mass(x), np.array([1.0, 2.0])),
    "blocks": lambda x: jnp.linalg.solve(split(x), jnp.append(x, 1.0)),
    "several": lambda x: jax.vmap(lambda s: jnp.linalg.inv(mass(s * x)) @ x)(jnp.arange(2.0))[1],
    "three": lambda x: jnp.linalg.solve(full(3, x), repeated(3, x)),
}


@pytest.mark.parametrize("name", VALUES)
def test_solutions_are_sound(name):
    assert_sound(VALUES[name], np.array([-0.05, 0.1]), np.array([0.05, 0.15]))


TIGHT = {
    "inverse": (alone(lambda x: jnp.linalg.inv(mass(x)) @ force(x)), BOX, 1.03),
    "solve": (alone(lambda x: jnp.linalg.solve(mass(x), force(x))), BOX, 1.03),
    "Cholesky": (alone(VALUES["solve by Cholesky"]), BOX, 1.04),
    "double pendulum": (
        double_pendulum,
        rj.Box([0.2, -0.3, -0.2, -0.2], [0.4, -0.1, 0.2, 0.2]),
        1.1,
    ),
    "three links": (Partial(arm, 3), rj.Box([-0.1] * 3 + [-0.2] * 3, [0.1] * 3 + [0.2] * 3), 1.3),
    "six links": (Partial(arm, 6), rj.Box([-0.03] * 6 + [-0.1] * 6, [0.03] * 6 + [0.1] * 6), 1.3),
    "six, full": (
        alone(lambda x: jnp.linalg.solve(full(6, x), repeated(6, x))[:2]),
        rj.Box([-0.05] * 2, [0.05] * 2),
        1.01,
    ),
    "diagonal": (
        alone(lambda x: jnp.linalg.solve(jnp.diag(repeated(6, jnp.exp(x))), repeated(6, x))[:2]),
        BOX,
        1.2,
    ),
    "four": (
        alone(lambda x: (jnp.linalg.inv(full(4, x)) @ repeated(4, x))[:2]),
        rj.Box([-0.1] * 2, [0.1] * 2),
        1.05,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TIGHT)
@pytest.mark.costly
def test_solutions_are_bounded_tightly(name):
    step, X0, most = TIGHT[name]
    bounds, sampled = widths(step, X0, rj.LinearBounds())
    assert np.all(bounds <= most * sampled), bounds / sampled


REFUSED = {
    "factors alone": (
        lambda x: linalg.lu_solve(linalg.lu_factor(mass(x)), x),
        r"'lu' \(in .*test_solvers.*largest pivots.*jnp\.linalg\.solve",
    ),
    "a matrix that is singular": (
        lambda x: jnp.linalg.solve(jnp.array([[x[0], 0.0], [1.0, 0.0]]), x),
        "'custom_linear_solve'.* is singular, whatever the inputs are",
    ),
    "a matrix too large": (
        lambda x: jnp.linalg.solve(jnp.sin(jnp.ones((7, 7)) * x[0]), jnp.ones(7))[:2],
        "a block of its matrix has 7 rows, but 6 at most have bounds",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_solution_or_is_none_is_named(name):
    function, message = REFUSED[name]
    with pytest.raises(TypeError, match=message):
        network(function)


def test_a_matrix_that_may_be_singular_is_named():
    plant = rj.NonlinearPlant(lambda x, u: jnp.linalg.inv(jnp.diag(x) + 0.1) @ x, 2, 1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: x[:1], 2, 1))
    with pytest.raises(UnboundedError, match=r"inverse of a matrix \(in .*determinant in"):
        rj.reach(loop, BOX, 1, rj.Template.box(2), rj.LinearBounds())
