"""The library beside its rivals: each bounds what is simulated, and ratios are of one run."""

import dataclasses
import json
import re
import time

import jax
import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import solve_ivp

import reachjax as rj
from experiments.benchmark import study
from experiments.benchmark.cases import Settings, he_network
from experiments.benchmark.rivals import cruise_control, motion
from experiments.benchmark.rivals.affine_forms import affine_bounds
from experiments.benchmark.rivals.comparison import Run, rows, size, unsound
from experiments.benchmark.rivals.lesson import Lesson
from experiments.benchmark.rivals.methods import HIGHS, METHODS, PAPER, Answer, chosen
from experiments.benchmark.rivals.processes import Stopped, from_process
from experiments.benchmark.rivals.table import NOTE, table
from experiments.benchmark.rivals.tasks import TASKS, random_planar, random_pushed, tasks
from experiments.benchmark.timing import Timing
from experiments.double_integrator.problem import closed_loop as planar_loop
from experiments.imitation import evaluate
from experiments.task import Task
from experiments.tightness.exact import SHARP, exact_maxima
from tests.closed_loops import closed_loop, random_loop
from tests.networks import box_region, saturating_network, simulate

QUICK = {"repetitions": 1, "simulations": 500, "patience": 100.0}
COLUMNS = 80
ROUNDING = 1e-12
LESSONS = [cruise_control.LESSON, motion.PLANE, motion.SPACE]


def box_of(n_x, seed=0):
    corners = box_region(n_x, seed).corners
    return rj.Box(corners.min(axis=0), corners.max(axis=0))


def tiny(**requirements):
    """Two steps of the double integrator under a network of three neurons."""
    loop = planar_loop(rj.MLP.from_layers(he_network((2, 3, 1), seed=3)))
    X0 = rj.Box([-0.5, -0.5], [0.5, 0.5])
    return Task(loop, X0, 2, rj.Template.octagonal(2), **requirements)


@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
@pytest.mark.parametrize("kind", [{}, {"boxed": False}, {"steps": 3}])
def test_no_simulated_state_is_beyond_affine_forms(n_x, kind):
    directions = np.vstack([np.eye(n_x), -np.ones(n_x)])
    for seed in range(3):
        data, X0 = random_loop(n_x, seed=seed, network=saturating_network, **kind), box_of(n_x)
        bounds = affine_bounds(closed_loop(data), X0, 3, directions)
        states = np.vstack([X0.vertices(), X0.sample(jax.random.key(seed), 2000)])
        values = (simulate(data, states, 3)[1:] @ directions.T).max(axis=1)
        assert np.all(values <= bounds + ROUNDING * (1 + abs(bounds)))


@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
def test_affine_forms_are_linear_bounds_where_these_have_no_better_interval(n_x):
    """Of two loops in sixteen all facets have a better one, so that four loops do is rare."""
    X0, template = rj.Box(-np.ones(n_x), np.ones(n_x)), rj.Template.box(n_x)
    differences, above = [], []
    for seed in range(4):
        loop = closed_loop(random_loop(n_x, hidden=(8,), boxed=False, seed=seed))
        tube = rj.reach(loop, X0, 1, template, rj.LinearBounds(), samples=1)
        (bounds,) = affine_bounds(loop, X0, 1, template.directions)
        differences.append(bounds - np.asarray(tube.proof(1).bounds))
        values = loop.simulate(X0.vertices(), 1)[:, 1] @ template.directions.T
        above.append(bounds - np.asarray(values).max(axis=0))
    assert np.min(differences) > -1e-9
    assert np.mean(abs(np.array(differences)) < 1e-9) > 0.5
    assert np.max(above) > 1e-3  # some unit switches


@pytest.fixture(scope="module")
def compared():
    """A task, and what every method makes of it, in this process."""
    task, settings = tiny(safe=rj.Box([-9.0, -9.0], [9.0, 9.0])), Settings(**QUICK)
    calls = [(2.0, method(task, settings)) for method in METHODS.values()]
    runs = [
        Run(name, Timing.of([(9.0, None), call])) for name, call in zip(METHODS, calls, strict=True)
    ]
    return task, runs, settings


@pytest.fixture(scope="module")
def related(compared):
    return rows("tiny", *compared)


def test_every_method_bounds_what_is_attained_and_highs_attains_it(compared, related):
    task, runs, _ = compared
    by_name = dict(zip(METHODS, related, strict=True))
    assert all(row["done"] == 1 for row in related)
    assert all(row["slack"] >= -1e-6 for row in related)
    assert not unsound(related)
    assert by_name[HIGHS]["size"] == pytest.approx(1, abs=1e-5)
    assert by_name["reach"]["size"] < by_name["LinearBounds"]["size"]
    assert 1 < by_name["LinearBounds"]["size"] <= by_name["numpy"]["size"] + 1e-9
    assert by_name[PAPER]["size"] > 1
    (answer,) = (run.answer for run in runs if run.method == HIGHS)
    for k in (1, 2):
        expected, _ = exact_maxima(task.loop, task.X0, k, task.directions)
        np.testing.assert_allclose(answer.attained[k - 1], expected, rtol=0, atol=SHARP)


