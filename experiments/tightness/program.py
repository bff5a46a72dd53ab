"""An unrolled loop of ReLUs as a mixed-integer linear program, which HiGHS solves.

A unit `z = max(y, 0)` whose input can have either sign is

    z >= 0,   z >= y,   z <= u d,   z - y <= -l (1 - d),   d in {0, 1},   l <= y <= u,

and the others are affine: `y` and every state are rows over the initial state and the `z` and `d`
of earlier units. Tolerances of HiGHS are absolute, so variables, constraints and objectives are
scaled to ranges of order one.

Multipliers of the projection onto a polytope `C u <= d` are more of these, given excesses `y`:

    0 <= m <= M d,   0 <= s <= S (1 - d),   s = C C' m - y,   d in {0, 1}.
"""

import contextlib
import itertools
import time
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.optimize import OptimizeResult, milp
from scipy.sparse import csc_array, vstack

import reachjax as rj

SPARE = 1e-6
"""By which part the range of a unit's input is enlarged: ten times what a linear program may be
off by."""

OPTIMAL, OUT_OF_TIME = 0, 1
"""What HiGHS says of a program, in scipy's numbers."""


@dataclass(frozen=True)
class Limits:
    """Seconds that programs may take, counted from now on.

    Attributes:
        total: all of them together.
        program: each of them.
        began: when now was.
    """

    total: float = np.inf
    program: float = np.inf
    began: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        """Those of the next program.

        Raises:
            TimeoutError: none are left.
        """
        left = self.total - (time.perf_counter() - self.began)
        if left <= 0:
            raise TimeoutError(f"programs have taken {self.total} seconds")
        return min(left, self.program)


class Largest(NamedTuple):
    """What is known of the largest value of a row.

    Attributes:
        state: `(n_x,)`, the initial state that attains it; NaN where none was found in time.
        bound: no value is larger, up to HiGHS's tolerances.
        spread: the range that the row is surely within.
        drawn: `(d,)`, the values of what was drawn before, in that order; NaN as of the state.
    """

    state: Float[ndarray, " n_x"]
    bound: float
    spread: float
    drawn: Float[ndarray, " d"]


