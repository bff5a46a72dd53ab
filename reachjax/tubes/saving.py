"""What a file keeps of tubes: all of them, but for a loop whose functions a user wrote.

Of such a loop it keeps the seal, a hash of every equation and every number, so that what was proved
is said of no other one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.numerics.seals import seal_of
from reachjax.numerics.storage import write


class Kept(NamedTuple):
    """What a file holds.

    Attributes:
        tube: or several, of cells.
        seal: that of the loop.
    """

    tube: Any
    seal: np.ndarray

    def is_of(self, loop: ClosedLoop) -> bool:
        """Whether a loop is the same one, in every equation and every bit of its numbers."""
        return np.array_equal(self.seal, seal_of(loop))


def keep(path: Path, tube: Any, loop: ClosedLoop) -> None:
    """Write tubes of one loop to a file."""
    write(path, Kept(tube, np.asarray(seal_of(loop))), outside=ClosedLoop)
