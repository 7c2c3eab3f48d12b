"""capture, restore, inspect, check: what one command does alone, without an agent."""
