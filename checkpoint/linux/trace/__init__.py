"""Control of other processes by ptrace(2): one thread, all threads of a process, remote system calls."""
