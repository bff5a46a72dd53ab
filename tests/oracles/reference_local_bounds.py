"""Minimum-volume ellipsoids from pre-activation bounds: the relaxation of DeepSDP, independently.

Written in numpy and cvxpy from Fazlyab, Morari, Pappas, "Safety verification and robustness
analysis of neural networks via quadratic constraints and semidefinite programming" (2020), beside
`tests.oracles.reference_ellipsoid`, whose program it solves with other facts. With bounds
`l <= y <= u` of a neuron's input, `z = max(y, 0)` and `r = z - y`, these are never negative:

    z,  r,  z (u - z),  r (-l - r),  (u - z) (-l - r),  z_i r_j + z_j r_i,

and `z r = 0`. A neuron that its bounds prove to be affine is no entry of the basis. Inputs are rows
over the state in the unit ball and neurons in [-1, 1]; bounds are the ranges of these rows, or of
intervals where those are tighter.
"""

import time
from typing import NamedTuple

import cvxpy as cp
import numpy as np

from tests.oracles.reference_ellipsoid import (
    SAMPLES,
    basis_points,
    smallest_ellipsoid,
    unit_ball,
)


class Units(NamedTuple):
    """Rows over the basis `[w, one entry a neuron, 1]`, the state being `center + factor w`.

    inputs, outputs (d, n): of neurons and projections; lower, upper (d,): bounds of the inputs;
    control (n_u, n): the loop's input.
    """

    inputs: np.ndarray
    outputs: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    control: np.ndarray


def local_bounds_ellipsoid_step(
    layers, A, B, c, u_lower, u_upper, center, shape, repeated=True, options=None
):
    """One step of problem sdp::ellips with the facts above, from the ellipsoid (center, shape).

    A (n_x, n_x), B (n_x, n_u), c (n_x,) at this time; u_lower, u_upper (n_u,); center (n_x,), shape
    (n_x, n_x) positive definite. With `repeated`, every pair of units has a `z_i r_j + z_j r_i`.
    `options` goes to `cvxpy.Problem.solve`.

    Returns an EllipsoidStep; its numbers are NaN where the solver has none.
    """
    start, n_x = time.perf_counter(), len(center)
    factor = np.linalg.cholesky(shape)
    units = propagate(layers, u_lower, u_upper, center, factor)
    size = units.inputs.shape[1]
    state, constant = _columns(center, factor, size), np.eye(size)[-1]
    out = A @ state + B @ units.control + np.outer(c, constant)
    used = np.r_[:n_x, np.flatnonzero(abs(units.outputs).max(axis=0)[n_x:-1]) + n_x, size - 1]
    ball = np.diag([-1.0] * n_x + [0.0] * (len(used) - n_x - 1) + [1.0])
    free, signed = (part[:, used][:, :, used] for part in _products(units, n_x, repeated))
    scale = cp.Variable(nonneg=True)
    facts, signs = scale * ball, []
    for products, multipliers in (
        (free, cp.Variable(len(free))),
        (signed, cp.Variable(len(signed), nonneg=True)),
    ):
        if len(products):
            total = multipliers @ products.reshape(len(products), -1)
            facts = facts + cp.reshape(total, (len(used), len(used)), order="C")
    x = center + unit_ball(n_x, SAMPLES) @ factor.T
    u = basis_points(layers, u_lower, u_upper, x)[:, -1 - len(u_upper) : -1]
    found = smallest_ellipsoid(
        facts, signs, np.vstack([out, constant])[:, used], x @ A.T + u @ B.T + c, options
    )
    return found._replace(seconds=time.perf_counter() - start)


def propagate(layers, u_lower, u_upper, center, factor):
    """`Units` of the network and its projection onto the input box, layer by layer."""
    n_x = len(center)
    size = n_x + sum(len(b) for _, b in layers) + len(u_lower) + 1
    constant, inputs, outputs, bounds = np.eye(size)[-1], [], [], []
    radius = np.sqrt(np.sum(factor**2, axis=1))

    def passed(W, b, rows, interval):
        """`max(W rows + b, 0)`, and the interval that holds it."""
        y = W @ rows + np.outer(b, constant)
        middle, spread = W @ interval.mean(axis=0) + b, abs(W) @ np.ptp(interval, axis=0) / 2
        reach = np.linalg.norm(y[:, :n_x], axis=1) + abs(y[:, n_x:-1]).sum(axis=1)
        lower = np.maximum(middle - spread, y[:, -1] - reach)
        upper = np.minimum(middle + spread, y[:, -1] + reach)
        z = np.where((lower >= 0)[:, None], y, 0.0)
        first = n_x + sum(map(len, inputs))
        for i in np.flatnonzero((lower < 0) & (upper > 0)):
            z[i, first + i] = z[i, -1] = upper[i] / 2
        inputs.append(y)
        outputs.append(z)
        bounds.append((lower, upper))
        return z, np.maximum([lower, upper], 0.0)

    rows, interval = _columns(center, factor, size), np.array([center - radius, center + radius])
    for W, b in layers[:-1]:
        rows, interval = passed(W, b, rows, interval)
    W, b = layers[-1]
    above, interval = passed(W, b - u_lower, rows, interval)
    below, _ = passed(-np.eye(len(b)), u_upper - u_lower, above, interval)
    lower, upper = np.hstack(bounds)
    control = np.outer(u_upper, constant) - below
    return Units(np.vstack(inputs), np.vstack(outputs), lower, upper, control)


def _columns(center, factor, size):
    rows = np.zeros((len(center), size))
    rows[:, : len(center)], rows[:, -1] = factor, center
    return rows


def _products(units, n_x, repeated):
    """Symmetric matrices of the free and of the signed facts, each of norm one.

    Facts without any neuron are left out: the ball's own fact implies them (S-lemma).
    """
    constant = np.eye(units.inputs.shape[1])[-1]
    z, r = units.outputs, units.outputs - units.inputs
    z_room = np.outer(np.maximum(units.upper, 0.0), constant) - z
    r_room = np.outer(np.maximum(-units.lower, 0.0), constant) - r
    ones = np.broadcast_to(constant, z.shape)
    pairs = [(z, ones), (r, ones), (z, z_room), (r, r_room), (z_room, r_room)]
    signed = [np.concatenate(rows) for rows in zip(*pairs, strict=True)]
    products = _symmetric(*signed)
    if repeated:
        i, j = np.triu_indices(len(z), 1)
        products = np.concatenate([products, _symmetric(z[i], r[j]) + _symmetric(z[j], r[i])])
    switching = (units.lower < 0) & (units.upper > 0)
    return _scaled(_symmetric(z[switching], r[switching]), n_x), _scaled(products, n_x)


def _symmetric(left, right):
    products = left[:, :, None] * right[:, None, :]
    return (products + products.transpose(0, 2, 1)) / 2


def _scaled(products, n_x):
    """Of norm one, without those that only the state and the constant enter."""
    norms = np.linalg.norm(products, axis=(1, 2))
    neurons = abs(products[:, n_x:-1]).max(axis=(1, 2), initial=0.0)
    kept = neurons > 1e-12 * np.maximum(norms, 1e-300)
    return products[kept] / norms[kept, None, None]
