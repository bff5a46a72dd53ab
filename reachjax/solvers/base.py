"""What a solver is: from a program to a proposal."""

from __future__ import annotations

import abc
import dataclasses
import numbers
from typing import Any

from reachjax.programs.lmi import Program
from reachjax.proofs.proposal import Enclosure, Solution
from reachjax.sets import NormalForm
from reachjax.solvers.faults import UnsupportedError


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
    """Solves the programs of one step. Hashable and immutable: its options are its fields.

    `solve` is all that one needs; nothing that it does breaks a bound. An exception, or an answer
    that is no `Solution` of the right shapes, is a failed proposal and gives a warning.
    """

    @abc.abstractmethod
    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet of a program whose leaves are numpy arrays."""

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        Args:
            program: whose leaves are numpy arrays and whose objective rows are the successor's.
            form: the ellipsoid up to a factor on `A` and `b`; free if it is None.

        Raises:
            NotImplementedError: this solver does not know ellipsoids.
        """
        raise UnsupportedError(f"{type(self).__name__} solves for facets, not for ellipsoids")
