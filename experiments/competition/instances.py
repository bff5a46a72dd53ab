"""The instances of the competition: where loops begin, what is required of them, their networks.

Units are those of the definitions. What they leave open is said in the notes, and decided in each
reading where that is cheap.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj
from experiments.competition import fields

Networks = Sequence[rj.AbstractNetwork]

RATES = -19.5, -22.5, -25.5, -28.5
"""Rates of climb at first, in ft/s, of the vertical collision avoidance."""

HALF_PLANES = 16
"""So many stand for a limit of speed in each direction: 2 % within it."""


@dataclass(frozen=True)
class Shape:
    """What a network looks like, for one that is trained to stand in for it.

    Attributes:
        hidden: neurons of each hidden layer.
        activation: of these: `relu` or `tanh`, which stands for `sigmoid` too.
        law: inputs `(c, n_u)` at states `(c, n)`, to be imitated.
        spread: `(n,)`, how far around the initial set it is learned.
        sees: what it is given of states `(c, n)`; None for the states.
        penalty: on squared weights in training: a steep network takes more cells to prove.
    """

    hidden: tuple[int, ...]
    activation: str
    law: Callable[[np.ndarray], np.ndarray]
    spread: tuple[float, ...]
    sees: Callable[[np.ndarray], np.ndarray] | None = None
    penalty: float = 1e-5

    def samples(self, X0: rj.Box, count: int = 5000) -> tuple[np.ndarray, np.ndarray]:
        """What the network sees, and what the law does there."""
        rng = np.random.default_rng(0)
        lower, upper = (np.asarray(end) for end in (X0.lower, X0.upper))
        states = rng.uniform(lower - self.spread, upper + self.spread, (count, len(lower)))
        seen = states if self.sees is None else self.sees(states)
        return seen, self.law(seen)


@dataclass(frozen=True)
class Instance:
    """A loop whose network is to be read, and a specification.

    Attributes:
        benchmark: its name in the competition.
        name: of the instance.
        files: of each network the paths at which it may be, relative to the folder that is given,
            with `*` for any name: the first one that is there is read.
        loop: made of the networks.
        X0: the initial set.
        horizon: the number of periods, or of steps.
        required: arguments of `rj.decide`.
        planes: pairs of coordinates, counted from 1, that are drawn over each other; 0 is time.
        shape: of networks that are trained where none is given.
        note: what the definition leaves open, and how it is read here.
    """

    benchmark: str
    name: str
    files: tuple[tuple[str, ...], ...]
    loop: Callable[[Networks], rj.ClosedLoop]
    X0: rj.Box
    horizon: int
    required: Mapping[str, Any]
    planes: tuple[tuple[int, int], ...]
    shape: Shape | None = None
    note: str = ""

    @property
    def title(self) -> str:
        """Benchmark and instance in one word."""
        return f"{self.benchmark}-{self.name}".lower().replace(" ", "-")

    def paths(self, folder: Path) -> list[Path]:
        """The files of its networks in a folder.

        Raises:
            FileNotFoundError: one is not there.
        """
        found = []
        for patterns in self.files:
            there = [path for pattern in patterns for path in sorted(folder.glob(pattern))]
            if not there:
                raise FileNotFoundError(f"{folder} has none of {', '.join(patterns)}")
            found.append(there[0])
        return found


def within(states: int, limits: Mapping[int, tuple[float, float]]) -> rj.Polytope:
    """States of which some coordinates, counted from 1, are between limits."""
    rows, ends = [], []
    for k, (least, most) in limits.items():
        unit = np.eye(states)[k - 1]
        for row, end in ((unit, most), (-unit, -least)):
            if np.isfinite(end):
                rows.append(row)
                ends.append(end)
    return rj.Polytope(np.array(rows), np.array(ends))


def sampled(
    f: Callable[..., Any], n: int, m: int, period: float, **more: Any
) -> Callable[[Networks], rj.ClosedLoop]:
    """The loop of a differential equation whose input, a network's output, is held."""
    return lambda nets: rj.ClosedLoop(rj.SampledPlant(f, n, m, period), nets[0], **more)


def scaled(
    net: rj.AbstractNetwork, n: int, before: Callable[..., Any], after: Callable[..., Any]
) -> rj.Network:
    """A network between two functions of modules, of the state and of its output."""
    m = jax.eval_shape(after, jax.ShapeDtypeStruct((net.outputs,), float)).shape[0]
    law = functools.partial(_between, before, after)
    return rj.Network(jax.tree_util.Partial(law, net), n, m)


