"""A limit is a limit, Ctrl-C keeps what was found, and dead workers lose nothing."""

import os
import pickle
import signal
import threading
import time
import warnings
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods import cells, recursion
from reachjax.numerics import budget
from reachjax.verdicts import invariance
from tests.networks import he_network

PATIENCE = 8.0
"""Seconds of this process beyond what is promised, on a slow machine; without a limit calls take
minutes."""


@pytest.fixture(scope="module")
def switching():
    """Four states under ReLUs that all switch: programs of which there is no end."""
    layers = he_network((4, 48, 48, 1), 0)
    layers[-1] = 0.2 * layers[-1][0], layers[-1][1]
    A = 0.9 * np.eye(4) + 0.1 * np.eye(4, k=1)
    plant = rj.AffinePlant(A, 0.1 * np.ones((4, 1)))
    one = np.ones(4)
    return rj.ClosedLoop(plant, rj.MLP.from_layers(layers)), rj.Box(-0.5 * one, 0.5 * one)


@pytest.fixture(scope="module")
def touching(switching):
    """A set so close around what is simulated that much has to be tried."""
    loop, X0 = switching
    states = np.asarray(loop.simulate(jnp.asarray(X0.corners()), 6))
    sizes = 1.02 * abs(states).max(axis=(0, 1))
    return rj.Box(-sizes, sizes)


CALLS = {
    "reach": lambda loop, X0, safe, **given: rj.reach(loop, X0, 6, rj.Template.box(4), **given),
    "reach_partitioned": lambda loop, X0, safe, **given: rj.reach_partitioned(
        loop, X0, 6, rj.Template.box(4), cells=(2, 2, 2, 2), **given
    ),
    "decide": lambda loop, X0, safe, **given: rj.decide(loop, X0, 6, safe=safe, **given),
    "decide, cells": lambda loop, X0, safe, **given: rj.decide(
        loop, X0, 6, safe=safe, cells=5000, **given
    ),
    "winning_set": lambda loop, X0, safe, **given: rj.winning_set(
        loop, X0, 6, safe=safe, cells=5000, **given
    ),
    "largest_set": lambda loop, X0, safe, **given: rj.largest_set(loop, X0, 6, safe=safe, **given),
}


def called(call, *given, **options):
    """What a call gives; None if a limit left no time for anything to be proved."""
    try:
        return CALLS[call](*given, **options)
    except ValueError as error:
        if "time_limit" not in str(error):
            raise
        return None


@pytest.mark.parametrize("call", CALLS)
def test_a_limit_is_kept(switching, touching, call):
    began = time.process_time()
    called(call, *switching, touching, time_limit=2.0)
    assert time.process_time() - began < 2.0 + PATIENCE


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.costly
def test_ctrl_c_ends_a_call_soon_and_keeps_what_was_found(switching, touching, call):
    called(call, *switching, touching, time_limit=0.5)  # what is compiled is compiled
    pressed = []

    def press():
        pressed.append(time.process_time())
        os.kill(os.getpid(), signal.SIGINT)

    timer, stopped = threading.Timer(0.7, press), None
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells may ignore it
    timer.start()
    try:
        CALLS[call](*switching, touching)
    except KeyboardInterrupt as error:
        stopped = error
    finally:
        timer.cancel()  # nothing else is to be interrupted
        signal.signal(signal.SIGINT, handler)
    if stopped is None:
        pytest.skip("the call ended before it could be interrupted")
    assert time.process_time() - pressed[0] < 1.0 + PATIENCE
    if isinstance(stopped, rj.Interrupted):
        found = pickle.loads(pickle.dumps(stopped)).found
        assert type(found) is type(stopped.found)
        assert str(stopped).startswith("interrupted")


