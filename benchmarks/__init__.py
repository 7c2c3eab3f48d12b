"""The costs, measured: ``python -m benchmarks`` (see `__main__`)."""
