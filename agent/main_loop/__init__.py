"""The process that beats and decides: one turn of the core, then persist, send, act. Imports nothing of the worker."""
