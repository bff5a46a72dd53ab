"""The paper's form of an ellipsoid, `|A x + b| <= 1`, which programs and solvers speak of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float


class NormalForm(NamedTuple):
    """The ellipsoid `|A x + b| <= 1`, the paper's (there `A` is symmetric).

    Attributes:
        A: `(n, n)`.
        b: `(n,)`.
    """

    A: Float[Array | np.ndarray, "n n"]
    b: Float[Array | np.ndarray, " n"]

    def of(self, inner: NormalForm) -> NormalForm:
        """This form in `x`, given in `y = inner.A x + inner.b`."""
        return NormalForm(self.A @ inner.A, self.A @ inner.b + self.b)

    @property
    def inverse(self) -> NormalForm:
        """`x = A^-1 y - A^-1 b`."""
        inverse = np.linalg.inv(self.A)
        return NormalForm(inverse, -inverse @ self.b)
