"""inspect: shows the content of a snapshot's file, in tables or as JSON, after every byte of it was verified."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from datetime import UTC, datetime
from typing import Any

import msgspec

from checkpoint.errors import AuthorError, FormatError
from checkpoint.linux import file_author
from checkpoint.model import Position, Snapshot, Vma
from checkpoint.snapshot import credentials, format
from failover.cli.output import render, team_tree

NANOSECONDS = 1_000_000_000

PROTECTION = ((1, "r"), (2, "w"), (4, "x"))


def inspect(arguments: argparse.Namespace) -> int:
    """Show the content of a snapshot."""
    try:
        format.verify(arguments.file)
        snapshot = format.read_outline(arguments.file)
        with open(arguments.file, "rb") as file:
            size, back = os.fstat(file.fileno()).st_size, rights_of(snapshot, file.fileno(), arguments.file)
    except OSError as error:
        raise FormatError(f"cannot read {arguments.file}: {error.strerror}") from error
    if arguments.json:
        render.as_json(as_builtins(snapshot, size) | {"rights": msgspec.to_builtins(back)})
        return 0
    _show(snapshot, size, arguments.vmas, back)
    return 0


class Rights(msgspec.Struct, frozen=True):
    """With whose rights a snapshot comes back if root restores it.

    Attributes:
        author: uid of its author; None: that cannot be told, and root is refused without --trust.
        why: the fact that shows that.
        reduced: the rights that it asks for and does not get, each with its figure.
    """

    author: int | None
    why: str
    reduced: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """In one line."""
        if self.author is None:
            return "refused: " + self.why
        if not self.author:
            return f"all that it asks for ({self.why})"
        lost = f"; not {', '.join(self.reduced)}" if self.reduced else "; it asks for no more"
        return f"those of {file_author.named(self.author)} at most ({self.why}){lost}"


def rights_of(snapshot: Snapshot, file: int, path: str) -> Rights:
    """The rights that `failover restore` would give it where root calls it."""
    try:
        author = file_author.author_of(file, path)
    except AuthorError as error:
        return Rights(None, str(error))
    if author.owner is None:
        return Rights(file_author.ROOT, author.why)
    return Rights(author.owner.uid, author.why, credentials.excess(snapshot, author.owner))


def as_builtins(snapshot: Snapshot, size: int) -> dict[str, Any]:
    """The whole snapshot without its pages, as plain values; bytes become hexadecimal."""
    found: dict[str, Any] = msgspec.to_builtins(snapshot, builtin_types=(bytes, bytearray, memoryview))
    found.pop("contents", None)
    found["output"] = [{"stream": piece.stream, "offset": piece.offset, "size": len(piece.content)} for piece in snapshot.output]
    found["file_size"] = size
    found["contents_size"] = sum(run.size for run in snapshot.runs)
    return found


def _show(snapshot: Snapshot, size: int, with_vmas: bool, back: Rights) -> None:
    render.table(("", ""), [*facts(snapshot, size), ("rights, if root restores it", back.line)], "Snapshot")
    print()
    render.table(("memory", "mappings", "size"), memory(snapshot.vmas), "Memory")
    if snapshot.resources:
        print()
        lines = [(resource.kind, resource.name, _facts_text(resource.facts)) for resource in snapshot.resources]
        render.table(("kind", "which", "facts"), lines, "Resources")
    if with_vmas:
        print()
        render.table(("start", "end", "size", "may", "kind", "name"), [vma_line(vma) for vma in snapshot.vmas], "Mappings")
    for note in snapshot.notes:
        print(f"note: {note}")


def facts(snapshot: Snapshot, size: int) -> list[tuple[str, str]]:
    """The facts that a person asks for first: which program, when, where, how large."""
    process, machine = snapshot.process, snapshot.machine
    taken = datetime.fromtimestamp(snapshot.clocks.realtime_ns / NANOSECONDS, UTC)
    carried = sum(run.size for run in snapshot.runs)
    threads = ", ".join(thread.name for thread in snapshot.threads)
    interrupted = ", ".join(thread.interrupted for thread in snapshot.threads if thread.interrupted)
    return [
        ("component", snapshot.component),
        ("program", process.executable.path),
        ("command", " ".join(process.arguments)),
        ("pid", f"{process.pid}{' (in a PID namespace of its own)' if process.isolated else ''}"),
        ("threads", f"{len(snapshot.threads)} ({threads})"),
        ("in the middle of", interrupted or "its own code"),
        ("directory", process.working_directory),
        ("user, group", f"{process.credentials.uids[1]}, {process.credentials.gids[1]}"),
        (
            "taken",
            f"{taken:%Y-%m-%d %H:%M:%S} UTC on {machine.hostname}, frozen for {team_tree.microseconds(snapshot.freeze_us)}",
        ),
        ("machine", f"{machine.architecture}, Linux {machine.kernel}, pages of {machine.page_size} bytes"),
        ("kind", "base (whole)" if snapshot.is_base else f"delta since {position(snapshot.parent)}"),
        ("position", position(snapshot.position)),
        ("epoch", str(snapshot.epoch)),
        ("engine", snapshot.engine),
        ("file", f"{team_tree.size(size)}, carries {team_tree.size(carried)} of pages in {len(snapshot.runs)} runs"),
    ]


def position(value: Position | None) -> str:
    """Generation.sequence and the digest's first digits."""
    return "–" if value is None else f"{value.generation}.{value.sequence} ({value.digest.hex()[:12]})"


def memory(vmas: tuple[Vma, ...]) -> list[tuple[str, str, str]]:
    """Mappings and their size by kind, the largest first."""
    sizes: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for vma in vmas:
        kind = f"{vma.kind.value}{', shared' if vma.shared else ''}"
        sizes[kind] += vma.size
        counts[kind] += 1
    return [(kind, str(counts[kind]), team_tree.size(total)) for kind, total in sizes.most_common()]


def vma_line(vma: Vma) -> tuple[str, ...]:
    """One mapping as /proc/PID/maps would show it."""
    may = "".join(letter if vma.protection & bit else "-" for bit, letter in PROTECTION) + ("s" if vma.shared else "p")
    return f"{vma.start:x}", f"{vma.end:x}", team_tree.size(vma.size), may, vma.kind.value, vma.name


def _facts_text(values: Any) -> str:
    parts = [
        f"{key}={value.hex() if isinstance(value, bytes) else value}" for key, value in values.items() if value not in (None, "")
    ]
    return " ".join(parts)
