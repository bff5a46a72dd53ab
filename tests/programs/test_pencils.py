"""A goal's pencil is theorem 1 for what is sought, and what is found for it leads back there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.lmi import form_rows, weighted_products
from reachjax.sets import NormalForm
from reachjax.solvers import Facets, GivenShape, LeastVolume
from reachjax.solvers.ellipsoids import form_of
from tests.closed_loops import closed_loop, random_loop, step_program
from tests.networks import box_region

STATES = [1, 2, 3, 6]


def program_of(n):
    """The program of a step of a small loop, with the successor for an objective."""
    region = box_region(n, n)
    X = rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))
    loop = closed_loop(random_loop(n, seed=n))
    return jax.device_get(step_program(loop, X, X, jnp.eye(n), 0, rj.LocalBounds()))


@pytest.fixture(scope="module", params=STATES)
def program(request):
    return program_of(request.param)


def of_facet(program, i, offset):
    """`2 b e e' - p e' - e p'`."""
    p, e = program.objective.mid[i], np.eye(len(program.transform))[-1]
    return 2 * offset * np.outer(e, e) - np.outer(p, e) - np.outer(e, p)


def of_form(program, form):
    """`[e e', V'; V, I]` with `V = A x+ + b`."""
    V, e = form_rows(program, form).mid, np.eye(len(program.transform))[-1]
    return np.block([[np.outer(e, e), V.T], [V, np.eye(len(V))]])


def explicit(goal, program, i, unknowns):
    """What `F' Gamma F` is subtracted from, as `programs.lmi` states it."""
    if isinstance(goal, Facets):
        return of_facet(program, i, unknowns[0])
    if isinstance(goal, LeastVolume):
        return of_form(program, form_of(unknowns))
    return of_form(program, NormalForm(*(unknowns[0] * part for part in goal.form)))


def goals(n):
    rng = np.random.default_rng(n)
    form = NormalForm(rng.normal(size=(n, n)), rng.normal(size=n))
    return Facets(np.eye(n)), LeastVolume(), GivenShape(form)


@pytest.mark.parametrize("which", range(3), ids=["facets", "least volume", "given shape"])
def test_a_pencil_is_the_matrix_of_its_goal(program, which):
    rng, goal = np.random.default_rng(which), goals(len(program.objective.mid))[which]
    pencil, n = goal.pencil(program), len(program.transform)
    for i in range(goal.shape(program).programs):
        y, u = rng.normal(size=pencil.multipliers), rng.normal(size=len(pencil.sizes))
        X = rng.normal(size=(pencil.size,) * 2)
        stated = pencil.constant(i) + pencil.terms.weighted(np.r_[y, u])
        unit = pencil.units[i]
        multipliers, moments = pencil.normal.invert(unit * y, X @ X.T)
        unknowns = goal.absolute(pencil.normal, i, unit * u)
        assert moments.shape == (goal.shape(program).size,) * 2
        assert len(unknowns) == goal.shape(program).unknowns
        matrix = explicit(goal, program, i, unknowns)
        matrix[:n, :n] -= weighted_products(program, multipliers).mid
        used = np.r_[pencil.normal.columns, np.arange(n, len(matrix))]
        size = abs(matrix).max()
        expected = matrix[np.ix_(used, used)]
        np.testing.assert_allclose(unit * stated, expected, atol=1e-12 * size)
        # so do moments: their products with both are alike, but for their scale
        corner = (X @ X.T)[len(pencil.normal.columns) - 1, len(pencil.normal.columns) - 1]
        pairs = np.sum(matrix * moments), unit * np.sum(stated * (X @ X.T)) / corner
        assert pairs[0] == pytest.approx(pairs[1], rel=1e-9)
        assert moments[n - 1, n - 1] == pytest.approx(1.0)


def test_moments_of_no_scale_are_none(program):
    normal = Facets(program.objective.mid).pencil(program).normal
    for X in (np.zeros((len(normal.columns),) * 2), np.full((len(normal.columns),) * 2, np.nan)):
        assert np.isnan(normal.invert(np.zeros(len(normal.kept)), X)[1]).all()
