"""Engines that capture and restore processes; each fulfils the contract of `checkpoint.engine`."""
