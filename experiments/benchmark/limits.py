"""Whether calls end in time: every entry point under `time_limit`, first calls included.

Each call has a process of its own, in which nothing is compiled yet and no compilation is kept. It
is made twice: what the second one takes less is what was compiled.
"""

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.benchmark.cases import Settings, he_network
from experiments.benchmark.rivals.processes import Stopped, from_process
from experiments.sampled.problems import RungeKutta

GRACE = 1.3
"""So many times its limit a call may take."""

LIMITS_NOTE = """\
first, second: wall seconds of the first call of a process, and of one more
compiled: seconds of XLA in the first call;  longest: of one compilation
! longer than 1.3 times the limit; such as --patience ended are 'ended'"""

STEP = 0.05
"""Seconds of a step of the pendulum and of the quadrotor."""


class Question(NamedTuple):
    """A loop, where it begins, and where it must stay.

    Attributes:
        loop: the loop.
        X0: the initial set.
        horizon: the number of steps.
        safe: where every state must be.
    """

    loop: rj.ClosedLoop
    X0: rj.Box
    horizon: int
    safe: rj.Box


def wide() -> Question:
    """Four states under 256 + 256 ReLUs."""
    A = 0.9 * np.eye(4) + 0.1 * np.eye(4, k=1)
    layers = he_network((4, 256, 256, 1), seed=0)
    layers[-1] = 0.1 * layers[-1][0], layers[-1][1]
    loop = rj.ClosedLoop(rj.AffinePlant(A, 0.1 * np.ones((4, 1))), rj.MLP.from_layers(layers))
    return _around(loop, 0.2, 5, 1.0)


def quadrotor() -> Question:
    """Twelve smooth states, one step of Euler each, under 32 neurons of tanh."""

    def f(x, u):
        position, (roll, pitch, yaw), velocity, rates = x[:3], x[3:6], x[6:9], x[9:]
        thrust, torque = 9.81 + u[0], u[1:]
        p, q, r = rates
        turned = jnp.array(
            [
                p + (q * jnp.sin(roll) + r * jnp.cos(roll)) * jnp.tanh(pitch),
                q * jnp.cos(roll) - r * jnp.sin(roll),
                q * jnp.sin(roll) + r * jnp.cos(roll),
            ]
        )
        lifted = thrust * jnp.array(
            [
                jnp.cos(roll) * jnp.sin(pitch) * jnp.cos(yaw) + jnp.sin(roll) * jnp.sin(yaw),
                jnp.cos(roll) * jnp.sin(pitch) * jnp.sin(yaw) - jnp.sin(roll) * jnp.cos(yaw),
                jnp.cos(roll) * jnp.cos(pitch),
            ]
        )
        lifted = lifted - jnp.array([0.0, 0.0, 9.81])
        turning = torque + jnp.array([-0.2 * q * r, 0.2 * p * r, 0.1 * p * q])
        return jnp.concatenate(
            [
                position + STEP * velocity,
                x[3:6] + STEP * turned,
                velocity + STEP * lifted,
                rates + STEP * turning,
            ]
        )

    layers = he_network((12, 32, 4), seed=0)
    layers[-1] = 0.05 * layers[-1][0], 0.0 * layers[-1][1]
    net = rj.MLP.from_layers(layers, activation=rj.Tanh())
    return _around(rj.ClosedLoop(rj.NonlinearPlant(f, 12, 4), net), 0.3, 5, 0.35)


def pendulum() -> Question:
    """Two hundred periods of a pendulum with friction, one step of Runge and Kutta each."""

    def slope(x, u):
        return jnp.array([x[1], -jnp.sin(x[0]) - 0.5 * x[1] + u[0]])

    layers = he_network((2, 16, 1), seed=0)
    layers[-1] = 0.1 * layers[-1][0], 0.0 * layers[-1][1]
    net = rj.MLP.from_layers(layers, activation=rj.Tanh())
    plant = rj.NonlinearPlant(RungeKutta(slope, STEP), 2, 1)
    return _around(rj.ClosedLoop(plant, net), 0.2, 200, 1.0)


def _around(loop: rj.ClosedLoop, half: float, horizon: int, room: float) -> Question:
    one = np.ones(loop.states)
    return Question(loop, rj.Box(-half * one, half * one), horizon, rj.Box(-room * one, room * one))


LOOPS = {loop.__name__: loop for loop in (wide, quadrotor, pendulum)}


def _reached(asked: Question, limit: float, *relaxation: Any) -> Any:
    template = rj.Template.box(asked.loop.states)
    return rj.reach(asked.loop, asked.X0, asked.horizon, template, *relaxation, time_limit=limit)


def _always(asked: Question, limit: float) -> Any:
    """A tube of two steps, half of the limit, and a verdict for all time in the rest."""
    began = time.monotonic()
    tube = _reached(asked._replace(horizon=2), limit / 2)
    left = max(limit - (time.monotonic() - began), 0.0)
    return rj.verify(tube, safe=asked.safe, forever=True, time_limit=left)


