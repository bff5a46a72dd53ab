"""What a verdict says: margins that are known, times, and which obstacle is meant."""

import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import autonomous

DOUBLED = autonomous([[2.0]])
X0 = rj.Box([1.0], [1.5])


def line(verdict, name):
    (found,) = [each for each in str(verdict).splitlines() if each.startswith(f"  {name}:")]
    return found


@pytest.mark.parametrize("cells", [None, 8])
def test_a_margin_is_said_where_every_time_is_known_and_of_a_refutation_the_trajectorys(cells):
    verdict = rj.decide(DOUBLED, X0, 6, safe=rj.Box([-50.0], [50.0]), cells=cells, samples=50)
    assert verdict.refuted
    said, example = line(verdict, "safe"), verdict.counterexample
    assert "certified margin +" not in said
    assert f"simulated margin -{example.violation:.4g} (smallest, at t = {example.time})" in said
    assert "inf" not in verdict._repr_html_().partition("<img")[0]


def test_of_a_proof_all_times_are_known():
    verdict = rj.decide(DOUBLED, X0, 3, safe=rj.Box([-50.0], [50.0]), samples=50)
    assert "certified margin +38 (smallest, at t = 3)" in line(verdict, "safe")
    assert "simulated margin +38 (smallest, at t = 3)" in line(verdict, "safe")


def test_what_was_not_looked_at_is_not_said_to_be_known():
    margins = {"safe": np.array([0.3, 0.2, -np.inf]), "goal": np.array([np.nan, np.nan, -np.inf])}
    simulated = {"safe": np.array([0.3, 0.4, 0.1]), "goal": np.array([np.nan, np.nan, -0.5])}
    verdict = rj.Verdict(rj.VerdictStatus.UNKNOWN, margins, simulated)
    said = "certified margin known at 2 of 3 times, simulated margin +0.1 (smallest, at t = 2)"
    assert line(verdict, "safe").endswith(said)
    said = "certified margin unknown, simulated margin -0.5 (smallest, at t = 2)"
    assert line(verdict, "goal").endswith(said)
    assert "0.2" not in verdict._repr_html_().partition("<img")[0]


def test_obstacles_at_different_times_have_names_of_their_own():
    early, late, both = rj.Box([4.0], [5.0]), rj.Box([20.0], [30.0]), rj.Box([-9.0], [-8.0])
    tube = rj.reach(DOUBLED, X0, 2, rj.Template.box(1))
    verdict = rj.verify(tube, avoid={1: [early, both], 2: [late, both]}, samples=50)
    assert verdict.proved
    assert [*verdict.margins] == ["avoid[0]", "avoid[1]", "avoid[2]"]
    assert "+1 (smallest, at t = 1)" in line(verdict, "avoid[0]")
    assert "+14 (smallest, at t = 2)" in line(verdict, "avoid[2]")
    np.testing.assert_array_equal(np.isnan(verdict.margins["avoid[1]"]), [True, False, False])
