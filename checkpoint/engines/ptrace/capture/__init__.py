"""From a running program to a snapshot: enter, freeze, look, copy, describe. Imports facts, resources, linux; no restore."""
