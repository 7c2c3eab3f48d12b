"""What a program is started with: its fencing token, its level of processor, the name of its scratch memory."""
