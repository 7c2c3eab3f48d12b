"""Connections to the other robots: the replication link, links for orders, and cables that are pulled and plugged."""
