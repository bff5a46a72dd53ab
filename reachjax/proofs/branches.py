"""Proofs by branches: bounds of rows in each of some branches that leave nothing out.

In every branch some facts are known to be zero, so that their multipliers may have either sign. A
row is bounded in all of them by the largest of its bounds (`programs.horizon`), whatever found the
multipliers.
"""

from __future__ import annotations

import enum

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.numerics.checks import floats_of, require_double_precision
from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.numerics.rounding import gamma
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import upper_bounds
from reachjax.programs.initial import InitialColumns
from reachjax.proofs.by_products import Certificate
from reachjax.proofs.certificates import AbstractProof, told


class Rung(enum.IntEnum):
    """By what a bound is proved, the cheapest first."""

    AFFINE_FORM = 0
    LINEAR_PROGRAM = 1
    PHASE_SPLITS = 2
    PRODUCTS = 3


@pytree
class Branches(Replaceable):
    """Leaves of trees, one tree for each bound of a step.

    Attributes:
        owner: `(l,)`, which bound a leaf belongs to.
        phases: `(l, p)`, which fact of each pair whose product is zero the leaf takes to be zero:
            0 for the first, 1 for the second, -1 where it takes neither.
        multipliers: `(l, m)`, of the facts.
        weights: `(l, f)`, of the rows, the least of which is bounded; for a facet 1 of its own.
    """

    owner: Int[Array | np.ndarray, " l"]
    phases: Int[Array | np.ndarray, "l p"]
    multipliers: Float[Array | np.ndarray, "l m"]
    weights: Float[Array | np.ndarray, "l f"]


@pytree
class HorizonFacts(Replaceable):
    """What branches are about: rows over the columns of a horizon, on the host.

    Attributes:
        start: what the first columns are.
        facts: rows `(m, n)` that are never negative.
        zero: `(p, 2)`, pairs of facts of which one is zero at each state.
        rows: `(f, n)`, what is bounded.
    """

    start: InitialColumns
    facts: AffineForms
    zero: Int[Array | np.ndarray, "p 2"]
    rows: AffineForms


@pytree
class BranchCertificate(AbstractProof):
    """Proof of the offsets of one step, `directions x[t] <= bounds`, each by the cheapest way.

    Or of one bound of the least of several rows, such as how deep states are in a set.

    A facet is proved by its affine form, by multipliers of the facts of the whole horizon, by these
    in each of some branches, or by products of facts: whatever is best. Ranges of units are those
    that the forms were made with; where sets of earlier steps bounded these, the proof is one given
    them.

    Attributes:
        about: rows over the columns of the horizon.
        branches: the leaves by which each facet is proved.
        products: the proof of some facets by semidefinite programs; None where there is none.
        by_products: `(p,)`, numbers of the facets of `products`.
        rungs: `(f,)`, values of `Rung`.
        nodes: `(f,)`, how many linear programs were solved for each facet.
        ranges: multipliers `(2 k, m)` that tightened the ranges of the step's units, in the order
            in which they were asked for; None where that is not known.
        least: whether there is one bound, of the least of all rows.
        time: of the states that are bounded; None where that is not known.

    Raises:
        ValueError: there are not as many bounds as rows, or more than one of their least.
    """

    about: HorizonFacts
    branches: Branches
    products: Certificate | None
    by_products: Int[Array | np.ndarray, " p"]
    rungs: Int[Array | np.ndarray, " f"]
    nodes: Int[Array | np.ndarray, " f"]
    ranges: tuple[Float[Array | np.ndarray, "k m"], ...] | None = None
    least: bool = static(default=False)
    time: int | None = static(default=None)

    def __post_init__(self):
        rows, bounds = len(self.about.rows.rows), len(self.bounds)
        expected = 1 if self.least else rows
        if bounds != expected:
            raise ValueError(
                f"BranchCertificate.bounds must be {expected} of {rows} rows, but {bounds} arrived"
            )

    def __repr__(self) -> str:
        counts = np.bincount(np.asarray(self.rungs), minlength=len(Rung))
        ways = ", ".join(f"{rung.name.lower()}={counts[rung]}" for rung in Rung if counts[rung])
        columns = self.about.facts.columns.shape[1]
        return (
            f"BranchCertificate(facets={len(self.bounds)}, columns={columns}, {ways}, "
            f"ended: {told(self.ends)})"
        )

    @property
    def ways(self) -> tuple[Rung, ...]:
        """By what each facet is proved."""
        return tuple(Rung(int(rung)) for rung in self.rungs)

    @property
    def multipliers(self) -> Float[Array | np.ndarray, "l m"]:
        """The multipliers of the facts of the horizon, one row for each leaf."""
        return self.branches.multipliers

    def recheck(
        self, multipliers: Float[np.ndarray, "l m"] | None = None
    ) -> Float[np.ndarray, " f"]:
        """Prove the offsets anew, with these or other multipliers of the facts.

        Sound for any multipliers: where they prove nothing of use, affine forms bound the facet.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach
            >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, -0.4]], [0.0])])
            >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)  # x+ = x - 0.4 |x|
            >>> proof = reach(loop, Box([-1.0], [2.0]), 1, Template.box(1)).proof(1)
            >>> proof.recheck().round(6).tolist()
            [1.2, 1.4]
            >>> garbage = -proof.multipliers
            >>> bool((proof.recheck(garbage) >= [1.2, 1.4]).all())
            True
        """
        require_double_precision(certificate=floats_of(self))
        about, branches = jax.device_get((self.about, self.branches))
        if multipliers is not None:
            given = np.asarray(multipliers, dtype=float)
            if given.shape != branches.multipliers.shape or not np.isfinite(given).all():
                raise ValueError(
                    f"multipliers must be finite and have shape {branches.multipliers.shape} "
                    f"(leaves, facts), but {given.shape} arrived, {np.isfinite(given).sum()} of "
                    "them finite"
                )
            branches = branches.replace(multipliers=given)
        count, upper = len(self.bounds), about.rows.ends(about.start)[1]
        if self.least:  # any of them bounds it
            upper = upper.min(keepdims=True)
        else:
            branches = branches.replace(weights=np.eye(count)[np.asarray(branches.owner)])
        values = leaf_bounds(about, branches)
        found = np.fmin(bounds_of(branches, values, count), upper)
        if self.products is not None:
            which = np.asarray(self.by_products)
            found[which] = np.fmin(found[which], self.products.recheck())
        return found


