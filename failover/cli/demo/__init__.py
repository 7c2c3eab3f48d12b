"""``failover demo``: two robots on this machine, real programs, a power cut, the programs go on.

Four rooms: `programs` (what runs), `robots` (where it runs, and how it loses its power), `play` (the acts, in order),
`interruption` (Ctrl-C at any instant).
"""
