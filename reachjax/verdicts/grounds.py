"""What a verdict rests on, in so far as a search found it: enough to prove it anew without one.

A proof is one of each leaf of a tree of cells. Over a leaf forms are unrolled, perhaps several
times: as they are, or with ranges of units that linear programs tightened. Of these programs, and
of those that bound requirements, the multipliers are kept. Nothing here has to be believed: any
multipliers are sound, and any tree of cells covers the set (`rechecks`).

Where states come into a set halfway, there are two proofs, and the set between them: what either
has to prove follows from the set (`halfway`), and is not kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
from reachjax.proofs.branches import Branches
from reachjax.sets import AbstractSet, PolyhedralSet
from reachjax.verdicts.specification import Requirement

Key = tuple[str, int]
"""The name and the time of a requirement."""

LARGEST = 2**27
"""A matrix of more entries than a gigabyte holds is none of a step's."""


class Asked(NamedTuple):
    """What a verdict is about.

    Attributes:
        loop: the closed loop.
        X0: the initial set.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements, each at its time.
    """

    loop: ClosedLoop
    X0: AbstractSet
    horizon: int
    start: int
    required: tuple[Requirement, ...]


class Multipliers(NamedTuple):
    """A matrix of multipliers, most of which are zero.

    Attributes:
        rows: `(k,)`, of those that are not.
        columns: `(k,)`.
        values: `(k,)`.
        shape: of the matrix.
    """

    rows: Int[np.ndarray, " k"]
    columns: Int[np.ndarray, " k"]
    values: Float[np.ndarray, " k"]
    shape: tuple[int, int]

    @classmethod
    def of(cls, matrix: Float[np.ndarray, "r m"]) -> Multipliers:
        """The entries of a matrix that are not zero."""
        rows, columns = np.nonzero(matrix)
        return cls(rows, columns, matrix[rows, columns], (matrix.shape[0], matrix.shape[1]))

    @property
    def matrix(self) -> Float[np.ndarray, "r m"]:
        """The matrix.

        Raises:
            ValueError: an entry is outside.
        """
        rows, columns = self.shape
        inside = (self.rows >= 0) & (self.rows < rows)
        inside &= (self.columns >= 0) & (self.columns < columns)
        if not inside.all() or rows * columns > LARGEST:
            raise ValueError("multipliers have entries outside of their matrix")
        found = np.zeros((rows, columns))
        found[self.rows, self.columns] = self.values
        return found


class Leaves(NamedTuple):
    """The branches by which a requirement is proved.

    Attributes:
        name: of the requirement.
        time: of the requirement.
        branches: over the columns of the horizon.
    """

    name: str
    time: int
    branches: Branches


class Climb(NamedTuple):
    """Forms unrolled over a part of the initial set, with what was proposed along the way.

    Attributes:
        ranges: of each step, multipliers that tighten ranges of its units, in the order in which
            they are asked for.
        leaves: of requirements that forms alone do not prove.
    """

    ranges: tuple[tuple[Multipliers, ...], ...] = ()
    leaves: tuple[Leaves, ...] = ()


class Grounds(NamedTuple):
    """Which cells an initial set is cut into, and what proves the requirements over each.

    Attributes:
        counts: equal parts of each coordinate to begin with; none for the whole set.
        axes: of each of these, along which coordinates it and its parts are halved, as `Node.axes`
            has them.
        climbs: of each cell that is left, in their order; none where forms alone prove all.
    """

    counts: tuple[int, ...] = ()
    axes: tuple[tuple[int, ...], ...] = ((-1,),)
    climbs: tuple[tuple[Climb, ...], ...] = ((),)


class Closing(NamedTuple):
    """A set that states come into, and what proves either part of the horizon.

    Attributes:
        step: when all states are in the set.
        region: the set.
        period: after how many steps states from it are in it again, and what is required later is
            proved at each of them; 0 where it is proved from the set on until the horizon.
        before: what proves the requirements until that step, and that all states are in the set.
        after: what proves the requirements of the states from the set.
    """

    step: int
    region: PolyhedralSet
    period: int
    before: Grounds | Closing
    after: Grounds | Closing


class ClimbRecord:
    """A climb as it is made."""

    def __init__(self):
        self._ranges = list[tuple[Multipliers, ...]]()
        self._leaves = list[Leaves]()
        self._proved = False

    def advanced(self, tightened: Sequence[np.ndarray]) -> None:
        """Note one step more, and the multipliers that tightened ranges of its units."""
        self._ranges.append(tuple(map(Multipliers.of, tightened)))

    def proved(self, item: Requirement, branches: Branches | None) -> None:
        """Note a requirement that is proved, by branches or by forms alone."""
        self._proved = True
        if branches is not None:
            self._leaves.append(Leaves(item.name, item.time, branches))

    @property
    def climb(self) -> Climb | None:
        """The climb, if it proved anything."""
        if not self._proved:
            return None
        return Climb(tuple(self._ranges), tuple(self._leaves))
