"""Sockets that answer as at the last look are not examined again; any change of one is seen."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from checkpoint.arch import stubs
from checkpoint.linux.net.socket_queries import SO_ATTACH_FILTER, WORTH_SHARING, Asking, Subject, Told
from checkpoint.linux.procfs.descriptors import NOT_YET, Copier, lending
from checkpoint.model import Fact
from checkpoint.resources.open_file import Opened, OpenFile
from checkpoint.resources.socket_cache import Recollection
from checkpoint.resources.sockets import sockets as kinds_of_sockets
from checkpoint.resources.sockets import unix
from checkpoint.resources.sockets.tcp import FIN_WAIT_2
from checkpoint.resources.survey import gather, with_contents

pytestmark = pytest.mark.root

LOOKS_UNTIL_KNOWN = 3
"""One finds what it is, one what it answers, one that it still does."""
PASS_ALL = struct.pack("HBBI", 6, 0, 0, 0xFFFFFFFF)
PASS_SOME = struct.pack("HBBI", 6, 0, 0, 0xFFFF)
"""BPF_RET: filters of one instruction."""


class Onlooker:
    """Looks at the sockets of this process, again and again; those whose descriptors are the same it has as the same objects."""

    def __init__(self) -> None:
        self.recollection = Recollection()
        self._sockets: dict[int, OpenFile] = {}

    def look(self) -> tuple[dict[int, dict[str, Fact]], Opened]:
        """What is said of each, by number, and what was recalled."""
        self.recollection.prepare()
        found = [one for one in gather(os.getpid()) if kinds_of_sockets.is_socket(one.first)]
        before = self._sockets
        same = [before[one.first.number] if before.get(one.first.number) == one else one for one in found]
        self._sockets = {one.first.number: one for one in same}
        opened = Opened(same)
        with lending(os.getpid()):
            found = with_contents(opened, None, (), self.recollection)
        return {held.first.number: dict(held.observed) for held in found if "family" in held.observed}, opened

    def recalls(self, one: socket.socket) -> bool:
        """Whether it knew everything about a socket."""
        _, opened = self.look()
        recalled = opened.recalled.get(one.fileno())
        return recalled is not None and recalled.whole is not None


def anew() -> dict[int, dict[str, Fact]]:
    """What somebody says of them who sees them for the first time."""
    return {
        held.first.number: dict(held.observed) for held in with_contents(gather(os.getpid()), None) if "family" in held.observed
    }


class Sockets:
    """Some that a program may have, and the file of a name."""

    def __init__(self, stack: ExitStack, directory: Path) -> None:
        self._stack = stack
        self.udp = self.made(socket.AF_INET, socket.SOCK_DGRAM)
        self.bound_udp = self.made(socket.AF_INET, socket.SOCK_DGRAM)
        self.bound_udp.bind(("127.0.0.1", 0))
        self.tcp = self.made(socket.AF_INET, socket.SOCK_STREAM)
        self.tcp6 = self.made(socket.AF_INET6, socket.SOCK_STREAM)
        self.listener = self.made(socket.AF_INET, socket.SOCK_STREAM)
        self.listener.bind(("127.0.0.1", 0))
        self.listener.listen()
        self.client = self.made(socket.AF_INET, socket.SOCK_STREAM)
        self.client.connect(self.listener.getsockname())
        self.accepted = self.kept(self.listener.accept()[0])
        self.unix, self.other_end = map(self.kept, socket.socketpair())
        self.unix_datagrams, _ = map(self.kept, socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM))
        self.path = directory / "name"
        self.named = self.made(socket.AF_UNIX, socket.SOCK_STREAM)
        self.named.bind(str(self.path))
        self.named.listen()

    def made(self, family: int, kind: int) -> socket.socket:
        """One more."""
        return self.kept(socket.socket(family, kind))

    def kept(self, one: socket.socket) -> socket.socket:
        """Closed at the end."""
        return self._stack.enter_context(one)

    def every(self) -> list[socket.socket]:
        """All of them."""
        return [one for one in vars(self).values() if isinstance(one, socket.socket)]


@pytest.fixture
def sockets(tmp_path: Path) -> Iterator[Sockets]:
    with ExitStack() as stack:
        yield Sockets(stack, tmp_path)


def test_sockets_that_are_as_they_were_are_known(sockets: Sockets) -> None:
    onlooker = Onlooker()
    for _ in range(LOOKS_UNTIL_KNOWN):
        facts, opened = onlooker.look()
    known = {number for number, recalled in opened.recalled.items() if recalled.whole is not None}
    assert {one.fileno() for one in sockets.every()} <= known
    _, again = onlooker.look()
    told_again = {number for number, recalled in again.recalled.items() if recalled is opened.recalled.get(number)}
    assert told_again >= {one.fileno() for one in sockets.every() if one is not sockets.named}, "worked out anew"
    assert facts == anew()


@pytest.mark.skipif(not stubs.SECOND_LOOP, reason="this processor has no loop for a second thread")
def test_of_many_sockets_a_second_thread_asks_half_and_of_few_none(sockets: Sockets, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    onlooker = Onlooker()
    many = [sockets.made(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2 * WORTH_SHARING)]
    for _ in range(LOOKS_UNTIL_KNOWN):
        before, _ = onlooker.look()
    second = onlooker.recollection._second
    assert second is not None
    for ttl, one in enumerate(many, 1):  # whoever of the two asks it
        one.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, ttl)
        after, _ = onlooker.look()
        assert [number for number in after if after[number] != before[number]] == [one.fileno()]
        before = after
    assert before == anew()
    for one in many[WORTH_SHARING // 2 :]:
        one.close()
    onlooker.look()
    after, _ = onlooker.look()
    assert onlooker.recollection._second is None
    assert not second._thread.is_alive()
    assert after == anew()
    onlooker.recollection.close()


def test_what_many_answer_as_before_is_not_taken_apart(sockets: Sockets, monkeypatch: pytest.MonkeyPatch) -> None:
    taken_apart: list[int] = []
    told = Asking.told

    def counted(asking: Asking, heard: bytes) -> list[Told]:
        found = told(asking, heard)
        taken_apart.append(len(found))
        return found

    sockets.named.close()  # a path may lead elsewhere by now
    onlooker = Onlooker()
    for _ in range(LOOKS_UNTIL_KNOWN + 1):
        before, _ = onlooker.look()
    monkeypatch.setattr(Asking, "told", counted)
    assert onlooker.look()[0] == before
    assert taken_apart == []
    sockets.udp.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, 9)
    assert onlooker.look()[0] == anew()
    assert sum(taken_apart) >= 1
    for _ in range(LOOKS_UNTIL_KNOWN):
        after, _ = onlooker.look()
    taken_apart.clear()
    assert onlooker.look()[0] == after == anew()
    assert taken_apart == []


def _attach_filter(one: socket.socket, instructions: bytes = PASS_ALL) -> None:
    program = ctypes.create_string_buffer(instructions, len(instructions))
    one.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("H6xQ", 1, ctypes.addressof(program)))


def _reopened(sockets: Sockets) -> None:
    """Another socket, like the one before, under the same number."""
    number = sockets.udp.fileno()
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    os.dup2(other.fileno(), number)
    other.close()


def _replaced(sockets: Sockets) -> None:
    """A socket of another family under the same number."""
    os.dup2(sockets.unix_datagrams.fileno(), sockets.tcp.fileno())


def _joined(sockets: Sockets) -> None:
    sockets.udp.setsockopt(
        socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton("224.0.0.251") + socket.inet_aton("127.0.0.1")
    )


def _told_an_error(sockets: Sockets) -> None:
    """A datagram to where nobody listens: the error waits."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
    sockets.bound_udp.connect(("127.0.0.1", port))
    sockets.bound_udp.send(b"is anybody there?")
    poll = select.poll()
    poll.register(sockets.bound_udp, 0)
    assert poll.poll(60_000)


