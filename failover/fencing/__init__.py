"""The fencing token as a program reads it, and a gateway that refuses an older one."""
