"""Unmodified programs: captured, restored, and kept ready at a standby, through ptrace(2)."""
