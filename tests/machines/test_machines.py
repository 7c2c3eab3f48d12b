"""Machines of other kinds, emulated: programs live three lives there. Takes many minutes each: ``FAILOVER_TEST_MACHINES``.

That is "all", or names of `tests.machines.emulated.KINDS`, with commas between them. ``FAILOVER_TEST_MACHINES_DIRECTORY`` names a
directory where they are kept for the next time. ``FAILOVER_TEST_KERNEL`` names packages with a kernel of your own, a robot's for
example (``linux-image-….deb,linux-modules-….deb``); this adds one machine.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from checkpoint.arch import TRY_UNPROVED, UNPROVED
from tests.machines.emulated import KINDS, Kind, Machine

pytestmark = pytest.mark.timeout(7200)

ENVIRONMENT = "PYTHONPATH=/opt/site:/root/failover"
TESTS = (
    ("tests/checkpoint/arch/test_processors.py", ""),
    ("tests/checkpoint/test_tracees.py", "heap or registers or mappings or advice or rseq or sigwait or sigsuspend"),
    ("tests/checkpoint/linux/trace/test_syscall_reentry.py", ""),
    ("tests/checkpoint/linux/trace/test_stopped_again.py", "takes_effect or keeper_enters or no_call"),
    ("tests/checkpoint/engines/ptrace/capture/test_eintr_syscalls.py", "relative_sleep or epoll-thread or inline or bytes"),
    ("tests/checkpoint/test_programs.py", "computes_the_same and bc"),
)
"""Of `checkpoint`, what is seen to pass there: file and names."""
TEST_S = 3600.0


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: kind.name)
def machine(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """One that runs."""
    kind: Kind = request.param
    if reason := kind.unwanted() or kind.lacking():
        pytest.skip(reason)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    made = Machine(kind, kind.place(tmp_path_factory.mktemp("machine")), port)
    made.make()
    with made.booted():
        yield made


def test_a_program_is_refused_by_name_and_the_way_that_works_is_told(machine: Machine) -> None:
    if machine.kind.processor not in UNPROVED:
        pytest.skip("this processor is supported")
    seen = machine.run(f"cd /root/failover && {ENVIRONMENT} python3 -m failover capture $$ -o /tmp/snapshot")
    assert seen.returncode == 1, seen.stdout
    assert machine.kind.processor.encode() in seen.stdout and b"docs/decorator.md" in seen.stdout


def test_the_machine_can_protect_programs(machine: Machine) -> None:
    seen = machine.run(f"cd /root/failover && {ENVIRONMENT} {TRY_UNPROVED}=1 python3 -m failover check")
    assert seen.returncode == 0, seen.stdout
    assert b"this machine can protect programs" in seen.stdout


@pytest.mark.parametrize(("file", "names"), TESTS, ids=[file for file, _ in TESTS])
def test_what_holds_elsewhere_holds_there(machine: Machine, file: str, names: str) -> None:
    pytest_command = f"python3 -m pytest -q -p no:cacheprovider --timeout 900 {file} -k '{names}'"
    seen = machine.run(f"cd /root/failover && {ENVIRONMENT} {TRY_UNPROVED}=1 {pytest_command}", timeout_s=TEST_S)
    assert seen.returncode == 0, seen.stdout.decode(errors="replace")[-6000:]
    assert b" passed" in seen.stdout
