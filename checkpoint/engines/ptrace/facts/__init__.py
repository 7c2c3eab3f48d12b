"""Facts about a process that both capture and restore need, and their common form."""
