"""A program with a write-ahead log of its own: ``ledger.py FOLDER ENOUGH``; it makes steps until ENOUGH exists.

Every step is a transaction: a line in the log, with its sum, forced to the disk; only then is it done, and its number printed.
After some steps all accounts are written aside, renamed, and a new log is begun. Again and again it reads the folder as it would
after a crash, and compares with its memory: not a line more and none less.
"""

from __future__ import annotations

import json
import os
import sys
import zlib
from pathlib import Path

ACCOUNTS = 50
STEPS_IN_LOG = 40
READ_EVERY = 7


class Ledger:
    """Accounts in memory and on the disk."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.accounts = [0] * ACCOUNTS
        self.step = 0
        self.log = (folder / "log-0").open("ab", buffering=0)

    def transfer(self) -> None:
        """One transaction."""
        self.step += 1
        source, target = self.step % ACCOUNTS, self.step * 7 % ACCOUNTS
        line = json.dumps([self.step, source, target, self.step]).encode()
        self.log.write(b"%08x %s\n" % (zlib.crc32(line), line))
        os.fsync(self.log.fileno())
        self.accounts[source] -= self.step
        self.accounts[target] += self.step
        if self.step % STEPS_IN_LOG == 0:
            self.begin_log()

    def begin_log(self) -> None:
        """Write the accounts, begin a new log, let the old one go."""
        aside = self.folder / "accounts.new"
        aside.write_text(json.dumps([self.step, self.accounts]))
        aside.rename(self.folder / "accounts")
        self.log.close()
        self.log = (self.folder / f"log-{self.step}").open("ab", buffering=0)
        (self.folder / f"log-{self.step - STEPS_IN_LOG}").unlink()

    def read(self) -> tuple[int, list[int]]:
        """What the folder says."""
        step, accounts = 0, [0] * ACCOUNTS
        if (self.folder / "accounts").exists():
            step, accounts = json.loads((self.folder / "accounts").read_text())
        for line in (self.folder / f"log-{step}").read_bytes().splitlines():
            told, _, content = line.partition(b" ")
            assert int(told, 16) == zlib.crc32(content), "a torn line"
            step, source, target, amount = json.loads(content)
            accounts[source] -= amount
            accounts[target] += amount
        return step, accounts

    def check(self) -> None:
        """End where disk and memory do not agree."""
        found = self.read()
        if found != (self.step, self.accounts):
            print(f"memory is at step {self.step}, the folder at {found[0]}; {sorted(os.listdir(self.folder))}", flush=True)
            sys.exit(1)


def main() -> None:
    """Make steps until a file exists."""
    ledger, enough = Ledger(Path(sys.argv[1])), Path(sys.argv[2])
    while not enough.exists():
        ledger.transfer()
        print(ledger.step, flush=True)
        if ledger.step % READ_EVERY == 0:
            ledger.check()
    ledger.check()
    print("ok", flush=True)


main()
