"""Sockets of every family: internet, unix, netlink, packet; queued datagrams and descriptors in transit."""
