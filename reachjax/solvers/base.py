"""What a solver takes and gives back.

Whatever the status, a solution is only a proposal: bounds come from `recheck`. A solver that fails
proposes zero multipliers, which prove the interval bound and no more.
"""

from __future__ import annotations

import abc
import dataclasses
import enum
import numbers
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.lmi import Program
from reachjax.sets import NormalForm
from reachjax.solvers.host import all_finite, on_host, shapes_of


class SolverStatus(enum.IntEnum):
    """How a solver ended. "Almost solved" is not solved, and "solved" is not proof."""

    SOLVED = 0
    INACCURATE = 1
    INFEASIBLE = 2
    UNBOUNDED = 3
    LIMIT = 4
    FAILED = 5

    @property
    def advice(self) -> str:
        """One sentence on what this means and what to do."""
        return _ADVICE[self]


ANSWERS = (SolverStatus.SOLVED, SolverStatus.INACCURATE)
"""The ends after which there is a proposal."""

_ADVICE = {
    SolverStatus.SOLVED: "solved to the tolerance asked for",
    SolverStatus.INACCURATE: "the tolerance was not reached: the bound is sound, perhaps loose; "
    "ask for a looser tolerance or try another solver",
    SolverStatus.INFEASIBLE: "reported infeasible, which a bounded set rules out: the data are "
    "badly scaled for this solver; the interval bound was used",
    SolverStatus.UNBOUNDED: "reported unbounded: the set of states is empty, or a shape was given "
    "and all successors are one point; the interval bound was used",
    SolverStatus.LIMIT: "stopped at the limit of iterations or time: the bound is sound, perhaps "
    "loose; raise the limit",
    SolverStatus.FAILED: "broke down without an answer: the interval bound was used; "
    "try another solver or relaxation",
}


class Solution(NamedTuple):
    """What a solver proposes for the facets of one program; arrays only.

    Attributes:
        offsets: `(f,)`, its own optimal values, NaN where it has none. Not bounds.
        multipliers: `(f, K)`, zero where it has none.
        moments: `(f, n, n)`, the dual matrices over the scaled basis with corner 1, NaN where
            it has none.
        statuses: `(f,)`, values of `SolverStatus`.
        seconds: `(f,)`, wall time of each facet.
    """

    offsets: Float[Array | np.ndarray, " f"]
    multipliers: Float[Array | np.ndarray, "f K"]
    moments: Float[Array | np.ndarray, "f n n"]
    statuses: Int[Array | np.ndarray, " f"]
    seconds: Float[Array | np.ndarray, " f"]

    @classmethod
    def blank(cls, facets: int, multipliers: int, size: int) -> Solution:
        """No proposal yet: zero multipliers, everything else missing."""
        return cls(
            offsets=np.full(facets, np.nan),
            multipliers=np.zeros((facets, multipliers)),
            moments=np.full((facets, size, size), np.nan),
            statuses=np.full(facets, int(SolverStatus.FAILED)),
            seconds=np.zeros(facets),
        )


class Enclosure(NamedTuple):
    """What a solver proposes for an ellipsoid around the successors; arrays only.

    Attributes:
        form: `A (q, q)` and `b (q,)`: it proposes `|A x + b| <= 1`; NaN where it has none.
        multipliers: `(K,)`, zero where it has none.
        moments: `(n + q, n + q)`, the dual matrix of the Schur complement over the scaled basis,
            NaN where it has none.
        status: a value of `SolverStatus`.
        seconds: wall time.
    """

    form: NormalForm
    multipliers: Float[Array | np.ndarray, " K"]
    moments: Float[Array | np.ndarray, "n+q n+q"]
    status: Int[Array | np.ndarray, ""]
    seconds: Float[Array | np.ndarray, ""]

    @classmethod
    def blank(cls, program: Program) -> Enclosure:
        """No proposal yet: zero multipliers, everything else missing."""
        q, n = program.objective.mid.shape
        return cls(
            form=NormalForm(np.full((q, q), np.nan), np.full(q, np.nan)),
            multipliers=np.zeros(program.products.free.shape[0]),
            moments=np.full((n + q, n + q), np.nan),
            status=np.array(int(SolverStatus.FAILED)),
            seconds=np.array(0.0),
        )


def require_positive(solver: Any) -> None:
    """Check that every option of a solver is a positive number.

    Raises:
        TypeError: one is no number.
        ValueError: one is not positive.
    """
    for field in dataclasses.fields(solver):
        value: Any = getattr(solver, field.name)
        name = f"{type(solver).__name__}.{field.name}"
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise TypeError(f"{name} must be a number, but {value!r} arrived")
        if not float(value) > 0:
            raise ValueError(f"{name} must be positive, but {value!r} arrived")


class AbstractSolver(abc.ABC):
    """Solves the programs of one step. Hashable and immutable: its options are its fields."""

    @abc.abstractmethod
    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet of a program whose leaves are numpy arrays."""

    def propose(self, program: Program) -> Solution:
        """Propose multipliers for every facet of a program of JAX arrays, traced ones too.

        A solver that runs in numpy is called on the host; one that is written in JAX says here how
        it is traced, since no JAX call may be made from a callback. A program that holds NaN or
        infinity gets a blank proposal.
        """
        facets, size = program.objective.mid.shape
        blank = Solution.blank(facets, len(program.products.free), size)

        def solve(program: Program) -> Solution:
            return self.solve(program) if all_finite(program) else blank

        return on_host(solve, shapes_of(blank), program)

    @property
    def for_rounds(self) -> AbstractSolver:
        """What solves programs to which products are added round by round."""
        return self

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        Args:
            program: whose leaves are numpy arrays and whose objective rows are the successor's.
            form: the ellipsoid up to a factor on `A` and `b`; free if it is None.

        Raises:
            NotImplementedError: this solver does not know ellipsoids.
        """
        raise NotImplementedError(f"{type(self).__name__} solves for facets, not for ellipsoids")
