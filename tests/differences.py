"""Gradients in a loop and its initial set against central differences.

One random direction moves all parts of the arguments at once, each by so much that the value
changes alike: a part whose gradient is wrong shows as much as if it were moved alone.
"""

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj

PARTS = {
    "weights": lambda loop, X0: loop.controller,
    "A": lambda loop, X0: loop.plant.A,
    "B": lambda loop, X0: loop.plant.B,
    "c": lambda loop, X0: loop.plant.c,
    "initial set": lambda loop, X0: X0.b if isinstance(X0, rj.Polytope) else X0,
    "input limits": lambda loop, X0: loop.input_box,
}


def dot(left, right):
    return float(sum(map(jnp.vdot, jax.tree.leaves(left), jax.tree.leaves(right))))


def norm(tree):
    return np.sqrt(dot(tree, tree))


def along(part, loop, X0, seed):
    """A random direction in one part of the arguments, zero in the others; symmetric in shapes."""
    rng = np.random.default_rng(seed)
    chosen = {id(leaf) for leaf in jax.tree.leaves(PARTS[part](loop, X0))}
    loop, X0 = jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)) * (id(leaf) in chosen), (loop, X0)
    )
    if isinstance(X0, rj.Ellipsoid):
        X0 = jax.tree.map(lambda d: (d + d.T) / 2 if d.ndim == 2 else d, X0)
    return loop, X0


def central_difference(f, args, direction, h):
    """Fourth order in `h`."""

    def shifted(s):
        return float(f(*jax.tree.map(lambda leaf, d: leaf + s * h * d, args, direction)))

    return (8 * (shifted(1) - shifted(-1)) - (shifted(2) - shifted(-2))) / (12 * h)


def relative_error(f, args, gradient, direction, h):
    """Against the central difference, or along a level line against the gradient's norm."""
    exact, difference = dot(gradient, direction), central_difference(f, args, direction, h)
    part = jax.tree.map(lambda g, d: g * (d != 0), gradient, direction)
    return abs(exact - difference) / max(abs(difference), norm(part))


def error_in_all_parts(f, args, gradient, h, seed=0):
    """The error of a derivative along one direction, relative to the gradient in one part.

    Args:
        f: a function of a loop and a set.
        args: the loop and the set.
        gradient: what is claimed to be its gradient there.
        h: by how much parts move; those of a small gradient up to ten times as far.
        seed: of the direction.
    """
    loop, X0 = args
    moves = [along(part, loop, X0, seed) for part in PARTS]
    sizes = [norm(jax.tree.map(lambda g, d: g * (d != 0), gradient, move)) for move in moves]
    size = float(np.median(sizes))
    weights = [
        np.copysign(size / max(own, size / 10), dot(gradient, move))
        for own, move in zip(sizes, moves, strict=True)
    ]
    direction = jax.tree.map(
        lambda *leaves: sum(w * leaf for w, leaf in zip(weights, leaves, strict=True)), *moves
    )
    return abs(dot(gradient, direction) - central_difference(f, args, direction, h)) / size
