"""A driver that keeps a count and a log of what it was told: ``python counter.py``."""

from __future__ import annotations

import failover


@failover.driver("Lab/Counter", alias="counter")
class Counter:
    count: int = failover.kept(default=0)
    log: list[list[object]] = failover.kept(factory=list)
    resumed = ""

    @failover.command
    def add(self, sender: str, number: int) -> int:
        self.log.append([sender, number])
        self.count += 1
        return self.count

    @failover.query
    def read(self) -> dict[str, object]:
        return {"count": self.count, "log": self.log, "resumed": self.resumed}

    def on_resume(self, resumed: failover.Resumed) -> None:
        self.resumed = resumed.why


if __name__ == "__main__":
    failover.run(Counter)
