"""Servers that speak the protocol of S3, for tests: moto and localbucket, two programs that share no line.

They have many packages that failover's own do not fit to, so `./run test` gives them an environment of their own.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

PROGRAMS = Path(sys.prefix) / "s3-servers" / "bin"
KINDS = ("moto", "localbucket")
BUCKET = "robots"
PATIENCE_S = 60.0
"""How long a server may take to answer: the machine may be busy."""


@contextlib.contextmanager
def server(kind: str, directory: Path) -> Iterator[str]:
    """A server with one empty bucket; its URL."""
    if not PROGRAMS.is_dir() or not shutil.which("python", path=PROGRAMS):
        pytest.skip("no servers of S3: ./run test installs them (requirements-s3-servers.txt)")
    pytest.importorskip("obstore")
    port = _free_port()
    command = {
        "moto": ["moto_server", "-H", "127.0.0.1", "-p", str(port)],
        "localbucket": ["localbucket", "--host", "127.0.0.1", "--port", str(port), str(directory)],
    }[kind]
    directory.mkdir(exist_ok=True)
    with (directory.parent / f"{kind}.log").open("wb") as log:
        process = subprocess.Popen([PROGRAMS / command[0], *command[1:]], stdout=log, stderr=log, stdin=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        _make_bucket(url, process)
        yield url
    finally:
        process.kill()
        process.wait()


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def _make_bucket(url: str, process: subprocess.Popen[bytes]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while True:
        assert process.poll() is None and time.monotonic() < until_s, "the server does not answer"
        with contextlib.suppress(urllib.error.URLError, ConnectionError):
            urllib.request.urlopen(urllib.request.Request(f"{url}/{BUCKET}", method="PUT"), timeout=PATIENCE_S).close()
            return
        time.sleep(0.05)


def environment() -> dict[str, str]:
    """What a program needs to be let in; these servers let everybody in."""
    return {"AWS_ACCESS_KEY_ID": "robot", "AWS_SECRET_ACCESS_KEY": "secret", "HOME": os.environ.get("HOME", "/")}
