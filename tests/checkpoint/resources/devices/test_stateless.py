"""Devices come back by the operator's rules: a line with its settings, under another name elsewhere, hung up where it is missing.

A pseudo-terminal stands for the serial line; the test holds its other end, like the equipment at the end of the line.
"""

from __future__ import annotations

import fcntl
import os
import struct
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.device_rules import DeviceRule, arrived, merged, missing, rule_from, travelling
from checkpoint.engine import REFUSED, ProtectOrder, Terms
from checkpoint.errors import MismatchError, UnsupportedError
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.resources.devices import by_rule
from tests.checkpoint.round_trip import ENGINE, captured_and_killed, ended, protected, restored, start

PYTHON = getattr(sys, "_base_executable", sys.executable)
UART = Path("/dev/ttyS0")

DRIVER = """
import fcntl, os, sys, termios, time, tty
path, how = sys.argv[1:]
line = os.open(path, os.O_RDWR | os.O_NOCTTY)
if how == "raw":
    tty.setraw(line)
    settings = termios.tcgetattr(line)
    settings[4] = settings[5] = termios.B19200
    settings[6][termios.VMIN], settings[6][termios.VTIME] = 0, 1
    termios.tcsetattr(line, termios.TCSANOW, settings)
before = termios.tcgetattr(line)
fcntl.ioctl(line, 0x540C)  # TIOCEXCL
print("ready", flush=True)
while True:
    try:
        said = os.read(line, 100)
        error = ""
    except OSError as trouble:
        said, error = b"", os.strerror(trouble.errno)
    if said:
        same = termios.tcgetattr(line) == before
        waits = fcntl.fcntl(line, fcntl.F_GETFL) & os.O_NONBLOCK
        print("heard", said.decode().strip(), "same" if same else "other", waits, flush=True)
        os.write(line, b"got " + said)
    elif os.path.exists("go"):
        try:
            os.write(line, b"x")
        except OSError as trouble:
            error = os.strerror(trouble.errno)
        print("hung up:", error, flush=True)
        break
    time.sleep(0.01)
"""
"""Reads its line, tells what it heard and whether its settings are what they were; in the end what it finds there."""

pytestmark = pytest.mark.root


@contextmanager
def line() -> Iterator[tuple[int, str]]:
    """Our end of a line, and the path of the program's."""
    ours, theirs = os.openpty()
    tty.setraw(ours)
    path = os.ttyname(theirs)
    try:
        yield ours, path
    finally:
        os.close(theirs)
        os.close(ours)


def told(ours: int, words: bytes) -> bytes:
    """Say something over the line, and what comes back."""
    os.write(ours, words)
    heard = b""
    while not heard.endswith(words):
        heard += os.read(ours, 100)
    return heard


