"""Functions of arrays that numpy and `jax.numpy` both have, by the kind of their arguments.

A file's function is traced by JAX, and evaluated in numpy before that: in 64 bits whatever JAX's
flags are, and without compiling anything. Points are where
it is evaluated.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

SCALES = (0.0, 1e-2, 0.3, 1.0, 1.0, 3.0, 30.0)
"""Sizes of the entries of a point. A scaler may expect large inputs, a logarithm small ones."""


def points(inputs: int) -> list[np.ndarray]:
    """Points of several sizes, in both orthants that have no mixed signs and at random."""
    rng = np.random.default_rng(0)
    drawn = [scale * rng.uniform(0.1, 1, inputs) for scale in SCALES]
    signs = [rng.choice([-1.0, 1.0], inputs) for _ in SCALES]
    return [*drawn, *(-x for x in drawn[1:]), *(s * x for s, x in zip(signs, drawn, strict=True))]


def require_finite(function: Callable[[Any], Any], inputs: int) -> list[np.ndarray]:
    """Raise an error where a function is finite at none of the points; else those where it is.

    Raises:
        ValueError: there are none.
    """
    with np.errstate(all="ignore"):
        found = [x for x in points(inputs) if np.isfinite(function(x)).all()]
    if not found:
        raise ValueError(
            "its output is finite at none of the points at which it was evaluated: numbers in it "
            "are out of the domain of their functions, or divided by zero"
        )
    return found


def over(*operands: Any) -> Any:
    """The module `jax.numpy`, or numpy if all operands are numpy's."""
    return np if all(isinstance(each, np.ndarray | np.generic) for each in operands) else jnp


def sigmoid(y: Any) -> Any:
    """The logistic function `1 / (1 + exp(-y))`."""
    return scipy.special.expit(y) if over(y) is np else jax.nn.sigmoid(y)


def erf(y: Any) -> Any:
    """The error function."""
    return scipy.special.erf(y) if over(y) is np else jax.lax.erf(y)


def softplus(y: Any) -> Any:
    """The softplus `log(1 + exp(y))`."""
    return np.logaddexp(y, 0.0) if over(y) is np else jax.nn.softplus(y)


def softmax(y: Any, axis: Any) -> Any:
    """The exponentials over their sum along an axis, or along several."""
    return (scipy.special if over(y) is np else jax.nn).softmax(y, axis=axis)


def log_softmax(y: Any, axis: Any) -> Any:
    """The logarithm of `softmax`."""
    return (scipy.special if over(y) is np else jax.nn).log_softmax(y, axis=axis)


def logsumexp(y: Any, axis: Any, keepdims: bool) -> Any:
    """The logarithm of the sum of exponentials along axes."""
    module = scipy.special if over(y) is np else jax.scipy.special
    return module.logsumexp(y, axis=axis, keepdims=keepdims)
