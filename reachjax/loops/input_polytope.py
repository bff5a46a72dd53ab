"""A polytope of inputs whose normals are part of a loop's structure."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.units import ProjectionSlack
from reachjax.loops.units.active_sets import Normals, active_sets, has_points
from reachjax.numerics.checks import is_concrete, require_kind
from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.sets import Box, Polytope


@pytree
class InputPolytope(Replaceable):
    """The polytope `C u <= d`, of which the offsets `d` alone are numbers of a loop.

    Which facets can be active together depends on the normals: another `C` compiles anew, and
    nothing has a derivative in it.

    Attributes:
        normals: `C`, `r` rows of `n` numbers.
        offsets: `d` `(r,)`.

    Example:
        >>> kept = InputPolytope.of(Polytope([[1.0, 2.0], [-1.0, 0.0]], [1.0, 0.0]))
        >>> kept.normals, kept.offsets.tolist()
        (((1.0, 2.0), (-1.0, 0.0)), [1.0, 0.0])
    """

    normals: Normals = static()
    offsets: Float[Array, " r"]

    def __post_init__(self):
        self._check()

    @classmethod
    def of(cls, polytope: Polytope) -> InputPolytope:
        """The inputs of a polytope; a facet that is there more than once is kept once.

        Raises:
            TypeError: the normals are traced.
            ValueError: the polytope is empty, or has too many facets.
        """
        if not is_concrete(polytope.A):
            raise TypeError(
                "ClosedLoop.input_box must have normals Polytope.A that are numbers, but traced "
                "ones arrived: which facets can be active together depends on them. Its offsets "
                "may be traced: inside jax.jit, take a loop that was built outside and replace "
                "loop.input_box.offsets, or give normals as an array of JAX's"
            )
        with jax.ensure_compile_time_eval():
            C = np.asarray(polytope.A)
        _, first, group = np.unique(C, axis=0, return_index=True, return_inverse=True)
        offsets = polytope.b
        if len(first) < len(C):
            order = np.argsort(np.argsort(first))
            offsets = jax.ops.segment_min(offsets, order[group.reshape(-1)], len(first))
            C = C[np.sort(first)]
        return cls(tuple(map(tuple, C.tolist())), offsets)

    @property
    def dimension(self) -> int:
        """The number of inputs."""
        return len(self.normals[0])

    @property
    def steps(self) -> None:
        """No number of steps: the polytope is the same at all times."""
        return None

    @property
    def polytope(self) -> Polytope:
        """The set of inputs."""
        return Polytope(np.array(self.normals), self.offsets)

    def _check(self) -> None:
        """Raise an error if there are too many facets, or no point satisfies all."""
        known = is_concrete(self.offsets)
        offsets = np.asarray(self.offsets) if known else np.zeros(len(self.normals))
        scaled = ProjectionSlack.scaled(self.normals, offsets)
        nearly = active_sets(scaled.normals).faces(scaled.offsets).any()
        if known and not has_points(scaled.normals, scaled.offsets):
            by = ", if only by rounding: enlarge its offsets b" if nearly else ""
            raise ValueError(
                "ClosedLoop.input_box must hold an input, but the polytope A u <= b that arrived "
                f"is empty{by}"
            )


def input_set(
    value: Box | Polytope | InputPolytope | None, name: str = "input_box"
) -> Box | InputPolytope | None:
    """What a loop keeps of a set of inputs.

    Raises:
        TypeError: it is of another kind.
    """
    if isinstance(value, InputPolytope):
        return value
    kinds: Any = (Box, Polytope)  # a converter is not asked about None, the default
    require_kind(name, value, kinds, "a Box or a Polytope")
    return InputPolytope.of(value) if value.needs_programs else value  # type: ignore[return-value]
