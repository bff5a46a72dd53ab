"""What comes of programs that end without columns."""

import jax
import numpy as np
import pytest

from reachjax import MLP, AffinePlant, Box, ClosedLoop
from reachjax.programs.horizon import Horizon
from reachjax.solvers.branching import Tree
from reachjax.solvers.linear_programs import Vertex


class Infeasible:
    """A solver to which facts of a thin set seem to hold nowhere."""

    def largest(self, rows, constants, zero, reach=1.0, basis=None):
        none = np.zeros(0)
        return Vertex(-np.inf, none, np.zeros(4), none, none)


class Silent:
    """A solver without answers."""

    def largest(self, rows, constants, zero, reach=1.0, basis=None):
        return None


@pytest.mark.parametrize("programs", [Infeasible(), Silent()])
def test_no_leaves_rest_on_a_first_program_without_columns(programs):
    net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    loop, X0 = jax.device_get((ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net), Box([-1.0], [2.0])))
    horizon = Horizon(loop, X0, X0)
    horizon.advance()
    parts = lambda columns: 0.0, lambda bound, attained: False
    tree = Tree(horizon, programs, horizon.state, *parts)
    assert not tree.is_open
    assert tree.found() is None
