"""All targets: each decoder that bytes of a stranger, another user or another robot reach; one module for each way in.

Left out, because no bytes of ours are decoded there: the ZeroMQ handshake (libzmq), HTTP and websocket framing (uvicorn, h11,
websockets), the protocol of Foxglove (foxglove-sdk), LDAP (python-ldap); the files that root alone writes into the agent's
`state_directory`, but for those that another robot's words stand in.
"""

from __future__ import annotations


def load() -> None:
    """Fill the table (`tests.fuzz.target.TARGETS`)."""
    from tests.fuzz.targets import boards, files, links, programs, sockets  # noqa: F401  # importing is filling