WAYS = {
    "many products": (rj.Template.box(4), rj.PaperQC(), rj.InteriorPoint()),
    "rounds": (rj.Template.box(4), rj.CuttingPlanes(), rj.Auto()),
    "Clarabel": (rj.Template.box(4), rj.LocalBounds(), rj.Clarabel()),
    "SCS": (rj.Template.box(4), rj.LocalBounds(), rj.SCS()),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.costly
def test_programs_in_progress_are_cut_and_what_is_returned_holds(switching, way):
    (loop, X0), (template, relaxation, solver) = switching, WAYS[way]
    began = time.process_time()
    tube = rj.reach(loop, X0, 3, template, relaxation, 1, solver, time_limit=1.0)
    assert time.process_time() - began < 2 * (1.0 + PATIENCE)  # of two threads
    states = loop.simulate(X0.sample(jax.random.key(0), 200), 3)
    for t in (1, 2, 3):
        assert bool(tube.sets[t].contains(states[:, t], 1e-9).all())
        statuses = {status.name for status in tube.proof(t).statuses}
        assert statuses & {"LIMIT", "FAILED", "TIME"}


def proved_again(tube, path):
    """The tube as it is read from a file and proved again."""
    tube.save(path)
    again = rj.load(path, recheck=True)
    assert isinstance(again, rj.ReachTube)
    return again


def test_steps_that_have_no_time_for_programs_are_by_forms(switching, tmp_path):
    (loop, X0), template = switching, rj.Template.box(4)
    tube = rj.reach(loop, X0, 3, template, rj.LocalBounds(), time_limit=0.0)
    forms = rj.reach(loop, X0, 3, template, rj.LinearBounds())
    for t in (1, 2, 3):
        np.testing.assert_array_equal(tube.sets[t].b, forms.sets[t].b)
        assert set(tube.proof(t).statuses) == {rj.SolverStatus.TIME}
    assert int(rj.unsolved(tube)) == 3 * len(template)
    again = proved_again(tube, tmp_path / "tube")
    np.testing.assert_array_equal(again.sets[3].b, forms.sets[3].b)


@pytest.mark.costly
def test_derivatives_of_steps_that_have_no_time_are_those_of_forms(small):
    """The function that is differentiated is the one that is called."""

    def largest(upper):
        X0, template = rj.Box([1.0], jnp.array([upper])), rj.Template.box(1)
        tube = rj.reach(small, X0, 2, template, rj.LocalBounds(), time_limit=0.0)
        return tube.sets[2].b.sum()

    value, slope = jax.value_and_grad(largest)(2.0)
    np.testing.assert_allclose(value, largest(2.0), rtol=1e-12)
    difference = (largest(2.0 + 1e-5) - largest(2.0 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


SOLVERS = rj.InteriorPoint(), rj.Clarabel()


@pytest.mark.parametrize(
    ("template", "solver"),
    [
        (rj.Template.box(4), rj.InteriorPoint()),
        (rj.Template.box(4), rj.Clarabel()),
        (rj.EllipsoidTemplate(), rj.Clarabel()),
    ],
)
def test_programs_that_are_too_large_for_memory_are_not_begun(
    switching, template, solver, monkeypatch
):
    """The warning says what they would take, and bounds need no solver."""
    loop, X0 = switching
    monkeypatch.setattr(budget, "MOST_BYTES", 2**10)
    with pytest.warns(RuntimeWarning, match=r"would take [0-9.e-]+ GiB, and 9.54e-07 GiB is"):
        tube = rj.reach(loop, X0, 1, template, rj.LocalBounds(), solver=solver)
    assert set(tube.proof(1).statuses) == {rj.SolverStatus.FAILED}
    states = loop.simulate(X0.sample(jax.random.key(0), 200), 1)
    assert bool(tube.sets[1].contains(states[:, 1], 1e-9).all())


@pytest.mark.parametrize("solver", SOLVERS)
def test_programs_that_would_end_after_the_time_are_not_begun(switching, solver, monkeypatch):
    (loop, X0), template = switching, rj.Template.box(4)
    monkeypatch.setattr(budget, "PACE", 1e-9)
    tube = rj.reach(loop, X0, 1, template, rj.LocalBounds(), solver=solver, time_limit=1000.0)
    assert set(tube.proof(1).statuses) == {rj.SolverStatus.LIMIT}


class Clock:
    """Seconds that pass where a test says so, in the place of the module `time`."""

    now = 0.0
    time = staticmethod(time.time)

    def monotonic(self):
        return self.now


@pytest.mark.parametrize(("spent", "by_programs_are"), [(3.0, 3), (6.5, 1)])
def test_steps_that_keep_to_their_shares_are_begun_and_others_are_not(
    small, spent, by_programs_are, monkeypatch
):
    """A step that took more than its share is followed by none that would end after the time."""
    clock, begun, successors = Clock(), [], recursion.successors

    def slowly(*given):
        found = successors(*given)
        clock.now += spent
        begun.append(found)
        return found

    monkeypatch.setattr(recursion, "successors", slowly)
    monkeypatch.setattr(budget, "time", clock)
    given = small, rj.Box([1.0], [2.0]), 3, rj.Template.box(1), rj.LocalBounds()
    tube = rj.reach(*given, time_limit=9.0)
    assert len(begun) == by_programs_are
    late = {t for t in (1, 2, 3) if rj.SolverStatus.TIME in tube.proof(t).statuses}
    assert late == set(range(by_programs_are + 1, 4))


@pytest.mark.costly
def test_ellipsoids_that_have_no_time_hold_what_is_simulated(switching, tmp_path):
    """No solver is asked, and what is kept is proved again."""
    loop, X0 = switching
    tube = rj.reach(loop, X0, 3, rj.EllipsoidTemplate(), time_limit=0.0)
    states = loop.simulate(X0.sample(jax.random.key(0), 200), 3)
    for t in (1, 2, 3):
        assert bool(tube.sets[t].contains(states[:, t], 1e-9).all())
        assert rj.SolverStatus.SOLVED not in tube.proof(t).statuses
    again = proved_again(tube, tmp_path / "tube")
    np.testing.assert_array_equal(again.sets[3].shape, tube.sets[3].shape)


@pytest.mark.costly
def test_compiled_ellipsoids_are_what_was_asked_for_however_slowly_they_are_traced(small):
    given = small, rj.Box([1.0], [2.0]), 2, rj.EllipsoidTemplate(), rj.LocalBounds(), 1

    @jax.jit
    def shape(X0):
        return rj.reach(small, X0, *given[2:], time_limit=0.0).sets[-1].shape

    wanted = rj.reach(*given).sets[-1].shape
    np.testing.assert_allclose(shape(given[1]), wanted, rtol=1e-4)


def test_cells_that_would_end_after_the_time_are_not_begun(monkeypatch):
    """A cell of a long horizon may take seconds."""
    made, unrolled = [], cells.unrolled

    def slowly(*given, **named):
        made.append(given)
        time.sleep(2.5)
        return unrolled(*given, **named)

    monkeypatch.setattr(cells, "unrolled", slowly)
    plant = rj.NonlinearPlant(lambda x, u: x - 0.5 * jnp.sin(2 * x) + 0 * u, 1, 1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: 0 * x, 1, 1))
    tube = rj.reach(loop, rj.Box([-1.0], [2.0]), 2, rj.Template.box(1), time_limit=4.0)
    assert len(made) == 1
    assert set(tube.proof(2).statuses) == {rj.SolverStatus.TIME}


def test_without_time_no_more_is_simulated_for_ever_than_one_turn(small):
    """Hundreds of steps of hundreds of trajectories of a wide network take seconds."""
    X0 = rj.Box([1.0], [2.0])
    runs = [
        invariance._long_runs(small, X0, 0, 0, budget.Budget(seconds)) for seconds in (0.0, 600.0)
    ]
    some, every = (len(each.states) for each in runs)
    assert some == len(runs[0].scenarios) == -(-every // invariance.TURNS)
    np.testing.assert_allclose(runs[0].states, runs[1].states[:some], rtol=1e-12)
    tube = rj.reach(small, X0, 2, rj.Template.box(1))
    found = rj.verify(tube, safe=rj.Box([-3.0], [3.0]), forever=True, time_limit=0.0)
    assert found.status is not rj.VerdictStatus.REFUTED


class Stopping:
    """A progress bar whose user presses Ctrl-C after so many items."""

    def __init__(self, after):
        self.after = after

    def __call__(self, items):
        for number, item in enumerate(items):
            if number == self.after:
                raise KeyboardInterrupt
            yield item


@pytest.fixture(scope="module")
def small():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    return rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net, rj.Box([-1.0], [1.0]))


@pytest.mark.costly
def test_partitions_go_on_from_the_cells_that_were_done(small):
    given = small, rj.Box([-3.0], [3.0]), 2, rj.Template.box(1)
    with pytest.raises(rj.Interrupted, match="known=found") as stopped:
        rj.reach_partitioned(*given, cells=(6,), progress=Stopping(2))
    done = stopped.value.found
    assert 2 <= len(done) < 6
    seen = []
    whole = rj.reach_partitioned(
        *given,
        cells=(6,),
        known=done,
        progress=lambda bar: (seen.append(each) or each for each in bar),
    )
    assert len(whole) == 6
    assert len(seen) == 6 - len(done)
    np.testing.assert_array_equal(
        whole.bounds(2), rj.reach_partitioned(*given, cells=(6,)).bounds(2)
    )
    with pytest.raises(ValueError, match="another question"):
        rj.reach_partitioned(*given[:2], 3, given[3], cells=(6,), known=done)


@pytest.mark.costly
def test_verdicts_and_winning_sets_hold_what_was_decided(small):
    domain, safe = rj.Box([-8.0], [8.0]), rj.Box([-4.0], [4.0])
    with pytest.raises(rj.Interrupted) as stopped:
        rj.decide(small, rj.Box([-3.9], [3.9]), 2, safe=safe, cells=(16,), progress=Stopping(4))
    verdict = stopped.value.found
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    statuses = [cell.status for cell in verdict.cells]
    assert statuses.count(rj.VerdictStatus.PROVED) >= 4
    assert sum(float(np.prod(cell.upper - cell.lower)) for cell in verdict.cells) == pytest.approx(
        7.8
    )
    given = small, domain, 2
    options = {"safe": safe, "cells": 64}
    with pytest.raises(rj.Interrupted, match="known=found") as stopped:
        rj.winning_set(*given, **options, progress=Stopping(2))
    found = stopped.value.found
    assert sum(map(found.volume, rj.VerdictStatus)) == pytest.approx(16.0)
    on = rj.winning_set(*given, **options, known=found)
    assert on.volume(rj.VerdictStatus.PROVED) == pytest.approx(
        rj.winning_set(*given, **options).volume(rj.VerdictStatus.PROVED)
    )


def test_of_a_partition_that_has_no_time_one_tube_stands_for_the_rest(small):
    X0 = rj.Box([-3.0], [3.0])
    tube = rj.reach_partitioned(small, X0, 2, rj.Template.box(1), cells=(6,), time_limit=0.0)
    states = small.simulate(jnp.linspace(-3.0, 3.0, 101)[:, None], 2)
    for t in (1, 2):
        inside = [np.asarray(X.contains(states[:, t], 1e-9)) for X in tube.sets(t)]
        assert np.any(inside, axis=0).all()
    guided = rj.reach_partitioned(small, X0, 2, rj.Template.box(1), cells=6, time_limit=0.0)
    assert len(guided) == 1


class Dying(ThreadPoolExecutor):
    """An executor whose worker dies after so many jobs, and takes those in flight with it."""

    def __init__(self, after):
        super().__init__(2)
        self.after = after

    def submit(self, fn, /, *given, **named):
        if self.after < 0:
            raise BrokenProcessPool("a process was terminated abruptly")
        self.after -= 1
        if self.after >= 0:
            return super().submit(fn, *given, **named)
        future = Future()
        future.set_exception(BrokenProcessPool("a process was terminated abruptly"))
        return future


ANSWERS = {
    "reach_partitioned": lambda loop, executor: rj.reach_partitioned(
        loop, rj.Box([-3.0], [3.0]), 2, rj.Template.box(1), cells=(6,), executor=executor
    ).bounds(2),
    "winning_set": lambda loop, executor: [
        rj.winning_set(
            loop,
            rj.Box([-8.0], [8.0]),
            2,
            safe=rj.Box([-4.0], [4.0]),
            cells=200,
            executor=executor,
        ).volume(rj.VerdictStatus.PROVED)
    ],
    "decide": lambda loop, executor: [
        rj.decide(
            loop,
            rj.Box([-3.9], [3.9]),
            2,
            safe=rj.Box([-4.0], [4.0]),
            cells=(16,),
            executor=executor,
        ).status.value
        == "proved"
    ],
}


@pytest.mark.parametrize("call", ANSWERS)
@pytest.mark.parametrize("after", [0, 2])
@pytest.mark.costly
def test_a_dead_worker_loses_nothing(small, call, after):
    with pytest.warns(RuntimeWarning, match="a worker of the executor has died"):
        found = ANSWERS[call](small, Dying(after))
    np.testing.assert_allclose(found, ANSWERS[call](small, None))


@pytest.mark.costly
def test_a_process_that_is_killed_loses_nothing(small):
    import multiprocessing

    killed = threading.Event()

    def bar(cells):
        for cell in cells:
            if not killed.is_set():
                killed.set()
                for process in list(pool._processes.values()):
                    os.kill(process.pid, signal.SIGKILL)
            yield cell

    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        assert isinstance(pool, Executor)
        with pytest.warns(RuntimeWarning, match="has died"):
            tube = rj.reach_partitioned(
                small,
                rj.Box([-3.0], [3.0]),
                2,
                rj.Template.box(1),
                cells=(6,),
                executor=pool,
                progress=bar,
            )
    assert len(tube) == 6


def swing(x, u):
    return jnp.array([x[1], 5 * jnp.sin(x[0]) + u[0]])


def push(x):
    return -8 * jnp.tanh(x[:1] + 0.5 * x[1:])


@pytest.mark.costly
def test_processes_that_have_no_long_floats_of_their_own_answer_to_the_last_digit():
    import multiprocessing

    sampled = rj.SampledPlant(swing, states=2, inputs=1, period=0.1)
    loop, X0 = rj.ClosedLoop(sampled, rj.Network(push, 2, 1)), rj.Box([-1.0, -1.0], [1.0, 1.0])
    thirds = rj.Box([-4.0 / 3, -10 / 3], [4.0 / 3, 10 / 3])  # which short floats would round
    few = (3, 1)  # of more, how long they take says whether they are bounded in a compiled call
    here = rj.decide(loop, X0, 3, safe=thirds, cells=few)
    assert here.proved
    rj.decide(loop, X0, 1, safe=thirds)  # functions of the loop are recorded
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool, warnings.catch_warnings():
        warnings.simplefilter("error")
        there = rj.decide(loop, X0, 3, safe=thirds, cells=few, executor=pool)
    np.testing.assert_array_equal(there.margins["safe"], here.margins["safe"])


@pytest.mark.parametrize(
    "call",
    [
        lambda loop, X0, pool: rj.decide(loop, X0, 1, goal=X0, cells=8, executor=pool),
        lambda loop, X0, pool: rj.reach_partitioned(
            loop, X0, 1, rj.Template.box(1), cells=(2,), executor=pool
        ),
        lambda loop, X0, pool: rj.winning_set(
            loop, X0, 1, safe=rj.Box([-0.9], [2.0]), cells=8, executor=pool
        ),
    ],
    ids=["decide", "reach_partitioned", "winning_set"],
)
def test_functions_that_no_process_can_be_sent_are_told_how_to(call):
    plant = rj.NonlinearPlant(lambda x, u: 0.5 * x, states=1, inputs=1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: -x, inputs=1, outputs=1))
    with (
        ProcessPoolExecutor(1) as pool,
        pytest.raises(TypeError, match=r"define it at the top of a module, or take threads"),
    ):
        call(loop, rj.Box([-1.0], [1.0]), pool)
