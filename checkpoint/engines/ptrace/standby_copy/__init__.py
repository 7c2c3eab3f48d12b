"""A restore up to its pages, kept current by deltas until it is needed. Imports restore."""
