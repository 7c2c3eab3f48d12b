"""Snapshots and the files of programs, outgoing and incoming: transfers under credit."""
