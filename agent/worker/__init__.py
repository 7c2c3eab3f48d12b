"""The worker process, for all slow work: snapshots, programs, users' requests. It starts at `process` or `witness`."""
