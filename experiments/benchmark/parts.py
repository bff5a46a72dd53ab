"""What one step of a loop consists of, part by part, timed by pytest-benchmark.

    python -m pytest experiments/benchmark/parts.py --benchmark-columns=median,iqr,rounds

One step and four facets of two random networks: with local bounds, as it is by default, and the
paper's program with every neuron kept.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

from collections.abc import Callable
from typing import Any

import jax
import pytest

import reachjax as rj
from experiments.benchmark.cases import random_case
from reachjax.solvers import Facets

PROGRAMS = {
    "local bounds, 2x10": (10, rj.LocalBounds(), rj.Clarabel()),
    "every neuron, 2x32": (32, rj.PaperQC(repeated=False), rj.InteriorPoint()),
}
PARTS = "step", "solver", "recheck", "volume and gradient"


def parts(
    width: int, relaxation: rj.AbstractRelaxation, solver: rj.AbstractSolver
) -> dict[str, Callable[[], Any]]:
    """A step of a random network, four facets, and its parts, ready to be called."""
    case, template = random_case(width, seed=0), rj.Template.box(2)
    options = {"relaxation": relaxation, "solver": solver, "samples": 1}

    def step():
        return rj.reach_step(case.loop, case.box, template, **options)[1]

    certificate = step()
    assert isinstance(certificate, rj.AbstractCertificate)
    program = jax.device_get(certificate.program)

    def size(loop):
        return rj.log_volume(rj.reach(loop, case.box, 1, template, relaxation, 1, solver))

    gradient = jax.jit(jax.value_and_grad(size), compiler_options=rj.compiler_options())
    ready = (
        step,
        lambda: solver.solve(program, Facets(template.directions)),
        certificate.recheck,
        lambda: gradient(case.loop),
    )
    return dict(zip(PARTS, ready, strict=True))


@pytest.fixture(scope="module", params=PROGRAMS.values(), ids=list(PROGRAMS))
def timed(request) -> dict[str, Callable[[], Any]]:
    """The parts of each program."""
    jax.config.update("jax_enable_x64", True)
    return parts(*request.param)


@pytest.mark.parametrize("name", PARTS)
def test_part(benchmark, timed, name):
    """Seconds of a warm call."""
    jax.block_until_ready(timed[name]())
    benchmark(lambda: jax.block_until_ready(timed[name]()))
