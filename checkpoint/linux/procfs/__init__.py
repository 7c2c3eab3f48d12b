"""What /proc says of processes, threads, descriptors, mappings and mounts."""
