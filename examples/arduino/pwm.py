"""The driver of an Arduino that runs arduino.ino: a motor behind a pulse width modulator, at a serial port or in the network.

    python3 pwm.py /dev/ttyACM0                    the driver, until Ctrl-C
    python3 pwm.py tcp://192.168.0.7:7000          the same for a device in the network
    failover call arduino set '{"duty": 0.4}'      {"duty": 0.4, "pwm": 102, "moves": 1}

A line of JSON goes to the device, a line comes back; no further line goes before that. A line that is not answered is sent again:
the device knows it by its id. The port is opened when it is needed, so the device may be unplugged and plugged in at any time.
"""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import select
import socket
import sys
import termios
import time
import tty
from typing import Annotated, Final

import msgspec
from msgspec import Meta, Struct

import failover

LINE_SIZE_MAX: Final = 256
"""Bytes of a line to the device, without its end."""

TCP: Final = "tcp://"

HEARD_SIZE_MAX: Final = 4_096
"""What a device may say without an end of line before it is forgotten."""

ID_MAX: Final = 999_999_999

TRY_S: Final = 1.0
"""Until a line is sent again. An Arduino Uno begins anew when its port is opened, and is deaf for about a second."""

TRIES: Final = 4
"""All of them together take less time than a call (5 s)."""


class DeviceError(Exception):
    """The device did not do it; says why, and what to do."""


class State(Struct):
    """What the device tells of itself. ``pwm``: 0 to 255; ``moves``: commands that moved it since it was switched on."""

    duty: float
    pwm: int
    moves: int


class Answer(Struct):
    """A line of the device: ``ok`` or ``error``."""

    id: int | None = None
    ok: State | None = None
    error: str | None = None


class Port:
    """What carries lines to a device and back; opened by the first one, closed when the device is gone.

    Attributes:
        ends_in_silence: a device that does not answer may be gone without a word: its port is opened anew.
    """

    ends_in_silence = False

    def __init__(self, path: str) -> None:
        self.path = path
        self._descriptor = -1
        self._heard = b""

    def open(self) -> None:
        """Have it open.

        Raises:
            DeviceError: it cannot be opened, or another program has it.
        """
        if self._descriptor < 0:
            self._descriptor, self._heard = self._opened(), b""

    def _opened(self) -> int:
        raise NotImplementedError

    def close(self) -> None:
        """Let it go; the next line opens it again."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1

    def send(self, line: bytes, until_s: float) -> None:
        """Send a line; what the device does not take until then is left out.

        Raises:
            OSError: the device is gone.
        """
        rest = line
        while rest and self._await(select.POLLOUT, until_s):
            rest = rest[os.write(self._descriptor, rest) :]

    def receive(self, until_s: float) -> bytes | None:
        """The next line; None: there is none until then.

        Raises:
            OSError: the device is gone.
        """
        while b"\n" not in self._heard:
            if not self._await(select.POLLIN, until_s):
                return None
            heard = os.read(self._descriptor, HEARD_SIZE_MAX)
            if not heard:
                raise ConnectionResetError(f"{self.path} hung up")
            self._heard = (self._heard + heard)[-HEARD_SIZE_MAX:]
        line, _, self._heard = self._heard.partition(b"\n")
        return line

    def _await(self, event: int, until_s: float) -> bool:
        poll = select.poll()
        poll.register(self._descriptor, event)
        return bool(poll.poll(max(until_s - time.monotonic(), 0) * 1_000))


class SerialPort(Port):
    """A serial port at 115200 baud."""

    def _opened(self) -> int:
        try:
            descriptor = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise DeviceError(
                f"cannot open {self.path}: {error.strerror}; plug the device in, or start the driver with the name of its port"
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._set_up(descriptor)
        except (OSError, termios.error) as error:
            os.close(descriptor)
            why = "another program uses it" if isinstance(error, BlockingIOError) else f"it is no serial port ({error})"
            raise DeviceError(f"cannot use {self.path}: {why}") from error
        return descriptor

    def _set_up(self, descriptor: int) -> None:
        tty.setraw(descriptor, termios.TCSANOW)
        settings = termios.tcgetattr(descriptor)
        settings[2] = settings[2] & ~termios.HUPCL | termios.CLOCAL | termios.CREAD  # HUPCL would reset an Arduino at each end
        settings[4] = settings[5] = termios.B115200
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        termios.tcflush(descriptor, termios.TCIOFLUSH)
        os.write(descriptor, b"\n")  # ends a line that the driver before did not


class NetworkPort(Port):
    """A TCP connection; ``path``: ``tcp://HOST:PORT``."""

    ends_in_silence = True

    def _opened(self) -> int:
        host, _, port = self.path.removeprefix(TCP).rpartition(":")
        try:
            connection = socket.create_connection((host, int(port)), TRY_S)
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.send(b"\n")  # ends a line that the driver before did not
        except (OSError, ValueError, OverflowError) as error:
            raise DeviceError(
                f"cannot connect to {self.path}: {error}; switch the device on, or write tcp://HOST:PORT"
            ) from error
        return connection.detach()


class Device:
    """What arduino.ino understands, at one port."""

    def __init__(self, path: str) -> None:
        self._port = NetworkPort(path) if path.startswith(TCP) else SerialPort(path)
        self._id = secrets.randbelow(ID_MAX)  # not one that the driver before has just used

    def ask(self, verb: str, **fields: float) -> State:
        """Have the device carry out a verb; what it tells then.

        Raises:
            DeviceError: it is not there, does not answer, or refuses.
        """
        self._id = self._id % ID_MAX + 1
        line = json.dumps({"verb": verb, **fields, "id": self._id}, separators=(",", ":")).encode()
        assert len(line) <= LINE_SIZE_MAX
        for tried in range(TRIES):
            self._port.open()
            try:
                answer = self._answered(b"\n" + line if tried else line)  # what was sent before may have broken off
            except OSError:
                self._port.close()  # gone; perhaps it is there again
                continue
            if answer is not None and answer.ok is not None:
                return answer.ok
            if answer is not None:
                raise DeviceError(f"the device at {self._port.path} refused {line.decode()}: {answer.error}")
            if self._port.ends_in_silence:
                self._port.close()
        raise DeviceError(
            f"the device at {self._port.path} did not answer {line.decode()}, sent {TRIES} times: "
            "is arduino.ino on it, and the cable whole?"
        )

    def _answered(self, line: bytes) -> Answer | None:
        """The answer to a line; None: it did not come in time."""
        until_s = time.monotonic() + TRY_S
        self._port.send(line + b"\n", until_s)
        while (said := self._port.receive(until_s)) is not None:
            try:
                answer = msgspec.json.decode(said, type=Answer)
            except (msgspec.DecodeError, UnicodeDecodeError):
                continue  # noise, or the greeting of another sketch
            if answer.id == self._id and (answer.ok is not None or answer.error is not None):
                return answer
        return None


@failover.driver("University/Lab/Robotino/Engines/4/PWM", alias="arduino", rate_hz=20)
class Pwm:
    """One motor behind an Arduino's pulse width modulator."""

    port = "/dev/ttyACM0"

    def __init__(self) -> None:
        self._device = Device(self.port)

    @failover.command(coalesce="latest")
    def set(self, duty: Annotated[float, Meta(ge=-1, le=1)]) -> State:
        """Drive at a duty cycle, from -1 (backwards) to 1."""
        return self._device.ask("set", duty=duty)

    @failover.query
    def read(self) -> State:
        """What it does now."""
        return self._device.ask("read")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        Pwm.port = sys.argv[1]
    failover.run(Pwm)
