"""What belongs to the process or thread itself: credentials, scheduling, job control, seccomp, what it shares with its parent."""
