"""Unprepared servers with clients: captured, killed and restored three times; the clients connect again."""

from __future__ import annotations

import contextlib
import http.client
import itertools
import os
import random
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.checkpoint.round_trip import captured_and_killed, ended, restored, start

pytestmark = [pytest.mark.root, pytest.mark.slow]

ROUNDS = 3
PATIENCE_S = 60.0
ENVIRONMENT = {"PATH": os.environ["PATH"], "LANG": "C", "HOME": "/tmp"}

NODE = """
const kept = new Map();
require('http').createServer((request, response) => {
  kept.set(request.url, (kept.get(request.url) || 0) + 1);
  response.end(`${request.url} ${kept.get(request.url)}`);
}).listen(Number(process.argv[1]), '127.0.0.1', () => console.log('ready'));
"""


class Redis:
    """One connection that speaks the protocol of Redis."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self._file = self._socket.makefile("rb")

    def ask(self, *words: str) -> str | None:
        """Give one order: the answer; the connection's end is an error."""
        self.send(*words)
        line = self._file.readline()
        if not line:
            raise ConnectionResetError("the server has ended the connection")
        if line[:1] == b"$":
            size = int(line[1:])
            return None if size < 0 else self._file.read(size + 2)[:-2].decode()
        return line[1:].strip().decode()

    def send(self, *words: str) -> None:
        """Give one order without waiting for the answer."""
        parts = [f"${len(word.encode())}\r\n{word}\r\n" for word in words]
        self._socket.sendall(f"*{len(words)}\r\n{''.join(parts)}".encode())

    def close(self) -> None:
        """End the connection."""
        self._file.close()
        self._socket.close()


def free_port() -> int:
    """A port that nobody uses just now, and that no connection is given: a server wants it again in each of its lives."""
    first_given = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    while True:
        port = random.randrange(1024, max(first_given, 2048))
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port


def answer_of(act: Callable[[], str]) -> str:
    """What a client does whose server has just come, or come back: connect until it is answered."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return act()
        except (OSError, http.client.HTTPException):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


class Load(threading.Thread):
    """A client that counts a number up in a server, as fast as it can, until the connection ends.

    Attributes:
        counted: what it has set and been told that it is set.
    """

    def __init__(self, port: int, first: int) -> None:
        super().__init__()
        self.counted = first
        self._port = port

    def run(self) -> None:
        """Count."""
        with contextlib.suppress(OSError), contextlib.closing(Redis(self._port)) as client:
            for number in itertools.count(self.counted + 1):
                assert client.ask("SET", "counter", str(number)) == "OK"
                self.counted = number

    def wait_for(self, least: int) -> None:
        """Wait until it has counted so far."""
        deadline = time.monotonic() + PATIENCE_S
        while self.counted < least:
            assert time.monotonic() < deadline, f"it has counted to {self.counted} only"
            time.sleep(0.002)


def test_redis_keeps_its_data_and_its_clients_connect_again(tmp_path: Path) -> None:
    if not (program_file := shutil.which("redis-server") or shutil.which("redis-check-rdb")):
        pytest.skip("needs redis-server (or redis-tools), which is not installed here")
    server = tmp_path / "redis-server"  # one program under several names, each with a task of its own
    server.symlink_to(os.path.realpath(program_file))
    port = free_port()
    words = [str(server), "--port", str(port), "--bind", "127.0.0.1", "--save", "", "--io-threads", "2"]
    program, counter = start(words, tmp_path, env=ENVIRONMENT), 0
    for round_number in range(ROUNDS):
        with ended(program):
            answer_of(lambda name=f"round {round_number}": ask_redis(port, "SET", name, "x" * 100_000))
            waits, load = Redis(port), Load(port, counter)
            waits.send("BLPOP", "nothing", "0")
            load.start()
            load.wait_for(counter + 50)
            before = load.counted
            snapshot = captured_and_killed(program)
            load.join()
        with contextlib.closing(waits), pytest.raises(ConnectionError):
            waits.ask("PING")
        program = restored(snapshot, tmp_path)
        counter = int(ask_redis(port, "GET", "counter"))
        assert before <= counter <= load.counted + 1
        for earlier in range(round_number + 1):
            assert ask_redis(port, "STRLEN", f"round {earlier}") == "100000"
    with ended(program):
        clients = program_clients(port)
        assert len(clients) == 1, f"it believes in clients that are gone: {clients}"


def ask_redis(port: int, *words: str) -> str:
    """One question by a client of its own."""
    with contextlib.closing(Redis(port)) as client:
        return client.ask(*words) or ""


def program_clients(port: int) -> list[str]:
    """Who is connected, as Redis itself believes, once it has seen who is not."""
    deadline = time.monotonic() + PATIENCE_S
    while len(found := ask_redis(port, "CLIENT", "LIST").splitlines()) > 1 and time.monotonic() < deadline:
        time.sleep(0.02)
    return found


def ask_by_http(port: int, path: str, *, keep: http.client.HTTPConnection | None = None) -> str:
    """One question by HTTP, over a connection of its own or one that stays."""
    client = keep or http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        client.request("GET", path)
        return client.getresponse().read().decode()
    finally:
        if keep is None:
            client.close()


@contextlib.contextmanager
def half_asked(port: int) -> Iterator[None]:
    """A client that has said half of what it wants."""
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as client:
        client.sendall(b"GET /half HTTP/1.1\r\nHost:")
        yield


def test_the_server_of_python_serves_on(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "page").write_text("a page\n" * 1000)
    serve(port, [sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1"], tmp_path, lambda _: "a page\n" * 1000)


def test_node_keeps_what_it_counts_and_serves_on(tmp_path: Path) -> None:
    if not (node := shutil.which("node")):
        pytest.skip("needs node, which is not installed here")
    port = free_port()
    serve(port, [node, "-e", NODE, str(port)], tmp_path, lambda count: f"/page {count}")


def serve(port: int, words: list[str], directory: Path, expected: Callable[[int], str]) -> None:
    """Ask a server, capture, kill and restore it with clients at it, and ask again.

    Args:
        expected: what it answers to the nth question.
    """
    program, count = start(words, directory, env=ENVIRONMENT), 0
    answer_of(lambda: ask_by_http(port, "/other"))
    for _ in range(ROUNDS):
        with ended(program), half_asked(port), contextlib.closing(http.client.HTTPConnection("127.0.0.1", port)) as kept:
            for keep in (None, kept, None):
                count += 1
                assert ask_by_http(port, "/page", keep=keep) == expected(count)
            snapshot = captured_and_killed(program)
        program = restored(snapshot, directory)
    with ended(program):
        assert ask_by_http(port, "/page") == expected(count + 1)
        assert program.poll() is None, program.complaints
