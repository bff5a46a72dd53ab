"""The loops: those of the competition and of other experiments, at samples and at all times."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.competition import fields
from experiments.competition.instances import Instance, instances
from experiments.competition.networks import networks, trained
from experiments.nonlinear.problems import Layers
from experiments.sampled import study as continuous
from experiments.sampled.problems import RungeKutta, Sampled

BALANCING = "balancing-reach"
DOUBLE = "double-pendulum-less-robust"
NAVIGATION = "nav-standard"
SINGLE = "single-pendulum-reach"
OSCILLATOR = "tora-reach-tanh"
CRUISE = "acc-safe-distance"
AIRPLANE = "airplane-continuous"
QUADROTOR = "quad-reach"


def read(title: str, settings: Settings) -> tuple[Instance, rj.ClosedLoop]:
    """An instance of the competition and its loop, under the network of the folder."""
    instance = instances()[title]
    given = settings.folder, settings.training_steps, settings.output / "networks"
    return instance, instance.loop(networks(instance, *given))


def stand_in(title: str, settings: Settings) -> tuple[Instance, rj.ClosedLoop]:
    """An instance and its loop under a network that is trained here."""
    instance = instances()[title]
    kept = settings.output / "networks"
    return instance, instance.loop([trained(instance, settings.training_steps, kept)])


def learned(sampled: Sampled, name: str, settings: Settings) -> Layers:
    """A network that imitates the law of a loop of `experiments.sampled`."""
    options = continuous.Settings(
        training_steps=settings.training_steps, output=settings.output / "networks"
    )
    return continuous.learned(sampled, name, options)


def at_samples(loop: rj.ClosedLoop) -> rj.ClosedLoop:
    """The loop in discrete time, a step of which is one of Runge and Kutta, as if it were exact."""
    plant = loop.plant
    assert isinstance(plant, rj.SampledPlant)
    step = RungeKutta(plant.f, float(plant.period))
    return loop.replace(plant=rj.NonlinearPlant(step, plant.states, plant.inputs))


def small_balancer(settings: Settings) -> rj.MLP:
    """A network of 4-16-1 neurons of `tanh` that balances the competition's pole."""
    instance = instances()[BALANCING]
    assert instance.shape is not None
    shape = dataclasses.replace(instance.shape, hidden=(16,))
    small = dataclasses.replace(instance, name="small", shape=shape)
    return trained(small, settings.training_steps, settings.output / "networks")


def pole(net: rj.MLP, step: float) -> rj.ClosedLoop:
    """The competition's cart-pole, one step of Euler a period."""

    def f(x, u):
        return x + step * fields.cart_pole(x, u)

    return rj.ClosedLoop(rj.NonlinearPlant(f, 4, 1), net)


def noisy_pole(net: rj.MLP, step: float, push: float, noise: float) -> rj.ClosedLoop:
    """The same, whose force is disturbed, under a controller that sees noise in all four states."""

    def f(x, u, w):
        return x + step * fields.cart_pole(x, u + w)

    plant = rj.NonlinearPlant(f, 4, 1, disturbances=1)
    seen = noise * np.ones(4)
    return rj.ClosedLoop(plant, net, disturbance=rj.Box([-push], [push]), noise=rj.Box(-seen, seen))


def swing(x, u):
    """The derivative of a pendulum with a sine and friction."""
    return jnp.array([x[1], jnp.sin(x[0]) + u[0] - 0.1 * x[1]])


def scaled_set(X0: rj.Box, part: float) -> rj.Box:
    """The box around the same center, of a part of the widths."""
    half = part * np.asarray(X0.widths) / 2
    center = np.asarray(X0.center)
    return rj.Box(center - half, center + half)
