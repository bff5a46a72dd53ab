"""Layers of a network `(W, b)` with `W` `(out, in)`, as the experiments train and keep them."""

from jaxtyping import Float
from numpy import ndarray

Layers = list[tuple[Float[ndarray, "out in"], Float[ndarray, " out"]]]
