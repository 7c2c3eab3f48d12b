"""Data that a cooperating program shares with us: committed state (SEGMENT.md), and messages with its guard (TASK.md)."""
