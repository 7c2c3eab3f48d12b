"""The name that marks memory whose content need not be restored: see `failover.kept_state.scratch`."""

from __future__ import annotations

from typing import Final

NAME: Final = "failover-scratch"
"""The name of a memory file (memfd_create(2)) that is mapped shared: a restore maps it again, filled with zeros."""

MAPPED: Final = f"/memfd:{NAME} (deleted)"
"""The kernel's name for it in /proc/PID/maps and /proc/PID/fd."""
