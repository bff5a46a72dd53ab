"""Polynomials of symbols: products hold, and leave nothing out that there are symbols for."""

import itertools
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.flows.taylor_models import Symbols, TaylorModels
from reachjax.loops.units import evaluate
from reachjax.numerics.host import in_numpy
from reachjax.programs.affine import AffineForms
from reachjax.programs.flows import flowed_forms
from reachjax.programs.initial import InitialColumns
from reachjax.sets import Box

SIZES = [(1, 1), (2, 3), (3, 2), (4, 6)]


def chebyshev(powers):
    """The product of Chebyshev polynomials of these degrees, of as many numbers."""
    return lambda w: np.prod([np.cos(k * np.arccos(x)) for k, x in zip(powers, w, strict=True)])


def values(symbols, w, r):
    """The constant and all symbols at a point; the `r` are parts of their radii."""
    n, both = symbols.initial, np.concatenate([w, r])
    pairs, triples = (itertools.combinations_with_replacement(range(n), k) for k in (2, 3))
    degrees = [np.bincount(each, minlength=n) for each in itertools.chain(pairs, triples)]
    products, second = [chebyshev(each)(w) for each in degrees], n * (n + 1) // 2
    mixed = [
        both[i] * both[j] if i != j else 2 * both[i] ** 2 - 1
        for i, j in itertools.combinations_with_replacement(range(len(both)), 2)
        if j >= n
    ]
    parts = [1.0], w, products[:second], symbols.radii * r, products[second:], mixed
    return np.concatenate(parts)


def points(rng, symbols, count):
    """Values of symbols at points within and at corners."""
    for k in range(count):
        w, r = (rng.uniform(-1, 1, size=size) for size in (symbols.initial, len(symbols.radii)))
        if k % 2:
            w, r = np.sign(w), np.sign(r)
        yield values(symbols, w, r)


@pytest.mark.parametrize(("initial", "count"), SIZES)
def test_products_hold_at_every_point(initial, count):
    rng = np.random.default_rng(initial)
    symbols = Symbols(initial, True, rng.uniform(size=count)).with_higher
    for _ in range(5):
        A, B = rng.normal(size=(2, 4, 1 + symbols.total)) * rng.uniform(size=(2, 1, 1))
        one, other = (TaylorModels(rows, rng.uniform(size=4) / 10, symbols) for rows in (A, B))
        found = one.times(other)
        for at in points(rng, symbols, 100):
            assert np.all(abs(at[1:]) <= 1 + 1e-12)
            first, second = (
                rows @ at + model.radii * rng.choice([-1, 1], size=4)
                for rows, model in ((A, one), (B, other))
            )
            assert np.all(abs(found.rows @ at - first * second) <= found.radii)
            assert np.all((found.ends()[0] <= first * second) & (first * second <= found.ends()[1]))


@pytest.mark.parametrize(
    ("size", "radius"), [(1e-165, 1e150), (1e-165, 1e300), (1e-200, 1e190), (1e140, 1e-150)]
)
def test_no_scale_takes_anything_from_a_number(size, radius):
    """What underflows in a coefficient is times a radius that may be large."""
    rng = np.random.default_rng(0)
    symbols = Symbols(1, True, radius * rng.uniform(0.1, 1, size=2)).with_higher
    rows = np.zeros((2, 1 + symbols.total))
    rows[:, 3:5] = size * rng.uniform(-1, 1, size=(2, 2))
    one, other = (TaylorModels(each[None], np.zeros(1), symbols) for each in rows)
    for s in itertools.product((-1, 0, 1), repeat=2):
        r = [Fraction(number) * part for number, part in zip(symbols.radii, s, strict=True)]
        first, second = (
            sum(Fraction(number) * part for number, part in zip(each[3:5], r, strict=True))
            for each in rows
        )
        cases = [(one.times(other), first * second), (one.times(one), first * first)]
        cases += [(1e-160 * one, Fraction(1e-160) * first)]
        cases += [(np.array([[1e-160]]) @ one, Fraction(1e-160) * first)]
        for found, value in cases:
            lower, upper = (float(end[0]) for end in found.ends())
            assert Fraction(lower) <= value <= Fraction(upper)


@pytest.mark.parametrize(("initial", "count"), SIZES)
def test_products_leave_nothing_out_that_there_are_symbols_for(initial, count):
    """Two linear numbers, or one of the initial set alone and one with products of it."""
    rng = np.random.default_rng(count)
    symbols = Symbols(initial, True, rng.uniform(size=count)).with_higher
    own, linear = 1 + symbols.own, 1 + symbols.own + count
    A, B, C, D = rng.normal(size=(4, 3, 1 + symbols.total))
    for rows in (A, B):
        rows[:, 1 + initial : own] = rows[:, linear:] = 0.0
    C[:, 1 + initial :] = D[:, own:] = 0.0
    for one, other in ((A, B), (C, D), (D, C)):
        found = TaylorModels(one, np.zeros(3), symbols).times(
            TaylorModels(other, np.zeros(3), symbols)
        )
        assert np.all(found.radii <= 1e-11)
        for at in points(rng, symbols, 20):
            np.testing.assert_allclose(found.rows @ at, (one @ at) * (other @ at), atol=1e-11)


def test_a_product_of_three_initial_columns_is_found_at_the_end_of_a_period():
    """Each operation alone would leave out what cancels."""
    n, box = 3, Box(np.full(3, -0.3), np.full(3, 0.3))
    plant = in_numpy(
        rj.SampledPlant(lambda x, u: jnp.ones(3) * x[0] * x[1] * x[2] + 0 * u, n, 3, period=0.1)
    )
    start = InitialColumns.of(box, box, curved=True)
    forms = AffineForms.beginning(start)
    found, _ = flowed_forms(plant.flow, (forms, np.zeros((3, 3)) @ forms), start)
    lower, upper = found.ends(start)
    corner = np.full(n, 0.3)
    highest = plant.flow.simulated((corner, np.zeros(n)), evaluate)
    assert np.all(upper <= highest + 0.05 * (highest - corner))
    assert np.all(upper >= highest - 1e-12)
    np.testing.assert_allclose(lower, -upper, rtol=1e-9)