def _between(before: Callable[..., Any], after: Callable[..., Any], net: Any, x: Any) -> Any:
    return after(net(before(x)))


def unchanged(x: Any) -> Any:
    """The vector as it is."""
    return x


def _less(offset: float, u: Any) -> Any:
    return u - offset


def _times(factor: float, u: Any) -> Any:
    return factor * u


def _cruise_control() -> Instance:
    n, room = 6, np.array([1.0, 0, 0, -1, -1.4, 0])

    def loop(nets: Networks) -> rj.ClosedLoop:
        plant = rj.SampledPlant(fields.cruise_control, n, 1, 0.1)
        return rj.ClosedLoop(plant, scaled(nets[0], n, fields.seen_ahead, unchanged))

    def law(x: np.ndarray) -> np.ndarray:
        speed, distance, relative = x[:, 2], x[:, 3], x[:, 4]
        wanted = 0.25 * (distance - 12 - 1.5 * speed) + 0.8 * relative
        return np.clip(np.minimum(wanted, 0.5 * (30 - speed)), -4, 2)[:, None]

    return Instance(
        "ACC",
        "safe-distance",
        (("**/ACC/*5_20.onnx", "**/ACC/*5_20.mat", "acc.onnx"),),
        loop,
        rj.Box([90.0, 32, 0, 10, 30, 0], [110, 32.2, 0, 11, 30.2, 0]),
        50,
        {"safe": rj.Polytope(-room[None], [-10.0])},
        ((0, 1), (0, 4)),
        Shape(
            (20,) * 5,
            "relu",
            law,
            (60.0, 12.0, 2.0, 60.0, 12.0, 2.0),
            lambda x: np.asarray(jax.vmap(fields.seen_ahead)(jnp.asarray(x))),
        ),
    )


def _oscillators() -> list[Instance]:
    goal = within(4, {1: (-0.1, 0.2), 2: (-0.9, -0.6)})
    X0 = rj.Box([-0.77, -0.45, 0.51, -0.3], [-0.75, -0.43, 0.54, -0.28])
    note = "'within 5' is read as at t = 5; the reading in which it may be at any time is implied"
    heterogeneous = [
        Instance(
            "TORA",
            f"reach-{name}",
            (
                (
                    f"**/Tora_Heterogeneous/nn_tora_{file}.mat",
                    f"**/Tora_Heterogeneous/nn_tora_{file}.txt",
                    f"tora_{file}.mat",
                ),
            ),
            lambda nets: rj.ClosedLoop(
                rj.SampledPlant(fields.oscillator, 4, 1, 0.5),
                scaled(nets[0], 4, unchanged, functools.partial(_times, 11.0)),
            ),
            X0,
            10,
            {"goal": goal},
            ((1, 2),),
            Shape((20, 20, 20), activation, lambda x: np.tanh(_tora(x) / 11), (1.0,) * 4),
            note,
        )
        for name, file, activation in (
            ("tanh", "relu_tanh", "relu"),
            ("sigmoid", "sigmoid", "tanh"),
        )
    ]
    remain = Instance(
        "TORA",
        "remain",
        (("**/Benchmark9-Tora/*ontroller*.onnx", "**/Benchmark9-Tora/*ontroller*.mat"),),
        lambda nets: rj.ClosedLoop(
            rj.SampledPlant(fields.oscillator, 4, 1, 1.0),
            scaled(nets[0], 4, unchanged, functools.partial(_less, 10.0)),
        ),
        rj.Box([0.6, -0.7, -0.4, 0.5], [0.7, -0.6, -0.3, 0.6]),
        20,
        {"safe": rj.Box([-2.0] * 4, [2.0] * 4)},
        ((1, 2), (3, 4)),
        Shape((100, 100, 100), "relu", lambda x: 10.0 + _tora(x), (1.0,) * 4),
    )
    return [remain, *heterogeneous]


def _tora(x: np.ndarray) -> np.ndarray:
    """Damped rotation with a little of the cart's motion in it."""
    return (-0.5 * x[:, 2] - 0.9 * x[:, 3] - 0.1 * x[:, 0])[:, None]


