"""A verdict in a file is proved anew without a search, or it is not believed."""

import dataclasses
import json
import multiprocessing
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.__main__ import main
from reachjax.tubes.rechecks import ROUNDING
from reachjax.tubes.saving import keep
from reachjax.verdicts import rechecks
from reachjax.verdicts.grounds import Climb, Grounds, Leaves, Multipliers
from reachjax.verdicts.verdict import KeptVerdict, VerdictStatus
from tests.closed_loops import closed_loop, random_loop
from tests.tubes.test_hostile_files import CHANGES, REFUSED, opened, written

X0 = rj.Box([-0.2, -0.3], [0.3, 0.2])
STEPS = 3


def rectified():
    return closed_loop(random_loop(2, (4, 3), seed=2))


def pushed():
    return rectified().replace(noise=rj.Box([-0.01, -0.01], [0.01, 0.01]))


def swung():
    plant = rj.SampledPlant(
        lambda x, u: jnp.array([x[1], jnp.sin(x[0]) + u[0]]), states=2, inputs=1, period=0.1
    )
    net = rj.MLP.from_layers([([[1.0, 0.5]], [0.0]), ([[-3.0]], [0.0])], rj.Tanh())
    return rj.ClosedLoop(plant, net)


def attained(loop, which=slice(None)):
    """What simulated states reach at the last step, as a box."""
    states = np.asarray(X0.sample(jax.random.key(0), 500))
    last = np.asarray(loop.simulate(np.concatenate([X0.corners(), states]), STEPS))[:, which]
    return last.min(axis=(0, 1)), last.max(axis=(0, 1))


def around(loop, room, which=slice(-1, None)):
    """A box around simulated states, with some room, negative for too little."""
    least, most = attained(loop, which)
    by = room * (most - least) + np.where(most > least, 0.0, room)
    return rj.Box(least - by, most + by)


KINDS = {
    "forms": (rectified, {}, 2.0),
    "programs": (rectified, {}, 0.01),
    "cells": (rectified, {"cells": 20}, 0.05),
    "grid": (rectified, {"cells": (2, 3)}, 0.1),
    "noise": (pushed, {}, 1.0),
    "in between samples": (swung, {}, 0.5),
}


def decided(kind):
    made, options, room = KINDS[kind]
    loop = made()
    whole = slice(None) if kind == "in between samples" else slice(-1, None)
    part = "safe" if kind == "in between samples" else "goal"
    return loop, rj.decide(loop, X0, STEPS, **{part: around(loop, room, whole)}, **options)


def decided_in_halves():
    """A verdict of two cells, on a function that other processes cannot find."""
    loop = swung()
    return loop, rj.decide(loop, X0, STEPS, safe=around(loop, 0.5, slice(None)), cells=(2, 1))


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_proved_is_proved_anew_with_the_same_margins(kind, tmp_path):
    loop, verdict = decided(kind)
    assert verdict.proved
    path = tmp_path / "a.verdict"
    verdict.save(path)
    again = rj.load(path, loop, recheck=True)
    assert again.proved
    for name, margins in verdict.margins.items():
        known = ~np.isnan(margins)
        assert np.array_equal(known, ~np.isnan(again.margins[name]))
        assert np.allclose(margins[known], again.margins[name][known], rtol=0, atol=1e-9)


def test_cells_are_proved_anew_by_processes_as_they_are_here(tmp_path):
    """And what one of them does not prove is proved by none."""
    loop, path = rectified(), tmp_path / "a.verdict"
    verdict = decided("grid")[1]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        verdict.save(path)
        here, there = rj.load(path, recheck=True), rj.load(path, recheck=True, executor=pool)
        for name, margins in here.margins.items():
            np.testing.assert_array_equal(margins, there.margins[name])
        grounds = verdict.grounds
        forged(path, verdict, grounds=grounds._replace(climbs=grounds.climbs[:-1]))
        with pytest.raises(rj.DisagreementError, match="5 proofs"):
            rj.load(path, recheck=True, executor=pool)
        tighter = rj.decide(loop, X0, STEPS, goal=around(loop, -0.05))
        forged(path, verdict, asked=tighter.asked)
        with pytest.raises(rj.DisagreementError, match="does not bear that out"):
            rj.load(path, recheck=True, executor=pool)
        loop, verdict = decided_in_halves()
        verdict.save(path)
        with pytest.raises(TypeError, match="executor sends the loop to other processes"):
            rj.load(path, loop, recheck=True, executor=pool)
    with pytest.raises(TypeError, match="executor must be an object with a method submit"):
        rj.load(path, loop, recheck=True, executor=2)


