"""What a policy does: states drawn from a box, and its decisions there.

Samples can be kept in a file together with the settings that made them: it is used again when the
settings agree, continued when it holds too few, and made anew, with a word about it, otherwise.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from experiments import stored
from experiments.mpc import LinearMPC
from experiments.progress import at_least_one, bar

# Candidate states are drawn in blocks of this size. The file is written after each block, so an
# interruption loses a fraction of a second.
CANDIDATES = 200


@dataclass(frozen=True, eq=False)
class Samples:
    """What a policy does: `inputs[i]` at `states[i]`."""

    states: Float[ndarray, "count n"]
    inputs: Float[ndarray, "count m"]


def sample_policy(
    mpc: LinearMPC,
    count: int,
    seed: int,
    *,
    lower: Float[ndarray, " n"] | None = None,
    upper: Float[ndarray, " n"] | None = None,
    path: str | Path | None = None,
    progress: bool = True,
) -> Samples:
    """`count` pairs of the MPC, uniform over the states of `lower <= x <= upper` it can steer.

    The box is the MPC's own `X` unless given. Candidates are drawn in blocks, block `k` from the
    seed `(seed, k)`, and infeasible ones left out; so a larger `count` only adds pairs, and a
    file at `path` that holds too few, as an interrupted run leaves it, is continued.
    """
    at_least_one(count=count)
    lower = np.asarray(mpc.state_lower if lower is None else lower, float)
    upper = np.asarray(mpc.state_upper if upper is None else upper, float)
    n, m = mpc.B.shape
    if not lower.shape == upper.shape == (n,) or not np.all(upper - lower >= 0):
        raise ValueError(f"lower <= upper must bound {n} states, got lower {lower}, upper {upper}")
    settings = {f.name: np.asarray(getattr(mpc, f.name)).tolist() for f in fields(mpc)}
    settings |= {"seed": int(seed), "lower": lower.tolist(), "upper": upper.tolist()}
    nothing = {"states": np.empty((0, n)), "inputs": np.empty((0, m)), "block": 0}
    kept = stored.load(path, settings) or nothing
    states, inputs, block = kept["states"], kept["inputs"], int(kept["block"])
    with bar(progress) as shown:
        task = shown.add_task("sampling the MPC", total=count, completed=min(count, len(states)))
        while len(states) < count:
            if block == 10 and not len(states):
                raise ValueError(
                    f"lower and upper must meet the states that the MPC can steer; of the first "
                    f"{block * CANDIDATES} drawn between {lower} and {upper}, none was feasible"
                )
            draws = np.random.default_rng([seed, block]).uniform(lower, upper, (CANDIDATES, n))
            decisions = mpc.batch(draws)
            feasible = ~np.isnan(decisions[:, 0])
            states = np.vstack([states, draws[feasible]])
            inputs = np.vstack([inputs, decisions[feasible]])
            block += 1
            stored.save(path, settings, states=states, inputs=inputs, block=block)
            shown.update(task, completed=min(count, len(states)))
    return Samples(states[:count], inputs[:count])