def _reset(sockets: Sockets) -> None:
    sockets.accepted.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sockets.accepted.close()


def _half_closed(sockets: Sockets) -> None:
    """Shut down, and its peer has acknowledged that."""
    sockets.client.shutdown(socket.SHUT_WR)
    deadline = time.monotonic() + 60
    while sockets.client.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != FIN_WAIT_2:
        assert time.monotonic() < deadline
        time.sleep(0.001)


CHANGES: dict[str, Callable[[Sockets], object]] = {
    "an option of TCP": lambda it: it.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    "an option of a connection": lambda it: it.client.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1234),
    "an option of IPv6": lambda it: it.tcp6.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1),
    "an option of datagrams": lambda it: it.udp.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, 9),
    "a longer option": lambda it: it.udp.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0"),
    "an option of a unix socket": lambda it: it.unix.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1),
    "the size of a buffer": lambda it: it.unix.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16384),
    "a filter": lambda it: _attach_filter(it.udp),
    "its owner": lambda it: os.fchown(it.tcp.fileno(), 12, 34),
    "an address": lambda it: it.udp.bind(("127.0.0.1", 0)),
    "a peer of datagrams": lambda it: it.udp.connect(("127.0.0.1", 9)),
    "that it listens": lambda it: (it.tcp.bind(("127.0.0.1", 0)), it.tcp.listen()),
    "another backlog": lambda it: it.listener.listen(7),
    "a connection that waits": lambda it: it.tcp.connect(it.listener.getsockname()),
    "what waits in a connection": lambda it: it.accepted.send(b"content"),
    "what waits in a socket for datagrams": lambda it: it.udp.sendto(b"content", it.bound_udp.getsockname()),
    "an empty datagram": lambda it: it.udp.sendto(b"", it.bound_udp.getsockname()),
    "what waits in a unix socket": lambda it: it.other_end.send(b"content"),
    "an end that was shut down": lambda it: it.unix.shutdown(socket.SHUT_WR),
    "an end of TCP that was shut down": _half_closed,
    "what was shut down of datagrams": lambda it: (it.bound_udp.connect(("127.0.0.1", 9)), it.bound_udp.shutdown(socket.SHUT_WR)),
    "that its peer has gone": lambda it: it.other_end.close(),
    "that its connection was reset": _reset,
    "an error that waits": _told_an_error,
    "another socket of its number": _reopened,
    "another kind of socket of its number": _replaced,
    "a group": _joined,
    "the name of a unix socket": lambda it: it.path.rename(it.path.with_name("other")),
    "the mode of that name": lambda it: it.path.chmod(0o600),
    "that its name was deleted": lambda it: it.path.unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_changes_is_seen(change: str, sockets: Sockets) -> None:
    onlooker = Onlooker()
    for _ in range(LOOKS_UNTIL_KNOWN):
        before, _ = onlooker.look()
    CHANGES[change](sockets)
    for _ in range(LOOKS_UNTIL_KNOWN):
        after, _ = onlooker.look()
        assert after != before
        assert after == anew()


