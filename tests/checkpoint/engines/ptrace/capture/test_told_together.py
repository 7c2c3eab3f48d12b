"""Refusals that are possible only when several reported facts are checked together."""

from __future__ import annotations

import ctypes
import os
import socket
import threading
from pathlib import Path

import pytest

from checkpoint.errors import CaptureError
from checkpoint.model import Fact, Resource
from checkpoint.resources.events import pidfd
from checkpoint.resources.open_file import Surroundings
from checkpoint.resources.process import shared_with_parent, unshared_threads
from checkpoint.resources.registry import findings_of_all
from checkpoint.resources.sockets import unix_names


@pytest.mark.parametrize(("passed", "thread", "is_refused"), [(5, 7, True), (6, 7, False), (5, 0, False)])
def test_a_pidfd_of_a_thread_that_is_on_its_way_too_is_refused(passed: int, thread: int, is_refused: bool) -> None:
    of_thread: dict[str, Fact] = {"descriptors": [[3, 0], [5, 1]], "flags": 0, "pid": 0, "thread": thread}
    sending = Resource("sockets", "fd 4", {"descriptors": [[4, 0]], "passed": [[], [passed]]})
    found = findings_of_all([sending, Resource(pidfd.KIND, "fd 3", of_thread)], Surroundings(), standing=True)
    assert ["fd 3 is a pidfd of the single thread 7 that is on its way" in one.text for one in found] == [True] * is_refused


@pytest.mark.parametrize(
    ("flags", "files", "is_refused"),
    [
        (shared_with_parent.CLONE_FILES, [], True),
        (shared_with_parent.CLONE_FILES, 0, False),
        (shared_with_parent.CLONE_FS, [], False),
    ],
)
def test_a_thread_with_files_of_its_own_where_the_process_has_its_parents_is_refused(
    flags: int, files: Fact, is_refused: bool
) -> None:
    with_parent = Resource(shared_with_parent.KIND, "", {"descriptors": [], "flags": flags})
    of_threads = Resource(unshared_threads.KIND, "", {"descriptors": [], "threads": [[7, "", 18, files]]})
    reasons = list(shared_with_parent.refuse([with_parent], os.getpid(), [of_threads]))
    assert ["it has its open files in common with its parent" in reason for reason in reasons] == [True] * is_refused


def test_who_has_the_name_of_a_socket_whose_file_is_gone_is_looked_for_where_it_is_bound(tmp_path: Path) -> None:
    """Its directory has got another name since: the file was there when it was deleted."""
    told, path = str(tmp_path / "told"), str(tmp_path / "renamed" / "told")
    facts: dict[str, Fact] = {"name": os.fsencode(told) + b"\0", "path": path, "mode": unix_names.GONE, "type": socket.SOCK_DGRAM}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as others:
        others.bind(told)
        assert ["is another process's here" in one for one in unix_names.mismatches(Resource("", "fd 3", facts))] == [True]
    assert not list(unix_names.mismatches(Resource("", "fd 3", facts)))


@pytest.mark.parametrize("is_together", [False, True])
def test_threads_that_share_what_the_first_has_not_are_told_from_those_that_have_it_alone(is_together: bool) -> None:
    """Who is born of a thread with a directory of its own shares that, until it takes its own."""
    born, done = threading.Barrier(3), threading.Event()

    def live(*, takes_own: bool, has_child: bool) -> None:
        assert not takes_own or ctypes.CDLL(None).unshare(unshared_threads.CLONE_FS) == 0
        child = threading.Thread(target=live, kwargs={"takes_own": not is_together, "has_child": False})
        if has_child:
            child.start()
        born.wait()
        done.wait()
        if has_child:
            child.join()

    mother = threading.Thread(target=live, kwargs={"takes_own": True, "has_child": True})
    mother.start()
    born.wait()
    tables = unshared_threads.ThreadTables(os.getpid())
    try:
        tables.prepare()
        tables.look()
        if is_together:
            with pytest.raises(CaptureError, match="that two of its threads share, but not all"):
                tables.describe()
        else:
            (told,) = tables.describe()
            assert len(list(unshared_threads._threads([told]))) == 2
    finally:
        done.set()
        mother.join()
