"""The control socket: verbs, queries, the status, how much each user may hold."""
