"""The board as programs, the commands and the agent use it: files mapped, items put, read and waited for (`failover.board`).

The rules and bytes are in `failover.core.board`; here is all that opens, maps, locks, waits or asks for the time. Imported by the
agent and the commands; by programs as `failover.board()`.
"""

from typing import Final

LINK_NAME: Final = "board"
"""A symbolic link in the agent's runtime directory, to the board of its robot."""
