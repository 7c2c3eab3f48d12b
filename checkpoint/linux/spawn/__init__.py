"""How a process of ours is born: vessel, namespaces, inherited limits, filters, vdso."""