CALLS: dict[str, Callable[[Question, float], Any]] = {
    "reach": _reached,
    "reach, LinearBounds": lambda asked, limit: _reached(asked, limit, rj.LinearBounds()),
    "reach, PaperQC": lambda asked, limit: _reached(asked, limit, rj.PaperQC()),
    "reach, LocalBounds": lambda asked, limit: _reached(asked, limit, rj.LocalBounds()),
    "reach_partitioned": lambda asked, limit: rj.reach_partitioned(
        asked.loop,
        asked.X0,
        asked.horizon,
        rj.Template.box(asked.loop.states),
        cells=8,
        time_limit=limit,
    ),
    "decide": lambda asked, limit: rj.decide(*asked[:3], safe=asked.safe, time_limit=limit),
    "decide, cells": lambda asked, limit: rj.decide(
        *asked[:3], safe=asked.safe, cells=2000, time_limit=limit
    ),
    "winning_set": lambda asked, limit: rj.winning_set(
        *asked[:3], safe=asked.safe, cells=2000, time_limit=limit
    ),
    "largest_set": lambda asked, limit: rj.largest_set(
        *asked[:3], safe=asked.safe, time_limit=limit
    ),
    "verify, forever": _always,
}

CASES = (
    ("wide", "reach"),
    ("wide", "reach, LinearBounds"),
    ("wide", "reach, PaperQC"),
    ("wide", "reach, LocalBounds"),
    ("wide", "reach_partitioned"),
    ("wide", "decide"),
    ("wide", "decide, cells"),
    ("wide", "winning_set"),
    ("wide", "largest_set"),
    ("wide", "verify, forever"),
    ("quadrotor", "reach"),
    ("quadrotor", "reach, LinearBounds"),
    ("quadrotor", "reach_partitioned"),
    ("quadrotor", "decide"),
    ("quadrotor", "decide, cells"),
    ("quadrotor", "winning_set"),
    ("quadrotor", "largest_set"),
    ("quadrotor", "verify, forever"),
    ("pendulum", "reach"),
    ("pendulum", "decide"),
    ("pendulum", "decide, cells"),
    ("pendulum", "winning_set"),
    ("pendulum", "largest_set"),
    ("pendulum", "verify, forever"),
)
"""Loops and calls, each in a process of its own."""


def chosen(settings: Settings) -> list[tuple[str, str]]:
    """The cases of the loops and methods that are asked for; all without any."""
    return [
        (loop, call)
        for loop, call in CASES
        if (not settings.loops or loop in settings.loops)
        and (not settings.methods or call in settings.methods)
    ]


class Compilations:
    """Seconds that XLA takes, one compilation after the other."""

    def __init__(self):
        self.seconds: list[float] = []
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.endswith("backend_compile_duration"):
            self.seconds.append(duration_secs)


def limited(loop: str, call: str, limit: float) -> Iterator[dict]:
    """What is seen of two calls, in a process in which nothing is compiled yet."""
    logging.getLogger("jax").setLevel(logging.ERROR)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", None)
    asked, heard = LOOPS[loop](), Compilations()
    for name in ("first", "second"):
        before, began = len(heard.seconds), time.perf_counter()
        try:
            said = _said(CALLS[call](asked, limit))
        except (ValueError, RuntimeError) as error:
            said = f"{type(error).__name__}: {error}"[:200]
        seconds, compiled = time.perf_counter() - began, heard.seconds[before:]
        found: dict[str, Any] = {name: seconds, "said": said}
        if name == "first":
            found |= {"compiled": sum(compiled), "longest": max(compiled, default=0.0)}
        yield found


def _said(found: Any) -> str:
    status = getattr(found, "status", None) or getattr(
        getattr(found, "verdict", None), "status", None
    )
    return getattr(status, "name", type(found).__name__)


def too_long(row: dict) -> bool:
    """Whether one of the two calls took longer than it may."""
    return max(row["first"], row["second"]) > GRACE * row["limit"]


def limit_rows(settings: Settings) -> Iterator[dict]:
    """The rows, one after the other; a call that patience ends has that for its seconds."""
    for loop, call in chosen(settings):
        row = {"loop": loop, "call": call, "limit": settings.limit, "said": "ended"}
        row |= dict.fromkeys(("compiled", "longest"), 0.0)
        row |= dict.fromkeys(("first", "second"), settings.patience)
        given = loop, call, settings.limit
        with contextlib.suppress(Stopped):
            for found in from_process(limited, *given, patience=settings.patience):
                row |= found
        yield row


def limits_table(rows: list[dict]) -> Table:
    """A loop and a call a row."""
    shown = [
        (
            row["loop"],
            row["call"] + " !" * too_long(row),
            *(f"{row[name]:.2f}" for name in ("first", "second", "compiled", "longest")),
            row["said"].split(":")[0],
        )
        for row in rows
    ]
    title = f"wall seconds of calls with time_limit={rows[0]['limit']:g}"
    headings = ("first", "second", "compiled", "longest", "said")
    return report.table(title, ("loop", "call"), headings, shown)
