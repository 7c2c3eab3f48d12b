"""A heartbeat as values and as the bytes of one datagram (PROTOCOL.md); names of robots and components."""
