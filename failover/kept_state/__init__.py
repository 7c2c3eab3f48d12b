"""The API that a program imports to keep its state: the decorator, timed loops, commits.

Periodic tasks of a schedule (`failover.scheduled`) are in `failover.schedule`.
"""
