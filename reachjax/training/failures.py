"""Steps at which no program was solved: skipped, and counted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reachjax.numerics.checks import described, is_concrete

if TYPE_CHECKING:
    import optax

FOREVER = 2**31 - 1
"""So many failed steps in a row are skipped: all of them (optax counts in 32 bits)."""


def skip_failures(
    optimizer: optax.GradientTransformation,
) -> optax.GradientTransformation:
    """An optimiser that skips, and counts, the steps whose gradient is not finite.

    At such a step weights and optimiser state stay as they are. `failures(state)` is the count.

    Args:
        optimizer: any optax optimiser.

    Raises:
        ImportError: optax is not installed.
        TypeError: the optimiser is not one of optax.

    Example:
        >>> import jax.numpy as jnp
        >>> import optax
        >>> optimizer = skip_failures(optax.sgd(0.1))
        >>> state = optimizer.init(jnp.zeros(2))
        >>> updates, state = optimizer.update(jnp.array([1.0, jnp.nan]), state)
        >>> updates.tolist(), failures(state)
        ([0.0, 0.0], 1)
    """
    try:
        import optax
    except ImportError:
        raise ImportError(
            'skip_failures wraps optax optimisers: pip install "reachjax[training]"'
        ) from None
    if not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise TypeError(
            "optimizer must be an optax optimiser, such as optax.adam(1e-3), "
            f"but {described(optimizer)} arrived"
        )
    return optax.apply_if_finite(optimizer, max_consecutive_errors=FOREVER)


def failures(state: Any) -> int:
    """How many steps an optimiser wrapped by `skip_failures` has skipped.

    Args:
        state: the optimiser's state, alone or inside another one's; where several are wrapped, or
            a batch is trained, the sum.

    Raises:
        ValueError: the state is not that of such an optimiser, or stands for one in `jax.jit`.

    Example:
        >>> import jax.numpy as jnp
        >>> import optax
        >>> failures(skip_failures(optax.adam(1e-3)).init(jnp.zeros(2)))
        0
    """
    from optax import tree_utils

    counts = [count for _, count in tree_utils.tree_get_all_with_path(state, "total_notfinite")]
    if not counts:
        raise ValueError(
            "state must be that of an optimiser wrapped by skip_failures, "
            f"but {described(state)} without a count arrived"
        )
    if not is_concrete(counts):
        raise ValueError("state must hold numbers: call failures(state) outside jax.jit")
    return int(sum(np.sum(count) for count in counts))
