"""Drivers: processes that speak for devices, find each other by name, and carry out messages. For programs and commands.

`server` runs a driver, `many` several in one process, `actor` calls their methods; `proxy` is the caller's side; `name_service`
and `lookup` find names.

Imports ``failover.core``, ``failover.config``, ``failover.client``, ``failover.kept_state`` and ``failover.boards``; the agent
does not import it.
"""
