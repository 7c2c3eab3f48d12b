"""The guard's end of the task socket: which process may keep a state, the order of messages, and that no client can upset it."""

from __future__ import annotations

import array
import contextlib
import os
import socket
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.guard.messages import TaskConnected, TaskKeeps
from agent.guard.task_socket import TaskEnd, Told
from checkpoint.segment.task_messages import (
    TAKEN_OVER,
    VARIABLE,
    Begin,
    FromGuard,
    Hello,
    Keeps,
    Kept,
    Origin,
    Refused,
    Safe,
    encode,
    from_guard,
)

NAME = "/lab/heater"
ORIGIN = Origin("robot1", 129, TAKEN_OVER, 5)
ME = os.getpid()


@pytest.fixture
def end() -> Iterator[TaskEnd]:
    """One that knows its program's output, and not yet how it begins."""
    with flowing() as made:
        yield made


@contextlib.contextmanager
def flowing() -> Iterator[TaskEnd]:
    made = TaskEnd(NAME, os.geteuid())
    read, write = os.pipe()
    counters = os.memfd_create("counters")
    made.flows_into(counters, (write, write))
    for descriptor in (read, write, counters):
        os.close(descriptor)
    yield made
    made.close()


def caller(end: TaskEnd) -> socket.socket:
    """A process of this user that connects: this one."""
    program = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    program.settimeout(5)
    program.connect("\0" + end.environment[VARIABLE][1:])
    return program


def said(end: TaskEnd, program: socket.socket, *contents: bytes) -> tuple[Told, ...]:
    """What the agent hears of packets."""
    for content in contents:
        program.send(content)
    return end.heed()


def heard(program: socket.socket) -> tuple[FromGuard | None, int]:
    """What the guard says, None if it hangs up, and with how many descriptors."""
    try:
        content, ancillary, _, _ = program.recvmsg(1024, 1024)
    except ConnectionResetError:  # it hung up before it had read everything: what it said comes afterwards
        content, ancillary, _, _ = program.recvmsg(1024, 1024)
    descriptors = array.array("i")
    for _, _, packed in ancillary:
        descriptors.frombytes(packed)
    for descriptor in descriptors:
        os.close(descriptor)
    return (from_guard(content) if content else None), len(descriptors)


def refusal(program: socket.socket) -> str:
    """Why the guard hangs up."""
    packet, _ = heard(program)
    assert isinstance(packet, Refused)
    assert heard(program) == (None, 0)
    return packet.text


def kept(end: TaskEnd) -> socket.socket:
    """A process that has committed something."""
    program = caller(end)
    end.begin(3)
    assert said(end, program, encode(Hello())) == (TaskConnected(ME),)
    assert isinstance(heard(program)[0], Begin)
    assert said(end, program, encode(Keeps())) == (TaskKeeps(ME),)
    return program


def test_a_program_begins_when_it_has_said_hello_and_is_known_how(end: TaskEnd) -> None:
    end.begin(3)
    with caller(end) as program:
        assert said(end, program, encode(Hello())) == (TaskConnected(ME),)
        packet, count = heard(program)
        assert isinstance(packet, Begin) and (packet.component, packet.epoch, packet.origin, count) == (NAME, 3, None, 1)


def test_a_program_that_waits_is_begun_later_with_its_state(end: TaskEnd) -> None:
    with caller(end) as program:
        assert said(end, program, encode(Hello())) == (TaskConnected(ME),)
        program.setblocking(False)
        with pytest.raises(BlockingIOError):
            program.recv(1024)
        segment = os.memfd_create("state")
        end.begin(4, ORIGIN, segment)
        os.close(segment)
        program.settimeout(5)
        packet, count = heard(program)
        assert isinstance(packet, Begin) and (packet.epoch, packet.origin, count) == (4, ORIGIN, 2)