def test_ratios_are_over_the_seconds_of_highs(compared, related):
    assert {row["ratio"] for row in related} == {"1"}
    task, runs, settings = compared
    (highs,) = (run for run in runs if run.method == HIGHS)
    assert highs.answer is not None
    half = dataclasses.replace(highs.answer, done=~highs.answer.done)
    late = Run(HIGHS, Timing(8.0, [8.0], half))
    ended = Run("numpy", None, "it took more than 100 seconds")
    found = rows("tiny", task, [runs[0], late, ended], settings)
    assert [row["ratio"] for row in found] == ["<0.25", "-", "-"]
    assert [row["first"] for row in found] == [9.0, 8.0, settings.patience]


def test_a_bound_below_what_is_attained_is_noticed(compared):
    task, runs, settings = compared
    answer = runs[0].answer
    wrong = dataclasses.replace(answer, bounds=answer.bounds - 1e-2)
    found = rows("tiny", task, [Run("reach", Timing(1.0, [], wrong)), *runs[1:]], settings)
    assert unsound(found) == ["reach on tiny"]


def written(found):
    console = Console(width=COLUMNS)
    with console.capture() as capture:
        console.print(table(found))
    return re.sub(r"\x1b\[[0-9;]*m", "", capture.get())


def test_the_table_fits_in_eighty_columns_and_says_what_did_not_end(compared, related):
    task, _, settings = compared
    problems = "it took more than 100 seconds", "it ended with exit code -9"
    late = rows("late", task, [Run("reach", None, words) for words in problems], settings)
    lines = [*written([*related, *late]).splitlines(), *NOTE.splitlines()]
    assert max(map(len, lines)) <= COLUMNS
    assert all(any(name in line for line in lines) for name in METHODS)
    assert sum(">100" in line for line in lines) == 2
    assert any("reach !" in line for line in lines)


def counted(start, pause):
    for number in range(3):
        yield start + number
        time.sleep(pause if number == 1 else 0)


def failing():
    yield 1
    raise SystemExit(3)


def test_a_process_tells_what_it_yields_in_double_precision():
    (first, *others) = from_process(counted, jax.numpy.array([0.1, 0.2]), 0.0, patience=50)
    assert first.dtype == np.float64
    np.testing.assert_array_equal(others[-1], np.array([0.1, 0.2]) + 2)


def test_a_process_that_takes_too_long_or_fails_is_ended_and_what_it_told_is_kept():
    told = []
    with pytest.raises(Stopped, match="more than 1 seconds"):
        told.extend(from_process(counted, 5, 100.0, patience=1))
    with pytest.raises(Stopped, match="exit code 3"):
        told.extend(from_process(failing, patience=50))
    assert told == [5, 6, 1]


def test_the_command_prints_one_table_and_writes_strict_json(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study, "tasks", lambda settings: {"tiny": tiny()})
    settings = Settings(study="rivals", methods=("numpy", HIGHS), output=tmp_path, **QUICK)
    study.main(settings)
    assert "tubes of the library and its rivals" in capsys.readouterr().out

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    found = json.loads((tmp_path / "rivals.json").read_text(), parse_constant=refuse)
    assert [row["method"] for row in found["rows"]] == [HIGHS, "numpy"]
    assert np.shape(found["rows"][0]["bounds"]) == (2, 8)
    assert found["rows"][0]["margin"] is None  # nothing is required


def test_only_what_there_is_can_be_asked_for():
    with pytest.raises(ValueError, match=r"--loops must be of 2-10-5-1, .* but 'tora' arrived"):
        tasks(Settings(loops=("tora",)))
    with pytest.raises(ValueError, match=r"--methods must be of reach, .* but 'highs' arrived"):
        chosen(tiny(), Settings(methods=("highs",)))
    assert list(tasks(Settings(loops=("random 2x20", "4-64-64-2")))) == ["4-64-64-2", "random 2x20"]


def test_the_paper_is_left_out_where_its_program_is_large():
    settings = Settings()
    assert PAPER in chosen(random_planar(20, settings), settings)
    assert PAPER not in chosen(random_planar(32, settings), settings)
    assert PAPER not in chosen(random_pushed(settings), settings)


def test_margins_are_the_least_room_to_what_is_required():
    states = np.zeros((2, 3, 2))
    states[1, 1], states[0, 2] = [0.0, 0.7], [0.4, 0.0]
    one, far = rj.Box([-1.0, -1.0], [1.0, 1.0]), rj.Box([0.6, -1.0], [0.9, 1.0])
    assert tiny().margin(states) == np.inf
    assert tiny(safe=one).margin(states) == pytest.approx(0.3)
    assert tiny(goal=one).margin(states) == pytest.approx(0.6)
    assert tiny(safe=one, avoid=(far,)).margin(states) == pytest.approx(0.2)
    states[1, 1, 0] = 0.7
    assert tiny(avoid=(far,)).margin(states) == pytest.approx(-0.1)


