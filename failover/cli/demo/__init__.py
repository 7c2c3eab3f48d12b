"""``failover demo``: two robots on this machine, real programs, a power cut; the programs resume.

Main modules: `failover.cli.demo.programs` (the programs that run), `failover.cli.demo.robots` (where they run, and the power
cut), `failover.cli.demo.play` (the steps, in order), `failover.cli.demo.interruption` (Ctrl-C at any instant).
"""
