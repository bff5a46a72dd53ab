"""What the proofs of a tube rest on, made again from its loop, initial set, template and start.

From a proof comes only what it proposes, of which any is sound: multipliers, slopes, cells, which
products of facts, ellipsoids. Each step rests on the sets that are proved by then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.methods.ladder import Ladder
from reachjax.methods.recursion import goals_of
from reachjax.methods.steps import Setting, Step, boxed
from reachjax.numerics.budget import ENDLESS
from reachjax.programs.lmi import Origin, Program
from reachjax.programs.relaxations import (
    AbstractRelaxation,
    AllProducts,
    FactLayout,
    LinearBounds,
    LocalBounds,
    Products,
)
from reachjax.programs.unrolled import ByForms, unrolled
from reachjax.programs.windows import Window
from reachjax.proofs.branches import BranchCertificate
from reachjax.proofs.by_forms import CellCertificate, LinearCertificate, numbers, over_cell
from reachjax.proofs.by_products import Certificate, EllipsoidCertificate, MixedCertificate
from reachjax.proofs.certificates import AbstractCertificate, AbstractProof
from reachjax.sets import AbstractSet, AbstractTemplate, Box, Polytope
from reachjax.sets.cells import from_tree
from reachjax.solvers import Auto
from reachjax.tubes.reach import ReachTube


class DisagreementError(ValueError):
    """A tube says what its own certificates do not prove.

    Attributes:
        step: how many steps after the initial set; None if it is not about one.
        facet: the number of the facet; None if it is not about one.
        said: what the tube says.
        proved: what is proved, or simulated.
    """

    def __init__(
        self,
        message: str,
        step: int | None = None,
        facet: int | None = None,
        said: Any = None,
        proved: Any = None,
    ):
        super().__init__(message)
        self.step, self.facet, self.said, self.proved = step, facet, said, proved


Again = tuple[AbstractProof, Float[np.ndarray, " f"]]
"""A proof with all that it rests on made again, and the bounds that it proves."""


class _Unrolled:
    """Forms over a part of the initial set, made step after step, of which the last is kept.

    Args:
        steps: what they say of the first step, the second, and so on.

    Attributes:
        taken: how many steps were made.
    """

    def __init__(self, steps: Iterator[ByForms]):
        self._steps, self.taken = steps, 0
        self._last: ByForms | None = None

    def at(self, k: int) -> ByForms | None:
        """What they say of the step `k`, which is not before those made; None without bounds."""
        assert k >= self.taken
        while self.taken < k:
            self._last = _next(self._steps)
            self.taken += 1
        return self._last


class _CellTube(NamedTuple):
    """What is said over one cell of an initial set, as a tube says it."""

    loop: ClosedLoop
    template: AbstractTemplate
    sets: tuple[AbstractSet, ...]
    certificates: tuple[AbstractProof | None, ...]
    start: int

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.certificates) - 1

    def proof(self, k: int) -> AbstractProof:
        """What is said of the states after `k` steps."""
        found = self.certificates[k] if k <= self.horizon else None
        if found is None:
            raise ValueError(f"nothing is said of a cell after {k} steps")
        return found


class Repeat:
    """The propagation of a tube, as its proofs say that it was.

    Args:
        tube: whose parts have the kinds that they should have.
        sets: those that are proved so far; they grow from outside, or, of a cell, by `until`.

    Attributes:
        again: of a cell, its proofs as they were made again.
    """

    def __init__(self, tube: ReachTube | _CellTube, sets: list[AbstractSet]):
        self._tube, self._sets = tube, sets
        self._within: dict[tuple[int, ...], Repeat] = {}
        self.again = list[AbstractProof]()
        self._forms: dict[Any, _Unrolled] = {}
        self._windows: dict[Origin, Window] = {}

    def of(self, k: int, proof: AbstractProof) -> Again:
        """The proof of the set after `k` steps, made again; that is asked for in order.

        Raises:
            Exception: of any kind: it does not fit the tube.
        """
        again, found = self._again(k, proof)
        facets, ball = self._tube.template.at(k).parts
        asked = ((0 if facets is None else len(facets.directions)) + (ball is not None),)
        if np.shape(proof.bounds) != asked or found.shape != asked:
            counts = np.shape(proof.bounds), found.shape
            raise ValueError(f"{counts[1]} numbers are proved and {counts[0]} said, not {asked}")
        return again, found

    def _again(self, k: int, proof: AbstractProof) -> Again:
        tube = self._tube
        own: dict[str, Any] = {"loop": tube.loop, "X0": tube.sets[0], "k": k, "start": tube.start}
        own["directions"] = self._directions(k)
        by_forms = isinstance(proof, LinearCertificate | CellCertificate)
        if by_forms and (proof.k, proof.start) != (k, tube.start):
            raise ValueError(f"it is of step {proof.k} from t = {proof.start}")
        if isinstance(proof, LinearCertificate):
            *_, last = (p for p in tube.certificates if isinstance(p, LinearCertificate))
            slopes, (cut, _) = np.asarray(last.slopes), proof.X0.parts
            if cut is None or not cut.needs_programs:  # its slopes hold on intervals without them
                own["X0"] = own["X0"].closed_form(self._box)
            (found,) = self._by_forms(k, ("slopes", last.k), [(own["X0"], self._box)], slopes)
            proof = proof.replace(**own, slopes=jax.device_put(slopes[:k]))
            return proof, numbers(found, len(own["directions"]))
        if isinstance(proof, CellCertificate):
            return self._by_cells(k, proof.replace(**own))
        if isinstance(proof, BranchCertificate):
            proof = self._branches(k, proof)
        elif type(proof) is self._by_products(k):
            goals = goals_of(tube.template.at(k), self._step(k - 1, LocalBounds()))
            rows = [goal.rows(tube.loop.states) for goal in goals]
            proof = proof.replace(program=self._program(k, jnp.concatenate(rows), proof.program))
        else:
            raise TypeError(f"{type(proof).__name__} proves no set of this template")
        return proof, np.asarray(proof.recheck())

    def _by_products(self, k: int) -> type[AbstractCertificate]:
        """The kind of certificate that programs give of the parts of the set after `k` steps."""
        facets, ball = self._tube.template.at(k).parts
        if ball is None:
            return Certificate
        return EllipsoidCertificate if facets is None else MixedCertificate

    def _directions(self, k: int) -> Any:
        """The directions of the facets of the set after `k` steps; None of ellipsoids."""
        return getattr(self._tube.template.at(k), "directions", None)

    @cached_property
    def _box(self) -> Any:
        return boxed(self._tube.sets[0], "X0")

    def _by_forms(
        self,
        k: int,
        key: Any,
        parts: Sequence[tuple[AbstractSet, Box]],
        slopes: Float[np.ndarray, "k units"] | None = None,
        most: int = 1,
    ) -> list[ByForms | None]:
        """The forms over each of these parts of the initial set; None where a unit has no bounds.

        Forms of parts that were asked for at the step before go on from there.
        """
        tube, before, self._forms = self._tube, self._forms, {}
        steps = range(1, tube.horizon + 1 if slopes is None else len(slopes) + 1)
        directions = np.stack([np.asarray(self._directions(j)) for j in steps])
        found = list[ByForms | None]()
        for part, box in parts:
            numbers_of, kind = jax.tree.flatten((part, box))
            name = key, kind, *(np.asarray(each).tobytes() for each in numbers_of)
            forms = before.get(name)
            if forms is None or forms.taken > k:
                given: Any = part, box, directions, tube.start, slopes
                forms = before[name] = _Unrolled(unrolled(tube.loop, *given, most=most))
            self._forms[name] = forms
            found.append(forms.at(k))
        return found

    def _by_cells(self, k: int, proof: CellCertificate) -> Again:
        """The proof over cells, each by forms and by what else is said of it."""
        axes = np.asarray(proof.axes).tolist()
        cells = from_tree(self._tube.sets[0], axes)
        wholes = {id(cell.whole): cell.whole for cell in cells}
        parts = [(whole.part, whole.box) for whole in wholes.values()]
        forms = self._by_forms(k, proof.ways, parts, most=proof.ways)
        known, given = dict(zip(wholes, forms, strict=True)), len(proof.directions)
        found = np.stack(
            [over_cell(self._tube.loop, cell, known[id(cell.whole)], given) for cell in cells]
        )
        if not proof.proofs:
            return proof, found.max(axis=0)
        if len(proof.proofs) != len(cells):
            raise ValueError(f"it has {len(cells)} cells, but {len(proof.proofs)} proofs")
        again = list(proof.proofs)
        for number, cell in enumerate(cells):
            if again[number]:
                own, count = self._over(k, number, axes, cell.part), len(again[number])
                if count > k:
                    raise ValueError(f"a cell has {count} proofs after {k} steps")
                found[number] = np.fmin(found[number], own.until(k))
                again[number] = tuple(own.again[k - count : k])
        return proof.replace(proofs=tuple(again)), found.max(axis=0)

    def _over(self, k: int, number: int, axes: list[int], part: AbstractSet) -> Repeat:
        """The propagation up to the step `k` over one of the cells that these axes leave.

        Its proofs begin with a certificate that has those of all steps before.
        """
        tube, leaves = self._tube, dict[int, tuple[AbstractProof, ...]]()
        for step, each in enumerate(tube.certificates):
            if isinstance(each, CellCertificate) and np.asarray(each.axes).tolist() == axes:
                leaves[step] = each.proofs[number] if each.proofs else ()
        first = max((step for step in leaves if step <= k and len(leaves[step]) == step), default=0)
        key = (number, first, *axes)
        if key not in self._within:
            proofs = [None, *leaves.get(first, ())]
            while len(leaves.get(len(proofs), ())) == 1:
                proofs.append(leaves[len(proofs)][0])
            own = _CellTube(tube.loop, tube.template, (part,), tuple(proofs), tube.start)
            self._within[key] = Repeat(own, [part])
        return self._within[key]

    def until(self, k: int) -> Float[np.ndarray, " f"]:
        """The bounds of the step `k` of a cell, whose proofs so far are made again.

        Each step rests on sets as large as the proofs say, or larger where these say too little:
        smaller ones would make other programs of later steps.

        Raises:
            Exception: of any kind: a proof does not fit the tube, or proves nothing.
        """
        while len(self.again) < k:
            step = len(self.again) + 1
            proof, bounds = self.of(step, self._tube.proof(step))
            rested = np.maximum(bounds, np.asarray(proof.bounds))  # NaN where one of them is
            self._sets.append(Polytope(self._directions(step), rested))
            self.again.append(proof.replace(bounds=rested))
        return np.asarray(self._sets[k].facets[1])

    @cached_property
    def _ladder(self) -> Ladder:
        tube = self._tube
        loop, X0, box = jax.device_get((tube.loop, tube.sets[0], self._box))
        scenarios = Scenarios.of(loop, X0, tube.horizon, tube.start)
        return Ladder(loop, X0, box, scenarios, tube.start, 1, ENDLESS)

    def _branches(self, k: int, proof: BranchCertificate) -> BranchCertificate:
        tube, ladder = self._tube, self._ladder
        if proof.time not in (None, tube.start + k):
            raise ValueError(f"it is of states at t = {proof.time}, not {tube.start + k}")
        while (done := len(ladder.horizon.steps)) < k:
            if done:
                ladder.narrow(self._sets[done])
            ladder.repeat(tube.proof(done + 1))
        directions = self._directions(k)
        about = ladder.about(np.asarray(directions) @ ladder.horizon.state)
        products = proof.products
        if products is not None:
            which = np.asarray(proof.by_products)
            program = self._program(k, directions[which], products.program)
            products = products.replace(program=program)
        return proof.replace(about=about, products=products, least=False)

    def _step(self, k: int, relaxation: AbstractRelaxation) -> Step:
        """The step after `k` others, for the bounds of its set and of units over it."""
        setting = Setting(
            self._tube.loop, self._tube.start, relaxation, Auto(), None, False, simulations=None
        )
        return Step(setting, self._sets[k], k, ())

    def _program(self, k: int, directions: Any, said: Program) -> Program:
        """The program of a window that ends after `k` steps, with products that hold in it.

        Raises:
            DisagreementError: an earlier version wrote it, which does not say what it was made of.
            ValueError: it is of another window, or a product does not hold.
        """
        origin = said.origin
        if origin is None:
            raise DisagreementError(
                f"step {k} cannot be rechecked: an earlier version wrote its certificate, which "
                "does not say over how many steps its program is. Call reach again and save that "
                "tube, or load this one without recheck",
                k,
            )
        start, steps, prune, linear, drop = origin
        first = k - steps
        if not (0 <= first < k and start == self._tube.start + first):
            raise ValueError(f"its program begins at t = {start}, and has {steps} steps")
        relaxation = AllProducts(prune) if linear else LocalBounds(remove_stable=prune)
        bounds = AllProducts() if linear else LocalBounds()  # of units, whatever was pruned
        key = origin._replace(steps=0)
        window = self._windows.get(key)
        if window is None or len(window) >= steps:
            begun = self._step(first, LocalBounds())
            given = self._tube.loop, begun.X, begun.box, begun.t
            window = Window.beginning(*given, relaxation, drop)
        while len(window) < steps:
            window = self._step(first + len(window), bounds).added_to(window)
        self._windows[key] = window
        program = window.program(directions, LinearBounds())
        return program.replace(products=holding(said.products, window.layout))


def _next(steps: Iterator[ByForms]) -> ByForms | None:
    """What forms say of the next step; None from the first one on where a unit has no bounds."""
    try:
        return next(steps, None)
    except UnboundedError:
        return None


def holding(products: Products, layout: FactLayout) -> Products:
    """The products themselves, each of which is known not to be negative, or to be zero.

    Raises:
        ValueError: one is not.
    """
    left, right, sign, owner, free = (
        np.asarray(getattr(products, name))
        for name in ("left", "right", "sign", "multiplier", "free")
    )
    pairs = np.sort(np.stack([left, right], axis=1), axis=1)
    zero = {tuple(sorted(pair)) for pair in layout.zero}
    vanishing = np.array([tuple(pair) in zero for pair in pairs.tolist()], bool)
    facts, cone = len(layout.linear), layout.cone_rows
    linear = (pairs[:, 0] >= 0) & (pairs[:, 1] < facts)
    holds = vanishing | linear & (sign == 1) & ~free[owner]
    if len(cone):  # the square of its level less those of its rows, all under one multiplier
        for k in set(owner[~holds].tolist()):
            mine = np.flatnonzero(owner == k)
            squares = (pairs[mine, 0] == pairs[mine, 1]).all()
            rows, signs = pairs[mine, 0].tolist(), sign[mine].tolist()
            expected = {row: 1.0 if row == cone[0] else -1.0 for row in cone}
            whole = len(rows) == len(cone) and dict(zip(rows, signs, strict=True)) == expected
            if squares and whole and not free[k]:
                holds[mine] = True
    if not holds.all():
        one = int(np.argmin(holds))
        raise ValueError(f"its product of facts {left[one]} and {right[one]} may be negative")
    return products
