"""Presolve: the program as a solver should see it, with nothing empty, no noise, nothing implied.

`presolved` applies it, and `NormalProgram.invert` leads back from what a solver finds.

Rows whose coefficients are rounding noise are dropped (one of size 1e-16 scaled up to 1 made a
solver report "solved" for an offset below the true support), so are columns that the others use at
that level or not at all, and products that say nothing beyond an ellipsoid's own fact. What stays
is brought to unit size.

A presolved program is held by symmetric matrices that are sums of products of two rows. `G_k = sum
w sym(l' r)` over the pairs that belong to `k`. Sums and inner products need Gram matrices of the
rows alone; only conic solvers ask for the `G_k`.

What a solver sees is a **pencil**: the matrix inequality of a goal, with what is sought among its
unknowns.

Theorem 1 for facets and the Schur complement of that for ellipsoids (`lmi`) are affine in the
multipliers and in what is sought, an offset or a form:

    Z_i(y, u)  =  C_i - sum_k y_k G_k + sum_j u_j H_j  >=  0,    y_k >= 0 unless free.

Such a linear matrix pencil is all that a solver needs to see. `G_k` and `H_j` are sums of products
of two rows. What the unknowns are to enlarge is `log det sum_j u_j S_j`, or, where one unknown is
sought alone, the one entry of `S` itself.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float

from reachjax.numerics.budget import clock
from reachjax.numerics.rounding import Ball
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import Products
from reachjax.sets import NormalForm

CHUNK = 256
"""Pairs that are treated together: it bounds the memory that products of them take."""


class Generators(NamedTuple):
    """The matrices `G_k`.

    Attributes:
        rows: `(m, n)`.
        left: `(p,)`, row numbers.
        right: `(p,)`, row numbers.
        sharing: sparse `(K, p)`, the weight of each pair in each matrix.
    """

    rows: np.ndarray
    left: np.ndarray
    right: np.ndarray
    sharing: sp.csr_array

    @property
    def size(self) -> int:
        """How many matrices there are."""
        return self.sharing.indptr.size - 1

    def weighted(self, y: np.ndarray) -> np.ndarray:
        """`sum_k y_k G_k` `(n, n)`."""
        weights = self.sharing.T @ y
        half = (weights[:, None] * self.rows[self.left]).T @ self.rows[self.right]
        return (half + half.T) / 2

    def paired(self, matrix: np.ndarray) -> np.ndarray:
        """`<G_k, M>` `(K,)` for a symmetric matrix."""
        return self.sharing @ np.sum((self.rows @ matrix)[self.left] * self.rows[self.right], 1)

    def schur(self, X: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`<G_k, X>` and `<G_k, W>` `(K,)`, and `<G_k, X G_l W>` `(K, K)`, for symmetric `X`, `W`.

        With the Gram matrices `A = F X F'` and `B = F W F'` of the rows, two pairs `(l, r)` and
        `(p, q)` have

            <sym(l' r), X sym(p' q) W>  =  (A_lp B_rq + A_lq B_rp + A_rp B_lq + A_rq B_lp) / 4.
        """
        left, right = self.left, self.right
        A, B = self.rows @ X @ self.rows.T, self.rows @ W @ self.rows.T
        A_left, A_right, B_left, B_right = A[:, left], A[:, right], B[:, left], B[:, right]
        shared = np.zeros((self.size, len(self.left)))
        for first in range(0, len(left), CHUNK):
            clock().require()
            here = slice(first, first + CHUNK)
            p, q = left[here], right[here]
            crossed = A_left[p] * B_right[q]
            crossed += A_right[p] * B_left[q]
            crossed += A_left[q] * B_right[p]
            crossed += A_right[q] * B_left[p]
            shared += self.sharing[:, here] @ crossed
        paired, paired_W = (self.sharing @ gram[left, right] for gram in (A, B))
        return paired, paired_W, (self.sharing @ shared.T) / 4

    def below(self, others: Generators) -> Generators:
        """The matrices `-G_k`, and then those of others, which may have more columns."""
        m, n = self.rows.shape
        rows = np.zeros((m + len(others.rows), others.rows.shape[1]))
        rows[:m, :n], rows[m:] = self.rows, others.rows
        return Generators(
            rows=rows,
            left=np.r_[self.left, m + others.left],
            right=np.r_[self.right, m + others.right],
            sharing=sp.csr_array(sp.block_diag([-self.sharing, others.sharing])),
        )

    def scaled(self, weights: np.ndarray) -> Generators:
        """Each matrix times a weight."""
        sharing = self.sharing.copy()
        sharing.data *= np.repeat(weights, np.diff(sharing.indptr))
        return self._replace(sharing=sharing)

    def columns(self) -> sp.csc_array:
        """The flattened matrices, sparse `(n * n, K)`."""
        n, blocks = self.rows.shape[1], []
        for first in range(0, len(self.left) or 1, CHUNK):
            clock().require()
            here = slice(first, first + CHUNK)
            outer = self.rows[self.left[here], :, None] * self.rows[self.right[here], None, :]
            symmetric = (outer + outer.transpose(0, 2, 1)) / 2
            blocks.append(sp.csr_array(symmetric.reshape(-1, n * n)))
        return sp.csc_array((self.sharing @ sp.vstack(blocks, format="csr")).T)


