"""The gradient agrees with an independent one: the paper's program, differentiated by diffcp.

The program is written by `experiments.benchmark.reference` from the paper's matrices alone, solved
by SCS and differentiated by diffcp through the optimality conditions of the cone program; how its
data move with weights, plant, sets and limits is a central difference, exact because they are
quadratic.
"""

import cvxpy as cp
import diffcp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import reachjax as rj
from experiments.benchmark.reference import paper_lmi
from tests.closed_loops import closed_loop, random_loop, recursion
from tests.networks import box_region

H = 1e-4


def cone_program(loop, X0, direction, repeated):
    """The paper's program for one facet, as SCS takes it: `A`, `b`, `c` and the cones."""
    plain = jax.tree.map(np.asarray, (loop, X0))
    (plant, net, box), (lower, upper) = (
        (plain[0].plant, plain[0].controller, plain[0].input_box),
        (plain[1].lower, plain[1].upper),
    )
    eye = np.eye(len(lower))
    offset = cp.Variable()
    M, signs = paper_lmi(
        net.layers,
        plant.A,
        plant.B,
        plant.c,
        box.lower,
        box.upper,
        np.vstack([-eye, eye]),
        np.r_[-lower, upper],
        direction,
        offset,
        repeated,
    )
    data, _, _ = cp.Problem(cp.Minimize(offset), [M << 0, *signs]).get_problem_data(cp.SCS)
    dims = data["dims"]
    cones = {"z": dims.zero, "l": dims.nonneg, "q": dims.soc, "s": dims.psd}
    return data["A"], data["b"], data["c"], cones


OTHERS = [(1, (3,), 0, False), (2, (3,), 0, True), (2, (3,), 1, False), (2, (3,), 1, True)]
OTHERS += [(1, (3,), 0, True), (2, (2, 2), 1, False), (2, (2, 2), 1, True)]


@pytest.mark.parametrize(
    ("n", "hidden", "seed", "repeated"),
    [(2, (3,), 0, False), *(pytest.param(*case, marks=pytest.mark.long) for case in OTHERS)],
)
@pytest.mark.costly
def test_the_gradient_agrees_with_diffcp(n, hidden, seed, repeated):
    loop = closed_loop(random_loop(n, hidden=hidden, seed=seed))
    corners = box_region(n, seed).corners
    X0, template = rj.Box(corners.min(axis=0), corners.max(axis=0)), rj.Template.box(n)
    A, b, c, cones = cone_program(loop, X0, np.asarray(template.directions[0]), repeated)
    x, _, _, derivative, _ = diffcp.solve_and_derivative(
        A, b, c, cones, solve_method="SCS", mode="dense", eps=1e-10, max_iters=100_000
    )

    def offset(loop, X0):
        return recursion(loop, X0, 1, template, rj.PaperQC(repeated)).sets[1].b[0]

    value, gradient = jax.value_and_grad(offset, argnums=(0, 1))(loop, X0)
    assert float(value) == pytest.approx(c @ x, abs=1e-5)
    for draw in range(3):
        rng = np.random.default_rng(draw)
        move = jax.tree.map(
            lambda leaf, rng=rng: jnp.asarray(rng.normal(size=leaf.shape)), (loop, X0)
        )
        ends = [
            cone_program(
                *jax.tree.map(lambda leaf, d, s=s: leaf + s * H * d, (loop, X0), move),
                np.asarray(template.directions[0]),
                repeated,
            )
            for s in (1, -1)
        ]
        dA, db = ((ends[0][k] - ends[1][k]) / (2 * H) for k in (0, 1))
        dx, _, _ = derivative(sp.csc_matrix(dA), db, np.zeros_like(c))
        mine = sum(
            float(jnp.vdot(g, d))
            for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(move), strict=True)
        )
        # SCS's accuracy decides: 1e-10 on degenerate optima leaves some 1e-4
        assert mine == pytest.approx(c @ dx, rel=1e-3, abs=1e-4)
