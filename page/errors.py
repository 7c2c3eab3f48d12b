"""What the page refuses: a status of HTTP and a sentence for the person who asked."""

from __future__ import annotations

from failover.errors import PageError


class TurnedAwayError(PageError):
    """A request is not served.

    Attributes:
        status: of HTTP. again_s: seconds after which it may be tried again; 0: it will not help.
    """

    def __init__(self, status: int, message: str, again_s: float = 0.0) -> None:
        super().__init__(message)
        self.status = status
        self.again_s = again_s