NOISE = 16.0
"""Coefficients no larger than this many times the rounding error of their row count as zero."""

GRAZING = 1e-6
"""A fact negative on an ellipsoid by no more than this part of its size counts as implied by it."""

THINNEST = 1e-4
"""In the coordinates in which it is sought, an ellipsoid has no half-axis below this part of the
interval radius: that keeps ellipsoids of least volume around flat sets from degenerating."""

LEAST_WIDTH = 1e-100
"""The least width of anything that is enclosed, in the units of the state."""


class NormalProgram(NamedTuple):
    """`sum_k y_k G_k + p e' + e p' - 2 b e e' <= 0` with `|G_k|` about 1, in `n` used columns.

    Attributes:
        generators: the `G_k`.
        objective: `(f, n)`, of unit 1-norm and without a constant.
        centers: `(f,)`, the constants; a facet's offset is `centers + units b`.
        units: `(f,)`; the program's multipliers are those of the scaled objective times this. Zero
            where the objective has one value.
        free: `(K',)`, multipliers of either sign.
        columns: `(n,)`, numbers of the columns kept.
        kept: `(K',)`, numbers of the multipliers kept.
        norms: `(K',)`: the program's multiplier is `y_k / norms_k`.
        whole: how many multipliers and columns the program has.
    """

    generators: Generators
    objective: np.ndarray
    centers: np.ndarray
    units: np.ndarray
    free: np.ndarray
    columns: np.ndarray
    kept: np.ndarray
    norms: np.ndarray
    whole: tuple[int, int]

    def invert(
        self, multipliers: Float[np.ndarray, " k"], moments: Float[np.ndarray, "m m"]
    ) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "M M"]]:
        """Multipliers and moments of the program itself, from those that were found for this one.

        Args:
            multipliers: the `y_k`.
            moments: over the columns kept, and over what a goal's matrix has beyond them; of any
                scale.

        Returns:
            Multipliers, and moments whose corner is one; NaN where there are none.
        """
        corner = moments[len(self.columns) - 1, len(self.columns) - 1]
        whole = self.moments_of(moments)
        there = corner > 0 and np.isfinite(moments).all()
        return self.multipliers_of(multipliers), whole / (corner if there else np.nan)

    def multipliers_of(self, multipliers: Float[np.ndarray, " k"]) -> Float[np.ndarray, " K"]:
        """Multipliers of the program itself, zero where they are not kept: linear."""
        whole = np.zeros(self.whole[0])
        whole[self.kept] = multipliers / self.norms
        return whole

    def moments_of(self, moments: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "M M"]:
        """Moments of the program itself, and of what is beyond its columns: linear."""
        n, size = len(self.columns), self.whole[1]
        beyond = np.arange(size, size + len(moments) - n)
        whole, used = np.zeros((size + len(beyond),) * 2), np.r_[self.columns, beyond]
        whole[np.ix_(used, used)] = moments
        return whole

    @property
    def widths(self) -> np.ndarray:
        """The units, none of them at rounding level, nor so small that squares underflow."""
        return np.maximum(self.units, 1e-9 * (abs(self.centers) + self.units.max()) + LEAST_WIDTH)

    def with_units(self, units: np.ndarray) -> NormalProgram:
        """The same program with other units of the objective; where it has one value they are 0."""
        ratios = self.units / np.where(units > 0, units, 1.0)
        return self._replace(objective=self.objective * ratios[:, None], units=units)

    @property
    def is_flat(self) -> bool:
        """Whether the objective hardly varies in some coordinate."""
        return bool(np.any(self.units < self.widths))

    def is_thinnest(self, form: NormalForm) -> bool:
        """Whether an ellipsoid is about as thin as it may be in these coordinates."""
        return bool(np.linalg.norm(form.A * self.widths, 2) > 0.5 / THINNEST)

    def to_unit_box(self, form: NormalForm) -> NormalForm:
        """`|A x + b| <= 1` over the coordinates in which the objective rows are stated."""
        return NormalForm(form.A * self.units, form.b + form.A @ self.centers)

    def from_unit_box(self, form: NormalForm) -> NormalForm:
        """The inverse of `to_unit_box`."""
        A = form.A / self.units
        return NormalForm(A, form.b - A @ self.centers)

    def cotangent_to_unit_box(self, cotangent: NormalForm) -> NormalForm:
        """The transpose of `from_unit_box`."""
        A = (cotangent.A - np.outer(cotangent.b, self.centers)) / self.units
        return NormalForm(A, cotangent.b)


