"""Widths of the sets of plants, and of what is sampled."""

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj


def widths(step, X0, *options, horizon=1, controller=None):
    """Widths of the last set along the axes, and of samples and corners, all of which are inside.

    Args:
        step: the plant `f(x, u)`, with one input.
        X0: a box.
        *options: of `reach`, after the template.
        horizon: of it.
        controller: the function of a state; None: `-x[0]`.
    """
    n = X0.lower.size
    network = rj.Network(controller or (lambda x: -x[:1]), n, 1)
    loop = rj.ClosedLoop(rj.NonlinearPlant(step, n, 1), network)
    region = rj.reach(loop, X0, horizon, rj.Template.box(n), *options).sets[horizon]
    starts = jnp.concatenate([X0.sample(jax.random.key(0), 4000), X0.corners()])
    values = np.asarray(loop.simulate(starts, horizon)[:, horizon] @ np.asarray(region.A).T)
    assert np.all(values <= np.asarray(region.b))
    bounds = np.asarray(region.b[::2] + region.b[1::2])
    return bounds, np.max(values[:, ::2], axis=0) + np.max(values[:, 1::2], axis=0)
