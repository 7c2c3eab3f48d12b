"""Snapshots and the files of programs, on their way out and in: transfers under credit."""
