"""Failures in a training loop: steps without a gradient, skipped and counted; unsolved programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from reachjax.numerics.checks import described, is_concrete, whole_number
from reachjax.numerics.host import on_host
from reachjax.proofs.proposal import AS_ASKED
from reachjax.tubes.reach import ReachTube

if TYPE_CHECKING:
    import optax

FOREVER = 2**31 - 1
"""So many failed steps in a row optax skips: all of them (it counts in 32 bits)."""


def skip_failures(
    optimizer: optax.GradientTransformation, limit: int | None = 10
) -> optax.GradientTransformationExtraArgs:
    """An optimiser that skips, and counts, the steps whose gradient is not finite.

    At such a step weights and optimiser state stay as they are. `failures(state)` is the count.

    Where the loss is the same at every step, so are the weights after a step that is skipped, and
    all later steps are skipped too. So more than `limit` of them in a row are an error: a
    `RuntimeError`, and where the step is compiled JAX's own error with the same message
    (`ValueError` or `jax.errors.JaxRuntimeError`), raised when what the step returns is waited for
    or handed to the next one.

    Args:
        optimizer: any optax optimiser.
        limit: how many steps in a row may be skipped; None for any number.

    Raises:
        ImportError: optax is not installed.
        TypeError: the optimiser is not one of optax, or the limit is no whole number.
        ValueError: the limit is negative.

    Example:
        >>> import jax.numpy as jnp
        >>> import optax
        >>> optimizer = skip_failures(optax.sgd(0.1))
        >>> state = optimizer.init(jnp.zeros(2))
        >>> updates, state = optimizer.update(jnp.array([1.0, jnp.nan]), state)
        >>> updates.tolist(), failures(state)
        ([0.0, 0.0], 1)
    """
    optax = optax_or_error("skip_failures")
    skipping = optax.apply_if_finite(require_optimizer(optimizer), max_consecutive_errors=FOREVER)
    if limit is None:
        return skipping
    limit = whole_number("limit", limit, 0)

    def update(updates, state, params=None, **extra_args):
        found: Any = skipping.update(updates, state, params, **extra_args)
        updates, state = found
        # the state holds what the check returns, so that no compiler can leave the check out
        return updates, state._replace(notfinite_count=_checked(limit, state.notfinite_count))

    return optax.GradientTransformationExtraArgs(skipping.init, update)


def optax_or_error(name: str) -> Any:
    """The module `optax`, for a function of this name.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import optax
    except ImportError:
        raise ImportError(
            f'{name} takes optax optimisers: pip install "reachjax[training]"'
        ) from None
    return optax


def require_optimizer(optimizer: Any) -> Any:
    """An optimiser, if it is one of optax.

    Raises:
        TypeError: it is none.
    """
    if not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise TypeError(
            "optimizer must be an optax optimiser, such as optax.adam(1e-3), "
            f"but {described(optimizer)} arrived"
        )
    return optimizer


def _checked(limit: int, count: Array) -> Array:
    """The count of skipped steps in a row, if it is within the limit.

    Raises:
        RuntimeError: it is beyond.
    """

    def check(count):
        if np.max(count) > limit:
            raise RuntimeError(_stuck(int(np.max(count))))
        return np.asarray(count)

    return on_host(check, jax.ShapeDtypeStruct(count.shape, count.dtype), count)


def _stuck(count: int) -> str:
    return (
        f"the last {count} steps had no finite gradient and were skipped, so the weights no longer "
        "change. A gradient is NaN where there is no bound: sets are empty, unbounded or overflow, "
        "because the weights went astray. Go on from earlier weights with a smaller learning rate, "
        "clip gradients (optax.clip_by_global_norm), give the loop an input_box, or look at "
        "reach(...) of these weights outside jax.jit, whose error says what is wrong. "
        "skip_failures(optimizer, limit=...) allows more steps in a row"
    )


def failures(state: Any) -> int:
    """How many steps an optimiser wrapped by `skip_failures` has skipped.

    A step whose gradient is that of a bound is not skipped, however its programs ended: `unsolved`
    counts these.

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


def unsolved(tube: ReachTube) -> Int[Array, ""]:
    """How many of a tube's bounds are not as tight as was asked for, also inside `jax.jit`.

    Programs that were not solved to tolerance, and facets whose gap was not closed in time or by
    the budget: all whose `SolverStatus` is neither `SOLVED` nor, of `LinearBounds`, `AFFINE_FORM`.

    Their bounds hold and have gradients, but they are looser than they might be. A loss that
    returns this beside its value (`jax.value_and_grad(loss, has_aux=True)`) says how often solvers
    failed in a training run.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach
        >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
        >>> int(unsolved(reach(loop, Box([1.0], [2.0]), 2, Template.box(1))))
        0
    """
    codes = [tube.proof(t).codes for t in range(1, len(tube.sets))]
    as_asked = jnp.asarray(AS_ASKED)
    return sum((jnp.sum(~jnp.isin(code, as_asked)) for code in codes), start=jnp.zeros((), int))
