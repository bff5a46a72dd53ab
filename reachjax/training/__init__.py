"""What a training loop adds to its own loss so that its controller can be verified.

Penalties on what the loop can reach, a schedule of when they are computed and what they weigh, and
an optimiser that skips the steps at which there is no bound (their gradient is NaN), leaving
weights and state as they are.
"""

from reachjax.training.failures import failures, skip_failures, unsolved
from reachjax.training.penalties import specification_penalty, volume_penalty
from reachjax.training.schedule import PenaltySchedule

__all__ = [
    "PenaltySchedule",
    "failures",
    "skip_failures",
    "specification_penalty",
    "unsolved",
    "volume_penalty",
]
