"""Functions of arrays that numpy and `jax.numpy` both have, by the kind of their arguments.

A file's function is traced by JAX, and evaluated in numpy before that: in 64 bits whatever JAX's
flags are, and without compiling anything.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special


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
