"""Numbers that are drawn from a set at each step, for any kind of number.

Of a set `W` around which `w = center + spread s`, `|s_i| <= 1`, is a box or a parallelepiped, each
`s_i` is a unit of its own, a `Disturbance`. Where the set is smaller, some of its facets and planes
that touch it are facts besides, stated by a `Constraint`:

- a box: the box itself;
- a polytope: the box around it, and its facets;
- an ellipsoid: the image of a cube, and planes that touch it, in the plane a polygon of 16 edges;
- an intersection: the box around it, facets, and planes that touch the ellipsoid.

What is drawn so holds the set, and is larger than it of ellipsoids alone.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.units import AtUnit, Constraint, Disturbance, evaluate
from reachjax.numerics.checks import within_time_axis
from reachjax.numerics.rounding import Ball, counting, gamma, namespace, settled
from reachjax.sets import AbstractSet

EDGES = 16
"""The edges of the polygon around a disc."""

CUBE = 3
"""Up to so many dimensions the planes around a ball are those whose normals have entries -1, 0, 1;
beyond, those with two entries that are not zero."""

Numbers = Float[Array | np.ndarray, "..."]


class Frame(NamedTuple):
    """A set as `w = center + spread s`, `|s_i| <= 1`, and what else is known of `w` and `s`.

    Attributes:
        center: `(n,)`.
        spread: `(n,)` of a box, else `(n, n)`.
        A: `(m, n)`, with `A w <= b`.
        b: `(m,)`.
        normals: `(r, n)`, with `normals s <= 1`, up to rounding.
    """

    center: Numbers
    spread: Numbers
    A: Numbers
    b: Numbers
    normals: Float[np.ndarray, "r n"]

    def placed(self, s: Any) -> Any:
        """`w`, of any kind of number."""
        return (self.spread * s if self.spread.ndim == 1 else self.spread @ s) + self.center

    def inverse(self, w: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch n"]:
        """About the `s` of some `w`; zero in directions that have no length."""
        off = np.asarray(w) - np.asarray(self.center)
        if self.spread.ndim == 1:
            some = np.asarray(self.spread) > 0
            return np.where(some, off, 0.0) / np.where(some, self.spread, 1.0)
        return np.linalg.solve(np.asarray(self.spread), off[..., None])[..., 0]

    def values(self, s: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch n"]:
        """About `w`, of many `s`."""
        spread = np.asarray(self.spread)
        return np.asarray(self.center) + (s * spread if spread.ndim == 1 else s @ spread.T)


@counting
def framed(W: AbstractSet, t: int | Array = 0) -> Frame:
    """A set at time `t` as a parallelepiped and what is cut off it."""
    flat, ball = W.parts
    none, nothing = np.zeros((0, W.dimension)), np.zeros(0)
    if flat is None:
        assert ball is not None
        center, spread = _settled(ball, ball.center, ball.from_ball())
        return Frame(center, spread, none, nothing, touching(W.dimension))
    around = Ball.between(*_ends(W if W.intervals is not None else W.bounding_box(), t))
    A, b = flat.facets if flat.needs_programs else (none, nothing)
    if ball is not None and W.dimension > 1:  # else the box is the set
        planes = touching(W.dimension) @ jnp.linalg.inv(jax.lax.stop_gradient(ball.from_ball()))
        A, b = jnp.concatenate([A, planes]), jnp.concatenate([b, ball.support(planes)])
    center, spread, A, b = _settled(W, around.mid, around.rad, A, b)
    return Frame(center, spread, A, b, none)


def _ends(box: AbstractSet, t: int | Array) -> tuple[Numbers, Numbers]:
    """The ends of a box at one time, numpy arrays if the box has them."""
    assert box.intervals is not None
    lower, upper = box.intervals
    if box.steps is None:
        return lower, upper
    within_time_axis("Box", t, box.steps)
    return lower[t], upper[t]


def _settled(W: AbstractSet, *parts: Any) -> Any:
    """One rounding of numbers for all that is made of them; on the host if the set is there."""
    if namespace(*jax.tree.leaves(W)) is np:
        return jax.device_get(parts)
    return settled(parts)


def touching(n: int) -> Float[np.ndarray, "r n"]:
    """Unit normals of planes around a ball, without those of the cube around it."""
    if n == 2:
        angles = 2 * np.pi * np.arange(EDGES) / EDGES
        every = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return every[np.arange(EDGES) % (EDGES // 4) > 0]
    signs = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=min(n, CUBE))))
    if n > CUBE:
        pairs = np.array(list(itertools.product((-1.0, 1.0), repeat=2)))
        signs = np.zeros((0, n))
        for i, j in itertools.combinations(range(n), 2):
            rows = np.zeros((4, n))
            rows[:, [i, j]] = pairs
            signs = np.concatenate([signs, rows])
    several = signs[(signs != 0).sum(axis=1) > 1].reshape(-1, n)
    return several / np.linalg.norm(several, axis=1, keepdims=True)


def middle(W: AbstractSet, t: int | Array = 0) -> Numbers:
    """What is drawn where one value is asked for: the middle, of a polytope about a point of it."""
    flat, ball = W.parts
    if flat is None:
        assert ball is not None
        return ball.center
    if W.intervals is not None:
        lower, upper = _ends(W, t)
        return lower + (upper - lower) / 2
    box = W.bounding_box()
    center = W.nearest(box.center, jnp.diag(box.widths / 2))
    return jax.device_get(center) if namespace(*jax.tree.leaves(W)) is np else center


def drawn(W: AbstractSet, x: Any, count: int, t: int | Array, unit: AtUnit) -> Any:
    """Numbers of a set, of which nothing is known but that, for any kind of number.

    Args:
        W: the set.
        x: `count` numbers, of the kind that is wanted; their values do not matter.
        count: how many these are.
        t: the time.
        unit: what is done at a layer of units.

    Example:
        >>> from reachjax.loops.units import evaluate
        >>> from reachjax.sets import Box
        >>> drawn(Box([1.0], [3.0]), jnp.zeros(2), 2, 0, evaluate).tolist()
        [2.0]
        >>> ends = drawn(Box([1.0], [3.0]), jnp.zeros(2), 2, 0, lambda unit, y: y + 1.0)
        >>> ends.round(6).tolist()
        [3.0]
    """
    zero = np.zeros((W.dimension, count)) @ x
    if unit is evaluate:
        return zero + middle(W, t)
    frame = framed(W, t)
    s = unit(Disturbance(), zero)
    w = frame.placed(s)
    if len(frame.b):
        unit(Constraint(closed=W.parts[1] is None), frame.b - frame.A @ w)
    if len(frame.normals):
        unit(Constraint(), 1 + gamma(8) - frame.normals @ s)
    return w
