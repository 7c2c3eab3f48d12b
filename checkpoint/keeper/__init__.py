"""The keeper, the tracer's own process (``python -m checkpoint``), and its messages."""
