"""What a training loop adds to its own loss so that its controller can be verified.

Penalties on what the loop can reach, a schedule of when they are computed and what they weigh, and
an optimiser that skips the steps at which there is no bound (their gradient is NaN), leaving
weights and state as they are. And the whole of it: training that ends when the controller is
proved.
"""

from reachjax.training.failures import failures, skip_failures, unsolved
from reachjax.training.history import Epoch, TrainingHistory
from reachjax.training.objectives import Certified, Simulated, Stage, TrainingBatch
from reachjax.training.penalties import specification_penalty, volume_penalty
from reachjax.training.schedule import PenaltySchedule
from reachjax.training.until_proved import Trained, train

__all__ = [
    "Certified",
    "Epoch",
    "PenaltySchedule",
    "Simulated",
    "Stage",
    "Trained",
    "TrainingBatch",
    "TrainingHistory",
    "failures",
    "skip_failures",
    "specification_penalty",
    "train",
    "unsolved",
    "volume_penalty",
]
