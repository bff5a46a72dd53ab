"""The double integrator of Hu, Fazlyab, Morari, Pappas (CDC 2020), section V-A, and its task.

All states of the initial box are to reach the goal box after `HORIZON` steps, while the state
constraint holds at all times and the input is projected onto its box.
"""

import numpy as np

import reachjax as rj
from experiments.double_integrator.mpc import LinearMPC

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
STATE_BOX = np.array([[-5.0, -1.0], [5.0, 1.0]])
INPUT_BOX = np.array([[-1.0], [1.0]])
INITIAL_BOX = np.array([[2.5, -0.25], [3.0, 0.25]])
GOAL_BOX = np.array([[-0.25, -0.25], [0.25, 0.25]])
HORIZON = 6


def closed_loop(net: rj.MLP) -> rj.ClosedLoop:
    """The loop under a network, its output projected onto the input box."""
    return rj.ClosedLoop(rj.AffinePlant(A, B), net, rj.Box(*INPUT_BOX))


def template(facets: int = 8) -> rj.Template:
    """The paper's eight facets; another number has equal angles."""
    return rj.Template.octagonal(2) if facets == 8 else rj.Template.regular(facets)


def linear_mpc(margin: float) -> LinearMPC:
    """The paper's MPC with its state constraint tightened by `margin`."""
    return LinearMPC(
        A,
        B,
        Q=np.eye(2),
        R=np.eye(1),
        horizon=10,
        state_lower=STATE_BOX[0] + margin,
        state_upper=STATE_BOX[1] - margin,
        input_lower=INPUT_BOX[0],
        input_upper=INPUT_BOX[1],
    )
