"""What every process of the agent asks of the machine: clock, permissions, system calls, systemd, network interfaces."""
