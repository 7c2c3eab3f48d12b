"""The rules, pure: no socket, clock, thread, dice or file. Start with ``node.py``; the words are in ``types.py``."""
