"""How long a switch of versions keeps a sender waiting that sends 20 commands a second: ``python -m benchmarks.program_switch``.

Two versions of a driver in a directory each, switched to and fro. ``gap``: from the old version's pause until the new one can
take a message, as the host measures it. ``call``: of all calls, and ``around``: of the slowest one around each switch, as the
sender measures them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Final

SWITCHES: Final = 40
RATE_HZ: Final = 20
SETTLE_S: Final = 0.2
LIMIT_S: Final = 120.0

PROGRAM: Final = """
name = "engine"
version = "{version}"
path = "Benchmark/Switched"
entry = "engine.py:Engine"
[health]
seconds = 0.1
"""

DRIVER: Final = """
import failover

@failover.driver("Benchmark/Switched", alias="switched")
class Engine:
    numbers: list[int] = failover.kept(default=[])

    @failover.command
    def step(self, number: int) -> int:
        self.numbers.append(number)
        return number

    @failover.query
    def read(self) -> list[int]:
        return self.numbers
"""


class Sender(threading.Thread):
    """Sends numbers at a rate until it is told to stop; each call's end and duration."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.answers: list[int] = []
        self.took: list[tuple[float, float]] = []
        self.is_over = False

    def run(self) -> None:
        """Call, and wait for the next instant."""
        import failover

        with failover.proxy("switched") as proxy:
            due = time.monotonic()
            while not self.is_over:
                time.sleep(max(due - time.monotonic(), 0))
                due += 1 / RATE_HZ
                began = time.monotonic()
                self.answers.append(proxy.call("step", number=len(self.answers), timeout=LIMIT_S))
                self.took.append((time.monotonic(), time.monotonic() - began))


def measured(folder: Path, switches: int) -> dict[str, Any]:
    """Gaps and calls of so many switches, in ms; checked that no command was lost, doubled or out of order."""
    import failover
    from failover.drivers.here import here, lives

    places = [folder / "one", folder / "two"]
    for number, place in enumerate(places, 1):
        place.mkdir()
        (place / "program.toml").write_text(PROGRAM.format(version=number))
        (place / "engine.py").write_text(DRIVER)
    words = [sys.executable, "-m", "failover", "program", "run", str(places[0])]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as host:
        try:
            end = time.monotonic() + LIMIT_S
            while not lives(here(), "Benchmark/Switched") and time.monotonic() < end:
                time.sleep(0.05)
            gaps, around = [], []
            sender = Sender()
            with failover.proxy("switched") as proxy:
                sender.start()
                for number in range(switches):
                    time.sleep(SETTLE_S)
                    proxy.call("_switch", {"directory": str(places[(number + 1) % 2])}, timeout=LIMIT_S)
                    while (found := proxy.call("_versions", timeout=LIMIT_S))["is_coming"] or found["on_trial"]:
                        time.sleep(0.02)
                    at = time.monotonic()
                    gaps.append(found["gap_ms"])
                    time.sleep(2 / RATE_HZ)
                    around.append(max((took for when, took in sender.took if when > at - 1.0), default=0.0) * 1e3)
                sender.is_over = True
                sender.join(LIMIT_S)
                kept = proxy.call("read", timeout=LIMIT_S)
        finally:
            host.terminate()
    if not sender.answers == kept == list(range(len(kept))):
        raise SystemExit("a command was lost, doubled or out of order")
    return {"commands": len(kept), "gap": gaps, "call": [took * 1e3 for _, took in sender.took], "around": around}


def main() -> None:
    """Print medians and 99th percentiles."""
    switches = int(sys.argv[1]) if len(sys.argv) > 1 else SWITCHES
    with tempfile.TemporaryDirectory(prefix="p") as folder:
        (Path(folder) / "m").mkdir(mode=0o700)
        os.environ.update(FAILOVER_DRIVERS=f"{folder}/m", FAILOVER_PROGRAMS=f"{folder}/s", FAILOVER_ROBOT="benchmark")
        found = measured(Path(folder), switches)
    print(f"{switches} switches, {found['commands']} commands at {RATE_HZ} Hz: each carried out once, in order, and in the state")
    for name in ("gap", "call", "around"):
        values = sorted(found[name])
        p50, p99 = values[len(values) // 2], values[int(len(values) * 0.99)]
        print(f"{name:7} p50 {p50:8.2f} ms   p99 {p99:8.2f} ms   most {values[-1]:8.2f} ms")


if __name__ == "__main__":
    main()
