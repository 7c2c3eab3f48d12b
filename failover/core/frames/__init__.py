"""The team frame, pure: who has which rank (`roster`), when each robot may send (`slots`). The core and the agent import it."""
