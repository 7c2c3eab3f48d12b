#!/usr/bin/env python3
"""Let a ROS 1 node be heard again after a resume: a command for ``after_resume``. It needs Python alone, no ROS.

    failover run --after-resume "ros1_reregister.py /listener http://10.0.0.2:11311" -- python3 listener.py

Why: a restore resets the TCP connections of a node with others. rospy connects anew only when the master tells it of publishers,
and the master does not tell, for nothing has changed there. This command registers all that the node offers and wants once more,
in the node's name. It tells each subscriber of its publishers: first without the lost ones, so that the subscriber forgets them,
then with them, so that it connects.

The node must be reached by the address under which it registered: on another robot too (ROS_IP is an address that moves with it).
"""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterable
from typing import Any, Final
from xmlrpc.client import ServerProxy

LIMIT_S: Final = 2.0
"""How long each question may take: the agent gives an after_resume command five seconds, see ``limit_s``."""
MASTER: Final = "/master"
OURS: Final = "/failover"
"""By which name this command asks the master for what it has."""
ANY_TYPE: Final = "*"


def told(answer: Any) -> Any:
    """What the master answers.

    Raises:
        SystemExit: it refuses; with its reason.
    """
    code, reason, value = answer
    if code != 1:
        raise SystemExit(f"the ROS master: {reason}")
    return value


def ask(master: ServerProxy, node: str) -> Any:
    """The master's whole answer to where a node is; one that has just ended is nowhere."""
    return master.lookupNode(OURS, node)


def connect_anew(subscriber: str, topic: str, publishers: Iterable[str], lost: Iterable[str]) -> None:
    """Have a node forget its connections with the publishers that were lost, and connect to all again."""
    node, everyone, gone = ServerProxy(subscriber), list(publishers), set(lost)
    try:
        node.publisherUpdate(MASTER, topic, [one for one in everyone if one not in gone])
        node.publisherUpdate(MASTER, topic, everyone)
    except OSError as error:
        print(f"{subscriber} does not answer: {error}", file=sys.stderr)  # it has ended, and the master does not know


def register(name: str, master_uri: str) -> int:
    """Register a node again; how many topics and services that were."""
    master = ServerProxy(master_uri)
    uri = told(master.lookupNode(OURS, name))
    published, subscribed, services = told(master.getSystemState(OURS))
    types = dict(told(master.getTopicTypes(OURS)))
    uris = {
        node: answer[2] for node in {node for _, nodes in published for node in nodes} if (answer := ask(master, node))[0] == 1
    }
    count = 0
    for topic, nodes in published:
        if name in nodes:
            count += 1
            for subscriber in told(master.registerPublisher(name, topic, types.get(topic, ANY_TYPE), uri)):
                connect_anew(subscriber, topic, [uris[node] for node in nodes if node in uris], [uri])
    for topic, nodes in subscribed:
        if name in nodes:
            count += 1
            publishers = told(master.registerSubscriber(name, topic, types.get(topic, ANY_TYPE), uri))
            connect_anew(uri, topic, publishers, publishers)
    for service, nodes in services:
        if name in nodes:
            count += 1
            told(master.registerService(name, service, told(master.lookupService(OURS, service)), uri))
    return count


def main() -> None:
    """Of the command."""
    if len(sys.argv) != 3:
        raise SystemExit("usage: ros1_reregister.py /NODE http://MASTER:11311")
    socket.setdefaulttimeout(LIMIT_S)
    try:
        count = register(sys.argv[1], sys.argv[2])
    except OSError as error:
        raise SystemExit(f"cannot reach the ROS master at {sys.argv[2]}: {error}") from error
    print(f"{sys.argv[1]} is registered again: {count} topics and services")


if __name__ == "__main__":
    main()
