"""The process that sends heartbeats and decides: one turn of the core, then persist, send, act. Imports nothing of the worker.

`loop` has the turn. `board_link`, `own_items` and `urgent_items` move items of the board between frames and files.
"""