def test_one_cell_is_proved_anew_without_a_process(tmp_path):
    """A process takes longer to begin than most cells to prove."""
    loop, verdict = decided("in between samples")
    verdict.save(tmp_path / "a.verdict")
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    pool.shutdown()  # it takes nothing any more
    assert rj.load(tmp_path / "a.verdict", loop, recheck=True, executor=pool).proved


def test_many_cells_are_proved_anew_in_threads(tmp_path):
    """Some in a batch, as far as that pays, and the others one by one."""
    loop, path = rectified(), tmp_path / "a.verdict"
    rj.decide(loop, X0, STEPS, goal=around(loop, 0.1), cells=(6, 7)).save(path)
    with ThreadPoolExecutor(2) as pool:
        here, there = rj.load(path, recheck=True), rj.load(path, recheck=True, executor=pool)
        for name, margins in here.margins.items():
            np.testing.assert_allclose(margins, there.margins[name], rtol=1e-12)
        with pytest.raises(ValueError, match="but 41 did not arrive"):
            rj.load(path, recheck=True, executor=pool, progress=lambda cells: list(cells)[:1])
        rj.load(path, recheck=True, executor=pool, progress=lambda cells: [*cells, 0])


@pytest.mark.parametrize(
    ("count", "said"),
    [
        ("2", "executor sends the loop to other processes"),  # they cannot find a lambda
        ("0", "must be a whole number from 1 on, but 0 arrived"),
    ],
)
def test_a_command_takes_processes(count, said, tmp_path):
    decided_in_halves()[1].save(tmp_path / "a.verdict")
    command = [sys.executable, "-m", "reachjax", "recheck", tmp_path / "a.verdict"]
    command += ["--loop", "tests.tubes.test_verdict_files:swung", "--processes", count]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode != 0
    assert said in done.stderr


def test_a_recheck_solves_and_searches_nothing(tmp_path, monkeypatch):
    _, verdict = decided("programs")
    verdict.save(tmp_path / "a.verdict")

    def refuse(*_, **__):
        raise AssertionError("something was searched")

    monkeypatch.setattr("reachjax.solvers.linear_programs.LinearPrograms.largest", refuse)
    monkeypatch.setattr("reachjax.methods.ladder.Ladder.bounds", refuse)
    assert rj.load(tmp_path / "a.verdict", recheck=True).proved


@pytest.mark.parametrize("options", [{}, {"cells": 6}])
def test_what_is_refuted_is_enclosed_anew(options, tmp_path):
    loop = rectified()
    verdict = rj.decide(loop, X0, STEPS, goal=around(loop, -0.2), **options)
    assert verdict.refuted
    path = tmp_path / "a.verdict"
    verdict.save(path)
    again = rj.load(path, recheck=True)
    assert again.refuted
    assert np.array_equal(again.counterexample.states[0], verdict.counterexample.states[0])
    example = verdict.counterexample
    assert np.all(example.lower <= example.states[: example.time + 1] + ROUNDING)
    assert np.all(example.states[: example.time + 1] <= example.upper + ROUNDING)


def forged(path, verdict, **changes):
    """A file that says something else than was found."""
    kept = KeptVerdict(verdict.asked, verdict.status, verdict.counterexample, verdict.grounds)
    keep(path, kept._replace(**changes), verdict.asked.loop)


