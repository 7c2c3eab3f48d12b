"""Devices: those without state, those that an operator's rule reopens, those that are refused."""
