"""What is remembered of a decision, and one log out of several robots' logs. Pure."""
