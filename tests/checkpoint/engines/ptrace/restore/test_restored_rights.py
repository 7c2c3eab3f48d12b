"""What a restore does not do with its own rights: names that belong to others, and more than its user had."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.arch import stubs
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import rebuild
from checkpoint.resources.files import unlinked
from checkpoint.resources.ipc import fifos
from checkpoint.resources.sockets import netlink, unix_names
from checkpoint.resources.sockets.peer_credentials import Disguise
from tests.checkpoint.snapshots import process


def bound(path: Path, kind: int = socket.SOCK_DGRAM) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, kind)
    made.bind(str(path))
    return made


def free(path: Path) -> None:
    """Nothing is there."""


def dead(path: Path) -> None:
    bound(path).close()


def regular(path: Path) -> None:
    path.write_text("kept")


def link_to_nothing(path: Path) -> None:
    path.symlink_to(path.with_name("nowhere"))


@pytest.mark.parametrize(("make", "expected"), [(free, True), (dead, True), (regular, False), (link_to_nothing, False)])
def test_only_a_free_name_or_a_dead_sockets_is_abandoned(make: Callable[[Path], None], expected: bool, tmp_path: Path) -> None:
    make(tmp_path / "name")
    assert unix_names.is_abandoned(str(tmp_path / "name")) is expected


def test_a_name_in_no_directory_is_not_abandoned(tmp_path: Path) -> None:
    assert not unix_names.is_abandoned(str(tmp_path / "none" / "name"))


def test_a_sender_that_hears_only_its_receiver_lives(tmp_path: Path) -> None:
    with bound(tmp_path / "sender") as sender, bound(tmp_path / "receiver") as receiver:
        sender.connect(str(tmp_path / "receiver"))
        receiver.close()
        assert unix_names.is_answered(str(tmp_path / "sender"))
        assert not unix_names.is_abandoned(str(tmp_path / "sender"))


def test_a_deleted_file_gets_no_attribute_that_takes_more_than_its_user_may() -> None:
    table = CallTable(0x10000)
    attributes: dict[str, Fact] = {"user.colour": b"red", "security.capability": b"all", "trusted.overlay.opaque": b"y"}
    facts: dict[str, Fact] = {"path": "/gone", "flags": 0, "size": 0, "content": [], "mode": 0o100755, "attributes": attributes}
    rebuild._finish(table, 3, Resource("files", "fd 3", facts), 0o100755)
    given = [call for call in table.calls if call.number == stubs.SYSTEM_CALLS["setxattr"]]
    assert len(given) == 1
    assert b"user.colour" in table.content and b"security." not in table.content


def disguise(uid: int) -> Disguise:
    """A vessel of root's that will be a program of this user's."""
    vessel = replace(procfs.status(os.getpid()), uids=(0, 0, 0, 0), gids=(0, 0, 0, 0))
    program = process()
    credentials = replace(program.credentials, uids=(uid,) * 4, gids=(uid,) * 4)
    return Disguise(vessel, replace(program, credentials=credentials), True, 1)


@pytest.mark.parametrize("facts", [{}, {"maker": [], "user": []}, {"maker": [7, 1000, 1000], "user": [1000, 1000]}])
def test_nothing_is_made_as_root_for_somebody_else(facts: dict[str, Fact]) -> None:
    for as_whom in (disguise(1000).as_maker, disguise(1000).as_owner):
        table = CallTable(0x10000)
        with as_whom(table, Resource("unix_sockets", "fd 3", facts)):
            before = [(call.number, call.arguments[:2]) for call in table.calls]
        assert (stubs.SYSTEM_CALLS["setresuid"], (1000, 1000)) in before


@pytest.mark.parametrize(("uid", "gid"), [(0, 0), (0, 1000), (1000, 0), (1001, 1000)])
def test_an_ordinary_users_socket_is_made_as_nobody_else_whatever_it_says(uid: int, gid: int) -> None:
    held = Resource("unix_sockets", "fd 3", {"maker": [1, uid, gid], "user": [uid, gid]})
    for as_whom in (disguise(1000).as_maker, disguise(1000).as_owner):
        table = CallTable(0x10000)
        with as_whom(table, held):
            before = [(call.number, call.arguments[:2]) for call in table.calls]
        assert before[-2:] == [
            (stubs.SYSTEM_CALLS["setresgid"], (1000, 1000)),
            (stubs.SYSTEM_CALLS["setresuid"], (1000, 1000)),
        ]
    assert any("another user" in note for note in disguise(1000).notes([held]))


def by_node(table: CallTable, path: str) -> None:
    unlinked.make_node(table, path, stat.S_IFIFO | 0o640)


def by_directory(table: CallTable, path: str) -> None:
    unlinked.make_directory(table, path, 0o750)


def by_named_pipe(table: CallTable, path: str) -> None:
    fifos._make(table, path, 0o640)


@pytest.mark.parametrize("make", [by_node, by_directory, by_named_pipe])
def test_the_mode_is_given_to_what_was_made_and_not_to_its_name(make: Callable[[CallTable, str], None], tmp_path: Path) -> None:
    table = CallTable(0x10000)
    make(table, str(tmp_path / "made"))
    (given,) = (call for call in table.calls if call.number == stubs.SYSTEM_CALLS["fchmodat"])
    offset = given.arguments[1] - (table.place(b"") - len(table.content))
    assert bytes(table.content)[offset:].startswith(b"/proc/self/fd/")


@pytest.mark.parametrize(("owner", "expected"), [(1000, ["setresgid", "setresuid", "socket"]), (0, ["socket"])])
def test_a_netlink_socket_is_opened_by_whom_it_belongs_to(owner: int, expected: list[str]) -> None:
    vessel = replace(procfs.status(os.getpid()), uids=(0, 0, 0, 0), gids=(0, 0, 0, 0))
    facts: dict[str, Fact] = {"family": 16, "type": 3, "protocol": 0, "socket": 7, "user": [owner, owner], "options": []}
    facts |= {"port": 0, "groups": [], "peer": [], "flags": 2}
    table = CallTable(0x10000)
    netlink.prepare(table, [Resource("netlink_sockets", "fd 3", facts)], 10, Disguise(vessel, process(), True, 1))
    names = {number: name for name, number in stubs.SYSTEM_CALLS.items()}
    assert [names[call.number] for call in table.calls][: len(expected)] == expected
