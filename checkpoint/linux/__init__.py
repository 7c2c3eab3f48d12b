"""The kernel's doors: each way into another process has one file here."""
