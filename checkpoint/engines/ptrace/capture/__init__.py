"""Make a snapshot of a running program: enter, freeze, inspect, copy, describe. Imports facts, resources, linux; no restore."""
