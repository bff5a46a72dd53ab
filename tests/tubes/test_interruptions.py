"""What was proved is not lost: tubes that are interrupted, and that go on."""

import pickle
import subprocess
import sys

import jax
import numpy as np
import pytest

import reachjax as rj
from tests.networks import he_network

STEPS, DONE = 5, 2


@pytest.fixture(scope="module")
def task():
    plant = rj.AffinePlant([[1.0, 0.4], [-0.2, 0.9]], [[0.1], [0.5]])
    loop = rj.ClosedLoop(
        plant, rj.MLP.from_layers(he_network((2, 6, 4, 1), 3)), rj.Box([-1.0], [1.0])
    )
    return loop, rj.Box([0.4, -0.3], [1.0, 0.3])


def same(one, other):
    """Whether all sets are the same, bit for bit, and all witnesses."""
    for mine, theirs in zip(
        jax.tree.leaves((one.sets, [proof.witnesses for proof in one.certificates[1:]])),
        jax.tree.leaves((other.sets, [proof.witnesses for proof in other.certificates[1:]])),
        strict=True,
    ):
        np.testing.assert_array_equal(mine, theirs)
    return True


CONTINUE = """
import pickle, sys
import jax
from tests.selection import draw_from
draw_from(int(sys.argv[2]))
jax.config.update("jax_enable_x64", True)
import reachjax as rj
tube = pickle.load(sys.stdin.buffer)
sys.stdout.buffer.write(pickle.dumps(tube.extended(int(sys.argv[1]))))
"""


@pytest.mark.costly
def test_a_tube_goes_on_in_another_process(task, request):
    template = rj.Template.octagonal(2)
    begun = rj.reach(*task, DONE, template)
    seed = request.config.getoption("seed")  # the other process draws from it too
    command = [sys.executable, "-c", CONTINUE, str(STEPS - DONE), str(seed)]
    found = subprocess.run(command, input=pickle.dumps(begun), capture_output=True, check=True)
    assert same(pickle.loads(found.stdout), rj.reach(*task, STEPS, template))


class Heard:
    """A progress bar that shows notes, as those of tqdm do, and stops at one."""

    def __init__(self, stop=None):
        self.notes, self.stop = [], stop

    def __call__(self, steps):
        self.steps = iter(steps)
        return self

    def __iter__(self):
        return self

    def __next__(self):
        self.notes.append("a step")
        return next(self.steps)

    def set_postfix_str(self, note):
        self.notes.append(note)
        if self.stop and self.stop in note and self.notes.count("a step") > DONE:
            raise KeyboardInterrupt


@pytest.mark.costly
def test_a_bar_is_told_what_happens_within_a_step(task):
    bar = Heard()
    rj.reach(*task, STEPS, rj.Template.octagonal(2), progress=bar, gap=1e-9)
    assert any("facets closed, largest gap" in note for note in bar.notes)
    assert any(note.startswith("ranges of") for note in bar.notes)
    bar = Heard()
    rj.reach(*task, 1, rj.Template.box(2), rj.LocalBounds(), progress=bar)
    assert "semidefinite programs" in bar.notes


@pytest.mark.costly
def test_ctrl_c_within_a_step_leaves_the_steps_before(task):
    template = rj.Template.octagonal(2)
    with pytest.raises(rj.Interrupted) as stopped:
        rj.reach(*task, STEPS, template, progress=Heard(stop="ranges of"))
    tube = stopped.value.tube
    assert tube.horizon == DONE
    assert same(tube.extended(STEPS - DONE), rj.reach(*task, STEPS, template))


@pytest.mark.parametrize(
    ("steps", "options", "error", "match"),
    [
        (0, {}, ValueError, "steps must be at least 1, but 0"),
        (1.5, {}, TypeError, "steps must be a whole number"),
        (1, {"windows": 2}, TypeError, "the options are relaxation, window.*but windows arrived"),
        (1, {"gap": -1.0}, ValueError, "gap must be finite and at least 0"),
    ],
)
def test_bad_continuations_are_named(task, steps, options, error, match):
    tube = rj.reach(*task, 1, rj.Template.box(2), rj.LinearBounds())
    with pytest.raises(error, match=match):
        tube.extended(steps, **options)


def test_a_time_varying_loop_goes_on_where_it_stopped():
    A = np.stack([np.eye(2) * factor for factor in (0.5, 2.0, 0.25, 1.0)])
    plant = rj.AffinePlant(A, np.zeros((4, 2, 1)))
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers(he_network((2, 3, 1), 0)))
    X0 = rj.Box([0.0, 0.0], [1.0, 2.0])
    tube = rj.reach(loop, X0, 1, rj.Template.box(2), start=1)
    assert same(tube.extended(2), rj.reach(loop, X0, 3, rj.Template.box(2), start=1))
