"""Simulated trajectories of a quadrotor loop, and how far they stay from breaking the task."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.command import at_least_one, bar
from experiments.quadrotor.model import (
    AXES,
    GOAL,
    INPUT_LIMITS,
    INPUT_NAMES,
    POSITION_LIMITS,
    VELOCITY_LIMITS,
)

BATCH = 10_000
"""Trajectories simulated at once."""


def simulate(
    loop: rj.ClosedLoop,
    initial: rj.Ellipsoid,
    steps: int,
    count: int,
    seed: int,
    *,
    progress: bool = True,
) -> Float[ndarray, "count steps+1 6"]:
    """`count` trajectories, every other one from the boundary of the initial set."""
    at_least_one(count=count)
    inside, boundary = jax.random.split(jax.random.key(seed))
    starts = np.empty((count, loop.states))
    starts[::2] = initial.sample(inside, (count + 1) // 2)
    if count > 1:
        starts[1::2] = initial.sample_boundary(boundary, count // 2)
    batches = np.split(starts, range(BATCH, count, BATCH))
    with bar(progress) as shown:
        tracked = shown.track(batches, description="simulating, batches of states")
        return np.vstack([loop.simulate(jnp.asarray(batch), steps) for batch in tracked])


def inputs_along(
    loop: rj.ClosedLoop, states: Float[ndarray, "count steps+1 6"]
) -> Float[ndarray, "count*steps 3"]:
    """The inputs applied at all states but the last of each trajectory."""
    return np.asarray(jax.vmap(loop.input)(states[:, :-1].reshape(-1, states.shape[-1])))


def extremes(
    loop: rj.ClosedLoop, states: Float[ndarray, "count steps+1 6"], *, velocity_limits: bool = False
) -> list[tuple[str, str, Float[ndarray, " 2"], Float[ndarray, " 2"]]]:
    """For each requirement and coordinate: the range simulated and the range allowed.

    With the velocity limits there is no goal.
    """
    goal = ("goal", AXES, states[:, -1, :3], GOAL)
    velocity = ("velocity limits", ("v_x", "v_y", "v_z"), states[:, :, 3:], VELOCITY_LIMITS)
    parts = [
        velocity if velocity_limits else goal,
        ("position limits", AXES, states[:, :, :3], POSITION_LIMITS),
        ("actuator limits", INPUT_NAMES, inputs_along(loop, states), INPUT_LIMITS),
    ]
    rows = []
    for requirement, names, values, allowed in parts:
        flat = values.reshape(-1, len(names))
        for i, name in enumerate(names):
            simulated = np.array([flat[:, i].min(), flat[:, i].max()])
            rows.append((requirement, name, simulated, allowed[:, i]))
    return rows


def margin(simulated: Float[ndarray, " 2"], allowed: Float[ndarray, " 2"]) -> float:
    """How far the range simulated stays inside the range allowed; negative if it does not."""
    return float(min(simulated[0] - allowed[0], allowed[1] - simulated[1]))


def table(title: str, heading: str, rows: list[tuple[str, str, ndarray, ndarray]]) -> Table:
    """Ranges under a heading, the ranges allowed, and margins: rows as in `extremes`."""
    cells = []
    for requirement, name, found, allowed in rows:
        ranges = (f"{lower:.4f} .. {upper:.4f}" for lower, upper in (found, allowed))
        cells.append([requirement, name, *ranges, f"{margin(found, allowed):.4f}"])
    return report.table(title, ("requirement", "", heading, "allowed", "margin"), (), cells)


def margins(rows: list[tuple[str, str, ndarray, ndarray]]) -> dict[str, float]:
    """Those of the rows of `extremes`, by requirement and coordinate."""
    return {f"{part} {name}": margin(found, allowed) for part, name, found, allowed in rows}