def test_a_status_is_not_believed(tmp_path):
    loop, path = rectified(), tmp_path / "a.verdict"
    broken = rj.decide(loop, X0, STEPS, goal=around(loop, -0.2))
    proof = decided("programs")[1]
    inside = np.asarray(X0.center)
    example = dataclasses.replace(
        broken.counterexample, states=np.tile(inside, (STEPS + 1, 1)), violation=1.0
    )
    lies = [
        (broken, {"status": VerdictStatus.PROVED}),
        (broken, {"status": VerdictStatus.PROVED, "grounds": proof.grounds}),
        (broken, {"counterexample": None}),
        (broken, {"counterexample": example}),
        (proof, {"status": VerdictStatus.REFUTED, "counterexample": broken.counterexample}),
        (proof, {"grounds": Grounds()}),
        (proof, {"grounds": Grounds(climbs=())}),
        (proof, {"grounds": Grounds(axes=((0, -1, -1),), climbs=((Climb(),),))}),
        (proof, {"grounds": Grounds(axes=((0, -1),), climbs=((Climb(),),))}),
    ]
    for verdict, changes in lies:
        forged(path, verdict, **changes)
        assert rj.load(path).status is changes.get("status", verdict.status)  # nothing was asked
        with pytest.raises(rj.DisagreementError):
            rj.load(path, recheck=True)


@pytest.mark.parametrize("what", ["verdict", "tube", "partition"])
def test_a_file_of_another_loop_is_not_taken_for_that_of_a_seal(what, tmp_path):
    """Nor where it has both, the loop that something is proved of and the seal of the one given."""
    path, mine, net = tmp_path / "a.file", rectified(), rj.MLP.from_layers([([[0.0]], [0.0])])
    tame, start = rj.ClosedLoop(rj.AffinePlant([[0.5]], [[1.0]]), net), rj.Box([1.0], [2.0])
    if what == "verdict":
        found = rj.decide(tame, start, 1, goal=rj.Box([0.0], [1.0]))
        about = KeptVerdict(found.asked, found.status, None, found.grounds)
    elif what == "tube":
        about = rj.reach(tame, start, 1, rj.Template.box(1))
    else:
        about = rj.reach_partitioned(tame, start, 1, rj.Template.box(1), cells=2)
    keep(path, about, mine)
    rj.load(path, recheck=True)  # it says of which loop
    for recheck in (False, True):
        with pytest.raises(ValueError, match="loop must be that of the tube"):
            rj.load(path, mine, recheck=recheck)


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_numbers_whose_rounding_is_not_counted_are_refused(kind, tmp_path):
    """What is computed in floats of fewer bits is rounded by more than proofs allow for."""
    path = tmp_path / "a.verdict"
    decided("forms")[1].save(path)
    head, arrays = opened(path)
    for number, array in enumerate(arrays):
        if array.dtype == float:
            few = [array.astype(kind) if k == number else each for k, each in enumerate(arrays)]
            written(path, head, few)
            for recheck in (False, True):
                with pytest.raises(rj.UnreadableError, match="numbers of float"):
                    rj.load(path, recheck=recheck)


def test_what_is_required_at_all_times_is_required_at_all_of_them(tmp_path):
    loop, path = rectified(), tmp_path / "a.verdict"
    verdict = rj.decide(loop, X0, STEPS, safe=around(loop, 3.0, slice(None)))
    assert verdict.proved
    asked = verdict.asked
    assert asked is not None
    for required in (asked.required[:-1], asked.required[1:], (), asked.required[:1] * 2):
        forged(path, verdict, asked=asked._replace(required=required))
        with pytest.raises(REFUSED):
            rj.load(path, recheck=True)
    loop = swung()
    verdict = rj.decide(loop, X0, STEPS, safe=around(loop, 1.0, slice(None)))
    at_samples = tuple(dataclasses.replace(r, throughout=False) for r in verdict.asked.required)
    forged(path, verdict, asked=verdict.asked._replace(required=at_samples))
    with pytest.raises(REFUSED):
        rj.load(path, loop, recheck=True)


