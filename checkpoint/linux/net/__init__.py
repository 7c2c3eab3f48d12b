"""Sockets as the kernel shows them: sock_diag(7), TCP repair, dropped packets."""
