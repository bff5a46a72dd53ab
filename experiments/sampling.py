"""What a policy does: states drawn from a box or otherwise, and its decisions there.

Samples can be kept in a file together with the settings that made them: it is used again when the
settings agree, continued when it holds too few, and made anew, with a word about it, otherwise.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from experiments import stored
from experiments.command import at_least_one, bar
from experiments.double_integrator.mpc import LinearMPC

# Candidate states are drawn in blocks of this size. The file is written after each block, so an
# interruption loses one block: a fraction of a second, or some ten for a nonlinear MPC.
CANDIDATES = 200


@dataclass(frozen=True, eq=False)
class Samples:
    """What a policy does: `inputs[i]` at `states[i]`."""

    states: Float[ndarray, "count n"]
    inputs: Float[ndarray, "count m"]


class Policy(Protocol):
    """A frozen dataclass that decides for many states at once; its fields are its settings."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def batch(self, states: Float[ndarray, "count n"]) -> Float[ndarray, "count m"]:
        """The inputs, NaN where there is none."""
        ...


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

    The box is the MPC's own `X` unless given. The rest is as in `sample_draws`.
    """
    lower = np.asarray(mpc.state_lower if lower is None else lower, float)
    upper = np.asarray(mpc.state_upper if upper is None else upper, float)
    n = len(mpc.A)
    if not lower.shape == upper.shape == (n,) or not np.all(upper - lower >= 0):
        raise ValueError(f"lower <= upper must bound {n} states, got lower {lower}, upper {upper}")
    return sample_draws(
        mpc,
        count,
        seed,
        draw=lambda rng: rng.uniform(lower, upper, (CANDIDATES, n)),
        settings={"lower": lower.tolist(), "upper": upper.tolist()},
        path=path,
        progress=progress,
    )


def sample_draws(
    policy: Policy,
    count: int,
    seed: int,
    *,
    draw: Callable[[np.random.Generator], Float[ndarray, "candidates n"]],
    settings: dict[str, Any],
    path: str | Path | None = None,
    progress: bool = True,
) -> Samples:
    """`count` pairs of the policy at those states of `draw` where it has an input.

    Candidates are drawn in blocks, block `k` from the seed `(seed, k)`, and infeasible ones left
    out; so a larger `count` only adds pairs, and a file at `path` that holds too few, as an
    interrupted run leaves it, is continued. `settings` is what `draw` depends on: a file is used
    again when these, the policy's fields and the seed agree.
    """
    at_least_one(count=count)
    drawn_with = ", ".join(f"{name} {value}" for name, value in settings.items())
    settings = settings | {"seed": int(seed)}
    settings |= {f.name: np.asarray(getattr(policy, f.name)).tolist() for f in fields(policy)}
    kept = stored.load(path, settings) or {"states": [], "inputs": [], "block": 0}
    states, inputs, block = [*kept["states"]], [*kept["inputs"]], int(kept["block"])
    with bar(progress) as shown:
        task = shown.add_task("sampling the MPC", total=count, completed=min(count, len(states)))
        while len(states) < count:
            if block == 10 and not states:
                raise ValueError(
                    f"the states drawn must meet those that the MPC can steer; of {block} blocks "
                    f"drawn with {drawn_with}, none was feasible"
                )
            draws = draw(np.random.default_rng([seed, block]))
            decisions = policy.batch(draws)
            feasible = ~np.isnan(decisions[:, 0])
            states += [*draws[feasible]]
            inputs += [*decisions[feasible]]
            block += 1
            stored.save(path, settings, states=states, inputs=inputs, block=block)
            shown.update(task, completed=min(count, len(states)))
    return Samples(np.array(states[:count]), np.array(inputs[:count]))
