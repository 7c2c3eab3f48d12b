"""Who may do what: rules over groups, verbs and paths, and why; pure. Configuration, agent and commands import it."""
