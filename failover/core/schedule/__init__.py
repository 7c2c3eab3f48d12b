"""The schedule of one robot's tasks: their terms, their instants, their order, their bytes; pure.

Imported by the mapped table (`failover.boards.schedule_file`), tasks as programs run them (`failover.schedule`), the periods of
`failover.kept_state`, the agent and the commands.
"""
