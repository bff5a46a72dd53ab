"""A mountain car and a cart-pole whose policies choose among actions.

Source: the mountain car of Moore (1990) and the cart-pole of Barto, Sutton, Anderson (1983), with
the constants and initial sets that the field's environments have.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import reachjax as rj
from experiments.layers import Layers

PERIODS = 20


def mountain_car(x: Array, u: Array) -> Array:
    """A car in a valley, whose push is too weak to climb out at once; velocities are limited."""
    speed = jnp.clip(x[1] + 0.001 * u[0] - 0.0025 * jnp.cos(3 * x[0]), -0.07, 0.07)
    return jnp.stack([x[0] + speed, speed])


def cart_pole(x: Array, u: Array) -> Array:
    """A pole on a cart, by one step of Euler's method in 0.02 s."""
    _, v, angle, turn = x
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    push = (u[0] + 0.05 * turn**2 * sine) / 1.1
    bend = (9.8 * sine - cosine * push) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
    return x + 0.02 * jnp.stack([v, push - 0.05 * bend * cosine / 1.1, turn, bend])


PLANTS = {"mountain car": (mountain_car, 2), "cart-pole": (cart_pole, 4)}

ACTIONS = {"mountain car": (-1.0, 0.0, 1.0), "cart-pole": (-10.0, 10.0)}

INITIAL = {
    "mountain car": ([-0.6, 0.0], [-0.4, 0.0]),
    "cart-pole": ([0.2, 0.1, 0.05, 0.1], [0.22, 0.12, 0.06, 0.12]),
}
"""Ends of initial boxes."""


def closed(name: str, layers: Layers) -> rj.ClosedLoop:
    """A plant under a policy: the action of the largest score is its input."""
    plant, states = PLANTS[name]
    scores, actions = rj.MLP.from_layers(layers), jnp.array(ACTIONS[name])[:, None]
    policy = rj.Network(lambda x: actions[jnp.argmax(scores(x))], states, 1)
    return rj.ClosedLoop(rj.NonlinearPlant(plant, states=states, inputs=1), policy)


def widths(tube: rj.ReachTube, states: Float[np.ndarray, "c t n"]) -> Float[np.ndarray, "t n"]:
    """Widths of boxes over those of simulated states, after each period."""
    boxes = [each.bounding_box() for each in tube.sets[1:]]
    return np.array([np.asarray(box.widths) for box in boxes]) / np.ptp(states, axis=0)[1:]