@pytest.mark.parametrize("name", ["safe", "avoid"])
def test_what_has_one_name_is_one_set(name, tmp_path):
    """Else a file says that a set is safe, and proves of another one that it is, at one time."""
    loop, path = rectified(), tmp_path / "a.verdict"
    far = rj.Box([50.0, 50.0], [60.0, 60.0])
    given = {"avoid": [far]} if name == "avoid" else {"safe": around(loop, 3.0, slice(None))}
    verdict = rj.decide(loop, X0, STEPS, **given)
    assert verdict.proved
    *others, last = verdict.asked.required
    other = (
        rj.Box([51.0, 51.0], [60.0, 60.0]) if name == "avoid" else around(loop, 9.0, slice(None))
    )
    several = (*others, dataclasses.replace(last, region=other))
    forged(path, verdict, asked=verdict.asked._replace(required=several))
    for recheck in (False, True):
        with pytest.raises(rj.UnreadableError, match="must be one set"):
            rj.load(path, recheck=recheck)


def test_multipliers_of_any_kind_prove_nothing_that_is_false():
    """Of goals that samples break, nothing that a file may propose is a proof."""
    loop = rectified()
    least, most = attained(loop, slice(-1, None))
    right = rj.decide(loop, X0, STEPS, goal=around(loop, 0.01))
    given = right.grounds.climbs[0]
    goal = rj.Box(least + 0.01 * (most - least), most)
    asked = rj.decide(loop, X0, STEPS, goal=goal).asked
    rng = np.random.default_rng(0)
    for _ in range(60):
        climbs = tuple(_distorted(rng, climb) for climb in given)
        verdict = rj.Verdict(
            VerdictStatus.PROVED, {}, {}, asked=asked, grounds=Grounds(climbs=(climbs,))
        )
        with pytest.raises(rj.DisagreementError):
            rechecks.rechecked(verdict)


def _distorted(rng, climb):
    def numbers(a):
        scale = 10.0 ** rng.integers(-3, 9)
        odd = rng.choice([np.nan, np.inf, -np.inf, 0.0, -1.0], size=a.shape)
        return np.where(rng.random(a.shape) < 0.1, odd, a + scale * rng.normal(size=a.shape))

    ranges = tuple(
        tuple(Multipliers.of(numbers(each.matrix)) for each in step) for step in climb.ranges
    )
    leaves = tuple(
        Leaves(
            each.name,
            each.time,
            each.branches.replace(
                multipliers=numbers(np.asarray(each.branches.multipliers)),
                weights=numbers(np.asarray(each.branches.weights)),
                phases=rng.permutation(np.asarray(each.branches.phases)),
            ),
        )
        for each in climb.leaves
    )
    return Climb(ranges, leaves)


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_file_that_was_changed_is_refused_or_says_what_is_true(change, tmp_path):
    _, verdict = decided("programs")
    verdict.save(tmp_path / "whole")
    rng = np.random.default_rng(len(change.__name__))
    for _ in range(8):
        head, arrays = opened(tmp_path / "whole")
        change(rng, head, arrays)
        try:
            written(tmp_path / "changed", head, arrays)
        except (TypeError, ValueError, AttributeError, KeyError):
            continue  # it cannot be written so
        try:
            again = rj.load(tmp_path / "changed", recheck=True)
        except REFUSED:
            continue
        if again.proved:
            _require_true(again)


def _require_true(verdict):
    """No simulated state breaks what the verdict says of the loop that it is about."""
    asked = verdict.asked
    states = np.asarray(asked.X0.sample(jax.random.key(1), 300))
    runs = np.asarray(asked.loop.simulate(states, asked.horizon, asked.start))
    for item in asked.required:
        assert item.simulated(runs).min() >= -ROUNDING


def test_files_that_differ_in_how_searches_ended_are_rechecked_alike(tmp_path):
    tube = rj.reach(rectified(), X0, 2, rj.Template.box(2), time_limit=0)
    for number, code in enumerate((rj.SolverStatus.TIME, rj.SolverStatus.SOLVED)):
        proofs = [
            p and p.replace(codes=np.full(4, int(code)), seconds=np.full(4, number * 1.0))
            for p in tube.certificates
        ]
        parts = tube.loop, tube.template, tube.sets, tuple(proofs), tube.start
        rj.ReachTube.sealed(*parts).save(tmp_path / f"{number}")
    found = [rj.load(tmp_path / f"{number}", recheck=True) for number in range(2)]
    for each in found:
        for t in (1, 2):
            assert set(each.proof(t).statuses) == {rj.SolverStatus.RECHECKED}
            assert np.isnan(each.proof(t).seconds).all()
    one, other = (jax.tree.leaves(each) for each in found)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


