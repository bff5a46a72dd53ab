"""The barrier function of a facet.

    f(y) = b - mu (log det Z + ...),    Z = 2 b e e' - p e' - e p' - sum_k y_k G_k,

with an objective row `p` of 2-norm 1 at most and without a constant (`barrier` has the rest).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from reachjax.programs.compact import CompactProgram
from reachjax.programs.pairs import Pairs
from reachjax.solvers.barrier import AbstractBarrier


class FacetBarrier(AbstractBarrier):
    """The function of this module, of `[multipliers, t, b]`.

    Args:
        program: of which this is one facet.
        facet: its number.
    """

    def __init__(self, program: CompactProgram, facet: int):
        n, row = program.objective.shape[1], program.objective[facet]
        e, zero = np.eye(n)[-1:], np.zeros(1, dtype=int)
        corner = Pairs(e, left=zero, right=zero, sharing=sp.csr_array([[2.0]]))
        super().__init__(program, corner, -np.outer(row, e) - np.outer(e, row), float(n))
        self.cost[-1] = 1.0

    def inside(self) -> np.ndarray:
        """A point inside: a large `t` and a larger offset."""
        y, t = np.zeros(self.others.stop), 4.0
        y[self.signed] = t / (4 * self.spread)
        y[self.count] = t
        y[-1] = t * self.n / 2
        return y
