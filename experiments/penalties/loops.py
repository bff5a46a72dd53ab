"""The loops of the study: a teacher to imitate, and a specification that imitation alone misses."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import reachjax as rj
from experiments.benchmark.rivals import cruise_control
from experiments.double_integrator import problem
from experiments.imitation import train_networks
from experiments.layers import Layers
from experiments.quadrotor import controller, model
from experiments.sampling import Samples, sample_policy
from experiments.task import Task


@dataclass(frozen=True)
class StudiedLoop:
    """A loop whose controller is to be learned.

    Attributes:
        samples: of the teacher, kept in a folder.
        task: what is required of the loop, under any network.
        controller: the network of the state, of the layers that are learned.
        hidden: neurons of each hidden layer.
        decay: weight of the squared weights while imitating.
        margin: how far bounds should be from breaking the specification, in the units of the state.
        weight: of the penalty, beside a mean squared error in parts of the inputs' variance.
    """

    samples: Callable[[Path], Samples]
    task: Task
    controller: Callable[[Layers], rj.MLP]
    hidden: tuple[int, ...]
    decay: float
    margin: float
    weight: float

    def under(self, layers: Layers) -> Task:
        """The task under a network; its sets are made once, so that compiled code knows them."""
        loop = self.task.loop.replace(controller=self.controller(layers))
        return dataclasses.replace(self.task, loop=loop)

    def networks(self, samples: Samples, count: int, steps: int, folder: Path) -> list[Layers]:
        """So many that imitate the teacher, from different random weights."""
        path = folder / "networks.npz"
        fits = train_networks(
            samples,
            self.hidden,
            penalty=self.decay,
            steps=steps,
            restarts=count,
            standardise=True,
            path=path,
        )
        return [each.layers for each in fits]


def _double_integrator() -> StudiedLoop:
    """The paper's, whose teacher rides on the constraint `x_2 >= -1` as it is printed."""
    mpc = problem.linear_mpc(margin=0.0)

    def samples(folder: Path) -> Samples:
        lower, upper = mpc.state_lower, mpc.state_upper
        return sample_policy(mpc, 1000, 0, lower=lower, upper=upper, path=folder / "samples.npz")

    task = Task(
        problem.closed_loop(_silent(2, 1)),
        rj.Box(*problem.INITIAL_BOX),
        problem.HORIZON,
        problem.template(),
        goal=rj.Box(*problem.GOAL_BOX),
        safe=rj.Box(*problem.STATE_BOX),
    )
    return StudiedLoop(samples, task, rj.MLP.from_layers, (10, 5), 1e-4, margin=0.005, weight=1.0)


def _quadrotor() -> StudiedLoop:
    """The paper's, under 20 neurons, braking: it is to come as close to the origin as its teacher.

    It starts where the teacher is after one second, and the goal ends a millimetre beyond the
    positions that it reaches in another one; copies brake a little less.
    """
    center = np.array([3.865, 2.967, 2.07, -2.62, -2.9, -1.295])
    closest, farthest = np.zeros(3), np.array([1.497, 1.103, 0.984])
    radii, rows = model.INITIAL_RADII, np.eye(3, 6)

    def samples(folder: Path) -> Samples:
        controller.use_committed(folder)
        with np.load(folder / "samples.npz") as file:
            return Samples(file["states"], file["inputs"])

    task = Task(
        model.loop_with(_silent(6, 3).layers),
        rj.Box(center - radii, center + radii),
        model.STEPS,
        rj.Template.box(6),
        goal=rj.Polytope(np.vstack([-rows, rows]), np.concatenate([-closest, farthest])),
        safe=model.safe_set(velocity_limits=False),
    )
    return StudiedLoop(samples, task, rj.MLP.from_layers, (10, 10), 1e-4, margin=5e-4, weight=1.0)


def _cruise_control() -> StudiedLoop:
    """A car that follows another one, which brakes, so closely that its teacher just keeps off.

    It decides twice a second, for five seconds.
    """
    period, steps, closer = 0.5, 10, -29.9
    room, stop = cruise_control.ROOM, cruise_control.STANDSTILL

    def samples(_: Path) -> Samples:
        return cruise_control.LESSON.shown(4000, seed=0)

    def network(layers: Layers) -> rj.MLP:
        return rj.MLP.from_layers(cruise_control.folded(layers))

    rows = np.vstack([np.eye(7), room])
    task = Task(
        rj.ClosedLoop(cruise_control.plant(period), _silent(7, 1)),
        cruise_control.following(closer).X0,
        steps,
        rj.Template(np.vstack([rows, -rows])),
        safe=rj.Polytope(-room[None], [-stop]),
    )
    return StudiedLoop(samples, task, network, (10,), 1e-4, margin=0.005, weight=1.0)


def _silent(states: int, inputs: int) -> rj.MLP:
    """Stands for the network until there is one."""
    return rj.MLP.from_layers([(np.zeros((inputs, states)), np.zeros(inputs))])


LOOPS = {
    "double integrator": _double_integrator,
    "quadrotor": _quadrotor,
    "cruise control": _cruise_control,
}