def test_in_space_the_worst_width_that_moves_counts():
    loop = closed_loop(random_loop(3))
    task = Task(loop, box_of(3), 1, rj.Template.box(3))
    known = np.array([1.0, 1.0, 2.0, 2.0, 1.0, -1.0])  # the third state stands still
    bounds = known + np.array([0.5, 0.0, 0.0, 0.0, 1e-12, 0.0])
    assert size(task, bounds, known) == pytest.approx(1.25)
    assert np.isnan(size(task, np.where(bounds == 2, np.nan, bounds), known))
    assert Answer.of_bounds(bounds[None]).done.all()


@pytest.mark.parametrize("lesson", LESSONS, ids=lambda lesson: lesson.name)
def test_stored_networks_imitate_their_laws(lesson, monkeypatch):
    def refuse(*_):
        raise AssertionError("the stored network was not used")

    monkeypatch.setattr(Lesson, "learned", refuse)
    layers = lesson.layers()
    sizes = [W.shape[0] for W, _ in layers]
    assert sizes[:-1] == list(lesson.hidden)
    typical, _ = lesson.errors(layers)
    assert typical < lesson.error


def test_a_lesson_is_learned_once_until_it_changes(tmp_path, capsys):
    lesson = Lesson(
        "halves", lambda x: x / 2, (-1.0,), (1.0,), (4,), error=0.1, samples=100, steps=500
    )
    first = lesson.layers(tmp_path)
    assert lesson.errors(first, 100)[0] < lesson.error
    np.testing.assert_array_equal(lesson.layers(tmp_path)[0][0], first[0][0])
    assert "other settings" not in capsys.readouterr().out
    other = dataclasses.replace(lesson, seed=1).layers(tmp_path)
    assert not np.array_equal(other[0][0], first[0][0])
    assert "other settings (seed)" in " ".join(capsys.readouterr().out.split())


def test_both_cars_move_as_their_equations_say():
    loop, x, u = cruise_control.following().loop, np.array([100.0, 32, 1, 10, 30, -1, -2]), [1.5]

    def rate(_, x):
        return [x[1], x[2], -2 * x[2] + 2 * x[6], x[4], x[5], -2 * x[5] + 2 * u[0], 0.0]

    after = solve_ivp(rate, (0, cruise_control.PERIOD), x, rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(loop.plant.propagate(x, np.array(u)), after, atol=1e-8)
    seen = np.array([[30.0, 1.4, 30.0, 90.0, 2.0]])
    expected = evaluate(cruise_control.LESSON.layers(), seen)[0]
    np.testing.assert_allclose(loop.input(jax.numpy.asarray(x)), expected, atol=1e-9)


def test_the_car_keeps_its_distance_until_the_lead_is_too_near():
    margins = []
    for ahead in (0.0, -28.0, -34.0):
        task = cruise_control.following(ahead)
        states = task.simulated(2000, 0)
        room = states[..., 0] - states[..., 3] - 10 - 1.4 * states[..., 4]
        assert task.margin(states) == pytest.approx(room.min())
        assert room[:, 0].min() > 0
        margins.append(room.min())
    assert margins[0] > 20
    assert margins[1] > 0 > margins[2]
    braking = np.ptp(states[:, -1, 5])
    assert braking > 0.1  # the last state of the ego car depends on the first ones


@pytest.mark.parametrize("lesson", LESSONS[1:], ids=lambda lesson: lesson.name)
def test_a_point_is_pushed_to_the_goal_by_limited_pushes(lesson):
    wanted = lesson.shown(1000, seed=3).inputs
    lengths = np.linalg.norm(wanted, axis=1)
    assert lengths.max() <= motion.PUSH + ROUNDING
    assert np.mean(lengths > motion.PUSH - 1e-9) > 0.3
    task = motion.pushed(lesson, radius=0.1)
    states = task.simulated(2000, 0)
    assert task.margin(states) > 0.5
    tube = rj.reach(task.loop, task.X0, task.horizon, task.template, rj.LinearBounds(), samples=1)
    assert rj.verify(tube, **task.required, samples=100).status is rj.VerdictStatus.PROVED


@pytest.mark.long
@pytest.mark.parametrize("name", TASKS)
def test_linear_bounds_hold_the_states_of_every_loop(name, tmp_path):
    (task,) = tasks(Settings(loops=(name,), output=tmp_path)).values()
    tube = rj.reach(task.loop, task.X0, task.horizon, task.template, rj.LinearBounds(), samples=1)
    bounds = np.array([tube.proof(k).bounds for k in range(1, task.horizon + 1)])
    support = task.support(task.simulated(2000, 0))
    assert np.all(bounds >= support - ROUNDING * (1 + abs(support)))
