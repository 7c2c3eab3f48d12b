"""What a restore does not do with its own rights: names that are somebody else's, and what is more than its user had."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from checkpoint.arch.x86_64_stub import SYSTEM_CALLS
from checkpoint.linux import procfs
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import netlink_sockets, rebuild, unix_names
from checkpoint.resources.unix_makers import Disguise
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
    given = [call for call in table.calls if call.number == SYSTEM_CALLS["setxattr"]]
    assert len(given) == 1
    assert b"user.colour" in table.content and b"security." not in table.content


@pytest.mark.parametrize(("owner", "expected"), [(1000, ["setresgid", "setresuid", "socket"]), (0, ["socket"])])
def test_a_netlink_socket_is_opened_by_whom_it_belongs_to(owner: int, expected: list[str]) -> None:
    vessel = replace(procfs.status(os.getpid()), uids=(0, 0, 0, 0), gids=(0, 0, 0, 0))
    facts: dict[str, Fact] = {"family": 16, "type": 3, "protocol": 0, "socket": 7, "user": [owner, owner], "options": []}
    facts |= {"port": 0, "groups": [], "peer": [], "flags": 2}
    table = CallTable(0x10000)
    netlink_sockets.prepare(table, [Resource("netlink_sockets", "fd 3", facts)], 10, Disguise(vessel, process(), True, 1))
    names = {number: name for name, number in SYSTEM_CALLS.items()}
    assert [names[call.number] for call in table.calls][: len(expected)] == expected
