"""ptrace(2): one thread, all threads of a process, calls that another process makes for us."""
