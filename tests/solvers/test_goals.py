"""Every solver takes every goal, and answers all of them alike."""

import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.proposal import ANSWERS, Proposal
from reachjax.solvers.ellipsoids import form_of
from tests.programs.test_pencils import goals, program_of

SOLVERS = {
    "by itself": rj.InteriorPoint(),
    "by name": rj.CvxpySolver(*rj.Clarabel().settings()),
    "SCS": rj.SCS(),
    "chosen": rj.Auto(),
}


@pytest.fixture(scope="module", params=[1, 2])
def program(request):
    return program_of(request.param)


def sizes(found):
    """What is sought; of a form that is, its determinant."""
    u = found.unknowns
    return u if u.shape[1] == 1 else np.linalg.det(form_of(u[0]).A)


@pytest.mark.parametrize("which", range(3), ids=["facets", "least volume", "given shape"])
@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_takes_every_goal(program, which, name):
    goal = goals(len(program.objective.mid))[which]
    found, reference = (each.solve(program, goal) for each in (SOLVERS[name], rj.Clarabel()))
    assert set(found.statuses.tolist()) <= set(ANSWERS)
    np.testing.assert_allclose(sizes(found), sizes(reference), rtol=1e-4, atol=1e-4)
    for part, like in zip(found, Proposal.blank(program, goal), strict=True):
        assert np.shape(part) == like.shape
    corner = len(program.transform) - 1
    np.testing.assert_allclose(found.moments[:, corner, corner], 1.0)
