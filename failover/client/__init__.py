"""Client side of the agent: its control socket, and the health of a component."""