def bounds_of(
    branches: Branches, values: Float[np.ndarray, " l"], count: int
) -> Float[np.ndarray, " count"]:
    """Upper bounds by those of the leaves of each tree; infinite where a leaf is missing."""
    phases = np.asarray(branches.phases)
    found = np.full(count, np.inf)
    for number in range(count):
        mine = np.asarray(branches.owner) == number
        if covered(phases[mine]):
            found[number] = values[mine].max()
    return found


def leaf_bounds(about: HorizonFacts, branches: Branches) -> Float[np.ndarray, " l"]:
    """Upper bounds of the rows in each leaf; infinite where there is none.

    Sound for any multipliers and weights: those of a sign that proves nothing are taken as zero.
    """
    given = np.asarray(branches.multipliers)
    free = _free(about, np.asarray(branches.phases))
    shares = _shares(np.asarray(branches.weights))
    multipliers = np.where(free, given, np.fmax(given, 0.0))
    values = upper_bounds(shares @ about.rows, about.facts, multipliers, about.start)
    # the least of the rows is at most their mean, and shares may add up to 1 but for rounding
    mixed = (shares > 0).sum(axis=1) > 1
    values = values + np.where(mixed, gamma(shares.shape[1] + 4) * abs(values), 0.0)
    return np.where(np.isnan(values), np.inf, values)


def _shares(weights: Float[np.ndarray, "l f"]) -> Float[np.ndarray, "l f"]:
    """Weights of sum 1, but for rounding; NaN where there are none."""
    weights = np.fmax(weights, 0.0)
    largest = weights.max(axis=1, keepdims=True)
    with np.errstate(all="ignore"):  # none above zero, or one that is infinite
        weights = weights / largest
        return weights / weights.sum(axis=1, keepdims=True)


def covered(phases: Int[np.ndarray, "l p"]) -> bool:
    """Whether leaves leave nothing out, as those of a binary tree do.

    Example:
        >>> covered(np.array([[0, -1], [1, 0], [1, 1]])), covered(np.array([[0, -1], [1, 0]]))
        (True, False)
    """
    groups = [(np.arange(len(phases)), phases >= 0)]
    while groups:
        leaves, held = groups.pop()
        if not len(leaves):
            return False
        if not held.any(axis=1).all():
            continue
        split = np.flatnonzero(held.all(axis=0))
        if not len(split):
            return False
        sides, rest = phases[leaves, split[0]], held.copy()
        rest[:, split[0]] = False
        groups += [(leaves[sides == side], rest[sides == side]) for side in (0, 1)]
    return True


def _free(about: HorizonFacts, phases: Int[np.ndarray, "l p"]) -> np.ndarray:
    """Which multipliers `(l, m)` are of facts that their leaf takes to be zero."""
    free = np.zeros((len(phases), len(about.facts.rows)), dtype=bool)
    leaf, pair = np.nonzero(phases >= 0)
    free[leaf, np.asarray(about.zero)[pair, phases[leaf, pair]]] = True
    return free
