"""Policies that choose among actions: a mountain car and a cart-pole, for twenty periods.

    python -m experiments.nonlinear.actions  # some minutes

Each network 2-32-32-3 or 4-32-32-2 scores the actions, and the action of the largest score is
taken. The car's imitates the best of three pushes by value iteration, the cart-pole's a linear law
of which only the sign is taken.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

import jax
import jax.numpy as jnp
import numpy as np
import optax
import rich
from jaxtyping import Array, Float, Int
from scipy.linalg import solve_discrete_are

import reachjax as rj
from experiments import report
from experiments.command import configure_jax, require_options, run_experiment
from experiments.nonlinear.choices import (
    ACTIONS,
    INITIAL,
    PERIODS,
    PLANTS,
    Layers,
    cart_pole,
    closed,
    widths,
)

LIMITS = np.array([[-1.2, -0.07], [0.6, 0.07]])
"""Positions and velocities of the car."""

CELLS = np.array([180, 140])
"""Of its states, for value iteration."""


@dataclass(frozen=True)
class Settings:
    """Train policies that choose among actions, and bound the states of their loops."""

    rounds: int = 4000
    """Steps of Adam."""
    samples: int = 40_000
    """Trajectories that sets are compared with."""
    time_limit: float = 60.0
    """Seconds for each loop."""
    output: Path = Path("results/nonlinear")
    """Where everything is written."""

    def __post_init__(self):
        require_options(self, rounds=1, samples=10)


def trained(
    states: Float[np.ndarray, "c n"],
    choices: Int[np.ndarray, " c"],
    scale: Sequence[float],
    rounds: int,
) -> Layers:
    """Layers that choose as they are shown; inputs are in units of `scale`."""
    sizes, keys = (
        [states.shape[1], 32, 32, int(choices.max()) + 1],
        jax.random.split(jax.random.key(0), 3),
    )
    layers = [
        (jax.random.normal(key, (m, n)) * np.sqrt(2 / n), jnp.zeros(m))
        for key, n, m in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]
    seen, right = jnp.asarray(states / np.asarray(scale)), jnp.asarray(choices)

    def scored(layers: Any, x: Array) -> Array:
        for W, b in layers[:-1]:
            x = jnp.maximum(x @ W.T + b, 0.0)
        return x @ layers[-1][0].T + layers[-1][1]

    def loss(layers: Any, x: Array, y: Array) -> Array:
        entropy = optax.softmax_cross_entropy_with_integer_labels(scored(layers, x), y).mean()
        return entropy + 1e-4 * sum((W**2).sum() for W, _ in layers)

    optimiser = optax.adam(optax.cosine_decay_schedule(5e-3, rounds))

    @jax.jit
    def step(k: int, layers: Any, moments: Any) -> tuple[Any, Any]:
        some = jax.random.randint(jax.random.fold_in(keys[0], k), (512,), 0, len(seen))
        slope = jax.grad(loss)(layers, seen[some], right[some])
        change, moments = optimiser.update(slope, moments)
        return optax.apply_updates(layers, change), moments

    moments = optimiser.init(layers)
    for k in range(rounds):
        layers, moments = step(k, layers, moments)
    (W, b), *rest = layers
    layers = [(W / jnp.asarray(scale), b), *rest]
    return [(np.asarray(W), np.asarray(b)) for W, b in layers]


def best_pushes() -> tuple[Float[np.ndarray, "c 2"], Int[np.ndarray, " c"]]:
    """States of the mountain car, and which push comes out soonest, by value iteration."""
    parts = zip(LIMITS.T, CELLS, strict=True)
    axes = [np.linspace(low, high, count + 1) for (low, high), count in parts]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    after = np.stack([_moved(grid, push) for push in ACTIONS["mountain car"]])
    place = (after - LIMITS[0]) / (LIMITS[1] - LIMITS[0]) * CELLS
    low = np.clip(place.astype(int), 0, CELLS - 1)
    part, time_left = place - low, np.zeros(len(grid))
    corners = [np.array(corner) for corner in np.ndindex(2, 2)]
    taken = np.zeros(after.shape[:2])
    for _ in range(400):
        weights = [abs(1 - corner - part).prod(axis=-1) for corner in corners]
        rows = [(low + corner) @ [CELLS[1] + 1, 1] for corner in corners]
        at = sum(w * time_left[row] for w, row in zip(weights, rows, strict=True))
        taken = np.where(after[..., 0] >= 0.5, 1.0, 1.0 + 0.995 * at)
        time_left = np.where(grid[:, 0] >= 0.5, 0.0, taken.min(axis=0))
    return grid, taken.argmin(axis=0)


def _moved(x: Float[np.ndarray, "c 2"], push: float) -> Float[np.ndarray, "c 2"]:
    speed = x[:, 1] + 0.001 * push - 0.0025 * np.cos(3 * x[:, 0])
    after = np.clip(np.stack([x[:, 0] + np.clip(speed, -0.07, 0.07), speed], axis=1), *LIMITS)
    return np.where((after[:, :1] <= LIMITS[0, 0]) & (speed[:, None] < 0), after * [1, 0], after)


def balancing() -> tuple[Float[np.ndarray, "c 4"], Int[np.ndarray, " c"]]:
    """States of the cart-pole, and the sign of a linear law.

    The weight of its force is one. Where it is a hundredth, a chain of decisions is taken by two of
    40,000 initial states alone and moves the cart by a tenth of its range: samples miss much there.
    """
    rest = jnp.zeros(4), jnp.zeros(1)
    A, B = (np.asarray(jax.jacobian(cart_pole, k)(*rest)) for k in (0, 1))
    P = solve_discrete_are(A, B, np.diag([1.0, 0.1, 10.0, 0.1]), np.eye(1))
    gain = np.linalg.solve(B.T @ P @ B + 1.0, B.T @ P @ A)[0]
    states = np.random.default_rng(0).normal(size=(60000, 4)) * [0.5, 0.7, 0.1, 0.9]
    return states, (states @ gain < 0).astype(int)


TEACHERS = {
    "mountain car": (best_pushes, (0.5, 0.03)),
    "cart-pole": (balancing, (1.0, 1.0, 0.2, 1.0)),
}


def learned(name: str, rounds: int) -> Layers:
    """The layers of a policy."""
    teacher, scale = TEACHERS[name]
    states, choices = teacher()
    return trained(states, choices, scale, rounds)


def main(settings: Settings) -> None:
    """Train, bound, print, and write a figure, the policies and results."""
    configure_jax(settings.output)
    figure, (axes,) = report.panels(1, 2, (11, 4.2))
    results, kept = {}, {}
    for ax, (name, ends) in zip(axes, INITIAL.items(), strict=True):
        X0, layers = rj.Box(*ends), learned(name, settings.rounds)
        for k, (W, b) in enumerate(layers):
            kept |= {f"{name} {k} weight": W, f"{name} {k} bias": b}
        loop, n = closed(name, layers), PLANTS[name][1]
        states = X0.sample(jax.random.key(0), settings.samples)
        states, began = np.asarray(loop.simulate(states, PERIODS)), time.perf_counter()
        tube = rj.reach(loop, X0, PERIODS, rj.Template.box(n), time_limit=settings.time_limit)
        seconds = time.perf_counter() - began
        worst = float(widths(tube, states).max())
        rich.print(f"{name}: {seconds:.0f} s, at most {worst:.3f} times the samples' widths")
        results[name] = {"seconds": seconds, "widths": worst}
        shown = (0, 1) if n == 2 else (2, 3)
        few = states[:2000, :, shown]
        points: dict[str, Any] = {"s": 0.3, "color": "tab:blue", "rasterized": True}
        ax.scatter(*few.reshape(-1, 2).T, label="simulated", **points)
        for k, box in enumerate(each.bounding_box() for each in tube.sets):
            (left, bottom), (right, top) = (
                np.asarray(end)[list(shown)] for end in (box.lower, box.upper)
            )
            around = [left, right, right, left, left], [bottom, bottom, top, top, bottom]
            colour, label = ("tab:red", "certified") if k else ("black", "initial set")
            ax.plot(*around, color=colour, lw=0.8, label=label, zorder=2 if k else 3)
        ax.set(title=name, xlabel=f"$x_{shown[0] + 1}$", ylabel=f"$x_{shown[1] + 1}$")
    report.legend_below(figure)
    report.save(figure, settings.output / "actions.png")
    np.savez_compressed(settings.output / "actions.npz", **kept)
    report.write(settings.output / "actions.json", settings, results=results)


if __name__ == "__main__":
    run_experiment(main, Settings)
