"""Replication of checkpoints to the standby and to the servers, and what waits there."""
