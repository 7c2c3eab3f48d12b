"""State of the process or thread itself: credentials, scheduling, job control, seccomp, and what it shares with its parent."""
