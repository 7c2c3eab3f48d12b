"""``failover demo``: two robots on this machine, real programs, a power cut, the programs go on.

Three rooms: `programs` (what runs), `robots` (where it runs, and how it loses its power), `play` (the acts, in order).
"""
