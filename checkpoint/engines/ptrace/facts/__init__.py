"""What capture and restore both ask of a process, and how both tell it."""
