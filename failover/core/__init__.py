"""The pure rules: no socket, clock, thread, random number, file. Start at `failover.core.node`; terms: `failover.core.types`."""
