"""A directory of snapshots that survives power loss at any point: chains, folding, files by content, older checkpoints."""