def _unicycles() -> list[Instance]:
    goal = rj.Box([-0.6, -0.2, -0.06, -0.3], [0.6, 0.2, 0.06, 0.3])
    X0 = rj.Box([9.5, -4.5, 2.1, 1.5], [9.55, -4.45, 2.11, 1.51])

    def law(x: np.ndarray) -> np.ndarray:
        px, py, heading, speed = x.T
        turned = np.clip(-0.6 * (heading - np.arctan2(-py, -px - 0.1)), -2, 2)
        return 20.0 + np.stack([np.clip(-0.3 * speed, -2, 2), turned], axis=1)

    def instance(name: str, plant: Callable[[], rj.SampledPlant], note: str, **more: Any):
        return Instance(
            "Unicycle",
            name,
            (("**/Benchmark10-Unicycle/*ontroller*.onnx", "**/Benchmark10-Unicycle/*nnv.mat"),),
            lambda nets: rj.ClosedLoop(
                plant(), scaled(nets[0], 4, unchanged, functools.partial(_less, 20.0)), **more
            ),
            X0,
            50,
            {"goal": goal},
            ((1, 2), (3, 4)),
            Shape((500,), "relu", law, (2.0, 2.0, 0.5, 0.5)),
            note,
        )

    return [
        instance(
            "reach",
            lambda: rj.SampledPlant(fields.unicycle, 4, 2, 0.2, disturbances=1),
            "the disturbance of 1e-4 is any signal; others take it for a constant",
            disturbance=rj.Box([-1e-4], [1e-4]),
        ),
        instance(
            "reach-undisturbed",
            lambda: rj.SampledPlant(fields.unicycle, 4, 2, 0.2),
            "without the disturbance, as some of the tools have it",
        ),
    ]


def _pendulums() -> list[Instance]:
    def swung(x: np.ndarray) -> np.ndarray:
        return (-0.9 * (x[:, 0] - 0.4) - 0.35 * x[:, 1] - 0.1)[:, None]

    def held(x: np.ndarray) -> np.ndarray:
        return -0.5 * (x[:, :2] - 0.4) - 0.4 * x[:, 2:]

    single = Instance(
        "Single Pendulum",
        "reach",
        (("**/Single_Pendulum/*ontroller*.onnx", "single_pendulum.onnx"),),
        sampled(fields.pendulum, 2, 1, 0.05),
        rj.Box([1.0, 0.0], [1.175, 0.2]),
        20,
        {"goal": {(0.5, 1.0): within(2, {1: (0.0, 1.0)})}},
        ((0, 1),),
        Shape((25, 25), "relu", swung, (0.8, 1.5)),
    )
    doubles = [
        Instance(
            "Double Pendulum",
            f"{name}-robust",
            (
                (
                    f"**/Double_Pendulum/*{name}_robust*.onnx",
                    f"double_pendulum_{name}.onnx",
                ),
            ),
            sampled(fields.double_pendulum, 4, 2, period),
            rj.Box([1.0] * 4, [1.3] * 4),
            20,
            {"safe": rj.Box([least] * 4, [most] * 4)},
            ((3, 4),),
            Shape((25, 25), "relu", held, (0.6, 0.6, 1.0, 1.0)),
            note,
        )
        for name, period, least, most, note in (
            ("less", 0.05, -1.7, 2.0, "the earlier years' box of [-1, 1.7] is broken"),
            ("more", 0.02, -1.5, 1.5, "the earlier years' box of [-0.5, 1.5] is broken a fortiori"),
        )
    ]
    return [single, *doubles]


def _airplanes() -> list[Instance]:
    X0 = rj.Box([0.0] * 12, [0.0] * 3 + [1.0] * 6 + [0.0] * 3)
    safe = within(12, {2: (-1, 1), 7: (-1, 1), 8: (-1, 1), 9: (-1, 1)})

    def law(x: np.ndarray) -> np.ndarray:
        v, angles, r, p, q = x[:, 3:6], x[:, 6:9], x[:, 9], x[:, 10], x[:, 11]
        force = -2.0 * v + np.stack([np.sin(angles[:, 1]), -np.sin(angles[:, 0]), -1 + 0 * r], 1)
        turned = np.stack([p, q, r], axis=1)
        return np.concatenate([force, -3.0 * angles - 3.0 * turned], axis=1)

    given: dict[str, Any] = {
        "files": (("**/Airplane/*ontroller*.onnx", "airplane.onnx"),),
        "X0": X0,
        "horizon": 20,
        "planes": ((2, 7),),
        "shape": Shape((100, 100, 20), "relu", law, (0.5,) * 12),
    }
    at_samples = dict.fromkeys(range(21), safe)
    return [
        Instance(
            "Airplane",
            "continuous",
            loop=sampled(fields.airplane, 12, 6, 0.1),
            required={"safe": safe},
            note="t in [0, 20] of the table is read as twenty periods of 0.1",
            **given,
        ),
        Instance(
            "Airplane",
            "discrete",
            loop=sampled(fields.airplane, 12, 6, 0.1),
            required={"goal": at_samples},
            note="required at the samples alone, of the same differential equation",
            **given,
        ),
    ]