def plain(theirs: str) -> None:
    """Set a line as it is when nobody has opened it: what comes back was not simply left standing."""
    opened = os.open(theirs, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.ioctl(opened, 0x540D)  # TIOCNXCL
        settings = termios.tcgetattr(opened)
        settings[3] |= termios.ECHO | termios.ICANON
        settings[4] = settings[5] = termios.B9600
        termios.tcsetattr(opened, termios.TCSANOW, settings)
    finally:
        os.close(opened)


def test_a_line_comes_back_with_its_settings(tmp_path: Path) -> None:
    with line() as (ours, path):
        rules = (DeviceRule(path),)
        with ended(start([PYTHON, "-S", "-c", DRIVER, path, "raw"], tmp_path)) as driver:
            driver.wait_for_line("ready")
            assert told(ours, b"one\n") == b"got one\n"
            driver.wait_for_line("heard one same 0")
            state = captured_and_killed(driver, rules)
        plain(path)
        with ended(restored(state, tmp_path)) as again:
            assert told(ours, b"two\n") == b"got two\n"
            again.wait_for_line("heard two same 0")
            with protected(again, devices=rules):
                pass
            assert is_exclusive(again.pid, path)


def is_exclusive(pid: int, path: str) -> bool:
    """Whether a process holds a line alone (TIOCEXCL)."""
    number = next(int(one) for one in os.listdir(f"/proc/{pid}/fd") if os.readlink(f"/proc/{pid}/fd/{one}") == path)
    with copy_of(pid, number) as descriptor:
        return bool(struct.unpack("i", fcntl.ioctl(descriptor, by_rule.TIOCGEXCL, bytes(4)))[0])


def test_a_line_has_another_name_at_the_other_robot_and_is_found_by_it_again(tmp_path: Path) -> None:
    with line() as (first, here), line() as (second, there):
        with ended(start([PYTHON, "-S", "-c", DRIVER, here, "raw"], tmp_path)) as driver:
            driver.wait_for_line("ready")
            state = captured_and_killed(driver, (DeviceRule(here),))
        elsewhere = (DeviceRule(here, there=there),)
        with ended(restored(state, tmp_path, devices=elsewhere)) as again:
            assert told(second, b"two\n") == b"got two\n"
            again.wait_for_line("heard two same 0")
            state = captured_and_killed(again, elsewhere)
        plain(here)
        with ended(restored(state, tmp_path, devices=(DeviceRule(here),))) as home:
            assert told(first, b"three\n") == b"got three\n"
            home.wait_for_line("heard three same 0")


def test_a_name_that_leads_to_the_line_is_as_good(tmp_path: Path) -> None:
    with line() as (ours, path):
        by_id = tmp_path / "by-id"
        by_id.symlink_to(path)
        with ended(start([PYTHON, "-S", "-c", DRIVER, path, "raw"], tmp_path)) as driver:
            driver.wait_for_line("ready")
            state = captured_and_killed(driver, (DeviceRule(str(by_id)),))
        plain(path)
        with ended(restored(state, tmp_path)) as again:
            assert told(ours, b"two\n") == b"got two\n"
            again.wait_for_line("heard two same 0")


@pytest.mark.parametrize("rule", ["optional", "hook"])
def test_what_is_missing_is_found_hung_up_where_the_rule_says_so(tmp_path: Path, rule: str) -> None:
    with line() as (_, path):
        with ended(start([PYTHON, "-S", "-c", DRIVER, path, "raw"], tmp_path)) as driver:
            driver.wait_for_line("ready")
            state = captured_and_killed(driver, (rule_from(path, rule),))
        gone = (DeviceRule(path, there="/dev/no-such-line", optional=True),) if rule == "optional" else ()
        with ended(restored(state, tmp_path, devices=gone)) as again:
            again.tell()
            assert again.finish() == 0
            assert again.output.splitlines()[-1] == "hung up: Input/output error"


def test_what_is_missing_is_said_with_the_cure_and_nothing_starts(tmp_path: Path) -> None:
    with line() as (_, path):
        with ended(start([PYTHON, "-S", "-c", DRIVER, path, "raw"], tmp_path)) as driver:
            driver.wait_for_line("ready")
            state = captured_and_killed(driver, (DeviceRule(path),))
        with pytest.raises(MismatchError, match=r"/dev/no-such-line, open as fd 3, is missing here: attach it, or give") as lack:
            restored(state, tmp_path, devices=(DeviceRule(path, there="/dev/no-such-line"),))
        assert len(lack.value.reasons) == 1
        with pytest.raises(MismatchError, match="is no device here"):
            restored(state, tmp_path, devices=(DeviceRule(path, there="/etc/passwd"),))


@pytest.mark.skipif(not UART.exists(), reason="this machine has no /dev/ttyS0")
def test_a_real_serial_line_comes_back_with_settings_and_modem_lines(tmp_path: Path) -> None:
    rules = (DeviceRule(str(UART)),)
    with ended(start([PYTHON, "-S", "-c", DRIVER, str(UART), "raw"], tmp_path)) as driver:
        try:
            driver.wait_for_line("ready")
        except AssertionError:
            pytest.skip(f"{UART} cannot be set here: {driver.complaints.splitlines()[-1]}")
        state = captured_and_killed(driver, rules)
    (facts,) = [held.facts for held in state.resources if held.kind == by_rule.KIND]
    settings, modem = facts["settings"], facts["modem"]
    opened = os.open(UART, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        standing = termios.tcgetattr(opened)
        standing[4] = standing[5] = termios.B300
        termios.tcsetattr(opened, termios.TCSANOW, standing)
        with ended(restored(state, tmp_path)) as again:
            assert fcntl.ioctl(opened, by_rule.TCGETS2, bytes(44)) == settings
            now = int.from_bytes(fcntl.ioctl(opened, by_rule.TIOCMGET, bytes(4)), "little")
            assert isinstance(modem, int)
            assert now & by_rule.MODEM_OUTPUTS == modem & by_rule.MODEM_OUTPUTS
            assert again.poll() is None
    finally:
        os.close(opened)


def test_a_device_without_a_rule_is_refused_by_name_with_the_cure(tmp_path: Path) -> None:
    with line() as (ours, path), ended(start([PYTHON, "-S", "-c", DRIVER, path, "raw"], tmp_path)) as driver:
        driver.wait_for_line("ready")
        other = (DeviceRule("/dev/other"),)
        with pytest.raises(UnsupportedError, match=rf"fd 3 is a terminal \({path}\), for which there is no rule: give it one"):
            ENGINE.protect(driver.pid, ProtectOrder("/test/driver", terms=Terms(devices=other))).close()
        (refusal,) = [one for one in ENGINE.probe(driver.pid).findings if one.verdict == REFUSED]
        assert refusal.kind == "devices"
        assert told(ours, b"one\n") == b"got one\n"


def test_rules_are_read_as_they_are_typed_and_the_robots_own_come_first() -> None:
    assert rule_from("/dev/a", "/dev/b") == DeviceRule("/dev/a", there="/dev/b")
    assert rule_from("/dev/a", "optional") == DeviceRule("/dev/a", optional=True)
    for said in ("open", "", "dev/b"):
        with pytest.raises(ValueError, match="say reopen, hook, optional, or the path"):
            rule_from("/dev/a", said)
    with pytest.raises(ValueError, match="absolute"):
        rule_from("ttyUSB0", "reopen")
    rules = (DeviceRule("/dev/a", there="/dev/b"), DeviceRule("/dev/c", "hook"), DeviceRule("/dev/d", optional=True))
    assert travelling(rules) == (("/dev/a", "reopen"), ("/dev/c", "hook"), ("/dev/d", "optional"))
    assert arrived((*travelling(rules), ("x", "reopen"), ("/dev/e", "?"))) == (DeviceRule("/dev/a"), *rules[1:])
    came, own = DeviceRule("/dev/a"), DeviceRule("/dev/a", there="/dev/b")
    assert merged((came, DeviceRule("/dev/c")), (own,)) == (own, DeviceRule("/dev/c"))


def test_what_a_robot_lacks_is_told_beforehand() -> None:
    rules = (
        DeviceRule("/dev/null"),
        DeviceRule("/dev/none"),
        DeviceRule("/dev/some", optional=True),
        DeviceRule("/dev/x", "hook"),
    )
    assert missing(rules) == (
        "lacks /dev/none: the program could not resume here",
        "lacks /dev/some: it would be found hung up",
    )
