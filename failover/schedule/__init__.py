"""Periodic tasks as programs run them: a row of the robot's schedule, and one sleep for each activation (`failover.scheduled`).

The rules and bytes are in `failover.core.schedule`, the mapped file in `failover.boards.schedule_file`.
"""
