"""Output of commands: tables, colours, the tree of the team."""
