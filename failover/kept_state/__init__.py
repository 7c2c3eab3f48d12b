"""The API that a program imports to keep its state: the decorator, timed loops, commits."""
