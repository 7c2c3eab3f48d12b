"""The schedule of one robot's tasks: their terms, their instants, their order, their bytes; pure.

Imported by programs' loops (`failover.task`), the mapped table (`failover.schedule`), the agent and the commands.
"""
