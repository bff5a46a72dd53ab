"""Steps of training: a specification's penalty with its gradient, compiled and not."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings, he_network
from experiments.benchmark.smooth import loops
from experiments.benchmark.smooth.rows import MEMORY, Figures, Row, gigabytes
from experiments.benchmark.timing import repeated

CALLS, PATIENCE = 20, 600.0
"""Warm calls of which the median is taken, and the seconds after which there is no further one: a
first call alone would say nothing of compilation."""

SWING, POLE = 0.05, 0.02
"""Seconds of a period of the pendulum and of the cart-pole."""


@dataclasses.dataclass(frozen=True)
class Lesson:
    """A loop whose penalty is lowered: it has to stay where not all of it does.

    Attributes:
        loop: the loop.
        X0: where it begins.
        horizon: the number of periods.
        safe: where every state must be.
    """

    loop: rj.ClosedLoop
    X0: rj.Box
    horizon: int
    safe: rj.Box

    @property
    def asked(self) -> dict[str, Any]:
        """The template and what is required."""
        return {"template": rj.Template.box(self.loop.states), "safe": self.safe}

    def penalty(self, net: rj.AbstractNetwork) -> jax.Array:
        """How much a network's loop misses, by affine forms."""
        loop, asked = self.loop.replace(controller=net), self.asked
        return rj.specification_penalty(
            loop, self.X0, self.horizon, **asked, relaxation=rj.LinearBounds()
        )

    def certified(self) -> float:
        """The penalty of the sets that `reach` proves, with rounding."""
        template = self.asked["template"]
        tube = rj.reach(self.loop, self.X0, self.horizon, template, rj.LinearBounds())
        return float(rj.shortfall(tube, safe=self.safe))


def pendulum(way: str, settings: Settings) -> Lesson:
    """A pendulum with a sine under 2-32-1 neurons of `tanh`, 20 periods.

    Args:
        way: how a period is sampled: by `Euler`, by one step of `Runge-Kutta`, or `at all times`.
        settings: of the benchmark.
    """
    net = rj.MLP.from_layers(he_network((2, 32, 1), seed=0), activation=rj.Tanh())
    loop = rj.ClosedLoop(rj.SampledPlant(loops.swing, 2, 1, SWING), net)
    if way == "Euler":
        plant = rj.NonlinearPlant(lambda x, u: x + SWING * loops.swing(x, u), 2, 1)
        loop = loop.replace(plant=plant)
    elif way == "Runge-Kutta":
        loop = loops.at_samples(loop)
    return Lesson(loop, _around(2, 0.1), 20, _around(2, 0.05))


def cart_pole(periods: int, settings: Settings) -> Lesson:
    """A cart-pole under 4-16-1 neurons of `tanh`, one step of Euler a period."""
    loop = loops.pole(loops.small_balancer(settings), POLE)
    return Lesson(loop, _around(4, 0.05), periods, _around(4, 0.04))


def _around(n: int, half: float) -> rj.Box:
    return rj.Box(np.full(n, -half), np.full(n, half))


def jitted(lesson: Callable[[Settings], Lesson], settings: Settings) -> Iterator[Figures]:
    """Milliseconds of value and gradient in compiled code, and what compiling takes."""
    given = lesson(settings)
    both = jax.jit(jax.value_and_grad(given.penalty), compiler_options=rj.compiler_options())
    yield from _timed(given, both, settings)


def eager(lesson: Callable[[Settings], Lesson], settings: Settings) -> Iterator[Figures]:
    """The same without `jax.jit`: what is compiled is so by the library."""
    given = lesson(settings)
    yield from _timed(given, jax.value_and_grad(given.penalty), settings)


def _timed(given: Lesson, both: Callable[..., Any], settings: Settings) -> Iterator[Figures]:
    net, often = (
        given.loop.controller,
        dataclasses.replace(settings, repetitions=CALLS, patience=PATIENCE),
    )
    timing = repeated(lambda: jax.block_until_ready(both(net)), often)
    value, gradient = timing.result
    size = np.sqrt(sum(float(np.sum(np.square(leaf))) for leaf in jax.tree.leaves(gradient)))
    yield {"first, s": timing.first, MEMORY: gigabytes()}
    if timing.calls:
        yield {"ms": 1000 * timing.seconds, "compilation, s": timing.first - timing.seconds}
    yield {"penalty": float(value), "gradient": size}
    if not given.loop.plant.continuous:
        certified = given.certified()
        yield {"off the certified": abs(float(value) - certified) / max(abs(certified), 1e-300)}


def _row(name: str, measure: Any, lesson: Any, **asked: float | None) -> Row:
    named = {"ms": "ms", "compilation": "compilation, s", "first": "first, s", "memory": MEMORY}
    limits = {named[key]: most for key, most in asked.items()}
    return Row("training", name, limits, functools.partial(measure, lesson))


def _exactly(row: Row) -> Row:
    """The row, of whose penalty it is asked that it is the certified one."""
    return dataclasses.replace(row, asked={**row.asked, "off the certified": 1e-9})


EULER, STAGES = (functools.partial(pendulum, way) for way in ("Euler", "Runge-Kutta"))
FIVE, SIXTY = functools.partial(cart_pole, 5), functools.partial(cart_pole, 60)
ALL_TIMES = functools.partial(pendulum, "at all times")

ROWS = (
    _exactly(
        _row("pendulum, 20 periods, Euler", jitted, EULER, ms=3.0, compilation=4.0, memory=0.6)
    ),
    _exactly(
        _row("the same, Runge-Kutta", jitted, STAGES, ms=6.0, compilation=6.0, memory=0.8),
    ),
    _exactly(_row("cart-pole, 5 periods", jitted, FIVE, ms=3.0, compilation=8.0, memory=0.8)),
    _exactly(_row("cart-pole, 60 periods", jitted, SIXTY, ms=30.0, compilation=8.0, memory=0.8)),
    _row("cart-pole, 5 periods, eager", eager, FIVE, ms=3.0, first=8.0, memory=0.8),
    _row("cart-pole, 60 periods, eager", eager, SIXTY, ms=30.0, first=8.0, memory=0.8),
    _row("pendulum, 20 periods, at all times", jitted, ALL_TIMES, ms=5.0, first=10.0, memory=1.0),
)
