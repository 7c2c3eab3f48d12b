"""The process that sends heartbeats and decides: one turn of the core, then persist, send, act. Imports nothing of the worker."""
