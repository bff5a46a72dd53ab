"""Each bound says how the search for it ended, and a verdict counts them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.proposal import AS_ASKED, OF_SOLVERS

STEPS = 2


def switching() -> tuple[rj.ClosedLoop, rj.Box, rj.Template]:
    """A loop whose bounds need the phases of three units, whatever is drawn elsewhere.

    The input, the sum of `relu(x_i + x_j) - relu(x_i) - relu(x_j)` over pairs, is zero at most;
    lines above and below units do not show that before one unit of each pair is in one phase.
    """
    single, pairs = np.eye(3), np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0]])
    layers = [
        (np.vstack([single, pairs]), np.zeros(6)),
        (np.array([[-2.0, -2.0, -2.0, 1.0, 1.0, 1.0]]), np.zeros(1)),
    ]
    plant = rj.AffinePlant(0.5 * single, np.ones((3, 1)))
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers(layers))
    return loop, rj.Box([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]), rj.Template.box(3)


def smooth() -> tuple[rj.ClosedLoop, rj.Box, rj.Template]:
    plant = rj.NonlinearPlant(
        lambda x, u: jnp.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (jnp.sin(x[0]) + u[0])]), 2, 1
    )
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: -jnp.tanh(x[:1]), 2, 1))
    return loop, rj.Box([-1.0, -1.0], [1.0, 1.0]), rj.Template.box(2)


ENDS = {
    "no time": (switching, {"time_limit": 0}, "TIME"),
    "few programs": (switching, {"relaxation": rj.BranchAndCut(nodes=2)}, "BUDGET"),
    "forms alone": (switching, {"relaxation": rj.LinearBounds()}, "AFFINE_FORM"),
    "no time for cells": (smooth, {"time_limit": 0}, "TIME"),
    "few cells": (smooth, {"relaxation": rj.BranchAndCut(cells=2)}, "BUDGET"),
    "one cell": (smooth, {"relaxation": rj.BranchAndCut(cells=1)}, "STALLED"),
}


@pytest.mark.parametrize(("made", "options", "expected"), ENDS.values(), ids=ENDS)
@pytest.mark.costly
def test_a_facet_whose_gap_is_open_says_why(made, options, expected):
    loop, X0, template = made()
    tube = rj.reach(loop, X0, STEPS, template, **options)
    status, open_facets = rj.SolverStatus[expected], 0
    for k in range(1, STEPS + 1):
        proof = tube.proof(k)
        widths = np.asarray(tube.sets[k].b + tube.sets[k].support(-template.directions))
        for each, gap, width in zip(proof.statuses, proof.gaps, widths, strict=True):
            if gap > 1e-3 * width:  # ten times what may be left open by default
                assert each is status
                open_facets += 1
        assert expected in repr(proof) or isinstance(proof, rj.LinearCertificate)
    assert open_facets
    verdict = rj.verify(tube, safe=rj.Box([-9.0] * loop.states, [9.0] * loop.states), samples=10)
    assert verdict.ends[status] >= open_facets
    assert (verdict.unsolved >= open_facets) == (status not in AS_ASKED)
    assert (expected in str(verdict)) == (status not in AS_ASKED)
    assert int(rj.unsolved(tube)) == verdict.unsolved


@pytest.mark.parametrize("made", [switching, smooth])
@pytest.mark.costly
def test_a_facet_whose_gap_is_closed_is_solved(made):
    loop, X0, template = made()
    tube = rj.reach(loop, X0, STEPS, template)
    for k in range(1, STEPS + 1):
        proof = tube.proof(k)
        assert proof.ends == {rj.SolverStatus.SOLVED: len(template)}
    assert int(rj.unsolved(tube)) == 0


@pytest.mark.costly
def test_a_decision_that_ran_out_of_time_or_programs_says_so():
    loop, X0, template = switching()
    proof = rj.reach(loop, X0, STEPS, template).proof(STEPS)
    bound = float(proof.bounds[0])
    goal = rj.Polytope(template.directions[:1], [bound + 1e-4])
    asked = {"goal": goal, "samples": 100}
    solved = rj.decide(loop, X0, STEPS, **asked)
    assert solved.proved
    assert set(solved.certificates["goal", STEPS].statuses) == {rj.SolverStatus.SOLVED}
    late = rj.decide(loop, X0, STEPS, **asked, time_limit=0)
    assert late.unknown
    assert late.ends == {rj.SolverStatus.TIME: 1}
    none = rj.decide(loop, X0, STEPS, **asked, relaxation=rj.BranchAndCut(nodes=0))
    assert none.ends == {rj.SolverStatus.AFFINE_FORM: 1}


def test_a_search_of_cells_that_is_interrupted_says_so():
    loop, X0, template = smooth()

    class Bar:
        def __init__(self, steps):
            self._steps, self._notes = steps, 0

        def __iter__(self):
            return iter(self._steps)

        def set_postfix_str(self, note):
            self._notes += 1
            if self._notes == 2:
                raise KeyboardInterrupt

    with pytest.raises(rj.Interrupted) as raised:
        rj.reach(loop, X0, STEPS, template, progress=Bar)
    tube = raised.value.tube
    assert rj.SolverStatus.INTERRUPTED in tube.proof(1).statuses


@pytest.mark.costly
def test_statuses_are_kept_by_a_file_and_shown_by_tables(tmp_path):
    loop, X0, template = switching()
    tube = rj.reach(loop, X0, STEPS, template, time_limit=0)
    tube.save(tmp_path / "tube.npz")
    again = rj.load(tmp_path / "tube.npz")
    assert again.proof(2).statuses == tube.proof(2).statuses
    assert "TIME" in again._repr_html_()
    assert "TIME" in set(again.to_dataframe().status)


def test_each_status_has_one_sentence_of_advice_and_solvers_report_the_first_ones_alone():
    assert all(status.advice for status in rj.SolverStatus)
    assert [status.name for status in OF_SOLVERS] == [
        "SOLVED",
        "INACCURATE",
        "INFEASIBLE",
        "UNBOUNDED",
        "LIMIT",
        "FAILED",
    ]


@pytest.mark.costly
def test_forms_in_compiled_code_say_what_they_are():
    loop, X0, template = switching()

    @jax.jit
    def codes(X0):
        tube = rj.reach(loop, X0, STEPS, template, rj.LinearBounds())
        return tube.proof(1).codes, rj.unsolved(tube)

    found, unsolved = codes(X0)
    assert set(np.asarray(found)) == {int(rj.SolverStatus.AFFINE_FORM)}
    assert int(unsolved) == 0
