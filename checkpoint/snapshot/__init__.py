"""One snapshot as values and as the bytes of a file (FORMAT.md), with its validity rules and the rights that it gets back."""
