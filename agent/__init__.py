"""The daemon: beats, lanes, guards and keepers. It acts on what `failover.core` decides; nobody imports it."""
