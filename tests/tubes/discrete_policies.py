"""Policies that choose among actions, as `experiments.nonlinear.actions` trains them."""

from pathlib import Path

import numpy as np

import reachjax as rj
from experiments.nonlinear.actions import closed

KEPT = Path(__file__).parents[1] / "data" / "discrete_policies.npz"


def loop_of(name: str) -> rj.ClosedLoop:
    """A plant under its policy."""
    with np.load(KEPT) as file:
        layers = [(file[f"{name} {k} weight"], file[f"{name} {k} bias"]) for k in range(3)]
    return closed(name, layers)
