"""Memory as the kernel shows it: read and written from outside, its page tables, three ways to find written pages."""