def test_only_what_is_newer_is_told_to_be_safe_and_only_to_who_has_begun(end: TaskEnd) -> None:
    end.tell_safe(1)
    with kept(end) as program:
        for commit in (2, 2, 1, 5):
            end.tell_safe(commit)
        assert [heard(program)[0] for _ in range(2)] == [Safe(2), Safe(5)]
        for commit in (6, 6, 7):
            end.tell_kept(commit)
        assert [heard(program)[0] for _ in range(2)] == [Kept(6), Kept(7)]


def test_what_did_not_fit_is_told_the_next_time(end: TaskEnd) -> None:
    with kept(end) as program:
        for commit in range(1, 3000):
            end.tell_safe(commit)
        program.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                program.recv(1024)
        program.settimeout(5)
        end.tell_safe(2999)
        assert heard(program)[0] == Safe(2999)


def test_a_second_process_is_told_who_keeps_the_state_and_disturbs_nobody(end: TaskEnd) -> None:
    with kept(end) as program, caller(end) as second:
        assert end.heed() == ()
        assert f"pid {ME} keeps its state already" in refusal(second)
        end.tell_safe(7)
        assert heard(program)[0] == Safe(7)


def test_a_state_whose_process_has_ended_is_kept_by_no_other(end: TaskEnd) -> None:
    kept(end).close()
    assert end.heed() == () and (end.pid, end.keeps) == (ME, True)
    with caller(end) as second:
        assert end.heed() == ()
        assert "kept its state and has ended" in refusal(second)


def test_a_process_that_committed_nothing_leaves_the_state_to_the_next(end: TaskEnd) -> None:
    segment = os.memfd_create("state")
    end.begin(4, ORIGIN, segment)
    os.close(segment)
    first = caller(end)
    said(end, first, encode(Hello()))
    first.close()
    assert end.heed() == (TaskConnected(0),) and end.pid == 0
    with caller(end) as second:
        said(end, second, encode(Hello()))
        packet, count = heard(second)
        assert isinstance(packet, Begin) and (packet.origin, count) == (ORIGIN, 2)


@pytest.mark.root
def test_a_process_of_another_user_is_turned_away(end: TaskEnd) -> None:
    program = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    os.seteuid(12345)  # the kernel notes who connects as who connects
    try:
        program.connect("\0" + end.environment[VARIABLE][1:])
    finally:
        os.seteuid(0)
    with program:
        assert end.heed() == ()
        assert "uid 12345 may not keep the state" in refusal(program)


@pytest.mark.parametrize(
    ("contents", "sentence"),
    [
        ([b"\x01"], "a packet of 1 bytes"),
        ([encode(Hello())[:4] + b"\x02\0\0\0"], "version 2"),
        ([encode(Hello()) + b"\0" * 4096], "kind 1 has 8 bytes"),
        ([encode(Keeps())], "before the guard told it how to begin"),
        ([encode(Safe(1))], "none that programs send"),
        ([encode(Hello()), encode(Hello())], "Hello was said twice"),
    ],
)
def test_who_breaks_the_rules_is_told_which_and_hung_up_on(end: TaskEnd, contents: list[bytes], sentence: str) -> None:
    with caller(end) as program:
        said(end, program, *contents)
        assert sentence in refusal(program)
    kept(end).close()


def test_descriptors_that_a_program_sends_are_not_kept(end: TaskEnd) -> None:
    with kept(end) as program:
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(8):
            socket.send_fds(program, [encode(Keeps())], [0] * 100)
        assert end.heed() == (TaskKeeps(ME),) * 8
        assert len(os.listdir("/proc/self/fd")) == before


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([encode(Hello()), encode(Keeps())]) | st.binary(min_size=1, max_size=520), max_size=6))
def test_whatever_a_program_says_its_guard_goes_on(contents: list[bytes]) -> None:
    with flowing() as end, caller(end) as program:
        end.begin(3)
        with contextlib.suppress(BrokenPipeError):
            for told in said(end, program, *contents):
                assert isinstance(told, TaskConnected | TaskKeeps)
        end.tell_safe(1)
        with caller(end) as second:
            second.send(encode(Hello()))
            end.heed()
            assert heard(second)[0] is not None, "it is answered: begun, or refused"
