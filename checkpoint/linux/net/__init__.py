"""Kernel interfaces for sockets: sock_diag(7), TCP repair, dropped packets."""
