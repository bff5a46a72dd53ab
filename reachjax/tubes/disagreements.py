"""What a tube says and its certificates do not prove."""

from __future__ import annotations

from typing import Any


class DisagreementError(ValueError):
    """A tube says what its own certificates do not prove.

    Attributes:
        step: how many steps after the initial set; None if it is not about one.
        facet: the number of the facet; None if it is not about one.
        said: what the tube says.
        proved: what is proved, or simulated.
    """

    def __init__(
        self,
        message: str,
        step: int | None = None,
        facet: int | None = None,
        said: Any = None,
        proved: Any = None,
    ):
        super().__init__(message)
        self.step, self.facet, self.said, self.proved = step, facet, said, proved
