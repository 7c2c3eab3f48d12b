"""Where no schedule is yet: as for boards, beside which it lies."""

from tests.failover.boards.conftest import place

__all__ = ["place"]
