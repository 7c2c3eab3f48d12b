"""What commands print: tables, colours, the tree of the team."""
