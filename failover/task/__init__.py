"""What a program imports to keep its state: the decorator API, timed loops, commits."""
