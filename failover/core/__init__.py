"""The pure rules: no socket, clock, thread, random number, file. Start with `failover.core.node`; terms: `failover.core.types`."""
