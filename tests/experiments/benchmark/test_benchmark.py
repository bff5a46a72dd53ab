"""The benchmark's table: the same program gives the same bounds, and ratios are of one run."""

import json
import re

import jax
import numpy as np
import pytest
from rich.console import Console

import reachjax as rj
from experiments.benchmark import loops, study
from experiments.benchmark.cases import Case, Settings, cases, he_network
from experiments.benchmark.growth import (
    GROWTH_NOTE,
    exponent,
    grown,
    growth_table,
    in_new_process,
    jobs,
    related,
)
from experiments.benchmark.parts import PARTS, parts
from experiments.benchmark.steps import REFERENCE, STEPS_NOTE, measured, methods, steps_table
from experiments.double_integrator.problem import INITIAL_BOX
from experiments.verified_training import step_cost
from tests.selection import draw_from

QUICK = {"networks": ("random",), "widths": (3,), "repetitions": 1, "patience": 1e3}
COLUMNS = 80


def case():
    """A tiny network, some of whose neurons switch on the set and none of which is constant."""
    return Case("random 2x3", he_network((2, 3, 3, 1), seed=3), np.array([[-0.25] * 2, [0.25] * 2]))


@pytest.fixture(scope="module")
def rows():
    settings = Settings(**QUICK)
    return list(measured(case(), methods(settings), settings))


def test_the_reference_comes_first_and_every_method_has_a_row(rows):
    assert [row["method"] for row in rows] == list(methods(Settings(**QUICK)))
    assert rows[0]["method"] == REFERENCE


def test_the_same_program_has_the_same_size_and_bounds(rows):
    reference, *same = rows[:3]
    for row in same:
        assert (row["n"], row["multipliers"]) == (reference["n"], reference["multipliers"])
        assert row["difference"] < 1e-5
    assert [row["difference"] for row in rows[3:]] == [None] * 4


def test_no_bound_is_below_what_was_simulated_and_removal_never_loosens(rows):
    reference, *others = (row["slack"] for row in rows)
    kept, removed, local = zip(others[::2], others[1::2], strict=True)
    for pair in (kept, removed, local):
        assert pair[0] == pytest.approx(pair[1], abs=1e-5)
    assert 0 < local[0] <= removed[0] + 1e-6 <= kept[0] + 2e-6
    assert kept[0] == pytest.approx(reference, abs=1e-4)
    support = case().support(seed=0)
    assert all((row["bounds"] >= support - 1e-7).all() for row in rows)


def test_ratios_are_of_the_seconds_of_the_same_run(rows):
    assert rows[0]["ratio"] == 1
    for row in rows:
        assert row["ratio"] == rows[0]["seconds"] / row["seconds"]
        assert row["seconds"] == pytest.approx(np.median(row["calls"]))


@pytest.mark.parametrize("limit", [{"reference_facets": 1}, {"reference_facets": 8}])
def test_a_reference_of_few_facets_is_scaled_up_and_says_so(limit):
    settings = Settings(**QUICK | limit | {"patience": 0.0})  # ends after its first facet
    (row,) = measured(case(), {REFERENCE: methods(settings)[REFERENCE]}, settings)
    assert row["facets"] == 1
    assert row["calls"] == []  # longer than the patience: not called again
    assert row["seconds"] == row["first"]
    assert np.isnan(row["slack"])
    assert np.isnan(row["bounds"][1:]).all()
    assert "~*" in text([row])


def test_the_table_fits_in_eighty_columns(rows):
    lines = text(rows).splitlines()
    assert max(map(len, lines)) <= COLUMNS
    assert all(len(line) <= COLUMNS for line in STEPS_NOTE.splitlines())
    assert all(any(name in line for line in lines) for name in methods(Settings()))


def text(rows, table=steps_table):
    console = Console(width=COLUMNS, record=True)
    with console.capture() as capture:
        console.print(table(rows))
    return re.sub(r"\x1b\[[0-9;]*m", "", capture.get())


