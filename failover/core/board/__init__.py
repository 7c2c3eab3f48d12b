"""The team's board: declarations of items, their bytes, their rules; pure. Imported by the client, the agent and the commands."""
