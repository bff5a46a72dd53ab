"""Switched controllers, and choices that anybody may make.

Both are functions of JAX: which controller acts is a place, such as `jnp.argmax` of the entries of
a state that hold the last decision, and a disturbance chooses among some vectors by the largest of
as many numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from reachjax.loops.networks import AbstractNetwork, Network
from reachjax.numerics.checks import Numbers, described, same_size


def Switched(  # noqa: N802  (it stands for a network)
    controllers: Sequence[AbstractNetwork], by: Callable[[Array], Array]
) -> Network:
    """The network that is one of several, whichever the state says.

    Over states of which it is known which one acts, the others are not looked at. Where it is not
    known, all that may act are followed.

    Args:
        controllers: networks of as many inputs, and as many outputs.
        by: the place among them of the one that acts, a function of JAX of what the controller is
            given: `lambda x: jnp.argmax(x[2:])`, or `lambda x: (x[0] > 1.0).astype(int)`.

    Raises:
        TypeError: a controller is none, or `by` is no function.
        ValueError: there are no controllers, or they have different sizes.

    Example:
        >>> from reachjax import MLP
        >>> slow, fast = (MLP.from_layers([([[gain]], [0.0])]) for gain in (-0.5, -2.0))
        >>> net = Switched([slow, fast], by=lambda x: (jnp.abs(x[0]) > 1.0).astype(int))
        >>> net([0.5]).tolist(), net([2.0]).tolist()
        ([-0.25], [-4.0])
    """
    given = tuple(controllers)
    if not given:
        raise ValueError("Switched.controllers must be networks, but none arrived")
    for each in given:
        if not isinstance(each, AbstractNetwork):
            raise TypeError(
                f"Switched.controllers must be networks, but {described(each)} arrived: an "
                "rj.Network makes one of a function"
            )
    if not callable(by):
        raise TypeError(f"Switched.by must be a function, but {described(by)} arrived")
    for each in given[1:]:
        for name in ("inputs", "outputs"):
            same_size(
                f"the first controller's number of {name} is",
                f"the number of {name} of another one is",
                (getattr(given[0], name), getattr(each, name)),
            )

    def acting(nets: tuple[AbstractNetwork, ...], x: Array) -> Array:
        return jax.lax.switch(by(x), [net.__call__ for net in nets], x)

    function = jax.tree_util.Partial(acting, given)
    return Network(function, given[0].inputs, given[0].outputs)


def one_of(options: Float[ArrayLike, "m n"], w: Float[ArrayLike, " m"]) -> Any:
    """The option whose number is the largest: any of them, if `w` is anything in a box.

    Of a plant with a disturbance in `Box(zeros(m), ones(m))` a person or a pilot may take any of
    `m` options at each step: the worst case is certified.

    Args:
        options: vectors.
        w: as many numbers as there are options.

    Example:
        >>> one_of([[-1.0], [0.0], [1.0]], jnp.array([0.2, 0.9, 0.1])).tolist()
        [0.0]
    """
    options = Numbers("(m, n)")(options, "options")
    same_size("the number of options is", "that of w is", (len(options), jnp.shape(w)[0]))
    return options[jnp.argmax(jnp.asarray(w))]