def strictly(path):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_the_command_prints_its_tables_and_writes_strict_json(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study, "cases", lambda settings: [case()])
    settings = Settings(**QUICK, reference_facets=1, output=tmp_path)
    few = dict(list(methods(settings).items())[::5])
    monkeypatch.setattr(study, "methods", lambda settings: few)
    study.main(settings)
    assert "random 2x3" in capsys.readouterr().out

    written = strictly(tmp_path / "steps.json")
    assert written["settings"]["widths"] == [3]
    assert [row["method"] for row in written["rows"]] == list(few)
    assert written["rows"][0]["bounds"][1:] == [None] * 7


def test_random_networks_have_the_widths_asked_for():
    (found,) = cases(Settings(**QUICK))
    assert [W.shape for W, _ in found.layers] == [(3, 2), (3, 3), (1, 3)]
    assert found.initial.shape == INITIAL_BOX.shape
    assert isinstance(found.loop, rj.ClosedLoop)


GROWTH = Settings(growth=(3, 5), reference_width=3, repetitions=1, study="growth")


@pytest.fixture(scope="module")
def growing():
    return related([grown(width, name, GROWTH) for width, name in jobs(GROWTH)])


def test_large_networks_are_left_to_the_interior_point_method():
    names = [REFERENCE, "Clarabel", "InteriorPoint"]
    assert jobs(GROWTH) == [*((3, name) for name in names), (5, "InteriorPoint")]


def test_one_facet_has_the_same_bounds_by_every_solver(growing):
    assert [row["n"] for row in growing] == [11, 11, 11, 15]
    assert all(row["difference"] < 1e-5 for row in growing[:3])
    assert growing[3]["difference"] is None


def test_seconds_grow_by_the_slope_of_their_logarithms(growing):
    slope = np.log(growing[3]["seconds"] / growing[2]["seconds"]) / np.log(15 / 11)
    assert exponent(growing, least=11) == pytest.approx(slope)
    assert np.isnan(exponent(growing))


def test_the_table_of_growth_fits_in_eighty_columns(growing):
    lines = [*text(growing, growth_table).splitlines(), *GROWTH_NOTE.splitlines()]
    assert max(map(len, lines)) <= COLUMNS
    assert sum("InteriorPoint" in line for line in lines) == 2


def grown_from(seed, *given):
    """A row of the table whose case is drawn as in a session of this seed."""
    draw_from(seed)
    return grown(*given)


def test_a_new_process_gives_the_same_bounds(growing, request):
    seed = request.config.getoption("seed")
    row = in_new_process(grown_from, seed, 3, "Clarabel", GROWTH)
    np.testing.assert_array_equal(row["bounds"], growing[1]["bounds"])
    assert row["memory"] > 2**20  # the program was compiled there, and nothing before it


@pytest.mark.long
def test_tubes_of_all_ways_agree_and_training_steps_are_timed(tmp_path, capsys, monkeypatch):
    layers = he_network((2, 3, 1), seed=0)
    monkeypatch.setattr(study, "controller", lambda settings: layers)
    monkeypatch.setattr(loops, "SOLVERS", {"Clarabel": rj.Clarabel()})
    monkeypatch.setattr(step_cost, "REPETITIONS", 1)
    study.main(Settings(study="loops", patience=0.0, output=tmp_path))
    written = strictly(tmp_path / "loops.json")
    reference, paper, local = (row["area"] for row in written["tubes"])
    assert paper == pytest.approx(reference, rel=1e-4)
    assert 0 < local <= paper * (1 + 1e-6)
    (cost,) = written["training"]
    assert 0 < cost["solver"] < cost["both"] < cost["first"]
    assert max(map(len, capsys.readouterr().out.splitlines())) <= COLUMNS


@pytest.mark.long
def test_every_part_of_a_step_can_be_timed():
    ready = parts(4, rj.LocalBounds(), rj.Clarabel())
    assert tuple(ready) == PARTS
    found = {name: jax.block_until_ready(part()) for name, part in ready.items()}
    assert np.all(found["solver"].statuses == rj.SolverStatus.SOLVED)
    np.testing.assert_array_equal(found["recheck"], found["step"].bounds)
    value, gradient = found["volume and gradient"]
    box = rj.Template.box(2).polytope(found["recheck"])
    assert value == pytest.approx(np.log(box.volume()), abs=1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
