"""The networks of an instance: from the competition's files, or trained here in their place."""

from pathlib import Path

import numpy as np

import reachjax as rj
from experiments.competition.instances import Instance
from experiments.imitation import train_network
from experiments.sampling import Samples

ADVISORIES = 9
"""So many networks, of as many outputs, has the vertical collision avoidance."""


def networks(instance: Instance, folder: Path | None, steps: int, kept: Path) -> list:
    """The networks of an instance, in its order.

    Args:
        instance: the instance.
        folder: a clone of the benchmark repository; None to train networks of the same shapes.
        steps: of Adam, where they are trained.
        kept: the folder in which trained ones are kept.

    Raises:
        FileNotFoundError: the folder has no such file.
    """
    if folder is not None:
        return [rj.Network.from_file(path) for path in instance.paths(folder)]
    if instance.shape is None:
        return advisories()
    return [trained(instance, steps, kept)]


def trained(instance: Instance, steps: int, kept: Path) -> rj.MLP:
    """A network of the instance's shape that imitates a law written by hand."""
    shape = instance.shape
    assert shape is not None
    samples = Samples(*shape.samples(instance.X0))
    fit = train_network(
        samples,
        shape.hidden,
        penalty=shape.penalty,
        steps=steps,
        learning_rate=3e-3,
        restarts=1,
        standardise=True,
        activation=shape.activation,
        path=kept / f"{instance.benchmark.lower().replace(' ', '-')}-{instance.name}.npz",
        progress=False,
    )
    return rj.MLP.from_layers(fit.layers, rj.Tanh() if shape.activation == "tanh" else rj.ReLU())


def advisories() -> list[rj.MLP]:
    """Nine networks of random weights: climb where the intruder is below, descend where above."""
    rng = np.random.default_rng(0)
    climb = np.array([0.1, -1, 1, -1, 1, -1, 1, -1, 1])
    found = []
    for _ in range(ADVISORIES):
        layers = [
            (rng.normal(size=(20, size)) / np.sqrt(size) / 10, np.zeros(20))
            for size in (3, 20, 20, 20, 20)
        ]
        for W, _ in layers:  # a pair of neurons hands the altitude on
            W[:2] = 0.0
        layers[0][0][0, 0], layers[0][0][1, 0] = 1.0, -1.0
        for W, _ in layers[1:]:
            W[0, 0] = W[1, 1] = 1.0
        W = rng.normal(size=(ADVISORIES, 20)) / 100
        W[:, 0], W[:, 1] = -climb, climb
        found.append(rj.MLP.from_layers([*layers, (W, 0.001 * rng.normal(size=ADVISORIES))]))
    return found
