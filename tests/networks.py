"""Networks, plants and initial sets that the project did not train, and a simulator of their loops.

Plain numpy, seeded, independent of the library. With proj the clipping to the input box of time t,

    x[t+1] = A_t x[t] + B_t proj(pi(x[t])) + c_t,    t = 0, ..., steps - 1.

Layers are [(W, b), ...] with W (out, in); ReLU between them, the last one affine. Points are rows.
"""

from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np


@dataclass(frozen=True)
class LoopData:
    """A loop as arrays. A, B, c and the box may carry a leading time axis; u_lower None: no box."""

    layers: list
    A: np.ndarray  # ([steps,] n_x, n_x)
    B: np.ndarray  # ([steps,] n_x, n_u)
    c: np.ndarray  # ([steps,] n_x)
    u_lower: np.ndarray | None = None  # ([steps,] n_u)
    u_upper: np.ndarray | None = None

    def at(self, t) -> tuple[Any, Any, Any, Any, Any]:
        """(A_t, B_t, c_t, u_lower_t, u_upper_t)."""
        A, B, c = (v[t] if v.ndim > n else v for v, n in ((self.A, 2), (self.B, 2), (self.c, 1)))
        ends = (self.u_lower, self.u_upper)
        lower, upper = (v if v is None or v.ndim == 1 else v[t] for v in ends)
        return A, B, c, lower, upper


@dataclass(frozen=True)
class Region:
    """The polytope `A x <= b`, and the corners (k, n_x) it is the hull of."""

    A: np.ndarray
    b: np.ndarray
    corners: np.ndarray

    def sample(self, count, seed):
        """(count, n_x) points: random convex combinations, from near the corners to the middle."""
        rng = np.random.default_rng(seed)
        concentration = rng.uniform(0.05, 1.0, size=(count, 1))
        weights = rng.gamma(concentration, size=(count, len(self.corners)))
        return weights / weights.sum(axis=1, keepdims=True) @ self.corners


def controller(layers, x):
    """pi(x) for points x (k, n_x): (k, n_u)."""
    for W, b in layers[:-1]:
        x = np.maximum(x @ W.T + b, 0.0)
    W, b = layers[-1]
    return x @ W.T + b


def simulate(loop, x0, steps):
    """Trajectories (steps + 1, k, n_x) from the points x0 (k, n_x)."""
    states = [x0]
    for t in range(steps):
        A, B, c, lower, upper = loop.at(t)
        u = controller(loop.layers, states[-1])
        u = u if lower is None else np.clip(u, lower, upper)
        states.append(states[-1] @ A.T + u @ B.T + c)
    return np.stack(states)


def he_network(sizes, seed):
    """He-initialised weights and small biases; sizes (n_x, n_1, ..., n_u)."""
    rng = np.random.default_rng(seed)
    return [
        (rng.normal(size=(out, into)) * np.sqrt(2.0 / into), 0.1 * rng.normal(size=out))
        for into, out in pairwise(sizes)
    ]


def dead_network(sizes, seed):
    """As `he_network`, the first half of every hidden layer off for all |x| of order one."""
    layers = he_network(sizes, seed)
    for _, b in layers[:-1]:
        b[: len(b) // 2] = -20.0
    return layers


def affine_network(sizes, seed):
    """As `he_network`, every hidden neuron on for all |x| of order one: pi is affine there."""
    layers = he_network(sizes, seed)
    x = np.zeros(sizes[0])
    for W, b in layers[:-1]:
        b[:] = 20.0 - W @ x  # each layer sends x = 0 to 20 in every neuron
        x = W @ x + b
    layers[-1][1][:] = -layers[-1][0] @ x
    return layers


def saturating_network(sizes, seed):
    """As `he_network`, output four times larger: it leaves an input box of order one both ways."""
    *hidden, (W, b) = he_network(sizes, seed)
    return [*hidden, (4.0 * W, 4.0 * b)]


def plant(n_x, n_u, seed, steps=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, B, c) with spectral radius 0.95; with `steps`, each varies in time around it (LTV)."""
    rng = np.random.default_rng(seed)
    lead = () if steps is None else (steps,)
    A = rng.normal(size=(n_x, n_x))
    A = 0.95 * A / np.abs(np.linalg.eigvals(A)).max()
    B, c = 0.5 * rng.normal(size=(n_x, n_u)), 0.1 * rng.normal(size=n_x)
    if steps is None:
        return A, B, c
    A, B, c = (v + 0.1 * rng.normal(size=lead + v.shape) for v in (A, B, c))
    return A, B, c


def input_box(n_u, seed, steps=None) -> tuple[np.ndarray, np.ndarray]:
    """(u_lower, u_upper) around zero, half-widths from 0.3 to 1, not symmetric."""
    rng = np.random.default_rng(seed)
    shape = (n_u,) if steps is None else (steps, n_u)
    return -rng.uniform(0.3, 1.0, size=shape), rng.uniform(0.3, 1.0, size=shape)


def box_region(n_x, seed, rotated=False):
    """A box with half-widths from 0.1 to 0.5 and a centre of order one, optionally rotated."""
    rng = np.random.default_rng(seed)
    centre, radii = rng.uniform(-1.0, 1.0, n_x), rng.uniform(0.1, 0.5, n_x)
    axes = np.linalg.qr(rng.normal(size=(n_x, n_x)))[0] if rotated else np.eye(n_x)
    signs = np.array(list(product((-1.0, 1.0), repeat=n_x)))
    A = np.vstack([axes.T, -axes.T])
    return Region(A, np.hstack([radii, radii]) + A @ centre, centre + (signs * radii) @ axes.T)


def simplex_region(n_x, seed):
    """A random simplex: the facet opposite to corner i is `barycentric coordinate i >= 0`."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, n_x) + 0.5 * rng.normal(size=(n_x + 1, n_x))
    barycentric = np.linalg.inv(np.vstack([corners.T, np.ones(n_x + 1)]))  # @ [x, 1]
    norms = np.linalg.norm(barycentric[:, :-1], axis=1)
    A, b = -barycentric[:, :-1] / norms[:, None], barycentric[:, -1] / norms
    return Region(A, b, corners)


def directions(n_x, seed=0, extra=0):
    """The 2 n_x facets of a box, then `extra` random directions, not of unit length."""
    rng = np.random.default_rng(seed)
    return np.vstack([np.eye(n_x), -np.eye(n_x), rng.normal(size=(extra, n_x))])
