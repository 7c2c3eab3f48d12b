"""The recipes of docs/recipes.md for mosquitto, gpsd and MAVLink routers, with the real programs; lines are pseudo-terminals."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import struct
import subprocess
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.device_rules import DeviceRule
from tests.checkpoint.round_trip import Program, captured_and_killed, ended, restored, start

SYSTEM_PYTHON = "/usr/bin/python3"
GPSD_MEMORY = (*range(0x4E545030, 0x4E545038), 0x47505344)
"""Keys of the shared memory that gpsd makes, for NTP and for clients on its machine (gpsd's ntpshm.h and gpsd.h)."""
MORE = 5
MEANWHILE = "1000000"


def needs(package: str, *commands: str) -> pytest.MarkDecorator:
    missing = [command for command in commands if found(command) is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs {', '.join(missing)}: {package}")


def found(command: str) -> str | None:
    return shutil.which(command, path=f"{os.environ.get('PATH', '')}:/usr/sbin")


pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]


@pytest.fixture
def port() -> str:
    """A free one."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return str(free.getsockname()[1])


def program(directory: Path, name: str, *words: str, isolate: bool = False) -> Program:
    place = directory / name
    place.mkdir()
    return start([found(words[0]) or words[0], *words[1:]], place, isolate=isolate)


# --- mosquitto -----------------------------------------------------------------------------------------------------------

COUNTS = "i=0; while sleep 0.02; do echo $((i += 1)); done | mosquitto_pub -p {port} -q 1 -t count -l"

with_mosquitto = needs("apt-get install mosquitto mosquitto-clients", "mosquitto", "mosquitto_sub", "mosquitto_pub")


def broker(directory: Path, port: str) -> Program:
    (directory / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    serves = program(directory, "broker", "mosquitto", "-c", str(directory / "mosquitto.conf"))
    serves.wait_until(lambda: " running" in serves.complaints, "the broker to run")
    return serves


def numbers(listener: Program) -> list[int]:
    return [int(line) for line in listener.output.splitlines() if line.isdecimal()]


def await_more(listener: Program) -> None:
    before = len(numbers(listener))
    listener.wait_until(lambda: len(numbers(listener)) >= before + MORE, f"more than {before} heard")


@with_mosquitto
@pytest.mark.parametrize("moved", ["broker", "subscriber", "publisher"])
def test_mosquitto_and_its_clients_connect_anew(moved: str, port: str, tmp_path: Path) -> None:
    listens = ("mosquitto_sub", "-p", port, "-q", "1", "-i", "listener", "-c", "-t", "count")
    with ended(broker(tmp_path, port)) as serves, ended(program(tmp_path, "subscriber", *listens)) as hears:
        with ended(program(tmp_path, "publisher", "sh", "-c", COUNTS.format(port=port), isolate=True)) as says:
            await_more(hears)
            one = {"broker": serves, "subscriber": hears, "publisher": says}[moved]
            snapshot = captured_and_killed(one)
            if moved == "subscriber":
                subprocess.run(["mosquitto_pub", "-p", port, "-q", "1", "-t", "count", "-m", MEANWHILE], check=True)
            with ended(restored(snapshot, one.directory, isolate=moved == "publisher")) as again:
                await_more(again if moved == "subscriber" else hears)
                if moved == "subscriber":
                    again.wait_until(lambda: int(MEANWHILE) in numbers(again), "what the broker has kept")


@with_mosquitto
def test_a_broker_has_what_it_retained_without_a_file_of_its_own(port: str, tmp_path: Path) -> None:
    with ended(broker(tmp_path, port)) as serves:
        subprocess.run(["mosquitto_pub", "-p", port, "-q", "1", "-r", "-t", "map", "-m", "hall"], check=True)
        snapshot = captured_and_killed(serves)
        with ended(restored(snapshot, serves.directory)):
            asked = ["mosquitto_sub", "-p", port, "-t", "map", "-C", "1", "-W", "60"]
            assert subprocess.run(asked, capture_output=True, text=True, check=True).stdout == "hall\n"


# --- serial lines --------------------------------------------------------------------------------------------------------


class SerialLine:
    """A serial line with a device at its other end that speaks ten times a second, and heeds nothing."""

    def __init__(self, speech: Callable[[int], bytes]) -> None:
        self._device, self._end = os.openpty()
        tty.setraw(self._device)
        self.name = os.ttyname(self._end)
        os.chmod(self.name, 0o666)  # as a rule of udev would give it to the group dialout
        self._speech = speech
        self._over = threading.Event()
        self._voice = threading.Thread(target=self._speak)

    def _speak(self) -> None:
        number = 0
        os.set_blocking(self._device, False)
        while not self._over.wait(0.1):
            number += 1
            with contextlib.suppress(BlockingIOError):
                os.read(self._device, 65536)
            with contextlib.suppress(BlockingIOError):
                os.write(self._device, self._speech(number))

    def rules(self) -> tuple[DeviceRule, ...]:
        return (DeviceRule(self.name),)

    def __enter__(self) -> SerialLine:
        self._voice.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._voice.join()
        os.close(self._device)
        os.close(self._end)


def reopened(one: Program, line: SerialLine) -> Program:
    """Captured with the rule `reopen`, which goes along; killed; restored."""
    return restored(captured_and_killed(one, line.rules()), one.directory)


# --- gpsd ----------------------------------------------------------------------------------------------------------------

FOLLOWS = """
import gps, sys, time

while True:
    try:
        for report in gps.gps(host="127.0.0.1", port=sys.argv[1], mode=gps.WATCH_ENABLE):
            if report["class"] == "TPV" and "lat" in report:
                print(report["lat"], flush=True)
    except OSError:
        print("lost", flush=True)
    time.sleep(0.1)
"""


def has_gps_module() -> bool:
    return (
        os.access(SYSTEM_PYTHON, os.X_OK)
        and not subprocess.run([SYSTEM_PYTHON, "-c", "import gps"], capture_output=True, check=False).returncode
    )


def sentence(number: int) -> bytes:
    """A position as a receiver says it: NMEA 0183, RMC."""
    now = time.gmtime()
    words = (
        f"GPRMC,{time.strftime('%H%M%S', now)}.00,A,4807.{number:04d},N,01131.0000,E,0.0,0.0,{time.strftime('%d%m%y', now)},,,A"
    )
    total = 0
    for letter in words.encode():
        total ^= letter
    return f"${words}*{total:02X}\r\n".encode()


@pytest.fixture
def gpsd_memory() -> Iterator[None]:
    """What a killed gpsd leaves in the System V shared memory goes with the test."""
    before = segments()
    yield
    for segment in segments() - before:
        subprocess.run(["ipcrm", "-m", str(segment)], check=False)


def segments() -> set[int]:
    rows = [line.split() for line in Path("/proc/sysvipc/shm").read_text().splitlines()[1:]]
    return {int(row[1]) for row in rows if int(row[0]) in GPSD_MEMORY}


@needs("apt-get install gpsd python3-gps", "gpsd")
@pytest.mark.skipif(not has_gps_module(), reason="needs python3-gps: apt-get install python3-gps")
@pytest.mark.usefixtures("gpsd_memory")
@pytest.mark.parametrize("moved", ["gpsd", "client"])
def test_gpsd_goes_on_with_its_serial_line_and_its_clients_connect_anew(moved: str, port: str, tmp_path: Path) -> None:
    with SerialLine(sentence) as line, ended(program(tmp_path, "gpsd", "gpsd", "-N", "-n", "-S", port, line.name)) as serves:
        with ended(program(tmp_path, "client", SYSTEM_PYTHON, "-c", FOLLOWS, port)) as client:
            client.wait_until(lambda: len(positions(client)) > MORE, "positions")
            one = reopened(serves, line) if moved == "gpsd" else restored(captured_and_killed(client), client.directory)
            with ended(one):
                client = client if moved == "gpsd" else one
                client.wait_until(lambda: "lost" in client.output, "it to see its connection reset")
                before = len(positions(client))
                client.wait_until(lambda: len(positions(client)) > before + MORE, "more positions")
                assert positions(client)[-1] > positions(client)[0]


def positions(client: Program) -> list[float]:
    return [float(line) for line in client.output.splitlines() if line[:1].isdecimal()]


# --- a MAVLink router ----------------------------------------------------------------------------------------------------


def frames(number: int) -> bytes:
    """What an autopilot says: a heartbeat, and its time.

    Source: MAVLink's common.xml; CRC-16/MCRF4XX with each message's extra byte.
    """
    beat = struct.pack("<IBBBBB", 0, 2, 0, 0, 4, 3)
    return frame(number * 2, 0, 50, beat) + frame(number * 2 + 1, 2, 137, struct.pack("<QI", 0, number))


def frame(sequence: int, kind: int, extra: int, payload: bytes) -> bytes:
    head = bytes((len(payload), sequence % 256, 1, 1, kind))
    crc = 0xFFFF
    for byte in (*head, *payload, extra):
        mixed = byte ^ (crc & 0xFF)
        mixed = (mixed ^ (mixed << 4)) & 0xFF
        crc = (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
    return b"\xfe" + head + payload + struct.pack("<H", crc)


def time_told(station: socket.socket) -> int:
    """The number of the next SYSTEM_TIME that a ground station receives."""
    while True:
        datagram = station.recv(2048)
        if datagram[0] == 0xFE and datagram[5] == 2:
            return int.from_bytes(datagram[14:18], "little")


MAVPROXY = "mavproxy.py --master={line} --out=udp:127.0.0.1:{port} --non-interactive --no-state --default-modules="
MAVLINK_ROUTER = "mavlink-routerd --tcp-port 0 --endpoint 127.0.0.1:{port} {line}:115200"


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(MAVPROXY, marks=needs("pip install MAVProxy, its bin directory in PATH", "mavproxy.py")),
        pytest.param(MAVLINK_ROUTER, marks=needs("mavlink-router, built from its sources, in PATH", "mavlink-routerd")),
    ],
    ids=["MAVProxy", "mavlink-router"],
)
def test_a_mavlink_router_goes_on_between_its_serial_line_and_a_station(tmp_path: Path, command: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station, SerialLine(frames) as line:
        station.bind(("127.0.0.1", 0))
        station.settimeout(60)
        words = command.format(line=line.name, port=station.getsockname()[1]).split()
        with ended(program(tmp_path, "router", *words)) as router:
            before = time_told(station)
            with ended(reopened(router, line)):
                station.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    while True:
                        before = max(before, time_told(station))
                station.settimeout(60)
                after = [time_told(station) for _ in range(MORE)]
                assert before < after[0] and sorted(after) == after
