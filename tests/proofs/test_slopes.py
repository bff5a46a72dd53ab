"""Derivatives of proved bounds at held multipliers: those of what the recheck proves."""

import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.gradients import held_level, held_offsets
from reachjax.proofs.recheck import interval_offsets, sound_level, sound_offsets
from reachjax.proofs.reported import Sized, judged_offsets
from reachjax.sets import NormalForm
from reachjax.solvers import Facets, LeastVolume
from reachjax.solvers.ellipsoids import form_of, level_slopes
from reachjax.solvers.facets import offset_slopes
from tests.closed_loops import proposal_of
from tests.solvers.test_enclosures import case, program

STEP = 1e-6
"""Rounding, which the recheck pays for, is some 1e-13 of a bound: 1e-7 of a difference over it."""


@pytest.fixture(scope="module", params=[1, 2, 3])
def held(request):
    """A program and Clarabel's multipliers for it, off by up to a third."""
    found = program(*case(request.param, seed=request.param))
    noise = np.random.default_rng(0).uniform(0.7, 1.3, found.products.free.shape)
    return found, noise * np.asarray(proposal_of(rj.Clarabel(), found).multipliers)


def moves(held):
    """The program moved by `h` along a random direction in its rows, and that direction."""
    rng = np.random.default_rng(1)
    facts, objective = (
        rng.normal(size=rows.mid.shape) * abs(rows.mid) for rows in (held.facts, held.objective)
    )

    def moved(h):
        return held.with_midpoints(held.facts.mid + h * facts, held.objective.mid + h * objective)

    return moved, (facts, objective)


def along(slopes, direction):
    """A derivative in rows along a direction in them."""
    return sum(np.sum(slope * part) for slope, part in zip(slopes, direction, strict=True))


def offsets_along(program, held, direction):
    """The derivatives of all offsets, one after the other."""
    facets = np.eye(len(program.objective.mid))
    return [along(offset_slopes(program, *held, facet), direction) for facet in facets]


def difference(f):
    return (f(STEP) - f(-STEP)) / (2 * STEP)


def test_offsets_that_multipliers_prove_have_the_derivative_of_what_is_proved(held):
    held, multipliers = held
    moved, direction = moves(held)
    slopes = held_offsets(held, multipliers, np.full(len(multipliers), True))
    mine = offsets_along(held, slopes, direction)
    proved = difference(lambda h: sound_offsets(moved(h), multipliers))
    np.testing.assert_allclose(mine, proved, rtol=1e-5, atol=1e-6)


def test_offsets_by_intervals_have_theirs(held):
    held, multipliers = held
    moved, direction = moves(held)
    slopes = held_offsets(held, multipliers, np.full(len(multipliers), False))
    mine = offsets_along(held, slopes, direction)
    proved = difference(lambda h: interval_offsets(moved(h)))
    np.testing.assert_allclose(mine, proved, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("factor", [1.0, 0.0], ids=["multipliers", "intervals"])
def test_levels_have_the_derivative_of_what_is_proved(held, factor):
    held, _ = held
    proposal = proposal_of(rj.Clarabel(), held, LeastVolume())
    noise = np.random.default_rng(0).uniform(0.9, 1.1, proposal.multipliers.shape)
    # off the middle, where a bound by intervals has no derivative
    form = form_of(proposal.unknowns[0])
    form = form._replace(b=form.b + 0.01)
    multipliers = factor * noise * proposal.multipliers
    moved, direction = moves(held)
    assert bool(held_level(held, multipliers, form).multipliers.any()) == bool(factor)
    value, off = Sized(form, np.array(np.nan)), proposal._replace(multipliers=multipliers)
    mine = along(level_slopes(held, value, off)[0], direction)
    proved = difference(lambda h: sound_level(moved(h), multipliers, form))
    assert float(mine) == pytest.approx(proved, rel=1e-5, abs=1e-6)


@pytest.mark.costly
def test_where_the_ball_alone_bounds_a_direction_the_derivative_holds_too():
    """No `v` in the direction of the largest eigenvalue: two maximisers, one on either side."""
    held = program(*case(2, seed=0))
    k = int(np.argmax(~held.products.free))
    pair = np.flatnonzero(held.products.multiplier == k)
    n = len(held.transform)
    facts = np.zeros_like(held.facts.mid)
    facts[held.products.left[pair], 0] = facts[held.products.right[pair], 0] = 1.0  # eta_0^2
    objective = np.zeros((1, n))
    objective[0, [1, -1]] = 0.1, 1.0
    bare = held.with_objective(slice(1)).replace(
        facts=type(held.facts)(facts, 0 * facts),
        objective=type(held.facts)(objective, 0 * objective),
    )
    multipliers = np.where(np.arange(len(held.products.free)) == k, 1.0, 0.0)[None]
    moved, direction = moves(bare)
    slopes = held_offsets(bare, multipliers, np.array([True]))
    assert slopes[1][0, 0, 0] == pytest.approx(bare.used.sum() - 1, abs=0.1)  # the ball's radius
    mine = offsets_along(bare, slopes, direction)
    proved = difference(lambda h: sound_offsets(moved(h), multipliers))
    np.testing.assert_allclose(mine, proved, rtol=1e-5, atol=1e-6)


@pytest.mark.costly
def test_a_point_has_a_level_without_a_derivative():
    held = program(*case(2, seed=0))
    zero = NormalForm(np.zeros((2, 2)), np.zeros(2))
    weights, moments = held_level(held, np.zeros((1, len(held.products.free))), zero)
    assert not weights.any()
    assert not moments.any()


@pytest.mark.costly
def test_multipliers_that_prove_nothing_are_not_in_the_derivative():
    """Negative ones are clipped in the proof, and so they are where the optimum is borne out."""
    given = program(*case(1, seed=1))
    found = proposal_of(rj.InteriorPoint(), given)
    signed, small = ~given.products.free, abs(found.multipliers) < 1e-6
    assert (signed & small).any()
    spoilt = found._replace(multipliers=np.where(signed & small, -3.0, found.multipliers))
    mine, clean = judged_offsets(given, spoilt), judged_offsets(given, found)
    assert mine.optimal.all()
    goal, weights = Facets(given.objective.mid), np.ones(len(mine.value))
    slopes = [goal.slopes(given, judged, weights)[0].facts for judged in (mine, clean)]
    np.testing.assert_allclose(*slopes, atol=1e-6 * abs(slopes[1]).max())
