"""Simulated robots for programs that are written for real ones (`failover simulate`): the world, and the processes that run it.

`world` is pure: rooms, motors, sensors, all by a seed. `group` runs the robots of some labs in one process: their items on the
board, their devices as drivers, their controllers in a task of the schedule. `run` starts the groups and adds up what they tell.
"""
