"""Merged columns hold what they held, and a horizon may be long."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.affine import AffineForms
from reachjax.programs.merging import merged_columns
from reachjax.programs.unrolled import unrolled_at_once, unrolled_from_boxes

FIRST, COLUMNS, COUNT = 3, 24, 12
MERGED = jax.jit(merged_columns, static_argnums=(1, 2))
exact = np.vectorize(lambda number: Fraction(float(number)), otypes=[object])


def forms(n, seed, size=None):
    """States over columns some of which are small, with radii as rounding leaves them."""
    rng = np.random.default_rng(seed)
    sizes = 10.0 ** rng.uniform(-6, 0, COLUMNS) if size is None else size
    rows = rng.normal(size=(n, 2 + FIRST + COLUMNS)) * np.r_[np.ones(2 + FIRST), sizes]
    rows = rows * 10.0 ** rng.uniform(-3, 3, (n, 1))
    rows[:, 2 + FIRST :][:, rng.random(COLUMNS) < 0.2] = 0.0
    if seed % 3 == 0 and n > 1:  # one state is a function of another one
        rows[-1] = 0.5 * rows[0]
    radii = np.stack([1e-16 * abs(rows).sum(axis=1), np.ones(n)], axis=1)
    return AffineForms(jnp.asarray(rows), jnp.asarray(radii))


def reaches(state, directions):
    """What columns and radii add to each direction, in fractions."""
    columns, radii = exact(state.columns[:, FIRST:]), exact(state.radii[:, 0])
    return abs(directions @ columns).sum(axis=1) + abs(directions) @ radii


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("n", [1, 2, 4])
def test_merged_columns_hold_what_they_held_in_fractions(n, seed):
    state = forms(n, seed)
    merged = MERGED(state, FIRST, COUNT)
    directions = exact(np.random.default_rng(seed).normal(size=(8, n)))
    assert (reaches(merged, directions) >= reaches(state, directions)).all()
    assert not merged.rows[:, 2 + FIRST + COUNT :].any()
    np.testing.assert_array_equal(merged.rows[:, : 2 + FIRST], state.rows[:, : 2 + FIRST])


def test_rounding_is_what_merging_adds_where_columns_lie_along_the_frame():
    """Then a bound is attained: an error of rounding that is not counted is seen."""
    for seed in range(40):
        rng, size = np.random.default_rng(seed), 10.0 ** np.random.default_rng(seed).uniform(-9, 9)
        rows = size * rng.normal(size=(1, 2 + FIRST + COLUMNS))
        state = AffineForms(jnp.asarray(rows), jnp.zeros((1, 2)))
        merged = MERGED(state, FIRST, COUNT)
        one = exact(np.ones((1, 1)))
        before, after = reaches(state, one)[0], reaches(merged, one)[0]
        assert before <= after <= before * (1 + Fraction(1, 10**12))


@pytest.mark.parametrize("seed", range(4))
def test_units_of_states_do_not_change_what_is_merged(seed):
    state, factors = forms(3, seed), 2.0 ** np.array([-20, 0, 17])
    scaled = AffineForms(factors[:, None] * state.rows, factors[:, None] * state.radii)
    one, other = (MERGED(each, FIRST, COUNT).rows for each in (state, scaled))
    np.testing.assert_allclose(other, factors[:, None] * one, rtol=1e-9, atol=0)


def test_columns_that_are_no_numbers_prove_nothing():
    state = forms(2, 1)
    for broken in (np.inf, np.nan):
        rows = state.rows.at[0, 2 + FIRST :].set(broken)
        merged = MERGED(AffineForms(rows, state.radii), FIRST, COUNT)
        assert not np.isfinite(abs(merged.columns[0]).sum() + merged.radii[0, 0])


def pendulum():
    """A pendulum that a tanh network holds upright, which falls without it."""
    net = rj.MLP.from_layers(
        [([[-4.0, -2.0], [1.0, -1.0]], [0.0, 0.1]), ([[1.0, 0.1]], [-0.01])], activation=rj.Tanh()
    )
    plant = rj.NonlinearPlant(
        lambda x, u: x + 0.1 * jnp.array([x[1], jnp.sin(x[0]) + u[0]]), states=2, inputs=1
    )
    return rj.ClosedLoop(plant, net), rj.Box([-0.1, -0.1], [0.1, 0.1])


def test_merged_horizons_hold_trajectories_and_are_hardly_wider():
    loop, X0 = pendulum()
    rows = np.broadcast_to(np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1], [1, 1]]), (80, 5, 2))
    whole = unrolled_at_once(loop, X0, X0, rows).offsets
    few = unrolled_from_boxes(loop, X0.lower[None], X0.upper[None], rows, columns=16)[0, :, 0]
    widths = [offsets[:, [0, 2]] + offsets[:, [1, 3]] for offsets in (few, whole)]
    assert (widths[0] <= 1.1 * widths[1]).all()
    states = X0.sample(jax.random.key(0), 200)
    trajectories = loop.simulate(states, 80)[:, 1:]
    assert (jnp.einsum("tmn,ctn->ctm", rows, trajectories) <= few).all()
