"""Tubes: by the default, and of differential equations, between samples too."""

import functools
import time
from collections.abc import Iterator

import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.smooth import loops, widths
from experiments.benchmark.smooth.rows import Figures, Row

STEPS = 10
"""Of tubes by the default."""


def by_default(title: str, settings: Settings) -> Iterator[Figures]:
    """Seconds of ten steps by the default, whose widths are compared with those of forms alone."""
    instance, loop = loops.read(title, settings)
    loop, template = loops.at_samples(loop), rj.Template.box(loop.states)
    began = time.perf_counter()
    tube = rj.reach(loop, instance.X0, STEPS, template)
    yield {"seconds": time.perf_counter() - began}
    try:
        forms = rj.reach(loop, instance.X0, STEPS, template, rj.LinearBounds())
    except ValueError:  # they leave a domain
        return
    pairs = zip(tube.sets[1:], forms.sets[1:], strict=True)
    ratios = [widths.ratio(widths.widths_of(one), widths.widths_of(other)) for one, other in pairs]
    yield {"over LinearBounds": max(ratios)}


def between_samples(title: str, settings: Settings) -> Iterator[Figures]:
    """Widths at the end over those of samples, and volumes of spans over those of dense samples."""
    instance, loop = loops.read(title, settings)
    given = loop, instance.X0, instance.horizon
    began = time.perf_counter()
    tube = rj.reach(*given, rj.Template.box(loop.states), rj.LinearBounds())
    yield {"seconds": time.perf_counter() - began}
    states = widths.drawn(instance.X0, settings.simulations)
    runs = np.asarray(loop.simulate(states, instance.horizon, parts=widths.DENSE))
    yield {"width": widths.at_the_end(tube, runs)}
    yield {"spans": widths.span_volumes(tube, runs, widths.DENSE)}


ROWS = (
    *(
        Row(
            "default",
            f"{name}, ten steps",
            {"seconds": 10.0, "over LinearBounds": 1.0},
            functools.partial(by_default, title),
            (title,),
        )
        for name, title in (
            ("cart-pole", loops.BALANCING),
            ("TORA", loops.OSCILLATOR),
            ("double pendulum", loops.DOUBLE),
        )
    ),
    *(
        Row(
            "widths",
            f"{name}, one cell",
            {"width": 1.05, "spans": 1.1, "seconds": None},
            functools.partial(between_samples, title),
            (title,),
        )
        for name, title in (
            ("single pendulum", loops.SINGLE),
            ("TORA, tanh", loops.OSCILLATOR),
            ("cruise control", loops.CRUISE),
        )
    ),
)
