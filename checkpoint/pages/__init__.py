"""Sets of pages and what is computed with them: differences, merges, caches of hot pages, sources of a restore."""
