"""The tracer's own process, ``python -m checkpoint``, and the messages that it takes and answers."""
