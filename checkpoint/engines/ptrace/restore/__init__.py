"""Turn a snapshot into a running program: check, lay memory, rebuild, resume. Imports facts, resources, linux; no capture."""
