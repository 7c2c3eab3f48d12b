"""One snapshot as values and as the bytes of a file (FORMAT.md): what must hold in it, with which rights it comes back."""
