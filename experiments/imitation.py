"""Learning a controller from its own decisions: samples of a policy, and a network fitted to them.

The network is `pi(x) = W_L relu(... relu(W_0 x + b_0) ...) + b_L`, its output affine and not
projected, and its weights minimise over the samples `(x_i, u_i)`

    mean_i |pi(x_i) - u_i|^2  +  penalty * sum_l |W_l|_F^2 .

A small penalty costs little accuracy and keeps the gain of the network low, and with it the
looseness of convex bounds on the network. Samples and weights can be kept in a file together with
the settings that made them: it is used again when the settings agree, and made anew, with a word
about it, when they do not.
"""

import hashlib
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Float
from numpy import ndarray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from experiments import stored
from experiments.mpc import LinearMPC

# Candidate states are drawn, and training steps compiled, in blocks of these sizes. The file of
# samples is written after each block, so an interruption loses a fraction of a second.
CANDIDATES = 200
STEPS = 500


@dataclass(frozen=True, eq=False)
class Samples:
    """What a policy does: `inputs[i]` at `states[i]`."""

    states: Float[ndarray, "count n"]
    inputs: Float[ndarray, "count m"]


@dataclass(frozen=True, eq=False)
class Fit:
    """A trained network `[(W, b), ...]`, `W` (out, in), and its root mean square errors."""

    layers: list[tuple[Float[ndarray, "out in"], Float[ndarray, " out"]]]
    training_error: float
    validation_error: float


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
    _at_least_one(count=count)
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
    with _bar(progress) as bar:
        task = bar.add_task("sampling the MPC", total=count, completed=min(count, len(states)))
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
            bar.update(task, completed=min(count, len(states)))
    return Samples(states[:count], inputs[:count])


def train_network(
    samples: Samples,
    hidden: tuple[int, ...] = (10, 5),
    seed: int = 0,
    *,
    penalty: float = 1e-4,
    steps: int = 20_000,
    learning_rate: float = 1e-2,
    restarts: int = 4,
    validation: float = 0.1,
    path: str | Path | None = None,
    retrain: bool = False,
    progress: bool = True,
) -> Fit:
    """Adam on full batches, its rate decaying from `learning_rate` to 0 along a cosine.

    `restarts` networks are trained side by side from different random weights, and the one of
    least validation error is returned. The last `validation` share of the samples is never
    trained on. `retrain` ignores the file at `path` and replaces it.
    """
    widths = {f"hidden[{i}]": width for i, width in enumerate(hidden)}
    _at_least_one(steps=steps, restarts=restarts, **widths)
    count = len(samples.states)
    split = round(count * (1 - validation))
    if not 0 < split < count:
        raise ValueError(f"validation must leave two sets of {count} samples, got {validation}")
    settings = {
        "samples": hashlib.sha256(samples.states.tobytes() + samples.inputs.tobytes()).hexdigest(),
        "hidden": list(hidden),
        "seed": int(seed),
        "penalty": penalty,
        "steps": steps,
        "learning_rate": learning_rate,
        "restarts": restarts,
        "validation": validation,
    }
    kept = None if retrain else stored.load(path, settings)
    if kept is not None:
        layers = [(kept[f"W{i}"], kept[f"b{i}"]) for i in range(len(hidden) + 1)]
        return _fit(layers, samples, split)
    # Single precision whatever JAX's global setting is: the fit needs no more.
    x, u = (np.asarray(a[:split], np.float32) for a in (samples.states, samples.inputs))
    trained = _train(x, u, hidden, seed, penalty, steps, learning_rate, restarts, progress)
    fits = [_fit(layers, samples, split) for layers in trained]
    best = min(fits, key=lambda fit: fit.validation_error)
    weights = {f"W{i}": W for i, (W, _) in enumerate(best.layers)}
    biases = {f"b{i}": b for i, (_, b) in enumerate(best.layers)}
    stored.save(path, settings, **weights, **biases)
    return best


def evaluate(layers, states: Float[ndarray, "count n"]) -> Float[ndarray, "count m"]:
    """The network's output at each row of `states`, in double precision."""
    *hidden, (W_out, b_out) = layers
    z = np.asarray(states, float)
    for W, b in hidden:
        z = np.maximum(z @ W.T + b, 0)
    return z @ W_out.T + b_out


class _Policy(nnx.Module):
    def __init__(self, sizes, rngs):
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in pairwise(sizes)])

    def __call__(self, x):
        for layer in self.layers[:-1]:
            x = nnx.relu(layer(x))
        return self.layers[-1](x)


def _train(x, u, hidden, seed, penalty, steps, learning_rate, restarts, progress):
    """The layers of every restart."""
    sizes = [x.shape[1], *hidden, u.shape[1]]
    structure, _ = nnx.split(_Policy(sizes, nnx.Rngs(0)))
    optimiser = optax.adam(optax.cosine_decay_schedule(learning_rate, steps))

    def loss(weights):
        policy = nnx.merge(structure, weights)
        size = sum(jnp.sum(layer.kernel[...] ** 2) for layer in policy.layers)
        return jnp.mean(jnp.sum((policy(x) - u) ** 2, axis=1)) + penalty * size

    def step(carry, _):
        weights, state = carry
        updates, state = optimiser.update(jax.grad(loss)(weights), state)
        return (optax.apply_updates(weights, updates), state), None

    @jax.vmap
    def start(key):
        _, weights = nnx.split(_Policy(sizes, nnx.Rngs(key)))
        return weights, optimiser.init(weights)

    # The last block may run past `steps`, where the rate is 0 and nothing moves.
    advance = jax.jit(jax.vmap(lambda carry: jax.lax.scan(step, carry, length=STEPS)[0]))
    carry = start(jax.random.split(jax.random.key(seed), restarts))
    with _bar(progress) as bar:
        for _ in bar.track(range(0, steps, STEPS), description="training the network"):
            carry = jax.block_until_ready(advance(carry))
    named = jax.tree.map(lambda w: np.asarray(w, float), nnx.to_pure_dict(carry[0]))["layers"]
    pairs = [(named[i]["kernel"], named[i]["bias"]) for i in range(len(sizes) - 1)]
    return [[(kernel[r].T, bias[r]) for kernel, bias in pairs] for r in range(restarts)]


def _fit(layers, samples, split) -> Fit:
    squares = np.sum((evaluate(layers, samples.states) - samples.inputs) ** 2, axis=1)
    return Fit(layers, float(squares[:split].mean() ** 0.5), float(squares[split:].mean() ** 0.5))


def _bar(progress):
    text = TextColumn("{task.description}")
    return Progress(text, BarColumn(), MofNCompleteColumn(), disable=not progress)


def _at_least_one(**counts):
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
