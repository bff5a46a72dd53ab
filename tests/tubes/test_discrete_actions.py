"""Policies that choose among actions: the same bounds as mixed-integer programs, and samples."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import Bounds as Between
from scipy.optimize import LinearConstraint, milp

import reachjax as rj

STEPS, HIDDEN = 4, 5


class Policy:
    """An affine plant under the argmax of a random network, as arrays."""

    def __init__(self, seed, actions=3, states=2):
        rng = np.random.default_rng(seed)
        self.A = np.eye(states) + 0.2 * rng.normal(size=(states, states))
        self.B = rng.normal(size=(states, 1))
        self.layers = [
            (rng.normal(size=(HIDDEN, states)), 0.3 * rng.normal(size=HIDDEN)),
            (rng.normal(size=(actions, HIDDEN)), 0.3 * rng.normal(size=actions)),
        ]
        self.actions = np.sort(rng.normal(size=actions))[rng.permutation(actions)]
        center = 0.3 * rng.normal(size=states)
        self.lower, self.upper = center - 0.4, center + 0.4

    @property
    def loop(self):
        (W, b), (V, c) = self.layers
        values = jnp.array(self.actions)

        def policy(x):
            return values[jnp.argmax(V @ jnp.maximum(W @ x + b, 0.0) + c)][None]

        net = rj.Network(policy, len(self.A), 1)
        return rj.ClosedLoop(rj.AffinePlant(self.A, self.B), net)

    def largest(self, direction, steps):
        """The largest value of a direction after some steps, by a program with whole numbers.

        The solver has no indicator constraints `z = 1 implies r >= 0`. Stated are
        `r >= least (1 - z)`, where `least` is below every value of `r` over bounds of what it is
        made of: at `z = 1` that is `r >= 0`, at `z = 0` it is true of all points. So the points
        with whole `z` are the same; only what lies between them differs, which the search closes.
        """
        rows, ends, columns, whole = [], [], [], []

        def column(low, high, is_whole=False):
            columns.append((low, high))
            whole.append(int(is_whole))
            return len(columns) - 1

        def require(terms, low, high):
            rows.append(terms)
            ends.append((low, high))

        x = [column(*each) for each in zip(self.lower, self.upper, strict=True)]
        (W, b), (V, c) = self.layers
        for _ in range(steps):
            box = np.array([columns[k] for k in x]).T
            h = []
            for w, e in zip(W, b, strict=True):
                low, high = (np.sum(np.minimum(w * box[0], w * box[1])) + e,
                             np.sum(np.maximum(w * box[0], w * box[1])) + e)  # fmt: skip
                out, on = column(0.0, max(high, 0.0)), column(0, 1, True)
                y = dict(zip(x, w, strict=True))
                require({out: 1.0, **{k: -v for k, v in y.items()}}, e, np.inf)
                terms = {out: 1.0, on: -min(low, 0.0), **{k: -v for k, v in y.items()}}
                require(terms, -np.inf, e - min(low, 0.0))
                require({out: 1.0, on: -max(high, 0.0)}, -np.inf, 0.0)
                h.append(out)
            z = [column(0, 1, True) for _ in c]
            require(dict.fromkeys(z, 1.0), 1.0, 1.0)
            top = np.array([columns[k][1] for k in h])
            for i, j in [(i, j) for i in range(len(c)) for j in range(len(c)) if i != j]:
                row = V[i] - V[j]
                least = np.sum(np.minimum(row, 0.0) * top) + c[i] - c[j]
                terms = dict(zip(h, row, strict=True))
                require(terms | {z[i]: least}, least - (c[i] - c[j]), np.inf)
            following = []
            for a, push in zip(self.A, self.B[:, 0], strict=True):
                values = push * self.actions
                low = np.sum(np.minimum(a * box[0], a * box[1])) + values.min()
                high = np.sum(np.maximum(a * box[0], a * box[1])) + values.max()
                new = column(low - 1e-6, high + 1e-6)
                terms = {new: -1.0, **dict(zip(x, a, strict=True))}
                terms |= dict(zip(z, values, strict=True))
                require(terms, 0.0, 0.0)
                following.append(new)
            x = following
        matrix = np.zeros((len(rows), len(columns)))
        for row, terms in zip(matrix, rows, strict=True):
            for k, v in terms.items():
                row[k] = v
        cost = np.zeros(len(columns))
        cost[x] = -np.asarray(direction)
        found = milp(
            cost,
            constraints=LinearConstraint(matrix, *np.array(ends).T),
            bounds=Between(*np.array(columns).T),
            integrality=whole,
            options={"mip_rel_gap": 1e-9},
        )
        assert found.success
        return -found.fun


@pytest.mark.costly
@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(k, marks=pytest.mark.long) for k in range(3, 6))]
)
def test_bounds_are_those_of_a_mixed_integer_program(seed):
    policy = Policy(seed)
    tube = rj.reach(policy.loop, rj.Box(policy.lower, policy.upper), STEPS, rj.Template.box(2),
                    gap=1e-8)  # fmt: skip
    for t in (1, STEPS):
        directions, bounds = np.asarray(tube.sets[t].A), np.asarray(tube.sets[t].b)
        for direction, bound in zip(directions, bounds, strict=True):
            exact = policy.largest(direction, t)
            assert abs(bound - exact) <= 1e-6 * max(1.0, abs(exact)), (t, bound, exact)
