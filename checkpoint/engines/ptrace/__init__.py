"""The ptrace engine for unmodified programs: capture, restore, and copies kept ready at a standby, through ptrace(2)."""
