"""Learning a controller from a policy's decisions: networks fitted to its samples.

The network is `pi(x) = W_L relu(... relu(W_0 x + b_0) ...) + b_L`, or one of `tanh`, its
output affine and not projected, and its weights minimise over the samples `(x_i, u_i)`

    mean_i |pi(x_i) - u_i|^2  +  penalty * sum_l |W_l|_F^2 .

A small penalty costs little accuracy and keeps the gain of the network low, and with it the
looseness of convex bounds on the network. Weights can be kept in a file together with the settings
that made them: it is used again when the settings agree, and made anew, with a word about it, when
they do not.
"""

import hashlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Float
from numpy import ndarray

from experiments import stored
from experiments.command import at_least_one, bar
from experiments.sampling import Samples

# Training steps are compiled in blocks of this size.
STEPS = 500


@dataclass(frozen=True, eq=False)
class Fit:
    """A trained network `[(W, b), ...]`, `W` (out, in), and its root mean square errors."""

    layers: list[tuple[Float[ndarray, "out in"], Float[ndarray, " out"]]]
    training_error: float
    validation_error: float


def train_network(samples: Samples, hidden: tuple[int, ...] = (10, 5), seed: int = 0, **options):
    """The network of least validation error among `restarts`; options as in `train_networks`."""
    fits = train_networks(samples, hidden, seed, **options)
    return min(fits, key=lambda fit: fit.validation_error)


def train_networks(
    samples: Samples,
    hidden: tuple[int, ...] = (10, 5),
    seed: int = 0,
    *,
    penalty: float = 1e-4,
    steps: int = 20_000,
    learning_rate: float = 1e-2,
    restarts: int = 4,
    validation: float = 0.1,
    standardise: bool = False,
    activation: str = "relu",
    path: str | Path | None = None,
    retrain: bool = False,
    progress: bool = True,
) -> list[Fit]:
    """Adam on full batches, its rate decaying from `learning_rate` to 0 along a cosine.

    `restarts` networks are trained side by side from different random weights. The last
    `validation` share of the samples is never trained on. With `standardise` loss and penalty are
    those of a network between standardised states and inputs (mean 0, deviation 1 over the samples
    trained on), which is then folded into the first and the last layer. `retrain` ignores the file
    at `path` and replaces it.
    """
    widths = {f"hidden[{i}]": width for i, width in enumerate(hidden)}
    at_least_one(steps=steps, restarts=restarts, **widths)
    split = training_share(samples, validation)
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
    if standardise:  # named only then: files of networks trained without it stay valid
        settings["standardise"] = True
    if activation != "relu":
        settings["activation"] = activation
    kept = None if retrain else stored.load(path, settings)
    if kept is None:
        # Single precision whatever JAX's global setting is: the fit needs no more.
        x, u = samples.states[:split], samples.inputs[:split]
        scales = (_scale(x), _scale(u)) if standardise else None
        if scales:
            x, u = ((a - m) / s for a, (m, s) in zip((x, u), scales, strict=True))
        x, u = np.asarray(x, np.float32), np.asarray(u, np.float32)
        options = penalty, steps, learning_rate, restarts, activation, progress
        trained = _train(x, u, hidden, seed, *options)
        trained = _folded(trained, *scales) if scales else trained
        kept = {f"W{i}": W for i, (W, _) in enumerate(trained)}
        kept |= {f"b{i}": b for i, (_, b) in enumerate(trained)}
        stored.save(path, settings, **kept)
    pairs = [(kept[f"W{i}"], kept[f"b{i}"]) for i in range(len(hidden) + 1)]
    every = ([(W[r], b[r]) for W, b in pairs] for r in range(restarts))
    return [fit(layers, samples, validation, activation) for layers in every]


def training_share(samples: Samples, validation: float) -> int:
    """How many of the samples are trained on."""
    count = len(samples.states)
    split = round(count * (1 - validation))
    if not 0 < split < count:
        raise ValueError(f"validation must leave two sets of {count} samples, got {validation}")
    return split


def fit(layers, samples: Samples, validation: float = 0.1, activation: str = "relu") -> Fit:
    """The network `layers` with its errors on the samples trained on and on the others."""
    split = training_share(samples, validation)
    found = evaluate(layers, samples.states, activation)
    squares = np.sum((found - samples.inputs) ** 2, axis=1)
    return Fit(layers, float(squares[:split].mean() ** 0.5), float(squares[split:].mean() ** 0.5))


def evaluate(
    layers, states: Float[ndarray, "count n"], activation: str = "relu"
) -> Float[ndarray, "count m"]:
    """The network's output at each row of `states`, in double precision."""
    *hidden, (W_out, b_out) = layers
    z = np.asarray(states, float)
    for W, b in hidden:
        y = z @ W.T + b
        z = np.tanh(y) if activation == "tanh" else np.maximum(y, 0)
    return z @ W_out.T + b_out


def _scale(values):
    """Mean and standard deviation of each column, 1 for the deviation of a constant."""
    deviation = values.std(axis=0)
    return values.mean(axis=0), np.where(deviation > 0, deviation, 1.0)


def _folded(layers, of_states, of_inputs):
    """The network between `(x - mean) / deviation` and the same of `u`, as one from `x` to `u`."""
    (mean, deviation), (shift, stretch) = of_states, of_inputs
    W, b = layers[0]
    layers = [(W / deviation, b - (W / deviation) @ mean), *layers[1:]]
    W, b = layers[-1]
    return [*layers[:-1], (W * stretch[:, None], b * stretch + shift)]


class _Policy(nnx.Module):
    def __init__(self, sizes, activation, rngs):
        self.activation = {"relu": nnx.relu, "tanh": nnx.tanh}[activation]
        self.layers = nnx.List([nnx.Linear(i, o, rngs=rngs) for i, o in pairwise(sizes)])

    def __call__(self, x):
        for layer in self.layers[:-1]:
            x = self.activation(layer(x))
        return self.layers[-1](x)


def _train(x, u, hidden, seed, penalty, steps, learning_rate, restarts, activation, progress):
    """Pairs `(W, b)`, one a layer, with a leading axis for the restarts."""
    sizes = [x.shape[1], *hidden, u.shape[1]]
    structure, _ = nnx.split(_Policy(sizes, activation, nnx.Rngs(0)))
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
        _, weights = nnx.split(_Policy(sizes, activation, nnx.Rngs(key)))
        return weights, optimiser.init(weights)

    # The last block may run past `steps`, where the rate is 0 and nothing moves.
    advance = jax.jit(jax.vmap(lambda carry: jax.lax.scan(step, carry, length=STEPS)[0]))
    carry = start(jax.random.split(jax.random.key(seed), restarts))
    with bar(progress) as shown:
        for _ in shown.track(range(0, steps, STEPS), description="training networks"):
            carry = jax.block_until_ready(advance(carry))
    named = jax.tree.map(lambda w: np.asarray(w, float), nnx.to_pure_dict(carry[0]))["layers"]
    pairs = [(named[i]["kernel"], named[i]["bias"]) for i in range(len(sizes) - 1)]
    return [(kernel.swapaxes(1, 2), bias) for kernel, bias in pairs]
