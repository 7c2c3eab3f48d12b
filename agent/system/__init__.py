"""Access to the machine for every process of the agent: clock, permissions, system calls, systemd, network interfaces."""
