"""Devices with a rule of the operator: opened again, or shown to the program as hung up, so that it opens them again itself.

A serial line is restored with its settings (termios) and modem lines. Bytes that waited to be read or sent are lost, as on the
line. For other devices the restore does not repeat settings that the program has made by ioctl(2).

Facts: ``descriptors``; ``path``: as the rule names it; ``opened``: the file that was really open; ``flags`` of open(2);
``action``, and ``optional`` of the rule; ``settings``: struct termios2, b"" if the device is no line; ``modem``: lines of
ioctl_tty(2), -1 where it has none; ``exclusive``: TIOCEXCL.

Source: ioctl_tty(2), termios(3).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from checkpoint import device_rules
from checkpoint.capability import Area, by_rule, refused
from checkpoint.device_rules import DeviceRule, rule_for, rule_of
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = device_rules.KIND

CAPABILITIES: Final = (
    by_rule(
        Area.DEVICES,
        "serial lines (`reopen`)",
        "opened again under the name that the rule gives for the robot, with settings and modem lines",
    ),
    by_rule(
        Area.DEVICES,
        "other devices (`reopen`): input, sound, I2C, SPI, GPIO …",
        "opened again; the program itself repeats its settings by ioctl(2), when a hook tells it to",
    ),
    by_rule(
        Area.DEVICES,
        "any device (`hook`)",
        "the program finds the device hung up, as after unplugging, and opens it anew",
    ),
    by_rule(
        Area.DEVICES,
        "a device that not every robot has (`optional`)",
        "hung up where it is missing",
    ),
    refused(
        Area.DEVICES,
        "a GPU, or a device that is mapped, also with the rule `reopen`",
        "use the rule `hook`, with nothing of the device mapped; or a driver process of its own",
        "whose state in the device failover cannot read",
    ),
    refused(
        Area.THERE,
        "a missing device",
        "attach it, name the device that replaces it there, or make it optional (`optional`)",
        "is missing here: attach it",
        "is no device here",
    ),
)

TCGETS2: Final = 0x802C542A
TCSETS2: Final = 0x402C542B
TIOCMGET: Final = 0x5415
TIOCMSET: Final = 0x5418
TIOCEXCL: Final = 0x540C
TIOCGEXCL: Final = 0x80045440
TIOCSPTLCK: Final = 0x40045431
TIOCGPTPEER: Final = 0x5441
"""Requests of ioctl(2), the same on x86-64 and aarch64. Source: asm-generic/ioctls.h."""
SETTINGS_SIZE: Final = 44
"""Bytes of struct termios2."""
MODEM_OUTPUTS: Final = 0x002 | 0x004
"""TIOCM_DTR and TIOCM_RTS: what a program sets; the others are what the other end says."""
NO_LINES: Final = -1

GPUS: Final = ("/dev/dri/", "/dev/nvidia", "/dev/kfd", "/dev/mali")
REOPENED_FLAGS: Final = os.O_ACCMODE | os.O_APPEND | os.O_NONBLOCK | os.O_SYNC | os.O_DIRECT


def is_ruled(one: Descriptor, rules: Iterable[DeviceRule]) -> bool:
    """Whether a descriptor is a device for which there is a rule."""
    return (stat.S_ISCHR(one.mode) or stat.S_ISBLK(one.mode)) and rule_for(one.target, rules) is not None


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """How it is set, if it is a line."""
    facts: dict[str, Fact] = {"settings": b"", "modem": NO_LINES, "exclusive": 0}
    with contextlib.suppress(OSError), copy_of(held.pid, held.first.number) as line:
        facts["settings"] = fcntl.ioctl(line, TCGETS2, bytes(SETTINGS_SIZE))
        facts["exclusive"] = int.from_bytes(fcntl.ioctl(line, TIOCGEXCL, bytes(4)), "little")
        facts["modem"] = int.from_bytes(fcntl.ioctl(line, TIOCMGET, bytes(4)), "little")
    return facts


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The device as it was observed, and its rule."""
    if not is_ruled(held.first, surroundings.devices):
        return None
    rule = rule_for(held.first.target, surroundings.devices)
    assert rule is not None
    facts: dict[str, Fact] = {
        "descriptors": held.numbers,
        "path": rule.path,
        "opened": held.first.target,
        "flags": held.first.flags & ~os.O_CLOEXEC,
        "action": rule.action,
        "optional": int(rule.optional),
        **held.observed,
    }
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a device cannot be kept by its rule."""
    rule = rule_for(held.first.target, surroundings.devices)
    if rule is None or not is_ruled(held.first, (rule,)) or rule.action == "hook":
        return None
    if held.first.target.startswith(GPUS):
        return (
            f'{held.name} is {held.first.target}, a GPU, whose state in the device failover cannot read: give it the rule "hook"'
        )
    return None


# --- Restore -----------------------------------------------------------------------------------------------------------


def rule_here(held: Resource, own: Iterable[DeviceRule]) -> DeviceRule:
    """This robot's own rule for a device, else the one that came along, which says nothing of places on this robot."""
    came = rule_of(held)
    return next((rule for rule in own if rule.path == came.path), came)


