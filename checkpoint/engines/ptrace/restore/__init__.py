"""From a snapshot to a running program: check, lay memory, rebuild, let go. Imports facts, resources, linux; no capture."""
