"""The Arduino of examples/: its sketch as a program of this machine, its driver at a pseudo-terminal with 50 ms a command."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import random
import re
import shlex
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Any

import pytest

import failover
from examples.arduino import pwm
from failover.cli.demo.robots import free_ports
from failover.errors import CallRefusedError

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "arduino"
PAGE = (ROOT / "docs" / "drivers.md").read_text()
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", str(FOLDER / "host"))
SANITIZED = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
LIMIT_S = 100
PORT = "ttyACM0"
LINE_SIZE_MAX, DEPTH_MAX, ID_MAX = 256, 8, 999_999_999
"""Of command.h."""

QUEUE = 500
"""Commands that may wait for an answer: what comes in two seconds at 200 Hz, and more."""

SEED = 31
MUTATED = 4_000

pytestmark = pytest.mark.compiler

Build = Callable[..., Path]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Make a program of the sketch's parser and another file, once for each set of flags."""
    made: dict[tuple[str, ...], Path] = {}

    def compile_once(*flags: str, source: Path = FOLDER / "host" / "host.c") -> Path:
        key = (*flags, str(source))
        if key not in made:
            path = tmp_path_factory.mktemp("sketch") / "engine"
            command = ["gcc", *WARNINGS, *(flags or ("-O2",)), "-o", path, source, FOLDER / "command.c"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            made[key] = path
        return made[key]

    return compile_once


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


# --- The sketch ------------------------------------------------------------------------------------------------------


def said(program: Path, lines: bytes, pwm_ms: int = 0) -> list[dict[str, Any]]:
    """What the sketch answers to lines on its standard input."""
    ran = subprocess.run(
        [program], input=lines, capture_output=True, timeout=LIMIT_S, check=False, env=os.environ | {"PWM_MS": str(pwm_ms)}
    )
    assert ran.returncode == 0, ran.stderr.decode()
    return [json.loads(line) for line in ran.stdout.splitlines()]


@pytest.mark.parametrize("level", ["-O0", "-O2", "-O3"])
@pytest.mark.parametrize("language", [("gcc", "-std=c11", "-x", "c"), ("g++", "-std=c++17", "-x", "c++")], ids=["C", "C++"])
def test_the_sketch_compiles_without_a_warning_also_as_arduino_does(
    language: tuple[str, ...], level: str, tmp_path: Path
) -> None:
    if subprocess.run(["which", language[0]], capture_output=True, check=False).returncode:
        pytest.skip(f"needs {language[0]}, which is not installed here")
    command = [language[0], *WARNINGS, level, *language[1:], "-c", "-o", tmp_path / "engine.o", FOLDER / "host" / "host.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.command("nm")
def test_the_parser_takes_no_memory_and_no_function_that_an_arduino_lacks(tmp_path: Path) -> None:
    subprocess.run(["gcc", "-O0", "-fno-builtin", "-c", "-o", tmp_path / "command.o", FOLDER / "command.c"], check=True)
    listed = subprocess.run(["nm", "-u", tmp_path / "command.o"], capture_output=True, text=True, check=True).stdout
    assert set(listed.replace("U", " ").split()) <= {"memcmp", "memset", "memcpy", "strchr", "strlen", "__stack_chk_fail"}


def test_the_lines_in_the_head_of_the_sketch_are_answered_as_it_says(build: Build) -> None:
    pairs = re.findall(r"^ \*     (\{.*\}) +(\{.*\})$", (FOLDER / "arduino.ino").read_text(), re.MULTILINE)
    assert len(pairs) == 3
    answers = said(build(), "".join(f"{line}\n" for line, _ in pairs).encode())
    assert answers == [json.loads(answer) for _, answer in pairs]


@pytest.mark.parametrize(
    ("line", "duty"),
    [
        ('{"duty":-1,"id":1,"verb":"set"}', -1),
        (' { "id" : 1 ,\t"verb" : "set" , "duty" : 1.0e-1 } \r', 0.1),
        ('{"verb":"set","duty":5e-1,"id":1}', 0.5),
        ('{"verb":"set","duty":0.00250000e2,"id":1}', 0.25),
        ('{"verb":"set","duty":0.30000000000000004,"id":1}', 0.3),
        ('{"verb":"set","duty":-0.99999999999,"id":1}', -0.9999),
        ('{"verb":"set","duty":1e-300,"id":1}', 0),
        ('{"v\\u0065rb":"s\\u0065t","duty":0.2,"id":1}', 0.2),
        ('{"note":"\\"}","verbs":[1,{"verb":"read","duty":[]},null,true,"]"],"verb":"set","duty":0.2,"id":1,"DUTY":7}', 0.2),
        ('{"x":' + "[" * 7 + "]" * 7 + ',"verb":"set","duty":0.2,"id":1}', 0.2),
        ('{"verb":"set","duty":0.2,"id":1}'.ljust(LINE_SIZE_MAX), 0.2),
    ],
)
def test_a_command_may_be_written_in_each_way_that_json_has(build: Build, line: str, duty: float) -> None:
    (answer,) = said(build(), line.encode() + b"\n")
    assert answer["id"] == 1 and answer["ok"]["duty"] == duty and answer["ok"]["pwm"] == int(abs(duty) * 255 + 0.5)


def test_a_line_that_comes_again_moves_nothing(build: Build) -> None:
    lines = b'{"verb":"set","duty":0.5,"id":1}\n' * 3 + b'{"verb":"set","duty":0.6,"id":1}\n{"verb":"set","duty":0.6,"id":2}\n'
    assert [answer["ok"]["moves"] for answer in said(build(), lines)] == [1, 1, 1, 2, 3]


HOSTILE = [
    (b'{"verb":"set","duty":0.2,"id":5}'.ljust(257), None, "longer than 256"),
    (b"x" * 100_000, None, "longer than 256"),
    (b"", None, "not JSON"),
    (b"\0" * 50, None, "not JSON"),
    (b"GET / HTTP/1.1", None, "not JSON"),
    (b'"set"', None, "not JSON"),
    (b'[{"verb":"read"}]', None, "not JSON"),
    (b'{"verb":"read"}{"verb":"read"}', None, "more follows"),
    (b'{"verb":"read",}', None, "not JSON"),
    (b'{"verb":"read","id":5', None, "not JSON"),
    (b'{"verb":"read","id":05}', None, "not JSON"),
    (b'{"verb":"set","duty":.5,"id":5}', None, "not JSON"),
    (b'{"verb":"set","duty":+1}', None, "not JSON"),
    (b'{"verb":"set","duty":NaN}', None, "not JSON"),
    (b'{"verb":"set","duty":0x1}', None, "not JSON"),
    (b'{"verb":"rea', None, "does not end"),
    (b'{"verb":"re\\', None, "not JSON"),
    (b'{"verb":"re\\u00', None, "not JSON"),
    (b'{"verb":"re\x07ad"}', None, "control character"),
    (b'{"verb":"re\0ad"}', None, "control character"),
    (b'{"verb":"read\\u0000"}', None, "unknown verb"),
    (b'{"x":' + b"[" * 8 + b"]" * 8 + b',"verb":"read"}', None, "inside each other"),
    (b'{"x":' + b"[" * 250, None, "inside each other"),
    (b'{"x":' * 50, None, "inside each other"),
    (b'{"verb":"set","duty":1.0000000000000000001,"id":5}', 5, "from -1 to 1"),
    (b'{"verb":"set","duty":-2,"id":5}', 5, "from -1 to 1"),
    (b'{"verb":"set","duty":1e999999999999,"id":5}', 5, "from -1 to 1"),
    (b'{"verb":"set","duty":' + b"9" * 200 + b',"id":5}', 5, "from -1 to 1"),
    (b'{"verb":"set","duty":"0.5","id":5}', 5, "duty is no number"),
    (b'{"verb":"set","id":5}', 5, "duty is missing"),
    (b'{"duty":0.5,"id":5}', 5, "verb is missing"),
    (b'{"verb":7,"id":5}', 5, "verb is no string"),
    (b'{"verb":"fly","id":5}', 5, "unknown verb"),
    (b'{"verb":"setsetset","duty":0.5,"id":5}', 5, "unknown verb"),
    (b'{"verb":"set","duty":0.1,"id":5,"duty":0.9}', 5, "twice"),
    (b'{"verb":"read","id":1000000000}', None, "id is no whole"),
    (b'{"verb":"read","id":-1}', None, "id is no whole"),
    (b'{"verb":"read","id":1.5}', None, "id is no whole"),
    (b'{"verb":"read","id":"5"}', None, "id is no number"),
]


@pytest.mark.parametrize(("line", "number", "words"), HOSTILE, ids=[repr(line[:30]) for line, _, _ in HOSTILE])
def test_a_hostile_line_gets_one_sentence_and_the_device_goes_on(
    build: Build, line: bytes, number: int | None, words: str
) -> None:
    before, refused, after = said(
        build(*SANITIZED), b'{"verb":"set","duty":0.25,"id":7}\n' + line + b'\n{"verb":"read","id":8}\n'
    )
    assert before == {"id": 7, "ok": {"duty": 0.25, "pwm": 64, "moves": 1}}
    assert refused["id"] == number and words in refused["error"] and 0 <= refused["at"] <= LINE_SIZE_MAX
    assert after == {"id": 8, "ok": before["ok"]}


# --- Mutated lines ---------------------------------------------------------------------------------------------------


class Table(list[tuple[str, Any]]):
    """A table of JSON with everything that was written."""


def meant(line: bytes) -> tuple[str, int, int] | None:
    """Verb, duty in 10,000ths and id (-1: none) of a line, read by Python's JSON; None: it is no command."""
    try:
        table = json.loads(
            line.decode("latin-1"), object_pairs_hook=Table, parse_int=Decimal, parse_float=Decimal, parse_constant=refuse
        )
    except ValueError:
        return None
    if len(line) > LINE_SIZE_MAX or not isinstance(table, Table) or depth(table) > DEPTH_MAX:
        return None
    known = [(key, value) for key, value in table if key in ("verb", "duty", "id")]
    fields = dict(known)
    verb, duty, number = fields.get("verb"), fields.get("duty", Decimal(0)), fields.get("id", Decimal(-1))
    if len(fields) < len(known) or verb not in ("set", "read") or (verb == "set" and "duty" not in fields):
        return None
    if not isinstance(duty, Decimal) or not isinstance(number, Decimal) or abs(duty) > 1:
        return None
    if "id" in fields and not (0 <= number <= ID_MAX and number == int(number)):
        return None
    with localcontext(prec=2 * LINE_SIZE_MAX):
        return verb, int(duty.scaleb(4)) if abs(duty) > Decimal("1e-9") else 0, int(number)


def refuse(constant: str) -> None:
    raise ValueError(constant)


def depth(value: object) -> int:
    if not isinstance(value, list):
        return 0
    inner = [one for _, one in value] if isinstance(value, Table) else value
    return 1 + max(map(depth, inner), default=0)


WHOLE = [
    b'{"verb":"set","duty":0.4,"id":7}',
    b'{"id":123456789,"duty":-1,"verb":"set"}',
    b'{"verb":"read","id":0,"note":"a \\"quoted\\" \\u00e9\\\\ word"}',
    b'{"x":[1,-2.5e+3,{"y":[null,true,false]}],"verb":"set","duty":1.0000}',
    b'{"verb":"set","duty":0.30000000000000004,"id":999999999}',
    b'{"verb":"set","duty":12345678912e-11,"id":1234567890e-1}',
    b'{"":{"":{"":{"":{"":{"":{"":0}}}}}},"v\\u0065rb":"read"}',
]
PIECES = [b'"', b"\\", b"{", b"}", b"[", b"]", b",", b":", b"0", b"9", b"-", b".", b"e", b"E+", b"\\u00", b"\0", b"\x1f", b"\x7f"]
PIECES += [
    b"\xff",
    b"\xc3\xa9",
    b" ",
    b"\t",
    b"\r",
    b"null",
    b"tru",
    b"NaN",
    b'"duty":',
    b'"id":',
    b'"verb":"set"',
    b"[[[[[[[[",
    b"0" * 90,
]


def mutated(dice: random.Random) -> bytes:
    """A line that was one, before some bytes of it were changed, put in, left out or doubled."""
    line = bytearray(dice.choice(WHOLE))
    for _ in range(dice.choice((0, 1, 1, 1, 2, 2, 4, 9))):
        at = dice.randrange(len(line) + 1)
        match dice.randrange(6):
            case 0 if at < len(line):
                line[at] = dice.randrange(256)
            case 1:
                line[at:at] = dice.choice(PIECES)
            case 2:
                del line[at : at + dice.randrange(1, 5)]
            case 3:
                line[at:at] = line[at : at + dice.randrange(40)]
            case 4:
                line[at:] = dice.choice(WHOLE)[at:]
            case _:
                line[-1:-1] = b"," + dice.choice(WHOLE)[1:-1]
    return bytes(line).replace(b"\n", b" ")


def test_mutated_lines_are_read_as_python_reads_them_and_never_hurt(build: Build) -> None:
    dice = random.Random(SEED)
    lines = [mutated(dice) for _ in range(MUTATED)]
    expected = [meant(line) for line in lines]
    assert MUTATED / 10 < sum(one is not None for one in expected) < MUTATED * 9 / 10, "the lines are all of one kind"

    alone = build("-std=gnu11", *SANITIZED, source=ROOT / "tests" / "examples" / "arduino_lines.c")
    ran = subprocess.run([alone], input=b"\n".join(lines) + b"\n", capture_output=True, timeout=LIMIT_S, check=False)
    assert ran.returncode == 0, ran.stderr.decode()
    for line, one, told in zip(lines, expected, ran.stdout.decode().splitlines(), strict=True):
        assert told == ("{} {} {}".format(*one) if one else "too long" if len(line) > LINE_SIZE_MAX else "refused"), line

    duty, moves, moved_by = 0, 0, -1
    answers = said(build(*SANITIZED), b"\n".join(lines) + b"\n")
    for line, one, answer in zip(lines, expected, answers, strict=True):
        assert ("ok" in answer) == (one is not None), line
        if one is None:
            continue
        verb, wanted, number = one
        if verb == "set" and (number < 0 or (number, wanted) != (moved_by, duty)):
            duty, moves, moved_by = wanted, moves + 1, number
        assert (answer["id"], answer["ok"]["duty"], answer["ok"]["moves"]) == (
            None if number < 0 else number,
            duty / 10_000,
            moves,
        ), line


# --- The driver ------------------------------------------------------------------------------------------------------


class Plugged:
    """The sketch behind a pseudo-terminal."""

    def __init__(self, program: Path, port: Path, pwm_ms: int = 50) -> None:
        self.port = port
        self.log = port.with_suffix(f".{time.monotonic_ns()}")
        with self.log.open("wb") as log:
            self._process = subprocess.Popen([program, port], stderr=log, env=os.environ | {"PWM_MS": str(pwm_ms)})
        until(port.exists)

    def moved(self) -> list[int]:
        """What its motor was told, negative: backwards."""
        pairs = re.findall(r"digital 8 (\d)\nanalog 9 (\d+)", self.log.read_text())
        return [-int(value) if backwards == "1" else int(value) for backwards, value in pairs]

    def unplug(self) -> None:
        self.port.unlink(missing_ok=True)  # first: another terminal may get the number of this one
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where the driver and its callers meet; its port is there, too."""
    found = tmp_path_factory.mktemp("d")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("FAILOVER_DRIVERS", str(found / "m"))
        environment.setenv("FAILOVER_ROBOT", "robot1")
        environment.delenv("FAILOVER_TEAM", raising=False)
        yield found


@pytest.fixture
def plug(build: Build, place: Path) -> Iterator[Callable[..., Plugged]]:
    """Plug the device in; it is unplugged at the end."""
    with contextlib.ExitStack() as all_of_them:

        def one(pwm_ms: int = 50) -> Plugged:
            device = Plugged(build(), place / PORT, pwm_ms)
            all_of_them.callback(device.unplug)
            return device

        yield one


@pytest.fixture(scope="module")
def driver(place: Path) -> Iterator[Path]:
    """The driver, once it takes messages: where it is typed to by hand. One process for all tests, with a new device in each."""
    told = place / "told"
    with (
        told.open("wb") as file,
        subprocess.Popen([sys.executable, FOLDER / "pwm.py", place / PORT], stderr=file, cwd=ROOT) as driver,
    ):
        try:
            until(lambda: "takes messages" in told.read_text() or driver.poll() is not None)
            (hand,) = (place / "m").glob("*.hand")
            yield hand
        finally:
            driver.kill()


def refused(proxy: failover.Proxy, verb: str, **fields: float) -> str:
    """The sentence that a caller gets."""
    with pytest.raises(CallRefusedError) as error:
        proxy.call(verb, timeout=LIMIT_S, **fields)
    return str(error.value)


DEVICE_S = float(os.environ.get("FAILOVER_DEVICE_S", "3"))
"""How long commands come to a device; 600 for ten minutes."""

LONG = pytest.mark.timeout(120 + 3 * DEVICE_S)
RATE_HZ = 20
OFFERED_HZ = 200


class Networked(Plugged):
    """The sketch behind a TCP port."""

    def __init__(self, program: Path, folder: Path) -> None:
        (number,) = free_ports(1)
        self.port = folder / "none"
        self.address = f"tcp://127.0.0.1:{number}"
        self.log = folder / "log"
        with self.log.open("wb") as log:
            self._process = subprocess.Popen([program, f"tcp:{number}"], stderr=log, env=os.environ | {"PWM_MS": "50"})


@pytest.fixture(params=["serial", "tcp"])
def motor(
    request: pytest.FixtureRequest, build: Build, plug: Callable[..., Plugged], driver: Path, tmp_path: Path
) -> Iterator[Plugged]:
    """A device that takes 50 ms a command, with its driver; the one with a TCP port has a driver of its own."""
    if request.param == "serial":
        yield plug()
        return
    request.getfixturevalue("monkeypatch").setenv("FAILOVER_DRIVERS", str(tmp_path / "m"))
    device, told = Networked(build(), tmp_path), tmp_path / "told"
    with told.open("wb") as file, subprocess.Popen([sys.executable, FOLDER / "pwm.py", device.address], stderr=file) as process:
        try:
            until(lambda: "takes messages" in told.read_text() or process.poll() is not None)
            yield device
        finally:
            process.kill()
            device.unplug()


@LONG
def test_commands_at_20_hz_arrive_all_and_in_order(motor: Plugged) -> None:
    count = round(DEVICE_S * RATE_HZ)
    with failover.proxy("arduino") as arduino:
        due = time.monotonic()
        for number in range(1, count + 1):
            duty = number % 100 / -100
            told = arduino.call("set", duty=duty, timeout=LIMIT_S)
            assert told == {"duty": duty, "pwm": pwm_of(duty), "moves": number}
            due += 1 / RATE_HZ
            time.sleep(max(due - time.monotonic(), 0))  # it is offered 20 commands a second, not more
        assert arduino.call("read", timeout=LIMIT_S) == told
    assert [abs(one) for one in motor.moved()] == [pwm_of(number % 100 / 100) for number in range(1, count + 1)]


def pwm_of(duty: float) -> int:
    """What the motor is told."""
    return (round(abs(duty) * 100) * 255 + 50) // 100


@LONG
def test_of_commands_at_200_hz_none_is_lost_and_each_sender_is_told_into_which_its_own_was_merged(motor: Plugged) -> None:
    count = round(DEVICE_S * OFFERED_HZ)
    told: dict[int, list[dict[str, Any]]] = {}
    moves: list[dict[str, Any]] = []

    def offer(place: int) -> None:
        with failover.proxy("arduino", queue=QUEUE) as arduino:
            done, due = [], time.monotonic()
            for number in range(count // 2):
                while len(done) >= QUEUE and not done[-QUEUE].done():
                    time.sleep(0.001)
                done.append(arduino.post("set", duty=number % 100 / 100))
                due += 2 / OFFERED_HZ
                time.sleep(max(due - time.monotonic(), 0))
            told[place] = [one.result(LIMIT_S) for one in done]
            moves.append(arduino.call("read", timeout=LIMIT_S))

    threads = [threading.Thread(target=offer, args=(place,)) for place in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    carried = sorted((one for one in (*told[0], *told[1]) if "moves" in one), key=lambda one: one["moves"])
    merged = [one for one in (*told[0], *told[1]) if "merged_into" in one]
    assert len(carried) + len(merged) == 2 * (count // 2) and len(merged) > len(carried)
    assert [one["moves"] for one in carried] == list(range(1, len(carried) + 1))
    assert motor.moved() == [one["pwm"] for one in carried], "the device was told what each sender was told"
    assert max(one["moves"] for one in moves) == len(carried)
    for place in range(2):
        own = [number for number, one in enumerate(told[place]) if "moves" in one]
        values = [told[place][number]["duty"] for number in own]
        assert values == [number % 100 / 100 for number in own], "each that was carried out has its own value"


def typed(hand: Path, sender: str, count: int) -> list[dict[str, Any]]:
    """The answers to commands that one sender gives all at once."""
    lines = "".join(
        json.dumps({"verb": "set", "body": {"duty": n / count}, "id": f"{sender}{n}"}) + "\n" for n in range(1, count + 1)
    )
    with socket.socket(socket.AF_UNIX) as typing:
        typing.settimeout(LIMIT_S)
        typing.connect(str(hand))
        typing.sendall(lines.encode())
        typing.shutdown(socket.SHUT_WR)
        return [json.loads(line) for line in typing.makefile()]


def test_a_burst_of_four_senders_is_merged_and_each_is_told_into_which(plug: Callable[..., Plugged], driver: Path) -> None:
    device, count, senders = plug(), 50, "abcd"
    answers: dict[str, list[dict[str, Any]]] = {}
    threads = [threading.Thread(target=lambda one=one: answers.update({one: typed(driver, one, count)})) for one in senders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    every = [answer for one in senders for answer in answers[one]]
    carried = {answer["re"]: answer["ok"] for answer in every if "moves" in answer["ok"]}
    into = {answer["re"]: answer["ok"]["merged_into"] for answer in every if "merged_into" in answer["ok"]}
    assert len(carried) + len(into) == len(senders) * count and len(into) > len(carried)
    assert set(into.values()) <= set(carried)
    assert device.moved() == [ok["pwm"] for ok in sorted(carried.values(), key=lambda ok: ok["moves"])]
    for one in senders:
        assert [answer["re"] for answer in answers[one]] == [f"{one}{n}" for n in range(1, count + 1)]
        moves = [carried[into.get(answer["re"], answer["re"])]["moves"] for answer in answers[one]]
        assert moves == sorted(moves)
    for name, ok in carried.items():
        assert ok["duty"] == int(name[1:]) / count
    with failover.proxy("arduino") as arduino:
        assert arduino.call("read", timeout=LIMIT_S)["moves"] == len(carried)


def test_unplugged_the_caller_gets_a_sentence_and_plugged_in_again_it_works(plug: Callable[..., Plugged], driver: Path) -> None:
    with failover.proxy("arduino") as arduino:
        sentence = f"set failed: DeviceError: cannot open .*/{PORT}: No such file or directory; plug the device in"
        assert re.match(sentence, refused(arduino, "set", duty=0.1))
        for _ in range(2):
            device = plug()
            assert arduino.call("set", duty=0.5, timeout=LIMIT_S) == {"duty": 0.5, "pwm": 128, "moves": 1}
            device.unplug()
            assert re.match(sentence, refused(arduino, "set", duty=0.6))
        plug().unplug()
        plug()
        assert arduino.call("read", timeout=LIMIT_S) == {"duty": 0, "pwm": 0, "moves": 0}


def test_another_device_at_the_port_between_two_calls_is_used_without_a_word(plug: Callable[..., Plugged], driver: Path) -> None:
    with failover.proxy("arduino") as arduino:
        for _ in range(3):
            device = plug()
            assert arduino.call("set", duty=0.5, timeout=LIMIT_S)["moves"] == 1
            device.unplug()


def test_a_device_that_is_unplugged_while_it_moves_is_told_to_the_caller(plug: Callable[..., Plugged], driver: Path) -> None:
    device = plug(pwm_ms=1_000 * LIMIT_S)
    with failover.proxy("arduino") as arduino:
        watcher = threading.Thread(target=lambda: (until(device.moved), device.unplug()))
        watcher.start()
        sentence = refused(arduino, "set", duty=0.1)
        watcher.join()
        assert "cannot open" in sentence or "did not answer" in sentence
        plug()
        assert arduino.call("set", duty=0.1, timeout=LIMIT_S)["moves"] == 1


def test_what_no_device_accepts_does_not_reach_it(plug: Callable[..., Plugged], driver: Path) -> None:
    device = plug()
    with failover.proxy("arduino") as arduino:
        assert "<= 1" in refused(arduino, "set", duty=1.5)
        arduino.call("set", duty=1, timeout=LIMIT_S)
    assert device.moved() == [255]


def test_the_lines_of_the_page_are_answered_as_it_says(plug: Callable[..., Plugged], driver: Path) -> None:
    plug()
    section = PAGE.split("\n## An Arduino\n")[1].split("\n## ")[0]
    (line,) = [line for line in section.splitlines() if line.startswith("failover call")]
    command, _, comment = line.partition("  #")
    words = [sys.executable, "-m", "failover", *shlex.split(command)[1:]]
    ran = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT_S, check=True, cwd=ROOT)
    assert json.loads(ran.stdout) == json.loads(comment)


# --- The port --------------------------------------------------------------------------------------------------------


def test_a_line_that_is_lost_is_sent_again_with_its_id_and_noise_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pwm, "TRIES", LIMIT_S)
    theirs, ours = os.openpty()
    with contextlib.ExitStack() as closing:
        for descriptor in (theirs, ours):
            closing.callback(os.close, descriptor)
        told: list[pwm.State] = []
        asking = threading.Thread(target=lambda: told.append(pwm.Device(os.ttyname(ours)).ask("set", duty=0.5)))
        asking.start()
        heard = b""
        while heard.count(b"duty") < 2:
            heard += os.read(theirs, 512)
        first, second = [json.loads(line) for line in heard.splitlines() if line][:2]
        assert first == second and first["duty"] == 0.5
        for line in ("\xff\0noise", "{}", '{"id":null,"error":"not JSON","at":0}', f'{{"id":{first["id"] + 1},"error":"late"}}'):
            os.write(theirs, line.encode("latin-1") + b"\n")
        os.write(theirs, b'{"id":%d,"ok":{"duty":0.5000,"pwm":128,"moves":1}}\n' % first["id"])
        asking.join()
    assert told == [pwm.State(0.5, 128, 1)]


def test_a_device_that_says_nothing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pwm, "TRY_S", 0.01)
    theirs, ours = os.openpty()
    try:
        with pytest.raises(pwm.DeviceError, match=r"did not answer \{.*\}, sent 4 times: is arduino\.ino on it"):
            pwm.Device(os.ttyname(ours)).ask("read")
        fcntl.flock(ours, fcntl.LOCK_UN)
    finally:
        os.close(theirs)
        os.close(ours)


def test_a_port_that_another_program_uses_is_told() -> None:
    theirs, ours = os.openpty()
    try:
        fcntl.flock(ours, fcntl.LOCK_EX)
        with pytest.raises(pwm.DeviceError, match=r"cannot use /dev/pts/\d+: another program uses it"):
            pwm.Device(os.ttyname(ours)).ask("read")
    finally:
        os.close(theirs)
        os.close(ours)


def test_a_file_that_is_no_port_is_told(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("dear diary\n")
    with pytest.raises(pwm.DeviceError, match=r"cannot use .*/notes: it is no serial port"):
        pwm.Device(str(tmp_path / "notes")).ask("read")
    assert (tmp_path / "notes").read_text() == "dear diary\n"


def test_what_the_device_refuses_is_told_in_its_words(plug: Callable[..., Plugged]) -> None:
    device = pwm.Device(str(plug().port))
    with pytest.raises(pwm.DeviceError, match=r'refused \{"verb":"set","duty":2.5,.*\}: duty is not from -1 to 1'):
        device.ask("set", duty=2.5)
    assert device.ask("read") == pwm.State(0, 0, 0)
