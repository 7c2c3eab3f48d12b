"""The board recorded, replayed, and shown live to programs for such files: `failover board record`, `replay`, `serve`.

The rules (channels, schemas, messages) are in `failover.core.board.recording`. Libraries come with the extras ``record`` and
``foxglove``; only these commands import them.
"""
