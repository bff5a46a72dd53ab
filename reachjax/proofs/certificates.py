"""What a bound rests on, kept so that anyone can check it again.

A certificate holds the program of one step, the multipliers that prove its bounds, and the dual
moment matrices: where one has rank one, it is the worst trajectory itself. Witnesses are simulated
trajectories; the true support of the reachable set lies between witness and bound.
"""

from __future__ import annotations

import abc
from collections import Counter
from collections.abc import Mapping
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.numerics.checks import floats_of, is_concrete, require_double_precision
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.programs.lmi import Program
from reachjax.proofs.proposal import Proposal, SolverStatus


def told(ends: Mapping[SolverStatus, int]) -> str:
    """How many ended in which way, the most frequent first.

    Example:
        >>> told({SolverStatus.TIME: 1, SolverStatus.SOLVED: 3})
        '3 SOLVED, 1 TIME'
    """
    counted = sorted(ends.items(), key=lambda each: (-each[1], each[0]))
    return ", ".join(f"{count} {status.name}" for status, count in counted)


@pytree
class AbstractProof(Replaceable, abc.ABC):
    """What every proof of one step's set says, whatever it rests on.

    Attributes:
        codes: `(f,)`, how the search for each bound ended, as values of `SolverStatus`.
        bounds: `(f,)`, what was proved.
        witnesses: `(f,)`, the largest simulated values of what is bounded.
        witness_states: `(f, n_x)`, the initial states that attain them. Of a loop with disturbances
            or noise `(f, s)`, with what is drawn at each step behind them: see `ClosedLoop.split`.
        seconds: `(f,)`, the time that it took to find.
    """

    codes: Int[Array | np.ndarray, " f"]
    bounds: Float[Array | np.ndarray, " f"]
    witnesses: Float[Array | np.ndarray, " f"]
    witness_states: Float[Array | np.ndarray, "f s"]
    seconds: Float[Array | np.ndarray, " f"]

    @property
    def statuses(self) -> tuple[SolverStatus, ...]:
        """How the search for each bound ended; each has a sentence of `advice`."""
        return tuple(SolverStatus(int(code)) for code in self.codes)

    @property
    def ends(self) -> dict[SolverStatus, int]:
        """How many bounds ended in each way."""
        return dict(Counter(self.statuses))

    @property
    def gaps(self) -> Float[Array | np.ndarray, " f"]:
        """`bounds - witnesses`: how much tightness may be left; negative by rounding at most."""
        return self.bounds - self.witnesses

    @abc.abstractmethod
    def recheck(self) -> np.ndarray:
        """Prove the bounds anew."""


@pytree
class AbstractCertificate(AbstractProof):
    """What the proof of one step's set by semidefinite programs has, whatever the set.

    Attributes:
        program: facts, products and objective rows over the scaled basis.
        multipliers: `(f, K)`, one row for each semidefinite program.
        moments: `(f, n, n)`, dual matrices over the unscaled basis with corner 1; NaN where the
            solver gave none.
    """

    program: Program
    multipliers: Float[Array | np.ndarray, "f K"]
    moments: Float[Array | np.ndarray, "f n n"]

    @classmethod
    def of(cls, program: Program, proposal: Proposal, **own: Any) -> Self:
        """What was proved with what a solver proposed; witnesses are not known yet (NaN).

        Args:
            program: of the step.
            proposal: for it.
            own: the bounds, and what else a certificate of this kind has.
        """
        T, programs = program.transform, len(proposal.statuses)
        moments = proposal.moments[:, : len(T), : len(T)]
        return cls(
            program=program,
            multipliers=proposal.multipliers,
            moments=T @ moments @ T.T,
            codes=proposal.statuses,
            witnesses=np.full(programs, np.nan),
            witness_states=np.full((programs, 0), np.nan),
            seconds=proposal.seconds,
            **own,
        )

    def of_programs(self, which: slice = slice(None)) -> dict[str, Any]:
        """What there is one of for each program, of some of them, by name."""
        return {
            "multipliers": self.multipliers[which],
            "moments": self.moments[which],
            "codes": self.codes[which],
            "bounds": self.bounds[which],
            "witnesses": self.witnesses[which],
            "witness_states": self.witness_states[which],
            "seconds": self.seconds[which],
        }

    @property
    def products_in_use(self) -> Int[np.ndarray, "p 2"]:
        """Pairs of facts, by number, of positive multipliers; none where these are traced."""
        products, weights = jax.lax.stop_gradient((self.program.products, self.multipliers))
        if not is_concrete(products, weights):
            return np.zeros((0, 2), dtype=int)
        pairs = np.stack([products.left, products.right], axis=1)
        return pairs[np.any(np.asarray(weights) > 0, axis=0)[np.asarray(products.multiplier)]]

    @abc.abstractmethod
    def recheck(self, multipliers: Float[np.ndarray, "f K"] | None = None) -> np.ndarray:
        """Prove the bounds anew, from the program and these or other multipliers."""

    def _proposed(self, multipliers: Float[np.ndarray, "f K"] | None) -> Float[np.ndarray, "f K"]:
        """These multipliers, or the certificate's own."""
        require_double_precision(certificate=floats_of(self))
        proposed = np.asarray(self.multipliers if multipliers is None else multipliers)
        if proposed.shape != self.multipliers.shape:
            raise ValueError(
                f"multipliers must have shape {self.multipliers.shape} (programs, products), "
                f"but {proposed.shape} arrived"
            )
        return proposed
