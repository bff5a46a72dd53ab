"""Law: the derivative of what is reported is the difference of it, in every number that goes in."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.cases import BASIC, Case, each
from tests.differences import central_difference, dot

LENGTHS, STEPS = (1e-4, 1e-2), 2
"""Of differences, the second where a solver leaves too much for the first; and steps of tubes."""

ACCURACY = {"forms": 1e-5}
"""Of derivatives, by method; a thousandth of those that programs or cells bound."""

INITIAL = "polytope", "ellipsoid"

NEAR = 0.05
"""Points are drawn around those of the table by a part of their sizes: none is at a kink."""


def size(case):
    """What is differentiated: offsets with weights of their own, volumes, and the ball's place."""

    def of(loop, X0):
        total, weights = 0.0, np.random.default_rng(0).uniform(0.5, 1.5, 100)
        for X in case.reach(loop, X0, STEPS).sets[1:]:
            flat, ball = X.parts
            if flat is not None:
                b = flat.facets[1]
                total += weights[: len(b)] @ b
            if ball is not None:
                total += rj.log_volume(ball) + weights[: len(ball.center)] @ ball.center
        return total

    return of


def direction(args, rng):
    """A direction in all numbers of a loop and a set; normals stay, and shapes are symmetric."""

    def drawn(leaf):
        sizes = abs(leaf) + 0.1 * jnp.max(abs(leaf), initial=0.0) + 0.01
        return jnp.asarray(rng.normal(size=jnp.shape(leaf))) * sizes

    def moved(node):
        if isinstance(node, rj.Polytope):
            return node.A * 0, drawn(node.b)
        if isinstance(node, rj.Ellipsoid):
            by = 0.1 * drawn(node.shape)
            return drawn(node.center), by + by.T
        return (drawn(node),)

    nodes = jax.tree.leaves(args, is_leaf=lambda node: isinstance(node, rj.Polytope | rj.Ellipsoid))
    leaves = itertools.chain.from_iterable(map(moved, nodes))
    return jax.tree.unflatten(jax.tree.structure(args), leaves)


def errors(case, seeds, accuracy=1e-3):
    """Errors at drawn points where differences of two lengths agree to a tenth of what is asked."""
    of, args, found = size(case), (case.closed_loop, case.X0), []
    gradient_of = jax.grad(of, argnums=(0, 1))
    for seed in seeds:
        rng = np.random.default_rng(seed)
        by = direction(args, rng)
        at = jax.tree.map(lambda leaf, d: leaf + NEAR * d, args, by)
        gradient, whole = gradient_of(*at), direction(at, rng)
        for part in range(2):
            along = tuple(
                each if number == part else jax.tree.map(jnp.zeros_like, each)
                for number, each in enumerate(whole)
            )
            for h in LENGTHS:
                wide, narrow = (central_difference(of, at, along, each) for each in (h, h / 3))
                scale = max(abs(wide), 1e-2)
                if abs(wide - narrow) < accuracy / 10 * scale:
                    found.append(abs(dot(gradient, along) - wide) / scale)
                    break
    return found


ALONE = (
    *(Case(loop) for loop in ("tank", "disturbed in a polytope", "disturbed in a ball")),
    Case("relu", "forms", "far intersection"),
)
"""Rows of a kind that no other row is of: none of them is left to `-m long`."""

MORE = (
    *(Case(loop, by) for loop in ("leaky", "residual") for by in ("forms", "programs")),
    Case("sine, tanh"),
)
"""Rows of units that no other row that is taken has."""

SOME = (
    *(Case(loop, "forms") for loop in ("relu", "leaky", "hard", "residual", "disturbed in a ball")),
    *(Case(loop, "forms") for loop in ("inputs in a cube", "sine", "tank", "oscillator")),
    *(Case("relu", "forms", initial) for initial in ("polytope", "ellipsoid")),
    *(Case(loop) for loop in ("relu", "disturbed", "inputs in a pentagon", "tanh", "sine, tanh")),
    *(Case(loop, "forms") for loop in ("disturbed in a polytope", "traced")),
    *(Case(loop, "few programs") for loop in ("hard", "sine")),
    *(Case(loop, "programs") for loop in ("relu", "leaky", "hard", "residual")),
    Case("oscillator, hard", "one cell"),
    Case("relu", "programs", "simplex"),
    Case("relu", "programs", "ellipsoid", "ellipsoids"),
    Case("one state", "programs", "own", "mixed"),
    *ALONE,
)
"""Rows that are quick to compile."""

LOOPS = "relu", "hard", "tanh", "sine", "sine, tanh", "oscillator, hard", "disturbed"
METHODS = "default", "one cell", "no programs", "few programs", "forms"
REST = [
    row
    for row in itertools.starmap(Case, itertools.product(LOOPS, METHODS, ("own", *INITIAL)))
    if row not in SOME
]


@pytest.mark.costly
@each(rows=SOME, basic=(*BASIC, *ALONE, *MORE), every=2)
def test_a_derivative_is_the_difference(case):
    accuracy = ACCURACY.get(case.method, 1e-3)
    found = errors(case, range(2), accuracy)
    assert found, "no generic point"
    assert max(found) < accuracy


@pytest.mark.long
@each(rows=REST)
def test_derivatives_of_all_kinds_are_differences(case):
    found = errors(case, range(10, 13))
    assert max(found, default=0.0) < 1e-3
    assert np.median(found or [0.0]) < 1e-6


@pytest.mark.costly
@each(rows=SOME, every=2)
def test_what_is_differentiated_is_what_is_called(case):
    of, args = size(case), (case.closed_loop, case.X0)
    value, _ = jax.value_and_grad(of, argnums=(0, 1))(*args)
    np.testing.assert_allclose(value, of(*args), rtol=1e-7)
