"""What a program imports to keep its state: the decorator API, loops at their times, commits."""
