"""The daemon: heartbeats, links, guards, keepers. It carries out what `failover.core` decides; no other package imports it."""