def _attitude() -> Instance:
    unsafe = rj.Box([-0.2, -0.5, 0, -0.7, 0.7, -0.4], [0, -0.4, 0.2, -0.6, 0.8, -0.2])

    def law(x: np.ndarray) -> np.ndarray:
        return -1.5 * x[:, :3] - 0.8 * x[:, 3:]

    return Instance(
        "Attitude Control",
        "avoid",
        (("**/Attitude*Control/*.onnx", "**/Attitude*Control/*.mat", "attitude_control.onnx"),),
        sampled(fields.attitude, 6, 3, 0.1),
        rj.Box([-0.45, -0.55, 0.65, -0.75, 0.85, -0.65], [-0.44, -0.54, 0.66, -0.74, 0.86, -0.64]),
        30,
        {"avoid": [unsafe]},
        ((1, 2),),
        Shape((64, 64, 64), "tanh", law, (0.8,) * 6),
    )


def _quadrotor() -> Instance:
    def law(x: np.ndarray) -> np.ndarray:
        lift = 3.0 * (1 - x[:, 2]) + 3.5 * x[:, 5]
        return np.stack([lift, *(-0.3 * x[:, 6:8] - 0.15 * x[:, 9:11]).T], axis=1)

    return Instance(
        "QUAD",
        "reach",
        (("**/QUAD/*.onnx", "**/QUAD/*.mat", "quadrotor.onnx"),),
        sampled(fields.quadrotor, 12, 3, 0.1),
        rj.Box([-0.4] * 6 + [0.0] * 6, [0.4] * 6 + [0.0] * 6),
        50,
        {"goal": within(12, {3: (0.94, 1.06)})},
        ((0, 3),),
        Shape((64, 64, 64), "tanh", law, (0.6,) * 6 + (0.3,) * 6, penalty=1e-3),
        "the published file has a product for a sum in x4', a sine for a cosine in x2', and signs "
        "of another axis in x5' and x9': the physics is taken, as all tools do; at t = 5",
    )


def slow(distance: float, slope: float) -> rj.Polytope:
    """States that surely keep `|v| <= distance + slope |s|`, in the quadrant of positive `s`.

    `d . v <= cos(pi / k) (distance + slope e . s)` for unit vectors `d` and `e`: `k` of `d` all
    around, and `e` in the middle of the quadrant, since `e . s <= |s|`.
    """
    angles = np.pi / 4 + 2 * np.pi * (np.arange(HALF_PLANES) + 0.5) / HALF_PLANES
    speeds = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    shorter = np.cos(np.pi / HALF_PLANES)
    towards = np.full((HALF_PLANES, 2), np.sqrt(0.5))
    rows = np.hstack([-slope * shorter * towards, speeds])
    return rj.Polytope(rows, np.full(HALF_PLANES, distance * shorter))


def _docking() -> Instance:
    def law(x: np.ndarray) -> np.ndarray:
        return 1.2 * (-0.0012 * x[:, :2] - x[:, 2:])

    def loop(nets: Networks) -> rj.ClosedLoop:
        return rj.ClosedLoop(rj.SampledPlant.affine(*fields.docking(), period=1.0), nets[0])

    return Instance(
        "Docking",
        "constraint",
        (("**/Docking/bias_model.onnx", "**/Docking/model.onnx", "docking.onnx"),),
        loop,
        rj.Box([70.0, 70, -0.28, -0.28], [106, 106, 0.28, 0.28]),
        40,
        {"safe": slow(0.2, 2 * fields.MOTION)},
        ((0, 1),),
        Shape((256, 256, 4), "tanh", law, (20.0, 20, 0.2, 0.2), penalty=1e-3),
        f"the limit of speed is a cone: {HALF_PLANES} half-spaces within it are proved",
    )


