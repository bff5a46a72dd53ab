"""What units that jump say of themselves holds of all that the closed law allows, exactly."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from reachjax.loops.units import Entered, Floor, Gated, OneHot, Step

exactly = np.vectorize(Fraction, otypes=[object])
TINY = 5e-324


def closed_steps(y):
    """Values of steps at points, as arrays: both at zero."""
    return [(y > 0).astype(int), (y >= 0).astype(int)]


def ends(seed, count):
    """Intervals of all sizes, thin ones, and some that end at zero or next to it."""
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.normal(size=(2, count)) * 10.0 ** rng.uniform(-9, 9, (2, count)), axis=0)
    kinds = rng.integers(6, size=count)
    lower, upper = drawn
    lower = np.where(kinds == 0, 0.0, np.where(kinds == 1, -TINY, lower))
    upper = np.where(kinds == 2, np.maximum(lower, 0.0), np.where(kinds == 3, lower, upper))
    return np.minimum(lower, upper), np.maximum(lower, upper)


def inside(lower, upper):
    """Exact points of intervals: ends, zero where it is one, and some between."""
    low, high = exactly(lower), exactly(upper)
    rows = [low + (high - low) * Fraction(k, 5) for k in range(6)]
    return [*rows, np.clip(exactly(np.zeros(len(low))), low, high)]


def require(unit, y, z, lower, upper):
    """Intervals, remainders and lines hold values, and facts are not negative, exactly."""
    low, high = map(exactly, unit.interval(lower, upper))
    assert np.all((low <= z) & (z <= high))
    lines = unit.lines(lower, upper)
    for slope in (np.asarray(lines.above.slope), 0.3 + 0 * lower, -1.7 + 0 * lower):
        low, high = map(exactly, unit.remainder(slope, lower, upper))
        rest = z - exactly(slope) * y
        assert np.all((low <= rest) & (rest <= high))
    below, above = (exactly(slope) * y + exactly(offset) for slope, offset in lines)
    assert np.all((below <= z) & (z <= above))
    affine = np.asarray(lines.affine)
    assert np.all(below[affine] == z[affine])


def require_facts(unit, y, z, lower, upper):
    """Facts are not negative, and complementarities are zero, up to rounding."""
    facts = unit.facts(np.asarray(y, float), np.asarray(z, float), lower, upper)
    size = 1e-12 * (1 + max(abs(lower).max(), abs(upper).max()))
    for block in facts.blocks:
        assert np.all(np.asarray(block.rows) >= -size), block.name
    for left, right in facts.zero:
        assert np.all(abs(facts[left] * facts[right]) <= size)
    names = {block.name for block in facts.blocks}
    assert {name for product in facts.products for name in product[:2]} <= names


@pytest.mark.parametrize("at_zero", [0.0, 1.0])
def test_a_step_is_zero_or_one_and_at_zero_both(at_zero):
    lower, upper = ends(0, 200)
    for y in inside(lower, upper):
        for z in closed_steps(y):
            require(Step(at_zero), y, z, lower, upper)
            require_facts(Step(at_zero), y, z, lower, upper)
    assert Step(at_zero)(np.zeros(1)).item() == at_zero


def test_facts_of_a_step_leave_one_value_off_zero():
    y, lower, upper = np.array([-2.0, -0.5, 0.5, 2.0]), np.full(4, -2.0), np.full(4, 2.0)
    right = Step()(y)
    facts = Step().facts(y, 1 - right, lower, upper)
    assert np.all(np.minimum(facts["not above"], facts["not below"]) < 0)


def test_a_gated_number_counts_where_its_gate_is_one():
    lower, upper = ends(1, 120)
    for y, gate in itertools.product(inside(lower, upper), (0, 1)):
        s = np.full(len(y), gate)
        for low, high in ((0.0, 1.0), (float(gate), float(gate))):
            box = (np.r_[np.full(len(y), low), lower], np.r_[np.full(len(y), high), upper])
            inputs, values = np.r_[s, y], np.r_[0 * s, s * y]
            require(Gated(), inputs, values, *box)
            require_facts(Gated(), inputs, values, *box)
            if high == 1.0:  # of a branch that is not taken nothing counts
                require(Entered(), inputs, np.r_[0 * s, y], *box)
    known = Gated().lines(np.array([0.9999, 1.0]), np.array([1.0001, 3.0]))
    assert known.affine.all()
    assert known.above.slope[1] == 1


@pytest.mark.parametrize("count", [2, 3, 4])
def test_one_of_the_largest_wins(count):
    unit, rng = OneHot(count), np.random.default_rng(count)
    for _ in range(150):
        center = rng.integers(-2, 3, size=count) / 2.0
        radius = rng.integers(0, 3, size=count) / 4.0
        scores = center + radius * rng.choice([-1.0, 0.0, 1.0], size=count)
        low, high = center - radius, center + radius
        pairs = unit.pairs
        box = (np.r_[low, [low[i] - high[j] for i, j in pairs]],
               np.r_[high, [high[i] - low[j] for i, j in pairs]])  # fmt: skip
        y = np.r_[scores, [scores[i] - scores[j] for i, j in pairs]]
        for winner in np.flatnonzero(scores == scores.max()):
            z = np.r_[np.arange(count) == winner, np.zeros(len(pairs))].astype(float)
            require(unit, exactly(y), exactly(z), *box)
            require_facts(unit, y, z, *box)
        least = np.flatnonzero(scores < scores.max())
        for loser in least:
            z = np.r_[np.arange(count) == loser, np.zeros(len(pairs))].astype(float)
            blocks = unit.facts(y, z, *box).blocks
            assert min(np.asarray(block.rows).min() for block in blocks) < 0
        assert unit(y)[:count].argmax() == scores.argmax()


@pytest.mark.parametrize("unit", [Floor(), Floor(0.5), Floor(0.5, even=False)], ids=str)
def test_whole_numbers_are_next_to_their_input(unit):
    rng = np.random.default_rng(3)
    lower = np.r_[rng.normal(size=100) * 4, np.arange(-3, 3) / 2]
    upper = lower + rng.choice([0.0, 0.25, 1.0, 3.0], size=len(lower))
    for y in inside(lower, upper):
        above = np.array([(each + Fraction(unit.above)) // 1 for each in y])
        below = np.array([-((-each - Fraction(unit.above)) // 1) - 1 for each in y])
        for z in (above, below):
            require(unit, y, z, lower, upper)
            require_facts(unit, y, z, lower, upper)
