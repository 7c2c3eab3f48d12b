"""Snapshots of what a program has committed to its segment. No thread is stopped or traced."""
