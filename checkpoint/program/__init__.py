"""Settings with which a program is started: its fencing token, its processor level, the name of its scratch memory."""
