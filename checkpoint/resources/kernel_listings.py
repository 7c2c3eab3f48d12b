"""Read the kernel's lists of all sockets once for all sockets of a process, because a list covers the whole machine.

Source: proc_pid_net(5), sock_diag(7).
"""

from __future__ import annotations

import functools
import socket
from collections.abc import Mapping
from typing import Final

from checkpoint.linux.net import inet_diag, packet_diag, unix_diag
from checkpoint.linux.net.packet_diag import PacketSocket
from checkpoint.linux.procfs import procfs
from checkpoint.model import Fact

Group = tuple[int, str]
"""A multicast group: interface and address."""
_PEER_COLUMN: Final = 2
_INODE_COLUMN: Final = 9
"""Columns of net/raw, icmp and tcp, and of net/netlink."""

LISTS_MAX: Final = 16
"""Lists of multicast groups that are remembered with what they mean: they are the same from one look to the next."""
UNIX_ASKED_SINGLY: Final = 4
"""To ask about one has the kernel go through half of the machine's unix sockets; to ask about all, through all of them."""


class Listings:
    """Lists of the sockets in a process's network namespace, as far as they were asked for during one look."""

    def __init__(self) -> None:
        self._groups: dict[int, tuple[Group, ...]] = {}
        self._lines: dict[str, Mapping[int, list[str]]] = {}
        self._shut_down: dict[tuple[int, int], Mapping[int, int]] = {}
        self._unix_answers: dict[int, bytes] = {}
        self._packet_sockets: Mapping[int, PacketSocket] | None = None

    def groups(self, pid: int, family: int) -> tuple[Group, ...]:
        """All joined multicast groups that a socket of this family may be in: one of AF_INET6 may be in any."""
        if family not in self._groups:
            self._groups[family] = _listed_groups(pid, family)
        return self._groups[family]

    def shut_down(self, family: int, protocol: int) -> Mapping[int, int]:
        """See `checkpoint.linux.net.inet_diag.shut_down`."""
        key = family, protocol
        if key not in self._shut_down:
            self._shut_down[key] = inet_diag.shut_down(family, protocol)
        return self._shut_down[key]

    def packet_sockets(self) -> Mapping[int, PacketSocket]:
        """See `checkpoint.linux.net.packet_diag.packet_sockets`.

        Raises:
            OSError: the kernel does not tell.
        """
        if self._packet_sockets is None:
            self._packet_sockets = packet_diag.packet_sockets()
        return self._packet_sockets

    def unix_answer(self, inode: int) -> bytes:
        """See `checkpoint.linux.net.unix_diag.answer_about`: one after the other, or all at once when it comes to many."""
        if inode in self._unix_answers:
            return self._unix_answers[inode]
        if len(self._unix_answers) == UNIX_ASKED_SINGLY:
            self._unix_answers |= unix_diag.answers()
        return self._unix_answers.get(inode) or self._unix_answers.setdefault(inode, unix_diag.answer_about(inode))

    def line(self, pid: int, table: str, inode: int) -> list[str]:
        """The words of a socket's line in /proc/PID/net/``table``; none where it has none."""
        if table not in self._lines:
            lines = (line.split() for line in procfs.read_text(pid, f"net/{table}").splitlines()[1:])
            self._lines[table] = {int(words[_INODE_COLUMN]): words for words in lines}
        return self._lines[table].get(inode, [])

    def peer(self, pid: int, table: str, family: int, inode: int) -> list[Fact]:
        """The address with which a socket is connected, or asks for a connection; empty for none.

        Args:
            table: "raw", "icmp" or "tcp".
        """
        words = self.line(pid, f"{table}6" if family == socket.AF_INET6 else table, inode)
        if not words:
            return []
        host, _, port = words[_PEER_COLUMN].partition(":")
        packed = b"".join(bytes.fromhex(host[place : place + 8])[::-1] for place in range(0, len(host), 8))
        if not any(packed):
            return []
        return [socket.inet_ntop(family, packed), int(port, 16), *([0, 0] if family == socket.AF_INET6 else [])]


def _listed_groups(pid: int, family: int) -> tuple[Group, ...]:
    of_six = _groups_of_six(procfs.read_text(pid, "net/igmp6")) if family == socket.AF_INET6 else ()
    return of_six + _groups_of_four(procfs.read_text(pid, "net/igmp"))


@functools.lru_cache(maxsize=LISTS_MAX)
def _groups_of_six(listed: str) -> tuple[Group, ...]:
    """Read net/igmp6."""
    lines = map(str.split, listed.splitlines())
    return tuple((int(words[0]), socket.inet_ntop(socket.AF_INET6, bytes.fromhex(words[2]))) for words in lines)


@functools.lru_cache(maxsize=LISTS_MAX)
def _groups_of_four(listed: str) -> tuple[Group, ...]:
    """Read net/igmp."""
    groups, interface = [], 0
    for line in listed.splitlines()[1:]:
        words = line.split()
        if not line.startswith("\t"):
            interface = int(words[0])
        else:
            groups.append((interface, socket.inet_ntoa(bytes.fromhex(words[0])[::-1])))
    return tuple(groups)
