"""Lines of the log with fields, straight to systemd's journal: ROBOT, COMPONENT and EPOCH can be asked for by journalctl(1).

Sources: systemd.exec(5), $JOURNAL_STREAM; https://systemd.io/JOURNAL_NATIVE_PROTOCOL.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
from collections.abc import Mapping
from typing import Final

ADDRESS: Final = "/run/systemd/journal/socket"
STREAM: Final = "JOURNAL_STREAM"
"""By it systemd names the stream to the journal that it gave a service, as DEVICE:INODE."""

STDERR: Final = 2
IDENTIFIER: Final = "failover-agent"
MESSAGE_MAX: Final = 32 << 10
"""Characters: what is longer would need a file of its own, and is a traceback at most."""

LOST: Final = "{} lines of this log are lost: the journal did not take them in time"

_LENGTH: Final = struct.Struct("<Q")
_PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG: Final = 7
"""Source: syslog(3)."""


def is_ours() -> bool:
    """Whether this process's standard error is the journal's own, so that its lines belong there."""
    try:
        stream = os.fstat(STDERR)
    except OSError:
        return False
    return os.environ.get(STREAM) == f"{stream.st_dev}:{stream.st_ino}" and os.path.exists(ADDRESS)


def encoded(fields: Mapping[str, str]) -> bytes:
    """One entry; a value of several lines goes with its length."""
    entry = bytearray()
    for name, value in fields.items():
        content = value.encode(errors="backslashreplace")
        if b"\n" in content:
            entry += name.encode() + b"\n" + _LENGTH.pack(len(content)) + content + b"\n"
        else:
            entry += name.encode() + b"=" + content + b"\n"
    return bytes(entry)


class Journal(logging.Handler):
    """Sends each record as one entry. It waits for nothing: what the journal cannot take at once is counted, and told later.

    COMPONENT is the record's ``component``, or the name that its sentence begins with; EPOCH its ``epoch``.
    """

    def __init__(self, robot: str, address: str = ADDRESS) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(message)s"))  # the journal has the rest in fields
        self._robot, self._address, self._lost = robot, address, 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)

    def emit(self, record: logging.LogRecord) -> None:
        """Send one, and before it how many were lost."""
        if self._lost and self._send({"MESSAGE": LOST.format(self._lost), "PRIORITY": "4", **self._always()}):
            self._lost = 0
        if not self._send(self._fields(record)):
            self._lost += 1

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()
        super().close()

    def _fields(self, record: logging.LogRecord) -> dict[str, str]:
        fields = {"MESSAGE": self.format(record)[:MESSAGE_MAX], "PRIORITY": str(_priority(record.levelno)), **self._always()}
        fields["LOGGER"] = record.name
        if component := component_of(record):
            fields["COMPONENT"] = component
        if epoch := getattr(record, "epoch", 0):
            fields["EPOCH"] = str(epoch)
        return fields

    def _always(self) -> dict[str, str]:
        return {"SYSLOG_IDENTIFIER": IDENTIFIER, "ROBOT": self._robot}

    def _send(self, fields: Mapping[str, str]) -> bool:
        try:
            self._socket.sendto(encoded(fields), self._address)
        except OSError:
            return False
        return True


def component_of(record: logging.LogRecord) -> str:
    """The component that a record is about; "" for none."""
    named, arguments = getattr(record, "component", ""), record.args
    if not named and isinstance(arguments, tuple) and arguments and str(record.msg).startswith("%s: "):
        named = arguments[0] if isinstance(arguments[0], str) and arguments[0].startswith("/") else ""
    return str(named)


def _priority(level: int) -> int:
    return next((number for least, number in _PRIORITIES if level >= least), _DEBUG)
