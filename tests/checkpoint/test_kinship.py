"""Whose streams are whose, also when those who started a program have ended meanwhile."""

from __future__ import annotations

import os
import subprocess

from checkpoint.linux.kinship import Children, Kinship


def test_an_ancestor_that_has_ended_has_no_stream_any_more() -> None:
    with subprocess.Popen(["true"]) as ancestor:
        ancestor.wait()
    kin = Kinship(os.getpid(), 0)
    try:
        kin._of_ancestors = (Children(ancestor.pid),)
        assert kin._streams_of_first() == [0, 1, 2]
    finally:
        kin.close()
