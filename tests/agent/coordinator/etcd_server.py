"""A real etcd for tests, on free ports of this machine, or in a network namespace of its own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

REQUIRED: Final = "FAILOVER_TEST_ETCD"
"""With the value ``required`` in the environment, what is missing here is an error."""


def why_not() -> str:
    """Why there can be no such server here; "" if there can.

    Raises:
        RuntimeError: there must be one, because the environment says so.
    """
    reason = "" if shutil.which("etcd") else "needs etcd: ./run test as root installs etcd-server"
    if reason and os.environ.get(REQUIRED) == "required":
        raise RuntimeError(reason)
    return reason


class EtcdServer:
    """One member. ``before``: words of the command line in front of etcd's; ``options``: behind them.

    ``cluster``: name → address for the other members, of all of them; none: this one alone is a cluster.
    """

    def __init__(
        self,
        place: Path,
        host: str,
        port: int,
        peer_port: int,
        *,
        before: Sequence[str] = (),
        options: Sequence[str] = (),
        name: str = "one",
        cluster: Mapping[str, str] | None = None,
    ) -> None:
        self._place, self._before = place, before
        self.scheme = "https" if "--cert-file" in options else "http"
        self.endpoint = f"{self.scheme}://{host}:{port}"
        peers = cluster or {name: f"http://127.0.0.1:{peer_port}"}
        listens = f"{self.scheme}://0.0.0.0:{port}" if before else self.endpoint
        self._options = (
            *("--name", name, "--data-dir", str(place / "data"), "--logger", "zap"),
            *("--listen-client-urls", listens, "--advertise-client-urls", self.endpoint),
            *("--listen-peer-urls", peers[name], "--initial-advertise-peer-urls", peers[name]),
            *("--initial-cluster", ",".join(f"{one}={url}" for one, url in peers.items())),
            *options,
        )
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it; what it kept before is there again."""
        self._place.mkdir(exist_ok=True)
        with (self._place / "log").open("ab") as log:
            command = [*self._before, "etcd", *self._options]
            self.process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)

    def kill(self) -> None:
        """End it at once; its files stay."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
        self.process = None

    def stop(self) -> None:
        """Stop all of it, as a machine that is overloaded does; no thread of it runs on."""
        assert self.process is not None
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED)

    def go_on(self) -> None:
        """Let it run again."""
        assert self.process is not None
        self.process.send_signal(signal.SIGCONT)


def three_members(place: Path, hosts: Sequence[str], ports: Sequence[int], before: Sequence[Sequence[str]]) -> list[EtcdServer]:
    """One cluster of three; of ``ports`` two for each, of ``before`` the words for each."""
    place.mkdir(exist_ok=True)
    pairs = list(zip(ports[::2], ports[1::2], strict=True))
    cluster = {str(number): f"http://{host}:{pair[1]}" for number, (host, pair) in enumerate(zip(hosts, pairs, strict=True))}
    return [
        EtcdServer(place / name, host, *pair, before=words, name=name, cluster=cluster)
        for name, host, pair, words in zip(cluster, hosts, pairs, before, strict=True)
    ]