def presolved(program: Program) -> NormalProgram:
    """The normal program of a program whose leaves are numpy arrays."""
    products = program.products
    solid, wanted = _solid(program.facts), _solid(program.objective)
    used = np.any(solid, axis=0) | np.any(wanted, axis=0)
    facts = np.where(np.any(solid, axis=1)[:, None] & used, program.facts.mid, 0.0)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is dropped
        sizes = _sizes(products, facts)
    kept = np.flatnonzero((sizes > 0) & np.isfinite(sizes) & ~_implied_by_cone(products, facts))
    number = np.full(len(sizes), -1)
    number[kept] = np.arange(len(kept))
    owner, present = number[products.multiplier], np.any(facts != 0, axis=1)
    there = np.flatnonzero((owner >= 0) & present[products.left] & present[products.right])
    owner, norms, columns = owner[there], sizes[kept], np.flatnonzero(used)
    shares = np.asarray(products.sign)[there] / norms[owner], (owner, np.arange(len(there)))
    objective = np.where(used, program.objective.mid, 0.0)
    centers, objective[:, -1] = objective[:, -1].copy(), 0.0
    # solvers' tolerances are absolute, objectives come in the size of the set of states
    units = abs(objective).sum(axis=1)
    return NormalProgram(
        generators=Generators(
            rows=facts[:, columns],
            left=np.asarray(products.left)[there],
            right=np.asarray(products.right)[there],
            sharing=sp.csr_array(shares, shape=(len(kept), len(there))),
        ),
        objective=objective[:, columns] / np.where(units > 0, units, 1.0)[:, None],
        centers=centers,
        units=units,
        free=np.asarray(products.free)[kept],
        columns=columns,
        kept=kept,
        norms=norms,
        whole=(len(sizes), len(used)),
    )


def _solid(rows: Ball) -> Bool[np.ndarray, "k n"]:
    """Which coefficients stand out from the rounding errors of their row."""
    noise = NOISE * np.sqrt((rows.rad**2).sum(axis=1))
    return np.asarray(abs(rows.mid) > noise[:, None])


def _sizes(products: Products, facts: np.ndarray) -> Float[np.ndarray, " K"]:
    """The root of the sum of `|sym(p' q)|^2` over the pairs of each multiplier."""
    squares = (facts**2).sum(axis=1)
    inner = np.zeros(len(products.left))
    for first in range(0, len(inner), CHUNK):
        here = slice(first, first + CHUNK)
        inner[here] = (facts[products.left[here]] * facts[products.right[here]]).sum(axis=1)
    of_pairs = (squares[products.left] * squares[products.right] + inner**2) / 2
    return np.sqrt(np.bincount(products.multiplier, of_pairs, len(products.free)))


