"""The control socket: verbs, queries, the status, which rights a user has (`rights_gate`) and how much it may hold (`quotas`)."""
