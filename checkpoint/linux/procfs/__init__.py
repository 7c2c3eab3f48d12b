"""Read /proc: processes, threads, descriptors, mappings and mounts."""
