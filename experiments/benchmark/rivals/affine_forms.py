"""Affine forms back to a box of initial states, as one would write them in an afternoon of numpy.

A number of the unrolled loop is `c + G e` with `|e_i| <= 1`: a row whose first entry is the
constant, then a column for each initial state, then one for each unit that switched so far. A ReLU
whose input is in `[l, u]` with `l < 0 < u` is

    z = s y + m + m e,    s = u / (u - l),    m = -s l / 2,

the middle between its chord and the parallel below (Singh, Gehr, Mirman, Puschel, Vechev, NeurIPS
2018). No column is dropped. Rounding is ignored, and nothing here is taken from the library but the
loop's numbers.
"""

import numpy as np
from jaxtyping import ArrayLike, Float
from numpy import ndarray

import reachjax as rj

Rows = Float[ndarray, "k columns+1"]


def affine_bounds(
    loop: rj.ClosedLoop, X0: rj.Box, horizon: int, directions: ArrayLike
) -> Float[ndarray, "horizon m"]:
    """Bounds of directions `(m, n_x)` of the states after `1 .. horizon` steps, ReLUs only."""
    assert isinstance(loop.controller, rj.MLP)
    assert isinstance(loop.plant, rj.AffinePlant)
    layers = [(np.asarray(W), np.asarray(b)) for W, b in loop.controller.layers]
    lower, upper = np.asarray(X0.lower), np.asarray(X0.upper)
    x = np.hstack([(lower + upper)[:, None], np.diag(upper - lower)]) / 2
    bounds = []
    for t in range(horizon):
        A, B, c = map(np.asarray, loop.plant.at(t))
        u = _controlled(layers, x)
        if loop.input_box is not None:
            assert isinstance(loop.input_box, rj.Box)
            box = loop.input_box.at(t)
            u = _clipped(u, np.asarray(box.lower), np.asarray(box.upper))
        x = _affine(A, _padded(x, u), c) + B @ u
        facets = np.asarray(directions) @ x
        bounds.append(facets[:, 0] + abs(facets[:, 1:]).sum(axis=1))
    return np.array(bounds)


def _controlled(layers: list[tuple[ndarray, ndarray]], x: Rows) -> Rows:
    """What the network makes of the state."""
    for W, b in layers[:-1]:
        x = _relu(_affine(W, x, b))
    W, b = layers[-1]
    return _affine(W, x, b)


def _clipped(u: Rows, lower: Float[ndarray, " n_u"], upper: Float[ndarray, " n_u"]) -> Rows:
    """`min(max(u, lower), upper)` by two layers of ReLUs."""
    above = _relu(_affine(np.eye(len(u)), u, -lower))
    below = _relu(_affine(-np.eye(len(u)), above, upper - lower))
    return _affine(-np.eye(len(u)), below, upper)


def _affine(W: Float[ndarray, "k j"], rows: Rows, b: Float[ndarray, " k"]) -> Rows:
    """`W x + b`."""
    result = W @ rows
    result[:, 0] += b
    return result


def _relu(y: Rows) -> Rows:
    """A layer of units, with a new column for each that switches."""
    reach = abs(y[:, 1:]).sum(axis=1)
    lower, upper = y[:, 0] - reach, y[:, 0] + reach
    switching = (lower < 0) & (upper > 0)
    slope = np.where(lower >= 0, 1.0, 0.0)
    slope[switching] = upper[switching] / (upper - lower)[switching]
    middle = np.where(switching, -slope * lower / 2, 0.0)
    z = _affine(np.diag(slope), y, middle)
    return np.hstack([z, np.diag(middle)[:, switching]])


def _padded(rows: Rows, like: Rows) -> Rows:
    """The rows over the columns that others have."""
    return np.pad(rows, ((0, 0), (0, like.shape[1] - rows.shape[1])))
