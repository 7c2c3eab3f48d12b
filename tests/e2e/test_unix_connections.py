"""A unix socket that leads to a process outside: told while the program runs, and found as after its peer's death elsewhere."""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

PYTHON = getattr(sys, "_base_executable", sys.executable)

ASKS = """
import socket, sys, time

def opened():
    talks = socket.socket(socket.AF_UNIX)
    talks.connect(sys.argv[1])
    return talks

time.sleep(0.5)
talks, number = opened(), 0
while True:
    try:
        talks.sendall(b"%d\\n" % number)
        answer = talks.recv(100)
    except BrokenPipeError:
        answer = b""
    if not answer:
        print("again", flush=True)
        talks.close()
        talks = opened()
        continue
    print(number, flush=True)
    number += 1
    time.sleep(0.01)
"""
"""Has each number acknowledged, and connects again when its server is gone."""


@contextlib.contextmanager
def server(path: Path) -> Iterator[list[bytes]]:
    """Of this machine: it acknowledges whatever a client says; the body may look at that."""
    heard: list[bytes] = []
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def answer(accepted: socket.socket) -> None:
            with accepted, contextlib.suppress(OSError):
                while said := accepted.recv(100):
                    heard.append(said)
                    accepted.sendall(b"ok")

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(target=answer, args=(listener.accept()[0],), daemon=True).start()

        serving = threading.Thread(target=serve)
        serving.start()
        try:
            yield heard
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            serving.join()


def notes(robot: RobotMachine) -> list[Any]:
    found: list[Any] = robots.component(robot, "asks").get("notes", [])
    return found


def test_a_client_is_told_of_and_connects_again_at_the_other_robot(tmp_path: Path) -> None:
    path = tmp_path / "server"
    with server(path), robots.two_robots(tmp_path) as (first, second):
        robots.run(first, "asks", PYTHON, "-c", ASKS, str(path), cwd=str(tmp_path))
        robots.until(lambda: any(f"with {path} ends" in note and "may exit" in note for note in notes(first)), "it to be told")
        robots.until_protected(first, "asks")
        robots.until(lambda: b"\n5\n" in robots.output(first, "asks"), "some answers")
        first.cut_power()
        robots.until_taken_over(second, "asks")
        before = len(robots.output(second, "asks").splitlines())
        robots.until(lambda: len(robots.output(second, "asks").splitlines()) > before + 5, "it to go on")
        lines = robots.output(second, "asks").decode().splitlines()
        numbers = [int(line) for line in lines if line != "again"]
        assert numbers == list(range(len(numbers))) and lines.count("again") == 1
        assert any(f"with {path} ends" in note for note in notes(second)), notes(second)


def test_a_program_that_is_not_to_lose_its_connection_is_not_captured_with_it(tmp_path: Path) -> None:
    path = tmp_path / "server"
    settings = '[components."/demo/robot1/asks"]\nconnections = "refuse"\n'
    with server(path) as heard, robots.two_robots(tmp_path, settings) as (first, _):
        robots.run(first, "asks", PYTHON, "-c", ASKS, str(path), cwd=str(tmp_path))
        robots.until(lambda: any('connections = "refuse" rules out' in note for note in notes(first)), "it to be refused")
        before = len(heard)
        robots.until(lambda: len(heard) > before + 5, "it to run on")
        assert heard == [b"%d\n" % number for number in range(len(heard))]
