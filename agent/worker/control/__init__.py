"""The control socket: verbs, queries, what status shows, how much each user may hold."""
