"""Counts in memory and in a database: one transaction a step. A line is written once its transaction is committed.

Arguments: the database, the journal's mode (delete, wal), the least number of steps; it continues until a file exists, if one is
named. In the end it says "ok" if the database is well and has a row for each step.
"""

import os
import sqlite3
import sys


def count(path: str, mode: str, least: int, enough: str) -> None:
    """Add a row with each step."""
    link = sqlite3.connect(path, isolation_level=None)
    assert link.execute(f"PRAGMA journal_mode={mode}").fetchone()[0] == mode
    link.execute("CREATE TABLE IF NOT EXISTS steps (number INTEGER PRIMARY KEY, content BLOB)")
    step = 0
    while step < least or not os.path.exists(enough):
        step += 1
        with link:
            link.execute("BEGIN")
            link.execute("INSERT INTO steps VALUES (?, ?)", (step, bytes([step % 256]) * 700))
        found = link.execute("SELECT count(*), max(number) FROM steps").fetchone()
        if found != (step, step):
            print(f"memory counts {step} steps, the database {found}", flush=True)
            sys.exit(1)
        print(step, flush=True)
    check(link, step)


def check(link: sqlite3.Connection, last: int) -> None:
    """Say whether database and memory are well."""
    well = link.execute("PRAGMA integrity_check").fetchall()
    held = link.execute("SELECT count(*) FROM steps").fetchone()[0]
    print("ok" if (well, held) == ([("ok",)], last) else f"{well}, {held} rows of {last}", flush=True)


count(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4] if len(sys.argv) > 4 else "/")
