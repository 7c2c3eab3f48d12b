"""Pending signals: all are reported, in however many calls the kernel reports them."""

from __future__ import annotations

import ctypes
import os

from checkpoint.linux import abi
from checkpoint.linux.trace.tracee import Tracee

QUEUED = 3


class OneAtATime(Tracee):
    """A thread of which the kernel tells one signal in a go, as it does when a signal waits for the asker."""

    def request(self, what: str, request: int, address: int = 0, value: int = 0) -> int:
        """Answer PTRACE_PEEKSIGINFO."""
        assert request == abi.PTRACE_PEEKSIGINFO
        order = abi.PeekSiginfo.from_address(address)
        if order.offset >= QUEUED:
            return 0
        ctypes.memset(value, 1 + order.offset, abi.SIGINFO_SIZE)
        return 1


def test_signals_that_the_kernel_breaks_off_in_the_middle_of_are_all_told() -> None:
    told = OneAtATime(os.getpid()).pending(shared=False)
    assert [siginfo[0] for siginfo in told] == [1, 2, 3]
    assert {len(siginfo) for siginfo in told} == {abi.SIGINFO_SIZE}
