"""What one step of a loop consists of, part by part, timed by pytest-benchmark.

    python -m pytest experiments/benchmark_parts.py --benchmark-columns=median,iqr,rounds

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
from experiments.benchmark_cases import random_case
from reachjax.programs.bounds import loop_bounds
from reachjax.programs.trimming import trimmed
from reachjax.programs.windows import step_program
from reachjax.proofs.accepted import accepted_offsets
from reachjax.solvers.arrangement import arranged, cut

jax.config.update("jax_enable_x64", True)

PROGRAMS = {
    "local bounds, 2x10": (10, rj.LocalBounds(), rj.Clarabel()),
    "every neuron, 2x32": (32, rj.PaperQC(repeated=False), rj.InteriorPoint()),
}
PARTS = "bounds", "program", "trimming", "solver", "recheck", "volume and gradient"


def parts(
    width: int, relaxation: rj.AbstractRelaxation, solver: rj.AbstractSolver
) -> dict[str, Callable[[], Any]]:
    """Each part of a step of a random network, four facets, ready to be called."""
    case = random_case(width, seed=0)
    loop, box, template = case.loop, rj.Box(*case.initial), rj.Template.box(2)
    bounds = jax.jit(loop_bounds)

    def stated():
        return step_program(loop, box, box, template.directions, 0, relaxation)

    program = jax.device_get(stated())
    solution = solver.solve(program)

    def size(loop):
        return rj.log_volume(rj.reach(loop, box, 1, template, relaxation, 1, solver))

    gradient = jax.jit(jax.value_and_grad(size))
    ready = (
        lambda: bounds(loop, box, 0),
        stated,
        lambda: cut(arranged(trimmed(program), program.products)),
        lambda: solver.solve(program),
        lambda: accepted_offsets(program, solution),
        lambda: gradient(loop),
    )
    return dict(zip(PARTS, ready, strict=True))


@pytest.fixture(scope="module", params=PROGRAMS.values(), ids=list(PROGRAMS))
def timed(request) -> dict[str, Callable[[], Any]]:
    """The parts of each program."""
    return parts(*request.param)


@pytest.mark.parametrize("name", PARTS)
def test_part(benchmark, timed, name):
    """Seconds of a warm call."""
    jax.block_until_ready(timed[name]())
    benchmark(lambda: jax.block_until_ready(timed[name]()))