def test_only_the_shutdown_of_sending_is_seen_by_the_kernels_list_alone(sockets: Sockets) -> None:
    onlooker = Onlooker()
    sockets.bound_udp.connect(("127.0.0.1", 9))
    for _ in range(LOOKS_UNTIL_KNOWN):
        before, _ = onlooker.look()
    sockets.bound_udp.shutdown(socket.SHUT_WR)
    after, _ = onlooker.look()
    assert after[sockets.bound_udp.fileno()]["shutdown"] != before[sockets.bound_udp.fileno()]["shutdown"]


def test_a_filter_as_long_as_the_one_before_is_seen(sockets: Sockets) -> None:
    onlooker = Onlooker()
    for instructions in (PASS_ALL, PASS_ALL, PASS_SOME):
        _attach_filter(sockets.udp, instructions)
        for _ in range(LOOKS_UNTIL_KNOWN):
            facts, _ = onlooker.look()
            assert facts[sockets.udp.fileno()]["filter"] == instructions


def test_what_waits_in_a_socket_that_nothing_is_read_from_any_more_is_seen(sockets: Sockets) -> None:
    """What poll(2) says of it does not change by that."""
    onlooker = Onlooker()
    sender = sockets.made(socket.AF_INET, socket.SOCK_DGRAM)
    sender.bind(("127.0.0.1", 0))
    sockets.bound_udp.connect(sender.getsockname())
    sockets.bound_udp.shutdown(socket.SHUT_RD)
    for _ in range(LOOKS_UNTIL_KNOWN):
        before, _ = onlooker.look()
    sender.sendto(b"content", sockets.bound_udp.getsockname())
    after, _ = onlooker.look()
    assert before[sockets.bound_udp.fileno()]["queue"] == []
    assert after[sockets.bound_udp.fileno()]["queue"] == [b"content"]


