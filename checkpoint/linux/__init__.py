"""Kernel interfaces: each way to access another process has one file here."""
