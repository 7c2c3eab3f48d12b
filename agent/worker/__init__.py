"""The process for all that may take its time: snapshots, programs, people. It starts at `process` or `witness`."""
