"""The world of simulated robots: what they are, how they move, what they measure. Pure; numpy over all robots of a lab."""
