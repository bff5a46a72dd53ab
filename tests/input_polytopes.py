"""Polytopes of inputs for tests, and the projection onto one in fractions."""

import itertools
from fractions import Fraction

import numpy as np

import reachjax as rj
from tests.closed_loops import switching_loop

exactly = np.vectorize(Fraction, otypes=[object])


def polygon(corners, turn=0.3, size=0.4, middle=(0.1, -0.05)):
    """A regular polygon in two dimensions, turned: normals and offsets."""
    angles = turn + 2 * np.pi * np.arange(corners) / corners
    C = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return C, size + C @ np.asarray(middle)


def box_facets(n):
    """A box with sides of different length."""
    C = np.vstack([np.eye(n), -np.eye(n)])
    return C, 0.3 + 0.1 * np.arange(2 * n)


def simplex(n):
    """`u >= -0.2`, and a sum that is bounded."""
    return np.vstack([-np.eye(n), np.ones((1, n))]), np.append(np.full(n, 0.2), 0.5)


def pyramid():
    """Four facets meet at the top: multipliers are not unique there."""
    sides = [[1.0, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1], [0, 0, -1]]
    return np.array(sides), np.array([1.0, 1, 1, 1, 0]) / 2


def random_facets(n, r, seed):
    """Random facets around zero, of all sizes; the set may be unbounded."""
    rng = np.random.default_rng(seed)
    C = rng.normal(size=(r, n)) * 10.0 ** rng.uniform(-2, 2, size=(r, 1))
    return C, rng.uniform(0.1, 1, size=r) * np.linalg.norm(C, axis=1)


SETS = {
    "interval": box_facets(1),
    "half-line": (np.array([[2.0]]), np.array([0.5])),
    "triangle": polygon(3),
    "rotated square": polygon(4),
    "pentagon": polygon(5),
    "flat box": (box_facets(2)[0], np.array([0.3, 0.25, -0.3, 0.2])),
    "facets that never touch": (
        np.vstack([polygon(4)[0], polygon(4)[0]]),
        np.append(polygon(4)[1], polygon(4)[1] + 0.2),
    ),
    "unbounded": (np.array([[1.0, 1.0], [-3.0, 1.0]]), np.array([0.1, 0.2])),
    "cube": box_facets(3),
    "pyramid": pyramid(),
    "simplex of three": simplex(3),
    "random in three": random_facets(3, 6, 1),
    "simplex of four": simplex(4),
    "random in four": random_facets(4, 7, 2),
}


def polytope_loop(inputs, n_x=2, seed=0, hidden=(4, 3)):
    """A loop of ReLUs whose inputs are projected onto a polytope of normals and offsets."""
    C, d = inputs
    n_u = C.shape[1]
    rng = np.random.default_rng(seed)
    plant = switching_loop(n_x, seed=seed).plant
    B = rng.normal(size=(n_x, n_u)) / np.sqrt(n_u)
    sizes = (n_x, *hidden, n_u)
    layers = [
        (rng.normal(size=(m, k)) * np.sqrt(2 / k), 0.3 * rng.normal(size=m))
        for k, m in itertools.pairwise(sizes)
    ]
    return rj.ClosedLoop(plant.replace(B=B), rj.MLP.from_layers(layers), rj.Polytope(C, d))


def exact_multipliers(C, y):
    """All basic multipliers of excesses `y` `(r,)`, in fractions."""
    C, r = exactly(C), len(C)
    G, found = C @ C.T, []
    for k in range(min(C.shape) + 1):
        for S in map(list, itertools.combinations(range(r), k)):
            m = np.full(r, Fraction(0))
            solution = solved(G[np.ix_(S, S)], y[S])
            if solution is None:
                continue
            m[S] = solution
            if (m >= 0).all() and (G @ m - y >= 0).all():
                found.append(m)
    return found


def solved(G, y):
    """`G^-1 y` in fractions; None where `G` is singular."""
    rows = np.column_stack([G, y]) if len(y) else np.zeros((0, 1), object)
    for i in range(len(rows)):
        if rows[i, i] == 0:
            return None
        rows[i] = rows[i] / rows[i, i]
        for j in set(range(len(rows))) - {i}:
            rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, -1]