def test_a_counterexample_is_a_file_that_anybody_can_check(tmp_path):
    loop = rectified()
    verdict = rj.decide(loop, X0, STEPS, goal=around(loop, -0.2))
    verdict.counterexample.save(tmp_path / "example.json")
    found = json.loads((tmp_path / "example.json").read_text())
    plant, t = loop.plant, found["sample"]
    x = np.array(found["initial_state"])
    assert np.all(x >= X0.lower)
    assert np.all(x <= X0.upper)
    lower, upper = np.array(found["lower"]), np.array(found["upper"])
    for k in range(t + 1):
        assert np.all(lower[k] - ROUNDING <= x)
        assert np.all(x <= upper[k] + ROUNDING)
        if k < t:
            u = np.asarray(loop.input(jnp.asarray(x), k))
            assert np.allclose(u, found["inputs"][k], atol=ROUNDING)
            x = np.asarray(plant.propagate(jnp.asarray(x), jnp.asarray(u), k))
    A, b = (np.array(found["required"][name]) for name in ("normals", "offsets"))
    ends = np.where(A > 0, lower[-1], upper[-1])
    assert found["required"]["inside"]
    assert np.any((A * ends).sum(axis=1) > b)


def test_a_command_rechecks_a_file(tmp_path):
    _, verdict = decided("forms")
    verdict.save(tmp_path / "right")
    broken = rj.decide(rectified(), X0, STEPS, goal=around(rectified(), -0.2))
    forged(tmp_path / "wrong", broken, status=VerdictStatus.PROVED)
    for name, code, said in (("right", 0, "PROVED"), ("wrong", 1, "error: ")):
        command = [sys.executable, "-m", "reachjax", "recheck", str(tmp_path / name)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == code
        assert said in (done.stdout if code == 0 else done.stderr)


def test_verdicts_of_tubes_are_kept_with_them(tmp_path):
    tube = rj.reach(rectified(), X0, 1, rj.Template.box(2))
    verdict = rj.verify(tube, safe=rj.Box([-9.0, -9.0], [9.0, 9.0]))
    with pytest.raises(ValueError, match="save the tube"):
        verdict.save(tmp_path / "a.verdict")


def test_a_bar_must_pass_on_all_cells(tmp_path):
    _, verdict = decided("grid")
    verdict.save(tmp_path / "a.verdict")
    with pytest.raises(ValueError, match="progress must pass on each cell, but 1 did not arrive"):
        rj.load(tmp_path / "a.verdict", recheck=True, progress=lambda cells: list(cells)[1:])


def test_of_a_loop_with_other_states_the_loop_is_what_is_wrong(tmp_path):
    one, two = (
        rj.ClosedLoop(
            rj.NonlinearPlant(lambda x, u: 0.5 * x + u[0], n, 1),
            rj.Network(lambda x: 0 * x[:1], n, 1),
        )
        for n in (1, 2)
    )
    rj.decide(one, rj.Box([1.0], [2.0]), 1, goal=rj.Box([0.0], [1.0])).save(
        tmp_path / "one.verdict"
    )
    with pytest.raises(ValueError, match="loop must be that of the tube or verdict in"):
        rj.load(tmp_path / "one.verdict", two)


@pytest.mark.parametrize("name", ["plants.make_loop", "plants:", ":make_loop"])
def test_a_loop_is_named_by_its_module_and_its_name(name, capsys):
    assert main(["recheck", "one.verdict", "--loop", name]) == 1
    assert (
        f"--loop must be MODULE:NAME, such as plants:make_loop, but {name}"
        in capsys.readouterr().err
    )