def test_what_was_changed_and_changed_back_is_known_again(sockets: Sockets) -> None:
    onlooker = Onlooker()
    for _ in range(LOOKS_UNTIL_KNOWN):
        onlooker.look()
    assert onlooker.recalls(sockets.bound_udp)
    sockets.udp.sendto(b"content", sockets.bound_udp.getsockname())
    assert not onlooker.recalls(sockets.bound_udp)
    sockets.bound_udp.recv(64)
    assert not onlooker.recalls(sockets.bound_udp), "what it answered when something waited is not what it answers now"
    facts, _ = onlooker.look()
    assert onlooker.recalls(sockets.bound_udp)
    assert facts[sockets.bound_udp.fileno()]["queue"] == []


def test_a_connection_of_ipv4_says_whom_it_is_with_where_it_has_ended_too(sockets: Sockets) -> None:
    asking = Asking(Subject(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP, ()))
    _, state = asking.ask(sockets.client.fileno())
    host, port = sockets.client.getpeername()
    by_name_and_by_option = 2
    assert state.count(struct.pack(">H", port) + socket.inet_aton(host)) == by_name_and_by_option


def test_a_socket_whose_name_cannot_be_looked_up_just_now_is_looked_into(
    sockets: Sockets, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: object) -> None:
        raise ProcessLookupError

    onlooker = Onlooker()
    for _ in range(LOOKS_UNTIL_KNOWN):
        facts, _ = onlooker.look()
    monkeypatch.setattr(unix, "again", gone)
    found, opened = onlooker.look()
    assert found == facts
    assert sockets.named.fileno() not in opened.recalled


def test_of_a_process_that_has_ended_no_copies_can_be_had() -> None:
    ended = os.posix_spawn("/bin/true", ["true"], {})
    os.waitpid(ended, 0)
    with Copier([0, 1]).taken(ended) as copies:
        assert list(copies) == [NOT_YET, NOT_YET]


def test_questions_about_groups_that_the_machine_has_no_more_are_forgotten(sockets: Sockets) -> None:
    onlooker = Onlooker()
    for _ in range(LOOKS_UNTIL_KNOWN):
        onlooker.look()
    before = len(onlooker.recollection._askings)
    for last in range(5):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            request = socket.inet_aton(f"239.1.2.{last}") + socket.inet_aton("127.0.0.1")
            other.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)
            for _ in range(LOOKS_UNTIL_KNOWN):
                onlooker.look()
    for _ in range(LOOKS_UNTIL_KNOWN):
        onlooker.look()
    assert len(onlooker.recollection._askings) == before


def test_that_we_have_no_descriptor_left_is_not_what_is_known_of_a_kind_of_socket(
    sockets: Sockets, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    sockets.udp.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, 7)
    onlooker = Onlooker()
    before, _ = onlooker.look()
    kinds_of_sockets._fresh_options.cache_clear()
    with monkeypatch.context() as patched:
        patched.setattr(socket, "socket", none_left)
        onlooker.recollection.prepare()
    for _ in range(LOOKS_UNTIL_KNOWN):
        after, _ = onlooker.look()
        assert after == before
    assert onlooker.recalls(sockets.udp)


def test_no_descriptor_of_ours_stays_open(sockets: Sockets) -> None:
    onlooker = Onlooker()
    before = os.listdir("/proc/self/fd")
    for _ in range(LOOKS_UNTIL_KNOWN):
        onlooker.look()
    assert os.listdir("/proc/self/fd") == before
