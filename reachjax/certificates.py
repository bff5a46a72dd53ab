"""What a bound rests on, kept so that anyone can check it again.

A certificate holds the program of one step, the multipliers that prove its offsets, and the dual
moment matrices: where one has rank one, it is the worst trajectory itself. Witnesses are simulated
trajectories; the true support of the reachable set lies between witness and bound.
"""

from __future__ import annotations

import abc

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.lmi import Program
from reachjax.pytrees import Replaceable, pytree
from reachjax.recheck import sound_level
from reachjax.sets import Ellipsoid, NormalForm
from reachjax.solvers import Enclosure, Solution, SolverStatus, accepted_offsets


@pytree
class AbstractCertificate(Replaceable, abc.ABC):
    """What the proof of one step's set has, whatever the set.

    Attributes:
        program: facts, products and objective rows over the scaled basis.
        multipliers: `(f, K)`, one row for each semidefinite program.
        moments: `(f, n, n)`, dual matrices over the unscaled basis with corner 1; NaN where the
            solver gave none.
        codes: `(f,)`, how the solver ended, as values of `SolverStatus`.
        bounds: `(f,)`, what was proved.
        witnesses: `(f,)`, the largest simulated values of what is bounded.
        witness_states: `(f, n_x)`, the initial states that attain them.
        seconds: `(f,)`, solver time.
    """

    program: Program
    multipliers: Float[Array | np.ndarray, "f K"]
    moments: Float[Array | np.ndarray, "f n n"]
    codes: Int[Array | np.ndarray, " f"]
    bounds: Float[Array | np.ndarray, " f"]
    witnesses: Float[Array | np.ndarray, " f"]
    witness_states: Float[Array | np.ndarray, "f n_x"]
    seconds: Float[Array | np.ndarray, " f"]

    @property
    def statuses(self) -> tuple[SolverStatus, ...]:
        """How the solver ended on each program; each has a sentence of `advice`."""
        return tuple(SolverStatus(int(code)) for code in self.codes)

    @property
    def gaps(self) -> Float[Array | np.ndarray, " f"]:
        """`bounds - witnesses`: how much tightness may be left; negative by rounding at most."""
        return self.bounds - self.witnesses

    @abc.abstractmethod
    def recheck(self, multipliers: Float[np.ndarray, "f K"] | None = None) -> np.ndarray:
        """Prove the bounds anew, from the program and these or other multipliers."""


@pytree
class Certificate(AbstractCertificate):
    """Proof of the offsets of one step, `directions x[t] <= bounds`: one program a facet.

    Attributes:
        solver_offsets: `(f,)`, what the solver itself claimed; not bounds.
    """

    solver_offsets: Float[Array | np.ndarray, " f"]

    @classmethod
    def from_solution(
        cls, program: Program, bounds: Float[Array, " f"], solution: Solution
    ) -> Certificate:
        """What was proved with what a solver proposed; witnesses are not known yet (NaN)."""
        facets = len(solution.offsets)
        T = program.transform
        return cls(
            program=program,
            multipliers=solution.multipliers,
            moments=T @ solution.moments @ T.T,
            codes=solution.statuses,
            solver_offsets=solution.offsets,
            bounds=bounds,
            witnesses=np.full(facets, np.nan),
            witness_states=np.full((facets, 0), np.nan),
            seconds=solution.seconds,
        )

    def __repr__(self) -> str:
        return f"Certificate(facets={len(self.bounds)}, products={self.multipliers.shape[-1]})"

    def recheck(
        self, multipliers: Float[np.ndarray, "f K"] | None = None
    ) -> Float[np.ndarray, " f"]:
        """Prove the offsets anew, from the program and these or other multipliers.

        Sound for any multipliers: negative ones are clipped where the sign matters, and what
        the matrix inequality misses is paid for.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach_step
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> _, certificate = reach_step(loop, Box([1.0], [2.0]), Template.box(1))
            >>> certificate.recheck().round(6).tolist()
            [1.0, -0.5]
            >>> garbage = -certificate.multipliers
            >>> bool((certificate.recheck(garbage) >= [1.0, -0.5]).all())
            True
        """
        proposed = self.multipliers if multipliers is None else multipliers
        solution = Solution(self.solver_offsets, proposed, self.moments, self.codes, self.seconds)
        return accepted_offsets(jax.device_get(self.program), solution)[0]


@pytree
class EllipsoidCertificate(AbstractCertificate):
    """Proof of the ellipsoid of one step, `|A x[t] + b| <= 1`: one program, so `f = 1`.

    What is bounded, by 1, is `|A x[t] + b|`.

    Attributes:
        form: `A` and `b` of the set.
    """

    form: NormalForm

    @classmethod
    def from_enclosure(
        cls, program: Program, region: Ellipsoid, enclosure: Enclosure
    ) -> EllipsoidCertificate:
        """What was proved with what a solver proposed; witnesses are not known yet (NaN)."""
        T, n = program.transform, len(program.transform)
        moments = enclosure.moments[:n, :n] / enclosure.moments[n - 1, n - 1]
        return cls(
            program=program,
            form=region.normal_form,
            multipliers=enclosure.multipliers[None],
            moments=(T @ moments @ T.T)[None],
            codes=enclosure.status[None],
            bounds=np.ones(1),
            witnesses=np.full(1, np.nan),
            witness_states=np.full((1, 0), np.nan),
            seconds=enclosure.seconds[None],
        )

    def __repr__(self) -> str:
        return f"EllipsoidCertificate(products={self.multipliers.shape[-1]})"

    def recheck(
        self, multipliers: Float[np.ndarray, "1 K"] | None = None
    ) -> Float[np.ndarray, " 1"]:
        """What `|A x + b|` surely does not exceed, by these or other multipliers.

        Sound for any multipliers; for the certificate's own it is 1 at most, but for rounding.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import AffinePlant, ClosedLoop, EllipsoidTemplate, MLP, reach_step
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> X0 = Ellipsoid([1.0], [[1.0]])
            >>> following, certificate = reach_step(loop, X0, EllipsoidTemplate())
            >>> following.shape.round(6).tolist(), certificate.recheck().round(6).tolist()
            ([[0.25]], [1.0])
        """
        proposed = np.asarray(self.multipliers if multipliers is None else multipliers)
        if proposed.shape != self.multipliers.shape:
            raise ValueError(
                f"multipliers must have shape {self.multipliers.shape} (1, products), "
                f"but {proposed.shape} arrived"
            )
        form = jax.device_get(self.form)
        return np.array([sound_level(jax.device_get(self.program), proposed[0], form)])
