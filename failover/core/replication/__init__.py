"""Replication of checkpoints to the standby and to the servers, and the programs that wait there."""
