"""Ways to capture and restore a process; each keeps the contract of ``checkpoint.engine``."""