def _navigations() -> list[Instance]:
    def law(x: np.ndarray) -> np.ndarray:
        _, py, speed, heading = x.T
        # around the obstacle, below it
        aim = np.where((py > 0.6)[:, None], [[2.4, 0.2]], [[0.0, 0.0]]) - x[:, :2]
        away = np.linalg.norm(aim, axis=1)
        wanted = np.arctan2(aim[:, 1], aim[:, 0])
        turned = (wanted - heading + np.pi) % (2 * np.pi) - np.pi
        return np.tanh(np.stack([np.minimum(away, 1.2) - speed, 2 * turned], axis=1))

    return [
        Instance(
            "NAV",
            name,
            ((f"**/NAV/**/nn-nav-{file}.onnx", f"nav_{file}.onnx"),),
            sampled(fields.navigation, 4, 2, 0.2),
            rj.Box([2.9, 2.9, 0.0, 0.0], [3.1, 3.1, 0.0, 0.0]),
            30,
            {
                "avoid": [within(4, {1: (1.0, 2.0), 2: (1.0, 2.0)})],
                "goal": within(4, {1: (-0.5, 0.5), 2: (-0.5, 0.5)}),
            },
            ((1, 2),),
            Shape((64, 32), "relu", law, (3.0, 3.0, 1.0, 3.0)),
            "the goal is required at t = 6",
        )
        for name, file in (("standard", "point"), ("robust", "set"))
    ]


def _balancing() -> Instance:
    def law(x: np.ndarray) -> np.ndarray:
        return np.tanh(0.6 * x[:, :1] + 1.0 * x[:, 1:2] + 9.0 * x[:, 2:3] + 1.8 * x[:, 3:])

    upright = within(4, {1: (-0.001, 0.001), 3: (-0.001, 0.001), 4: (-0.001, 0.001)})
    return Instance(
        "Balancing",
        "reach",
        (
            (
                "**/CartPole/*.onnx",
                "**/Balancing/*.onnx",
                "cartpole.onnx",
            ),
        ),
        sampled(fields.cart_pole, 4, 1, 0.02),
        rj.Box([-0.1, -0.05, -0.1, -0.05], [0.1, 0.05, 0.1, 0.05]),
        500,
        {"goal": {(8.0, 10.0): upright}},
        ((1, 3),),
        Shape((64, 64), "tanh", law, (0.3, 0.5, 0.3, 0.5)),
        "x2 is not required to stand still",
    )


def _avoidances() -> list[Instance]:
    def loop(worst: bool) -> Callable[[Networks], rj.ClosedLoop]:
        def made(nets: Networks) -> rj.ClosedLoop:
            step = fields.avoidance(worst)
            count = 3 if worst else 0
            plant = rj.NonlinearPlant(step, 12, 9, **({"disturbances": count} if worst else {}))
            scores = rj.Switched(
                [scaled(net, 12, fields.seen_intruder, unchanged) for net in nets],
                by=fields.last_advisory,
            )
            policy = scaled(scores, 12, unchanged, fields.best_of)
            drawn = rj.Box(np.zeros(count), np.ones(count)) if worst else None
            return rj.ClosedLoop(plant, policy, disturbance=drawn)

        return made

    files = tuple((f"**/VCAS/**/*pra0{k}*.nnet", f"vcas_{k}.nnet") for k in range(1, 10))
    last = np.eye(9)[0]
    return [
        Instance(
            "VCAS",
            f"{name}{rate}",
            files,
            loop(name == "worst"),
            rj.Box(np.r_[-133.0, rate, 25, last], np.r_[-129.0, rate, 25, last]),
            10,
            {"avoid": {k: [within(12, {1: (-100.0, 100.0)})] for k in range(1, 11)}},
            ((0, 1),),
            None,
            "rates of climb are divided by 5000 as the definition has it, though in ft/s: by the "
            "networks' own ranges of 200, or in ft/min, every instance is broken; an advisory is "
            "complied with only where it is that of the last second, too",
        )
        for name in ("middle", "worst")
        for rate in RATES
    ]


def instances() -> dict[str, Instance]:
    """All instances, by their titles, in the order of the competition."""
    remain, *heterogeneous = _oscillators()
    found = [
        _cruise_control(),
        *_airplanes(),
        _attitude(),
        _balancing(),
        _docking(),
        *_pendulums()[1:],
        *_navigations(),
        _quadrotor(),
        _pendulums()[0],
        remain,
        *heterogeneous,
        *_unicycles(),
        *_avoidances(),
    ]
    return {each.title: each for each in found}
