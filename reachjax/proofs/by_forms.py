"""Proofs of facets by affine forms, over the initial set or over each cell of it."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.units import UnboundedError
from reachjax.numerics.checks import floats_of, require_double_precision
from reachjax.numerics.pytrees import pytree, static
from reachjax.programs.unrolled import ByForms, subbox_columns, unrolled
from reachjax.proofs.certificates import AbstractProof, told
from reachjax.sets import AbstractSet, Box
from reachjax.sets.cells import Cell, from_tree


@pytree
class LinearCertificate(AbstractProof):
    """Proof of the offsets of one step, `directions x[t] <= bounds`, by affine forms from `X0`.

    What it rests on are the slopes of the lines that stand for the units: they and the loop are all
    that the forms are made of.

    Attributes:
        loop: the closed loop.
        X0: the initial set, or one around it that forms are bounded over without programs.
        directions: `(f, n_x)`, of the facets.
        slopes: `(k, units)`, of the units at each time before.
        corners: `(f, n_x)`, initial states at which the forms are largest.
        k: how many steps after the initial set.
        start: the time of the initial set.
    """

    loop: ClosedLoop
    X0: AbstractSet
    directions: Float[Array | np.ndarray, "f n_x"]
    slopes: Float[Array | np.ndarray, "k units"]
    corners: Float[Array | np.ndarray, "f n_x"]
    k: int = static()
    start: int = static()

    def __repr__(self) -> str:
        return f"LinearCertificate(facets={len(self.bounds)}, steps={self.k})"

    def recheck(
        self, slopes: Float[np.ndarray, "k units"] | None = None
    ) -> Float[np.ndarray, " f"]:
        """Prove the offsets anew, step by step from the initial set, with these or other slopes.

        Sound for any slopes: where two lines of this slope must lie to hold a unit between them is
        found again on the intervals that are proved on the way. Infinite where they overflow, or
        where a unit has no bounds on them.

        Raises:
            ValueError: the slopes contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template
            >>> from reachjax import LinearBounds, reach
            >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
            >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)
            >>> tube = reach(loop, Box([-1.0], [2.0]), 2, Template.box(1), LinearBounds())
            >>> proof = tube.proof(2)
            >>> bool((proof.recheck() == proof.bounds).all())
            True
            >>> bool((proof.recheck(-3 * proof.slopes) >= [0.72, 0.36]).all())
            True
        """
        require_double_precision(certificate=floats_of(self))
        chosen = np.asarray(self.slopes if slopes is None else slopes)
        if chosen.shape != self.slopes.shape or not np.isfinite(chosen).all():
            raise ValueError(
                f"slopes must be finite and have shape {self.slopes.shape} (steps, units), "
                f"but {chosen.shape} arrived, {np.isfinite(chosen).sum()} of them finite"
            )
        directions = np.broadcast_to(self.directions, (self.k, *self.directions.shape))
        box = self.X0.bounding_box()
        last = _last(self.loop, self.X0, box, directions, self.start, chosen)
        return numbers(last, len(self.directions))


def _last(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[np.ndarray, "k f n_x"],
    start: int,
    slopes: Float[np.ndarray, "k units"] | None = None,
    most: int = 1,
) -> ByForms | None:
    """What forms say of the last step; None where a unit has no bounds."""
    try:
        *_, last = unrolled(loop, X0, box, directions, start, slopes, most=most)
    except UnboundedError:
        return None
    return last


def over_cell(
    loop: ClosedLoop, cell: Cell, found: ByForms | None, facets: int
) -> Float[np.ndarray, " f"]:
    """The offsets that forms over a cell prove of it, or those over what it is a part of."""
    source = cell.source
    if found is not None and source is not None:
        found = found.over_part(subbox_columns(loop, source.part, source.box, cell.box))
    return numbers(found, facets)


def numbers(found: ByForms | None, facets: int) -> Float[np.ndarray, " f"]:
    """The offsets that forms prove; infinite where they overflow or a unit has no bounds."""
    if found is None:
        return np.full(facets, np.inf)
    return np.where(np.isnan(found.offsets), np.inf, found.offsets)


@pytree
class CellCertificate(AbstractProof):
    """Proof of the offsets of one step, `directions x[t] <= bounds`, over cells of `X0`.

    The cells are what halving the box around the initial set again and again leaves, so that they
    cover it whatever they are. Of each, forms are made of nothing but the loop; what proves more of
    some cells is kept.

    Attributes:
        loop: the closed loop.
        X0: the initial set.
        directions: `(f, n_x)`, of the facets.
        axes: `(nodes,)`, along which coordinate each part is halved, the initial set first and each
            half with all of its own before the next; -1 where it is a cell. Of a cell with -2, -3,
            ... nothing but what forms over the part 1, 2, ... halvings before say of it is used.
        k: how many steps after the initial set.
        start: the time of the initial set.
        proofs: for each cell what proves more than forms: the proof of this step, behind those of
            steps before that no certificate has; nothing where forms prove all, and nothing at all
            if that is so of all cells.
        ways: along how many ways of its decisions a loop that jumps was followed over a cell.
    """

    loop: ClosedLoop
    X0: AbstractSet
    directions: Float[Array | np.ndarray, "f n_x"]
    axes: Int[Array | np.ndarray, " nodes"]
    k: int = static()
    start: int = static()
    proofs: tuple[tuple[AbstractProof, ...], ...] = ()
    ways: int = static(default=1)

    def __repr__(self) -> str:
        return (
            f"CellCertificate(facets={len(self.bounds)}, cells={self.cells}, steps={self.k}, "
            f"ended: {told(self.ends)})"
        )

    @property
    def cells(self) -> int:
        """How many there are."""
        return int(np.sum(np.asarray(self.axes) < 0))

    def recheck(self, axes: Int[np.ndarray, " nodes"] | None = None) -> Float[np.ndarray, " f"]:
        """Prove the offsets anew, cell by cell, or by forms over other cells.

        Infinite where numbers overflow, or where a unit has no bounds over a cell.

        Raises:
            ValueError: the axes are no tree: its cells would leave something out.

        Example:
            >>> import jax.numpy as jnp
            >>> from reachjax import Box, ClosedLoop, Network, NonlinearPlant, Template, reach
            >>> plant = NonlinearPlant(lambda x, u: x + 0.1 * jnp.sin(x) + u, states=1, inputs=1)
            >>> loop = ClosedLoop(plant, Network(lambda x: -jnp.tanh(x), inputs=1, outputs=1))
            >>> proof = reach(loop, Box([0.0], [1.0]), 2, Template.box(1)).proof(2)
            >>> bool((proof.recheck() == proof.bounds).all())
            True
            >>> bool((proof.recheck([-1]) >= proof.bounds).all())  # one cell
            True
        """
        require_double_precision(certificate=floats_of(self))
        given = np.asarray(self.axes if axes is None else axes).tolist()
        directions = np.broadcast_to(self.directions, (self.k, *self.directions.shape))
        cells, proofs = from_tree(jax.device_put(self.X0), given), self.proofs
        if axes is not None or not proofs:
            proofs = ((),) * len(cells)
        found, sources = [], dict[int, ByForms | None]()
        for cell, own in zip(cells, proofs, strict=True):
            bounds = self._over(cell, directions, sources)
            found.append(np.fmin(bounds, own[-1].recheck()) if own else bounds)
        return np.max(found, axis=0)

    def _over(
        self,
        cell: Cell,
        directions: Float[np.ndarray, "k f n_x"],
        sources: dict[int, ByForms | None],
    ) -> Float[np.ndarray, " f"]:
        """What forms over a cell prove, or those over what it is a part of, which are kept."""
        source = cell.whole
        known = sources.get(id(source))
        if id(source) not in sources:
            given = self.loop, source.part, source.box, directions, self.start
            known = _last(*given, most=self.ways)
        if cell.source is not None:
            sources[id(source)] = known
        return over_cell(self.loop, cell, known, directions.shape[1])