def _implied_by_cone(products: Products, facts: np.ndarray) -> Bool[np.ndarray, " K"]:
    """Multipliers `(K,)` of products that say nothing beyond an ellipsoid's own fact.

    A quadratic function of the state that is not negative on the ellipsoid is a positive multiple
    of its fact and a positive semidefinite term (the S-lemma loses nothing for one constraint).
    Products of neurons that are affine on the set are of this kind; kept, hundreds of them made a
    solver stall at its second digit. So are those of facets that do not cut the ellipsoid.
    """
    cone, count = products.of_cone, len(products.free)
    if not cone.any():
        return np.zeros(count, dtype=bool)
    own = np.bincount(products.multiplier, cone, count) > 0
    holds = _least_on_ellipsoid(products, facts, own) >= 0
    present = (facts != 0).any(axis=1)
    left, right = products.left, products.right
    beyond = ~(holds[left] & holds[right]) & present[left] & present[right]
    return ~(np.bincount(products.multiplier, beyond, count) > 0) & ~own


def _least_on_ellipsoid(
    products: Products, facts: np.ndarray, own: np.ndarray
) -> Float[np.ndarray, " m"]:
    """A lower bound `(m,)` of each fact on the ellipsoid; `-inf` if it is not one of the state.

    Args:
        products: whose pairs of a cone are those of the rows `R` with `|R x| <= s`.
        facts: `(m, n)`.
        own: `(K,)`, the multiplier of the ellipsoid's own fact.
    """
    cone, (left, right) = products.of_cone, (facts[products.left], facts[products.right])
    of_level = own[products.multiplier] & ~cone
    level = np.sqrt(np.where(of_level, left[:, -1] * right[:, -1], 0.0).sum())
    R, linear = np.where(cone[:, None], left, 0.0), facts[:, :-1]
    inverse = np.linalg.pinv(R[:, :-1].T @ R[:, :-1], hermitian=True)
    middle = facts[:, -1] - linear @ (inverse @ (R[:, :-1].T @ R[:, -1]))
    squares = ((linear @ inverse) * linear).sum(axis=1)
    reach = level * np.sqrt(np.maximum(squares, 0.0))
    elsewhere = ((linear != 0) & ~(R[:, :-1] != 0).any(axis=0)).any(axis=1)
    least = middle - reach + GRAZING * (abs(middle) + reach)
    return np.where(elsewhere, -np.inf, least)


class Pencil(NamedTuple):
    """The programs of a goal as solvers take them.

    Attributes:
        normal: the program without what is empty or implied, of unit size.
        terms: the `-G_k`, and then the `H_j`.
        constant: the `C_i` `(N, N)` of a program, by its number.
        sizes: `(u, s, s)`, the `S_j`.
        units: `(f,)`; multipliers and unknowns of the normal program are to be multiplied by these.
    """

    normal: NormalProgram
    terms: Generators
    constant: Callable[[int], Float[np.ndarray, "N N"]]
    sizes: Float[np.ndarray, "u s s"]
    units: Float[np.ndarray, " f"]

    @property
    def multipliers(self) -> int:
        """How many multipliers there are."""
        return len(self.normal.kept)

    @property
    def size(self) -> int:
        """The size `N` of the matrices."""
        return self.terms.rows.shape[1]


class Shape(NamedTuple):
    """How large a goal's programs are: how many, of how many unknowns, and of which size `N`."""

    programs: int
    unknowns: int
    size: int


class AbstractInequality(abc.ABC):
    """What is sought of a program, as a matrix inequality: what a solver sees of a goal.

    Attributes:
        named: what messages call one of its programs, by its number.
        logarithmic: whether unknowns lie along a central path, on which `log det` is enlarged.
    """

    named: ClassVar[str] = "program {}"
    logarithmic: ClassVar[bool] = False

    @abc.abstractmethod
    def shape(self, program: Program) -> Shape:
        """The size of its programs."""

    @abc.abstractmethod
    def pencil(self, program: Program) -> Pencil:
        """Its programs as solvers take them, of numpy arrays."""

    @abc.abstractmethod
    def absolute(
        self, normal: NormalProgram, i: int, unknowns: Float[np.ndarray, " u"]
    ) -> Float[Array | np.ndarray, " u"]:
        """The unknowns of a program from those of a normal program's pencil."""
