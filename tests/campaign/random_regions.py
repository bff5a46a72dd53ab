"""Random initial sets of every kind: generic, flat, a point, redundant, thin, (nearly) empty."""

from dataclasses import dataclass
from itertools import combinations, product
from math import comb

import numpy as np

from tests.campaign.oracle import WIDE, Region, exact, rounded, solved

MOST_CORNERS = 64
HALVINGS = 60
SHORT = 1 - WIDE(2) ** -40
"""By so much points that were moved to the surface are moved further."""


@dataclass(frozen=True)
class Initial:
    """A set of initial states, and points of it.

    Attributes:
        kind: what it is, in words.
        expression: Python that builds it.
        region: plain arrays.
        corners: `(v, n)` in fractions; none where there are too many, or a part is round.
        inner: `(n,)`, a point inside in fractions; None if the set is empty or none is known.
        empty: whether it surely is.
    """

    kind: str
    expression: str
    region: Region
    corners: np.ndarray
    inner: np.ndarray | None
    empty: bool = False

    @property
    def all_corners(self) -> bool:
        """Whether the set is the hull of its corners."""
        return self.region.center is None and len(self.corners) > 0

    def starts(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Points `(k, n)` in longdouble, near the set: corners first, then draws from it."""
        known, n = rounded(self.corners), self.region.dimension
        if self.region.center is not None:
            w = rng.normal(size=(count, n))
            w /= np.linalg.norm(w, axis=1, keepdims=True)
            w[::2] *= rng.uniform(size=(len(w[::2]), 1))
            drawn = self._from_ball(w.astype(WIDE))
        else:  # between corners, one after the other: what they share is kept to the last digit
            drawn = known[rng.integers(len(known), size=count)]
            for _ in range(3):
                part = rng.uniform(size=(count, 1)) ** 2
                drawn = drawn + part * (known[rng.integers(len(known), size=count)] - drawn)
        return np.vstack([known, self.pulled(drawn)])

    def extreme(self, directions: np.ndarray) -> np.ndarray:
        """Points of the set far along the directions `(k, n)`, one for each part of the set."""
        found = []
        if self.region.center is not None:
            Q = self.region.shape.astype(WIDE)
            size = abs(directions).max(axis=1, keepdims=True)
            unit = directions / np.where(size > 0, size, 1)
            length = np.sqrt(np.maximum((unit @ Q * unit).sum(axis=1, keepdims=True), 0))
            away = unit @ Q / np.where(length > 0, length, 1)
            found.append(self.region.center + away)
        if "Box" in self.expression:
            n = self.region.dimension
            found.append(np.where(directions > 0, self.region.b[n:], -self.region.b[:n]))
        elif self.region.center is None:
            known = rounded(self.corners)
            found.append(known[np.argmax(directions @ known.T, axis=1)])
        return np.stack([self.pulled(points.astype(WIDE)) for points in found])

    def _from_ball(self, w: np.ndarray) -> np.ndarray:
        factor = np.linalg.cholesky(scaled := self.region.shape / self._outer).astype(WIDE)
        assert np.isfinite(scaled).all()
        return self.region.center + w @ (factor * np.sqrt(np.diag(self._outer))[:, None]).T

    @property
    def _outer(self) -> np.ndarray:
        widths = np.sqrt(np.diag(self.region.shape))
        return np.outer(widths, widths)

    def pulled(self, points: np.ndarray) -> np.ndarray:
        """Points moved towards the inner one until they may be inside, for all longdouble tells."""
        middle = rounded(self.inner[None])
        low, high = np.zeros((len(points), 1), WIDE), np.ones((len(points), 1), WIDE)
        part = high
        for _ in range(1 if self._perhaps(points).all() else HALVINGS):
            inside = self._perhaps(middle + part * (points - middle))[:, None]
            low, high = np.where(inside, part, low), np.where(inside, high, part)
            part = (low + high) / 2
        low = np.where(low < 1, low * SHORT, low)
        return middle + low * (points - middle)

    def _perhaps(self, points: np.ndarray) -> np.ndarray:
        room, error = self.region.room_wide(points, np.zeros_like(points))
        return np.all(room >= -error, axis=1)


def random_region(rng: np.random.Generator, kind: str, scale: np.ndarray, facets: int) -> Initial:
    """A set of this kind; coordinates are of the scales `(n,)`, but for its offset."""
    draw = {"box": _box, "polytope": _polytope, "ellipsoid": _ellipsoid}
    if kind == "intersection":
        return _intersection(rng, scale)
    return draw[kind](rng, scale, *([facets] if kind == "polytope" else []))


def literal(array) -> str:
    """An array as Python."""
    return repr(np.asarray(array).tolist())


def _offset(rng: np.random.Generator, scale: np.ndarray) -> np.ndarray:
    """Where a set lies: at zero, nearby, or far away beside its size."""
    far = rng.choice([0.0, 1.0, 10.0 ** rng.uniform(0, 8)], p=[0.2, 0.5, 0.3])
    return far * scale * rng.normal(size=len(scale))


def _boxed(kind: str, lower: np.ndarray, upper: np.ndarray) -> Initial:
    n = len(lower)
    region = Region(np.vstack([-np.eye(n), np.eye(n)]), np.hstack([-lower, upper]))
    bounds = [sorted({lo, hi}) for lo, hi in zip(lower, upper, strict=True)]
    corners = list(product(*bounds)) if n <= 6 else [lower, upper]
    expression = f"rj.Box({literal(lower)}, {literal(upper)})"
    middle = (exact(lower) + exact(upper)) / 2
    return Initial(f"Box, {kind}", expression, region, exact(corners[:MOST_CORNERS]), middle)


def _box(rng: np.random.Generator, scale: np.ndarray) -> Initial:
    kind = rng.choice(["generic", "flat", "a point", "thin"], p=[0.6, 0.15, 0.1, 0.15])
    q, n = _offset(rng, scale), len(scale)
    radii = scale * 10 ** rng.uniform(-2, 0, n)
    if kind == "flat":
        radii[rng.permutation(n)[: rng.integers(1, n + 1)]] = 0
    elif kind == "a point":
        radii[:] = 0
    elif kind == "thin":
        radii[rng.integers(n)] *= 10 ** rng.uniform(-16, -6)
    return _boxed(kind, q - radii, q + radii)


def _corners(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Every corner of a polytope, in fractions."""
    A, b, n = exact(A), exact(b), A.shape[1]
    found = set()
    for rows in map(list, combinations(range(len(A)), n)):
        point = solved(A[rows], b[rows])
        if point is not None and np.all(b - A @ point >= 0):
            found.add(tuple(point))
    result = np.empty((len(found), n), dtype=object)
    for i, point in enumerate(sorted(found)):
        result[i] = point
    return result


def _polytope(rng: np.random.Generator, scale: np.ndarray, facets: int) -> Initial:
    kinds = ["generic", "redundant", "flat", "a point", "thin", "nearly empty", "empty"]
    kind = rng.choice(kinds, p=[0.4, 0.2, 0.1, 0.05, 0.1, 0.1, 0.05])
    n, q = len(scale), _offset(rng, scale)
    axes = np.eye(n)
    if kind not in ("flat", "a point") and rng.random() < 0.5:
        axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    radii = 10 ** rng.uniform(-2, 0, n)
    extra = rng.normal(size=(facets - 2 * n, n))
    rows = np.vstack([axes, -axes, extra])
    reach = abs(extra @ axes.T) @ radii  # of the rotated box
    offsets = np.hstack([radii, radii, reach * rng.uniform(0.2, 0.9, len(extra))])
    if kind == "redundant":
        offsets[2 * n :] = reach * rng.choice([1.0, 1 + 1e-12, 1.5, 1e6], len(extra))
        if rng.random() < 0.5:
            k = rng.integers(2 * n)
            rows[-1], offsets[-1] = rows[k], offsets[k]
    elif kind in ("thin", "nearly empty", "empty"):
        k = rng.integers(n)
        sign = {"thin": 1.0, "nearly empty": 10.0**-6, "empty": -1.0}[kind]
        offsets[n + k] = -offsets[k] + sign * radii[k] * 10 ** rng.uniform(-10, -3)
    A, b = rows / scale, offsets + rows / scale @ q
    if kind in ("flat", "a point"):  # exactly so: unscaled axes
        for k in range(n) if kind == "a point" else [rng.integers(n)]:
            A[k], A[n + k] = np.eye(n)[k], -np.eye(n)[k]
            b[k], b[n + k] = q[k], -q[k]
    sizes = 10 ** rng.uniform(-3, 3, facets) if rng.random() < 0.5 else np.ones(facets)
    if rng.random() < 0.05:
        sizes = np.full(facets, 10.0 ** rng.choice([-170.0, 155.0]))
    with np.errstate(over="ignore"):
        scaled = A * sizes[:, None], b * sizes
    if np.isfinite(scaled[0]).all() and np.isfinite(scaled[1]).all() and scaled[0].any(1).all():
        A, b = scaled
    corners = _corners(A, b) if comb(facets, n) <= 300 else np.empty((0, n), object)
    inner = corners.sum(axis=0) / len(corners) if len(corners) else None
    expression = f"rj.Polytope({literal(A)}, {literal(b)})"
    region = Region(A, b)
    return Initial(f"Polytope, {kind}", expression, region, corners, inner, not len(corners))


def _ball(rng: np.random.Generator, scale: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    n = len(scale)
    turned = np.linalg.qr(rng.normal(size=(n, n)))[0]
    least = {"thin": rng.uniform(-6.5, -3), "round": 0.0}.get(kind, -1.0)
    radii = 10 ** rng.uniform(-1, 0, n) if kind != "round" else np.ones(n)
    radii[0] *= 10**least
    L = scale[:, None] * turned * radii
    Q = L @ L.T
    return _offset(rng, scale), (Q + Q.T) / 2


def _ellipsoid(rng: np.random.Generator, scale: np.ndarray) -> Initial:
    kind = str(rng.choice(["generic", "round", "thin"], p=[0.6, 0.2, 0.2]))
    q, Q = _ball(rng, scale, kind)
    expression = f"rj.Ellipsoid({literal(q)}, {literal(Q)})"
    none = np.empty((0, len(q)), dtype=object)
    return Initial(f"Ellipsoid, {kind}", expression, Region(None, None, q, Q), none, exact(q))


def _intersection(rng: np.random.Generator, scale: np.ndarray) -> Initial:
    kinds = ["half", "sliver", "box inside", "ball inside", "nearly empty", "empty"]
    kind = str(rng.choice(kinds, p=[0.4, 0.2, 0.1, 0.1, 0.1, 0.1]))
    q, Q = _ball(rng, scale, "generic")
    widths = np.sqrt(np.diag(Q))
    n, lower, upper = len(q), q - 1.1 * widths, q + 1.1 * widths
    cuts = {"half": rng.uniform(-0.5, 0.5), "sliver": 0.99, "nearly empty": 1 - 1e-9, "empty": 1.01}
    if kind in cuts:
        lower[0] = q[0] + cuts[kind] * widths[0]
    elif kind == "box inside":
        lower, upper = q - 0.1 * widths, q + 0.1 * widths
    tip = Q[0] / widths[0]  # the ball goes farthest along the first axis here
    place = {"half": 0.75, "sliver": 0.995, "nearly empty": 1 - 5e-10}.get(kind, 0.0)
    region = Region(np.vstack([-np.eye(n), np.eye(n)]), np.hstack([-lower, upper]), q, Q)
    inner = exact(q.astype(WIDE) + WIDE(place) * tip)
    if not region.holds(inner):
        inner = None
    expression = (
        f"rj.Intersection(rj.Box({literal(lower)}, {literal(upper)}), "
        f"rj.Ellipsoid({literal(q)}, {literal(Q)}))"
    )
    none = np.empty((0, n), dtype=object)
    surely = kind == "empty" and float(widths[0]) * 0.005 > 4e-16 * abs(float(q[0]))
    return Initial(f"Intersection, {kind}", expression, region, none, inner, surely)
