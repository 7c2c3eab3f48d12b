"""Memory of a process through kernel interfaces: remote reads and writes, page tables, three ways to find written pages."""
