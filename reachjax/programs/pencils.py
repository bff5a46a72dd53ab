"""The matrix inequality of a goal, with what is sought among its unknowns.

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
from jaxtyping import Array, Float

from reachjax.programs.lmi import Program
from reachjax.programs.presolve import Generators, NormalProgram


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