class Program:
    """Variables, and what is known of them: `G v <= h`, intervals, and which are whole numbers.

    Rows over the variables begin with the constant, and grow with the number of variables.

    Args:
        X0: what the first variables are in.
        limits: of time.

    Raises:
        RuntimeError: HiGHS failed; any method may raise it.
        TimeoutError: no time is left; any method may raise it.
        ValueError: `X0` is empty or unbounded.
    """

    def __init__(self, X0: rj.PolyhedralSet, limits: Limits):
        try:
            box = X0.bounding_box()
        except ValueError as error:
            raise ValueError(f"X0 cannot be used: {error}") from None
        A, b = map(np.asarray, X0.facets)
        n = X0.dimension
        center, radii = np.asarray(box.center), np.asarray(box.widths) / 2
        self._limits, self._first = limits, np.hstack([center[:, None], np.diag(radii)])
        self._whole, self._lower, self._upper = np.zeros(n, bool), -np.ones(n), np.ones(n)
        self._drawn: list[tuple[int, float, float]] = []
        within = np.zeros(0, int) if isinstance(X0, rj.Box) else np.arange(len(b))
        self._G, self._h = csc_array((A * radii)[within]), (b - A @ center)[within]

    def state(self) -> Float[ndarray, "n_x size"]:
        """Rows of the initial state."""
        return self._first

    def draw(self, box: rj.Box) -> Float[ndarray, "n size"]:
        """Rows of variables that may be anywhere in a box."""
        size, n = len(self._whole), box.dimension
        center, radii = np.asarray(box.center), np.asarray(box.widths) / 2
        self._drawn += [(size + i, *pair) for i, pair in enumerate(zip(center, radii, strict=True))]
        self._G.resize((len(self._h), size + n))
        self._whole = np.append(self._whole, np.zeros(n, bool))
        self._lower, self._upper = (
            np.append(self._lower, -np.ones(n)),
            np.append(self._upper, np.ones(n)),
        )
        return np.hstack([center[:, None], np.zeros((n, size)), np.diag(radii)])

    def relu(self, inputs: Float[ndarray, "k size"]) -> Float[ndarray, "k grown"]:
        """Rows of the outputs of a layer of units, given those of its inputs."""
        y = self.padded(inputs)
        ends = np.array([self._range(row) for row in y]).reshape(-1, 2)
        on, switching = ends[:, 0] >= 0, (ends[:, 0] < 0) & (ends[:, 1] > 0)
        outputs = self._add(y[switching], *ends[switching].T)
        z = self.padded(np.where(on[:, None], y, 0.0))
        z[switching] = outputs
        return z

    def multipliers(
        self, C: Float[ndarray, "r n"], excesses: Float[ndarray, "r size"]
    ) -> Float[ndarray, "r grown"]:
        """Rows of the multipliers of the facets of a polytope, given those of its excesses.

        Those of linearly independent facets, which are at most `|(C_S C_S')^-1| |y_S|` in size.
        """
        y, r = self.padded(excesses), len(C)
        ends = np.array([self._range(row) for row in y])
        size = abs(ends).max(axis=1)
        G, most = C @ C.T, np.zeros(r)
        for count in range(1, C.shape[1] + 1):
            for S in map(list, itertools.combinations(range(r), count)):
                if np.linalg.matrix_rank(C[S]) == count:
                    bound = abs(np.linalg.inv(G[np.ix_(S, S)])) @ size[S]
                    most[S] = np.maximum(most[S], bound)
        most *= 1 + SPARE
        slack = abs(G) @ most + size
        none = np.zeros((r, r))
        y = np.hstack([y, none, none])
        m, d = (np.eye(r, y.shape[1], k=y.shape[1] - (2 - i) * r) for i in range(2))
        m *= most[:, None]
        one = np.eye(1, y.shape[1])
        s = G @ m - y
        facts = [(m - most[:, None] * d) / most[:, None], -s / slack[:, None]]
        facts.append(s / slack[:, None] - (one - d))
        new = np.vstack(facts)
        self._G.resize((len(self._h), len(self._whole) + 2 * r))
        self._G = vstack([self._G, csc_array(new[:, 1:])], format="csc")
        self._h = np.append(self._h, -new[:, 0])
        self._lower = np.append(self._lower, np.zeros(2 * r))
        self._upper = np.append(self._upper, np.ones(2 * r))
        self._whole = np.append(self._whole, np.repeat([False, True], r))
        return m

    def largest(self, row: Float[ndarray, " size"]) -> Largest:
        """The largest value of a row, as far as that is found in time.

        Solved again with whole numbers held fast, as the first solution may be off by 1e-6.
        """
        row = self.padded(row[None])[0]
        least, most = self._relaxed(row)
        spread = most - least
        scale = 1 / spread if spread > 0 else 1.0  # HiGHS's tolerances are absolute
        found = self._solved(-scale * row[1:], self._whole)
        bound = most
        if (proved := found.get("mip_dual_bound", found.fun)) is not None:
            bound = min(most, row[0] - proved / scale)
        if found.x is None:
            unknown = np.full(len(self._first), np.nan), np.full(len(self._drawn), np.nan)
            return Largest(unknown[0], bound, spread, unknown[1])
        held = np.where(self._whole, np.round(found.x), np.nan)
        with contextlib.suppress(RuntimeError, TimeoutError):  # rounding has left no state, or time
            again = self._solved(-scale * row[1:], np.zeros_like(self._whole), held)
            found = again if again.status == OPTIMAL else found
        center, spans = self._first[:, 0], self._first[:, 1:]
        drawn = np.array([mid + rad * found.x[column] for column, mid, rad in self._drawn])
        return Largest(center + spans @ found.x[: len(center)], bound, spread, drawn)

    def padded(self, rows: Float[ndarray, "k size"]) -> Float[ndarray, "k grown"]:
        """Rows over all variables that there are by now."""
        return np.pad(rows, ((0, 0), (0, 1 + len(self._whole) - rows.shape[1])))

    def _add(
        self, y: Float[ndarray, "k size"], lower: Float[ndarray, " k"], upper: Float[ndarray, " k"]
    ) -> Float[ndarray, "k grown"]:
        """New variables, outputs and phases of units that switch; rows of the outputs."""
        (k, size), none = y.shape, np.zeros((len(y), len(y)))
        constant = np.eye(1, size).repeat(k, axis=0)
        y, one = (np.hstack([rows, none, none]) for rows in (y, constant))
        z, d = (np.eye(k, size + 2 * k, k=first) for first in (size, size + k))
        z *= (size_of := (upper - lower)[:, None])
        new = np.vstack([y - z, z - upper[:, None] * d, z - y + lower[:, None] * (one - d)])
        new /= np.vstack([size_of] * 3)
        self._G.resize((len(self._h), len(self._whole) + 2 * k))
        self._G = vstack([self._G, csc_array(new[:, 1:])], format="csc")
        self._h = np.append(self._h, -new[:, 0])
        self._lower = np.append(self._lower, np.zeros(2 * k))
        self._upper = np.concatenate([self._upper, upper / (upper - lower), np.ones(k)])
        self._whole = np.append(self._whole, np.repeat([False, True], k))
        return z

    def _range(self, y: Float[ndarray, " size"]) -> tuple[float, float]:
        """Bounds of a row: by intervals of the variables, and by programs if these leave the sign
        open; somewhat enlarged.
        """
        lower, upper = self._interval(y)
        spare = SPARE * (upper - lower)
        if lower < 0 < upper:
            lower, upper = self._relaxed(y)
        return lower - spare, upper + spare

    def _interval(self, row: Float[ndarray, " size"]) -> tuple[float, float]:
        """Bounds of a row by intervals of the variables."""
        ends = row[1:, None] * np.stack([self._lower, self._upper], axis=1)
        return row[0] + ends.min(axis=1).sum(), row[0] + ends.max(axis=1).sum()

    def _relaxed(self, row: Float[ndarray, " size"]) -> tuple[float, float]:
        """The smallest and the largest value of a row where no variable need be whole."""
        lower, upper = self._interval(row)
        scale = (upper - lower) or 1.0
        least, most = (
            self._solved(sign * row[1:] / scale, np.zeros_like(self._whole)) for sign in (1, -1)
        )
        if not least.status == most.status == OPTIMAL:
            raise TimeoutError(f"a linear program took {self._limits.program} seconds")
        return row[0] + scale * least.fun, row[0] - scale * most.fun

    def _solved(
        self,
        objective: Float[ndarray, " v"],
        whole: Bool[ndarray, " v"],
        held: Float[ndarray, " v"] | None = None,
    ) -> OptimizeResult:
        """What HiGHS makes of a program that is to be smallest; `held` are values that are given
        where they are no NaN.
        """
        seconds = self._limits.seconds()
        limit = {"time_limit": seconds} if np.isfinite(seconds) else {}
        lower, upper = self._lower, self._upper
        if held is not None:
            lower, upper = (np.where(np.isnan(held), end, held) for end in (lower, upper))
        found = milp(
            objective,
            integrality=whole,
            bounds=(lower, upper),
            constraints=(self._G, -np.inf, self._h),
            options={"mip_rel_gap": 0.0} | limit,
        )
        if found.status != OPTIMAL and not (found.status == OUT_OF_TIME and limit):
            raise RuntimeError(f"HiGHS did not find the maximum: {found.message}")
        return found
