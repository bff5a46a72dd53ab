"""Affine forms alone: products, a double pendulum, noise, a hundred periods from many cells."""

import functools
import os
import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.smooth import loops, widths
from experiments.benchmark.smooth.rows import Figures, Row
from reachjax.programs.unrolled import unrolled_from_boxes

SCALES = tuple(10.0**k for k in range(7))
NOISE_STEP, PUSH, NOISE = 0.05, 0.5, 0.01
"""Seconds of a step of the cart-pole with noise, its disturbance, and the noise of each state."""

TWENTIETH = 0.05
"""Of the initial set's widths, that of a cell in which the cart-pole's forms contract."""


def products(settings: Settings) -> Iterator[Figures]:
    """Width of a product of factors of sizes `1 / s` and `s`, over the true one, which is 0.708."""
    X0, net = rj.Box([0.0, 0.0], [1.0, 1.0]), rj.MLP.from_layers([(np.zeros((1, 2)), np.zeros(1))])
    for s in SCALES:
        plant = rj.NonlinearPlant(functools.partial(_product, s), 2, 1)
        loop = rj.ClosedLoop(plant, net)
        tube = rj.reach(loop, X0, 1, rj.Template.box(2), rj.LinearBounds())
        yield {_of_scale(s): widths.widths_of(tube.sets[-1])[0] / np.sin(1.0) ** 2}


def _product(s: float, x: jax.Array, u: jax.Array) -> jax.Array:
    return jnp.array([(jnp.sin(x[0]) / s) * (s * jnp.sin(x[1])), u[0]])


def _of_scale(s: float) -> str:
    return f"width, s = {s:g}"


def tenth(settings: Settings) -> Iterator[Figures]:
    """Widths of the double pendulum from a tenth of its set, one step of Runge-Kutta a period."""
    instance, loop = loops.read(loops.DOUBLE, settings)
    loop, X0 = loops.at_samples(loop), loops.scaled_set(instance.X0, 0.1)
    began = time.perf_counter()
    tube = rj.reach(loop, X0, instance.horizon, rj.Template.box(4), rj.LinearBounds())
    yield {"seconds": time.perf_counter() - began}
    runs = np.asarray(loop.simulate(widths.drawn(X0, settings.simulations), instance.horizon))
    yield {"width": widths.at_the_end(tube, runs)}


def noise(settings: Settings) -> Iterator[Figures]:
    """Widths over those that witnesses of the default attain, which climb in disturbances too."""
    net, steps = loops.small_balancer(settings), 5
    loop = loops.noisy_pole(net, NOISE_STEP, PUSH, NOISE)
    X0, template = rj.Box([-0.1, -0.05, -0.1, -0.05], [0.1, 0.05, 0.1, 0.05]), rj.Template.box(4)
    began = time.perf_counter()
    tube = rj.reach(loop, X0, steps, template)
    yield {"seconds": time.perf_counter() - began}
    attained = widths.widths_of(rj.Polytope(template.directions, tube.proof(steps).witnesses))
    yield {"default": widths.ratio(widths.widths_of(tube.sets[-1]), attained)}
    tube = rj.reach(loop, X0, steps, template, rj.LinearBounds())
    yield {"LinearBounds": widths.ratio(widths.widths_of(tube.sets[-1]), attained)}


def hundred(periods: int, cells: int, settings: Settings) -> Iterator[Figures]:
    """What forms from many cells of a twentieth take, all in one compiled call."""
    instance, loop = loops.read(loops.BALANCING, settings)
    loop, X0 = loops.at_samples(loop), instance.X0
    half = TWENTIETH * np.asarray(X0.widths) / 2
    rng = np.random.default_rng(0)
    middle = rng.uniform(X0.lower + half, X0.upper - half, (cells, 4))
    rows = jnp.broadcast_to(jnp.asarray(rj.Template.box(4).directions), (periods, 8, 4))
    given = jax.device_put((loop, middle - half, middle + half, rows))

    def bounds() -> np.ndarray:
        return np.asarray(unrolled_from_boxes(*given))

    began = time.perf_counter()
    bounds()
    first, began, used = time.perf_counter() - began, time.perf_counter(), time.process_time()
    found = bounds()
    warm, used = time.perf_counter() - began, time.process_time() - used
    yield {"ms a cell and core": 1000 * used / cells, "compilation, s": first - warm}
    ends = found[:, :, 0]
    yield {"least width": float((ends[:, -1, :4] + ends[:, -1, 4:]).max(axis=1).min())}
    yield {"cores": used / warm if warm else float(os.cpu_count() or 1)}


ROWS = (
    Row(
        "products",
        "(sin x1 / s) (s sin x2) on [0, 1]^2",
        {_of_scale(s): 1.13 for s in SCALES},
        products,
    ),
    Row(
        "tenth",
        "double pendulum from a tenth of its set, 20 periods",
        {"width": 1.3, "seconds": None},
        tenth,
        (loops.DOUBLE,),
    ),
    Row(
        "noise",
        "cart-pole with noise and disturbance, five steps",
        {"default": 1.3, "LinearBounds": 2.0, "seconds": None},
        noise,
    ),
    *(
        Row(
            "hundred",
            f"cart-pole, {cells} cells of a twentieth, {periods} periods",
            {"ms a cell and core": most, "compilation, s": 10.0, "least width": None},
            functools.partial(hundred, periods, cells),
            (loops.BALANCING,),
        )
        for periods, cells, most in ((100, 256, 20.0), (500, 32, 100.0))
    ),
)
