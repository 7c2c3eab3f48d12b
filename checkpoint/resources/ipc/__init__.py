"""Pipes, named pipes, pseudo-terminals, standard streams, POSIX and System V shared memory."""
