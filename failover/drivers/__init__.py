"""Drivers: processes that speak for devices, find each other by name, and carry out messages. For programs and commands.

Imports ``failover.core``, ``failover.config``, ``failover.kept_state`` and ``failover.boards``; the agent does not import it.
"""
