"""The team frame, which carries heartbeats and items; pure. The core and the agent import it.

`lane` seals and opens one robot's frames (`frame` has their bytes), `roster` says who has which rank, `slots` when each robot may
send.
"""
