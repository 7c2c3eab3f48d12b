"""Sets of pages and operations on them: differences, merges, and the source of pages for a restore."""
