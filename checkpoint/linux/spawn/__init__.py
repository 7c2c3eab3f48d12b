"""Create processes: vessel, namespaces, inherited limits, filters, vdso."""
