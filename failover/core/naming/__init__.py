"""The team's names: their kinds, who answers to one, and how tables of them spread; pure. For drivers, agent and commands."""
