"""The operators' page of a robot for a test: its process, and what a browser or an attacker sends it."""

from __future__ import annotations

import http.client
import importlib.resources
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failover.cli.demo.robots import RobotMachine

if TYPE_CHECKING:
    from playwright.sync_api import Page

PATIENCE_S = 60.0
COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.05)\n"

AXE = "axe_playwright_python"
"""The package that brings axe-core, which finds what hinders people who cannot see, hear or point."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def why_not() -> str:
    """Why no page can be served here; "" if one can."""
    missing = [name for name in ("starlette", "uvicorn", "websockets") if importlib.util.find_spec(name) is None]
    return f"needs {', '.join(missing)}: pip install --require-hashes -r requirements-page.txt" if missing else ""


def browser() -> str:
    """The browser of this machine; "" if there is none that can be driven, or what is tried with it is missing."""
    if any(importlib.util.find_spec(name) is None for name in ("playwright", AXE)):
        return ""
    return next((path for name in BROWSERS if (path := shutil.which(name))), "")


def mistakes(window: Page, *rules: str) -> list[str]:
    """What axe-core finds wrong with a window as it is now; by these rules only, or by all."""
    if window.evaluate("typeof axe") == "undefined":
        window.evaluate((importlib.resources.files(AXE) / "axe.min.js").read_text())
    options = {"resultTypes": ["violations"]} | ({"runOnly": list(rules)} if rules else {})
    found = window.evaluate("(options) => axe.run(document, options)", options)["violations"]
    return [f"{one['id']}: {one['help']}: {node['html'][:120]}" for one in found for node in one["nodes"]]


class Served:
    """A page that is served: its address, its process, and what its process said."""

    def __init__(self, url: str, process: subprocess.Popen[str], log: Path) -> None:
        self.url = url
        self.process = process
        self.log = log
        self.port = int(url.rstrip("/").rpartition(":")[2])
        self.origin = url.rstrip("/")
        self.cookie = ""
        self.token = ""
        self.boot = ""

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Mapping[str, str], bytes]:
        """One request as it is, with these headers; underscores in their names stand for hyphens."""
        link = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            content = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
            link.request(method, path, content, {name.replace("_", "-"): value for name, value in headers.items()})
            answer = link.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            link.close()

    def begin(self) -> None:
        """Have a session, as the page's script does."""
        status, headers, body = self.ask("GET", "/session")
        assert status == 200, body
        said = json.loads(body)
        self.cookie, self.token, self.boot = headers["set-cookie"].partition(";")[0], said["token"], said["boot"]

    def own(self) -> dict[str, str]:
        """The headers of a POST of our own page."""
        return {"Origin": self.origin, "Cookie": self.cookie, "x-failover-token": self.token, "Content-Type": "application/json"}

    def post(self, path: str, body: Any, **changed: str) -> tuple[int, Any]:
        """A POST of our own page, with some headers changed; "" leaves one out. An order is bound to the page that began it."""
        if path == "/orders" and isinstance(body, dict):
            body = {"boot": self.boot, **body}
        headers = {name: value for name, value in {**self.own(), **changed}.items() if value}
        status, _, said = self.ask("POST", path, body, **headers)
        return status, json.loads(said)


@contextmanager
def served(robot: RobotMachine, directory: Path, config: str = "", **environment: str) -> Iterator[Served]:
    """The page of a robot, at a port of the loopback.

    Args:
        config: of page.toml.
    """
    directory.mkdir(exist_ok=True)
    file, log = directory / "page.toml", directory / "page.log"
    file.write_text(config)
    options = ["--config", str(file), "--listen", "127.0.0.1:0", "--socket", str(robot.socket), "--json"]
    with log.open("w") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "failover", "page", *options],
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            env={**os.environ, **environment},
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, log.read_text()
        yield Served(json.loads(line)["url"], process, log)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) in (0, -signal.SIGTERM), log.read_text()
        assert "Traceback" not in log.read_text(), log.read_text()
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
        print("--- the page said:", log.read_text()[-4000:], sep="\n")
