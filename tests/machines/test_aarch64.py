"""A machine of aarch64, emulated: programs go through three lives there. Takes many minutes: ``FAILOVER_TEST_MACHINES=1``.

``FAILOVER_TEST_MACHINES_DIRECTORY`` names a directory where the machine is kept for the next time.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.arch import TRY_UNPROVED
from tests.machines import emulated
from tests.machines.emulated import Machine

pytestmark = [
    pytest.mark.skipif(os.environ.get("FAILOVER_TEST_MACHINES") != "1", reason="FAILOVER_TEST_MACHINES=1 has machines emulated"),
    pytest.mark.timeout(7200),
]

ENVIRONMENT = "PYTHONPATH=/opt/site:/root/failover PYTHONDONTWRITEBYTECODE=1"
TESTS = (
    ("tests/checkpoint/test_processors.py", ""),
    ("tests/checkpoint/test_tracees.py", "heap or registers or mappings or advice"),
    ("tests/checkpoint/test_programs.py", "computes_the_same and bc"),
)
"""Of `checkpoint`, what is seen to pass there: file and names."""
TEST_S = 3600.0


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """One that runs."""
    if reason := emulated.lacking():
        pytest.skip(reason)
    kept = os.environ.get("FAILOVER_TEST_MACHINES_DIRECTORY")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    made = Machine(Path(kept or tmp_path_factory.mktemp("machine")) / "aarch64", port)
    made.make()
    with made.booted():
        yield made


def test_a_program_is_refused_by_name_and_the_way_that_works_is_told(machine: Machine) -> None:
    seen = machine.run(f"cd /root/failover && {ENVIRONMENT} python3 -m failover capture $$ -o /tmp/snapshot")
    assert seen.returncode == 1, seen.stdout
    assert b"aarch64" in seen.stdout and b"docs/decorator.md" in seen.stdout


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
