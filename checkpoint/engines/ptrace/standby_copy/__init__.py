"""Standby copies: a restore up to the pages, kept current by deltas until a takeover needs it. Imports restore."""
