"""keepalived beside us: how soon after a power cut its second machine has the address. No program and no memory moves with it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from benchmarks.alternatives import call
from benchmarks.running import BenchmarkError

WHO: Final = "keepalived, an address and no program"
ADVERT_S: Final = 0.01
ADDRESS: Final = "10.77.3.100"
"""That moves, between 10.77.3.1 and 10.77.3.2: in namespaces of ours alone."""

PATIENCE_S: Final = 30.0
SETTLED_S: Final = 0.5
"""Adverts have been exchanged by then."""

CONFIGURATION: Final = """
global_defs {{
    vrrp_version 3
    vrrp_rt_priority 50
    vrrp_no_swap
}}
vrrp_instance measured {{
    interface wire
    state BACKUP
    virtual_router_id 77
    priority {priority}
    advert_int {advert_s}
    virtual_ipaddress {{
        {address}/24
    }}
}}
"""

BIND: Final = """
import socket, sys, time
while True:
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((sys.argv[1], 0))
        print(time.time(), flush=True)
        break
    except OSError:
        time.sleep(0.0005)
"""
"""Says when the address is there."""


def why_absent() -> str:
    """Why it cannot be measured here; "" when it can."""
    if shutil.which("keepalived") is None:
        return "not installed (Debian package keepalived)"
    return "" if os.geteuid() == 0 else "needs root"


def outages(count: int, directory: Path) -> tuple[float, ...]:
    """Milliseconds from each of so many power cuts to the address at the other machine.

    Raises:
        BenchmarkError: it does not come about.
    """
    directory.mkdir()
    return tuple(_outage(directory / str(number)) for number in range(count))


def _outage(directory: Path) -> float:
    directory.mkdir()
    with _wired() as (primary, standby), ExitStack() as stack:
        first = stack.enter_context(_keepalived(primary, directory / "primary", 150))
        with _watched(primary) as there:
            _instant(there, directory)
        stack.enter_context(_keepalived(standby, directory / "standby", 100))
        time.sleep(SETTLED_S)
        with _watched(standby) as there:
            if there.poll() is not None:
                raise BenchmarkError("keepalived: both machines have the address before the power cut")
            time.sleep(SETTLED_S)
            cut = time.time()
            _signal_all(first, signal.SIGSTOP)
            return (_instant(there, directory) - cut) * 1000


@contextmanager
def _wired() -> Iterator[tuple[str, str]]:
    """Two namespaces with a cable between them."""
    names = f"keepalived-{os.getpid()}-1", f"keepalived-{os.getpid()}-2"
    try:
        for name in names:
            call(["ip", "netns", "add", name])
        call(["ip", "link", "add", "wire", "netns", names[0], "type", "veth", "peer", "name", "wire", "netns", names[1]])
        for number, name in enumerate(names, 1):
            call(["ip", "-n", name, "address", "add", f"10.77.3.{number}/24", "dev", "wire"])
            call(["ip", "-n", name, "link", "set", "wire", "up"])
        yield names
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


@contextmanager
def _keepalived(namespace: str, directory: Path, priority: int) -> Iterator[int]:
    """One machine's daemon; yields its PID."""
    directory.mkdir()
    settings = directory / "keepalived.conf"
    settings.write_text(CONFIGURATION.format(priority=priority, advert_s=ADVERT_S, address=ADDRESS))
    pids = ["-p", str(directory / "main.pid"), "-r", str(directory / "vrrp.pid"), "-c", str(directory / "checkers.pid")]
    with (directory / "log").open("wb") as log:
        process = subprocess.Popen(
            ["ip", "netns", "exec", namespace, "keepalived", "-n", "-l", "-P", "-f", str(settings), *pids],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    try:
        yield process.pid  # `ip netns exec` becomes the daemon
    finally:
        _signal_all(process.pid, signal.SIGKILL)
        process.wait()


def _signal_all(pid: int, number: signal.Signals) -> None:
    """Signal a process of ours and its children at one stroke."""
    pids = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    for one in (*pids, pid):
        try:
            os.kill(one, number)
        except ProcessLookupError:
            continue


@contextmanager
def _watched(namespace: str) -> Iterator[subprocess.Popen[str]]:
    """A process that says when a namespace has the address."""
    command = ["ip", "netns", "exec", namespace, sys.executable, "-S", "-c", BIND, ADDRESS]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def _instant(watch: subprocess.Popen[str], directory: Path) -> float:
    """The instant that it tells, seconds since 1970.

    Raises:
        BenchmarkError: it says nothing in time.
    """
    assert watch.stdout is not None
    os.set_blocking(watch.stdout.fileno(), False)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if line := watch.stdout.readline():
            return float(line)
        time.sleep(0.001)
    logs = "; ".join(path.read_text(errors="replace").strip()[-200:] for path in directory.glob("*/log"))
    raise BenchmarkError(f"keepalived did not bring the address in {PATIENCE_S:.0f} s: {logs or 'it said nothing'}")
