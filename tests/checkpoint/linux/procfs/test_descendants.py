"""Which program owns which streams, also when the processes that started the program have ended meanwhile."""

from __future__ import annotations

import os
import subprocess
import threading

from checkpoint.linux.procfs.descendants import Children, Kinship


def test_an_ancestor_that_has_ended_has_no_stream_any_more() -> None:
    with subprocess.Popen(["true"]) as ancestor:
        ancestor.wait()
    kin = Kinship(os.getpid(), 0)
    try:
        kin._of_ancestors = (Children(ancestor.pid),)
        assert kin._streams_of_first() == [0, 1, 2]
    finally:
        kin.close()


def test_a_child_is_seen_whenever_it_is_born_and_by_whichever_thread() -> None:
    """At first, and when all have been asked before."""
    go_on = threading.Semaphore(0)
    done = threading.Semaphore(0)
    born: list[subprocess.Popen[bytes]] = []

    def live() -> None:
        go_on.acquire()
        born.append(subprocess.Popen(["sleep", "600"]))
        done.release()
        go_on.acquire()

    thread = threading.Thread(target=live)
    thread.start()
    assert thread.native_id is not None
    tids = [os.getpid(), thread.native_id]
    before = Children(os.getpid()).read([os.getpid()])
    children = Children(os.getpid())
    try:
        only = tids[1:]
        assert not children.are_there(only)
        assert not children.are_there(only)
        go_on.release()
        done.acquire()
        assert children.are_there(only)
        assert Children(os.getpid()).are_there(only)
        assert children.read(only) == [born[0].pid]
        assert children.are_there(tids)
        assert set(children.read(tids)) == {*before, born[0].pid}
    finally:
        go_on.release(2)
        thread.join()
        for child in born:
            child.kill()
            child.wait()
        children.close()
