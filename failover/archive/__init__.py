"""Sealed copies of whole checkpoints in an object store that no robot is part of: S3, or a folder on another disk."""
