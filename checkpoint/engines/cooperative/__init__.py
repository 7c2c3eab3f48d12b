"""The cooperative engine: snapshots of the state that a program has committed to its segment. It stops and traces no thread."""