def mismatches(held: Resource, own: Iterable[DeviceRule]) -> Iterator[str]:
    """Why it could not be opened here.

    Args:
        own: this robot's rules.
    """
    rule = rule_here(held, own)
    if rule.action == "hook":
        return
    try:
        mode = os.stat(rule.place).st_mode
    except OSError:
        if not rule.optional:
            yield (
                f"the device {rule.place}, open as {held.name}, is missing here: attach it, or give this robot a rule of its own "
                f'for {rule.path} (docs/devices.md): {{ reopen = "/dev/…" }}, "optional" or "hook"'
            )
        return
    if not (stat.S_ISCHR(mode) or stat.S_ISBLK(mode)):
        yield f"{rule.place}, open as {held.name}, is no device here: remove it"


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it as it was, or hung up."""
    rule = rule_here(held, rebuilding.options.terms.devices)
    if rule.action == "hook" or (rule.optional and not os.path.exists(rule.place)):
        return _hung_up(table, held)
    flags = number_of(held.facts["flags"]) & REOPENED_FLAGS
    made = table.open(rule.place, flags | os.O_NOCTTY | os.O_NONBLOCK)  # a line without a carrier would be waited for
    settings = held.facts["settings"]
    assert isinstance(settings, bytes)
    if settings:
        _set(table, held, made, settings, rule.place)
    if not flags & os.O_NONBLOCK:
        table.call(f"set the flags of {held.name}", "fcntl", made, fcntl.F_SETFL, flags & ~os.O_ACCMODE)
    return made


def _set(table: CallTable, held: Resource, made: int, settings: bytes, place: str) -> None:
    lost = f"{held.name} ({place}) is not set as the line was"
    table.attempt(lost, "ioctl", made, TCSETS2, table.place(settings))
    modem = number_of(held.facts["modem"])
    if modem != NO_LINES:
        lines = table.place((modem & MODEM_OUTPUTS).to_bytes(4, "little"))
        table.attempt(f"the modem lines of {held.name} ({place}) are not as they were", "ioctl", made, TIOCMSET, lines)
    if held.facts["exclusive"]:
        table.attempt(f"{held.name} ({place}) is not held alone", "ioctl", made, TIOCEXCL)


def _hung_up(table: CallTable, held: Resource) -> int:
    """A terminal whose other end has gone: reading gives its end, writing EIO, and poll says so, as with a device unplugged."""
    other = table.open("/dev/ptmx", os.O_RDWR | os.O_NOCTTY)
    table.call(f"unlock a terminal for {held.name}", "ioctl", other, TIOCSPTLCK, table.place(bytes(4)))
    flags = os.O_RDWR | os.O_NOCTTY | number_of(held.facts["flags"]) & os.O_NONBLOCK
    made = table.obtain(f"open a terminal for {held.name}", "ioctl", other, TIOCGPTPEER, flags)
    table.close(other)
    return made
