"""Policies that choose among actions, and the plants that they were trained for.

`python -m tests.tubes.discrete_policies` trains them again: a mountain car's imitates the best of
three pushes by value iteration, a cart-pole's a linear law of which only the sign is taken.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

import reachjax as rj

KEPT = Path(__file__).parents[1] / "data" / "discrete_policies.npz"
PERIODS = 20


def mountain_car(x, u):
    """A car in a valley, whose push is too weak to climb out at once; velocities are limited."""
    speed = jnp.clip(x[1] + 0.001 * u[0] - 0.0025 * jnp.cos(3 * x[0]), -0.07, 0.07)
    return jnp.stack([x[0] + speed, speed])


def cart_pole(x, u):
    """A pole on a cart, by one step of Euler's method in 0.02 s."""
    _, v, angle, turn = x
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    push = (u[0] + 0.05 * turn**2 * sine) / 1.1
    bend = (9.8 * sine - cosine * push) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
    return x + 0.02 * jnp.stack([v, push - 0.05 * bend * cosine / 1.1, turn, bend])


PLANTS = {"mountain car": (mountain_car, 2), "cart-pole": (cart_pole, 4)}
ACTIONS = {"mountain car": (-1.0, 0.0, 1.0), "cart-pole": (-10.0, 10.0)}


def kept(name):
    """The layers of a policy."""
    with np.load(KEPT) as file:
        return [(file[f"{name} {k} weight"], file[f"{name} {k} bias"]) for k in range(3)]


def loop_of(name):
    """A plant under its policy: the action of the largest score is its input."""
    plant, states = PLANTS[name]
    scores, forces = rj.MLP.from_layers(kept(name)), jnp.array(ACTIONS[name])[:, None]
    policy = rj.Network(lambda x: forces[jnp.argmax(scores(x))], states, 1)
    return rj.ClosedLoop(rj.NonlinearPlant(plant, states=states, inputs=1), policy)


def _trained(states, choices, scale, seed=0, rounds=4000):
    """Layers that choose as they are shown; inputs are in units of `scale`."""
    sizes, keys = (
        [states.shape[1], 32, 32, int(choices.max()) + 1],
        jax.random.split(jax.random.key(seed), 3),
    )
    layers = [
        (jax.random.normal(key, (m, n)) * np.sqrt(2 / n), jnp.zeros(m))
        for key, n, m in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]

    def scored(layers, x):
        for W, b in layers[:-1]:
            x = jnp.maximum(x @ W.T + b, 0.0)
        return x @ layers[-1][0].T + layers[-1][1]

    def loss(layers, x, y):
        entropy = optax.softmax_cross_entropy_with_integer_labels(scored(layers, x), y).mean()
        return entropy + 1e-4 * sum((W**2).sum() for W, _ in layers)

    optimiser = optax.adam(optax.cosine_decay_schedule(5e-3, rounds))

    @jax.jit
    def step(k, layers, moments):
        some = jax.random.randint(jax.random.fold_in(keys[0], k), (512,), 0, len(states))
        slope = jax.grad(loss)(layers, states[some] / scale, choices[some])
        change, moments = optimiser.update(slope, moments)
        return optax.apply_updates(layers, change), moments

    moments = optimiser.init(layers)
    for k in range(rounds):
        layers, moments = step(k, layers, moments)
    right = jnp.mean(scored(layers, states / scale).argmax(axis=1) == choices)
    assert right > 0.95
    (W, b), *rest = layers
    return [(np.asarray(W / scale), np.asarray(b)), *(map(np.asarray, each) for each in rest)]


def _best_pushes(rng):
    """States of the mountain car, and which push comes out soonest, by value iteration."""
    grid = np.stack(np.meshgrid(np.linspace(-1.2, 0.6, 181), np.linspace(-0.07, 0.07, 141),
                                indexing="ij"), axis=-1).reshape(-1, 2)  # fmt: skip
    after = np.stack([_moved(grid, push) for push in ACTIONS["mountain car"]])
    cell = (after - [-1.2, -0.07]) / [0.01, 0.001]
    low = np.clip(cell.astype(int), 0, [179, 139])
    part = cell - low
    time = np.zeros(len(grid))
    for _ in range(400):
        corners = [(i, j) for i in (0, 1) for j in (0, 1)]
        weights = [abs(1 - np.array(corner) - part).prod(axis=-1) for corner in corners]
        values = [time[(low[..., 0] + i) * 141 + low[..., 1] + j] for i, j in corners]
        at = sum(weight * value for weight, value in zip(weights, values, strict=True))
        taken = np.where(after[..., 0] >= 0.5, 1.0, 1.0 + 0.995 * at)
        time = np.where(grid[:, 0] >= 0.5, 0.0, taken.min(axis=0))
    return grid, taken.argmin(axis=0)


def _moved(x, push):
    speed = np.clip(x[:, 1] + 0.001 * push - 0.0025 * np.cos(3 * x[:, 0]), -0.07, 0.07)
    place = np.clip(x[:, 0] + speed, -1.2, 0.6)
    return np.stack([place, np.where((place <= -1.2) & (speed < 0), 0.0, speed)], axis=1)


def _balancing(rng):
    """States of the cart-pole, and the sign of a linear law."""
    from scipy.linalg import solve_discrete_are

    A = np.asarray(jax.jacobian(cart_pole)(jnp.zeros(4), jnp.zeros(1)))
    B = np.asarray(jax.jacobian(cart_pole, 1)(jnp.zeros(4), jnp.zeros(1)))
    P = solve_discrete_are(A, B, np.diag([1.0, 0.1, 10.0, 0.1]), np.eye(1) * 0.01)
    gain = np.linalg.solve(B.T @ P @ B + 0.01, B.T @ P @ A)[0]
    states = rng.normal(size=(60000, 4)) * [0.5, 0.7, 0.1, 0.9]
    return states, (states @ gain < 0).astype(int)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    found, rng = {}, np.random.default_rng(0)
    given = (("mountain car", _best_pushes, [0.5, 0.03]), ("cart-pole", _balancing, [1, 1, 0.2, 1]))
    for name, teacher, scale in given:
        states, choices = map(jnp.asarray, teacher(rng))
        for k, (W, b) in enumerate(_trained(states, choices, jnp.array(scale))):
            found |= {f"{name} {k} weight": W, f"{name} {k} bias": b}
    np.savez_compressed(KEPT, **found)
