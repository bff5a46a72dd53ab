"""Tubes and verdicts as sequences, data frames, pictures and HTML."""

import re
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

import reachjax as rj
from tests.closed_loops import autonomous, closed_loop, random_loop

BOX = rj.Template.box(2)
SAFE = rj.Box([-9.0, -9.0], [9.0, 9.0])


@pytest.fixture(scope="module")
def loop():
    return closed_loop(random_loop(2, (4, 3), seed=2))


@pytest.fixture(scope="module")
def X0():
    return rj.Box([-0.2, -0.2], [0.2, 0.2])


@pytest.fixture(scope="module")
def tube(loop, X0):
    return rj.reach(loop, X0, 3, BOX)


@pytest.fixture(scope="module")
def parts(loop, X0):
    return rj.reach_partitioned(loop, X0, 2, BOX, cells=(2, 1))


def test_a_tube_is_the_sequence_of_its_sets(tube):
    assert len(tube) == 4
    assert tube[-1] is tube.sets[3]
    assert tube[1:] == tube.sets[1:]
    assert [*tube] == [*tube.sets]


def test_a_partitioned_tube_is_the_sequence_of_its_cells(parts):
    assert len(parts) == 2
    assert [*parts] == [parts[0], parts[1]] == [*parts.tubes]


def test_a_data_frame_says_what_certificates_say(tube):
    table = tube.to_dataframe()
    assert len(table) == 3 * 4
    for t in (1, 2, 3):
        rows, proof = table[table.t == t], tube.proof(t)
        np.testing.assert_array_equal(rows.bound, proof.bounds)
        np.testing.assert_array_equal(rows.witness, proof.witnesses)
        np.testing.assert_array_equal(rows.gap, proof.gaps)
        np.testing.assert_array_equal(rows.seconds, proof.seconds)
        np.testing.assert_array_equal(np.stack(rows.direction), BOX.directions)
        assert [*rows.facet] == [0, 1, 2, 3]
        assert [*rows.status] == [status.name for status in proof.statuses]
        assert set(rows.proof) == {type(proof).__name__}


def test_a_data_frame_of_cells_numbers_them(parts):
    table = parts.to_dataframe()
    assert table.columns[0] == "cell"
    bounds = table[table.t == 2].groupby("facet").bound.max()
    np.testing.assert_array_equal(bounds, parts.bounds(2))


@pytest.mark.costly
def test_ellipsoids_have_no_facet(loop, X0):
    mixed = rj.reach(loop, X0, 1, rj.MixedTemplate(BOX), rj.LocalBounds(), 1).to_dataframe()
    assert mixed.facet.isna().tolist() == [False] * 4 + [True]
    assert mixed.direction.isna().tolist() == [False] * 4 + [True]


def test_directions_that_change_with_time_are_those_of_the_step(loop, X0):
    template = rj.Template(np.stack([BOX.directions, 2 * BOX.directions]))
    table = rj.reach(loop, X0, 2, template).to_dataframe()
    np.testing.assert_array_equal(np.stack(table[table.t == 2].direction), 2 * BOX.directions)


def test_without_pandas_the_error_says_what_to_install(tube, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'reachjax\[tables\]'"):
        tube.to_dataframe()


def test_without_matplotlib_the_error_says_what_to_install(tube, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"pip install 'reachjax\[plot\]'"):
        tube.plot()


def test_a_plot_is_that_of_the_function(tube, parts):
    for each in (tube, parts):
        ax = Figure().subplots()
        assert each.plot(ax, samples=10) is ax
        assert len(ax.patches) == sum(len(t.sets) for t in getattr(each, "tubes", (each,)))


@pytest.mark.costly
def test_notebooks_show_a_table_and_a_picture(tube, parts):
    for each in (tube, parts):
        shown = each._repr_html_()
        assert shown.count("<tr>") == 1 + each.horizon
        assert shown.count('<img src="data:image/png;base64,') == 1
    assert "BranchCertificate" in tube._repr_html_()


def test_a_loop_of_one_state_has_a_table_only():
    tube = rj.reach(autonomous([[0.5]]), rj.Box([1.0], [2.0]), 2, rj.Template.box(1))
    assert "<img" not in tube._repr_html_()
    assert tube._repr_html_().count("<tr>") == 3


def test_without_matplotlib_there_are_tables(tube, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert "<img" not in tube._repr_html_()


VERDICTS = {
    "proved": SAFE,
    "refuted": rj.Box([-0.1, -9.0], [9.0, 9.0]),
}


@pytest.mark.parametrize("status", VERDICTS)
def test_a_verdict_says_what_it_is(status, tube):
    verdict = rj.verify(tube, safe=VERDICTS[status], samples=50)
    said = {name: getattr(verdict, name) for name in ("proved", "refuted", "unknown")}
    assert said == {"proved": False, "refuted": False, "unknown": False} | {status: True}
    shown = verdict._repr_html_()
    assert re.findall(r"<b>(\w+)</b>", shown) == [status.upper()]
    assert '<td style="text-align: left">safe</td>' in shown
    assert shown.count("<img") == 1
    assert ("counterexample" in shown) is (status == "refuted")


def test_a_verdict_that_is_unknown(loop, X0):
    verdict = rj.decide(loop, X0, 3, safe=SAFE, time_limit=0.0)
    assert not verdict.refuted
    tube = rj.reach(loop, X0, 3, BOX, rj.LinearBounds())
    best = np.asarray(tube.proof(3).bounds) - 0.5 * np.asarray(tube.proof(3).gaps)
    assert rj.verify(tube, goal=rj.Polytope(BOX.directions, best), samples=50).unknown


@pytest.mark.costly
def test_a_verdict_of_cells_and_a_winning_set_show_their_cells(loop, X0):
    verdict = rj.decide(loop, X0, 2, safe=SAFE, cells=2)
    assert "cells: " in verdict._repr_html_()
    found = rj.winning_set(loop, X0, 2, safe=SAFE, cells=4)
    shown = found._repr_html_()
    assert shown.count("<tr>") == 4
    assert shown.count("<img") == 1
    assert found.plot(Figure().subplots()).get_legend() is not None


@pytest.mark.costly
def test_the_package_lists_its_public_names_only():
    script = "import reachjax; print(*dir(reachjax))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == sorted(rj.__all__)
