"""Made-up snapshots of a small program, for tests of modules that store and send them."""

from __future__ import annotations

from collections.abc import Mapping

from msgspec.structs import replace

from checkpoint.model import (
    Clocks,
    Credentials,
    FileIdentity,
    Machine,
    Member,
    MemoryLayout,
    OutputPiece,
    PageRun,
    Position,
    ProcessState,
    Resource,
    Snapshot,
    ThreadState,
    Vma,
    VmaKind,
    Zombie,
)
from checkpoint.pages import page_set
from checkpoint.snapshot import process_tree
from checkpoint.store.chain import applied, position_of

PAGE = 4096
START = 0x10000000
COMPONENT = "/lab/robot1/mapper"

Pages = Mapping[int, bytes]
"""Page number from `START` → its content."""


def page(text: str) -> bytes:
    """One page that begins with a text."""
    return text.encode().ljust(PAGE, b".")


def process() -> ProcessState:
    """A process as small as one can be."""
    return ProcessState(
        pid=2,
        ppid=0,
        pgid=2,
        sid=2,
        executable=FileIdentity("/usr/bin/mapper", size=4, digest=bytes(32)),
        arguments=("mapper", "--fast"),
        layout=MemoryLayout(*range(11), auxv=b"\x00" * 16),
        working_directory="/",
        root_directory="/",
        umask=0o22,
        credentials=Credentials((0,) * 4, (0,) * 4),
        limits={7: (1024, -1)},
    )


def vma(first: int, count: int) -> Vma:
    """Anonymous memory of some pages from page number ``first`` on."""
    return Vma(START + first * PAGE, START + (first + count) * PAGE, 3, False, VmaKind.ANONYMOUS)


def runs_of(numbers: Mapping[int, object] | set[int]) -> tuple[PageRun, ...]:
    """Page numbers as runs in address order."""
    addresses = sorted(START + number * PAGE for number in numbers)
    return page_set.page_runs(page_set.extents(PageRun(address, address + PAGE) for address in addresses))


def snapshot(
    state: Pages,
    *,
    carried: Pages | None = None,
    cleared: frozenset[int] = frozenset(),
    parent: Position | None = None,
    sequence: int = 1,
    generation: int = 1,
    vmas: tuple[Vma, ...] = (vma(0, 128),),
    output: tuple[OutputPiece, ...] = (),
    component: str = COMPONENT,
) -> Snapshot:
    """A snapshot that leads to ``state``.

    Args:
        state: every page of the whole state.
        carried: what this snapshot carries of it; all for a base.
    """
    carried = state if carried is None else carried
    table = page_set.PageTable.empty(PAGE).apply((), runs_of(state), _joined(state), vmas)
    made = Snapshot(
        component=component,
        engine="ptrace",
        position=Position(generation, sequence, bytes(16)),
        parent=parent,
        machine=Machine("x86_64", PAGE, "6.1", "boot", "robot1"),
        clocks=Clocks(1, 2, 3),
        process=process(),
        threads=(ThreadState(2, "mapper", {"prstatus": bytes(216), "xstate": bytes(576)}),),
        vmas=vmas,
        resources=(Resource("files", "fd 3", {"descriptors": [[3, 0]], "path": "/tmp/map", "flags": 2, "offset": 7}),),
        cleared=runs_of(set(cleared)),
        runs=runs_of(carried),
        contents=_joined(carried),
        page_sum=table.page_sum,
        output=output,
        epoch=1,
        freeze_us=700,
    )
    return replace(made, position=position_of(made, generation, sequence))


def _joined(state: Pages) -> bytes:
    return b"".join(state[number] for number in sorted(state))


def family(count: int) -> list[Snapshot]:
    """A base and deltas of a program with a child, which has the same addresses, and one that has ended."""
    made: list[Snapshot] = []
    table = page_set.PageTable.empty(PAGE)
    for sequence in range(1, count + 1):
        alone = snapshot(
            {0: page("both"), 1: page(f"parent {sequence}")}, sequence=sequence, parent=made[-1].position if made else None
        )
        child = Member(
            slot=1,
            exit_signal=17,
            process=replace(process(), pid=3, ppid=2),
            threads=(replace(alone.threads[0], tid=3),),
            vmas=(vma(0, 128),),
            resources=(Resource("shared", "fd 3", {"descriptors": [[3, 0]], "description": 1, "path": "/tmp/map"}),),
        )
        whole = replace(
            alone,
            members=(child,),
            zombies=(Zombie("mapper", 4, 2, 2, 2, 3 << 8, 17),),
            runs=(*alone.runs, *process_tree.shifted_runs(alone.runs, 1)),
            contents=b"".join((alone.contents, page("both"), page(f"child {sequence}"))),
        )
        runs, contents, copies = process_tree.told_once(whole.runs, memoryview(whole.contents), PAGE)
        whole = replace(whole, runs=runs, contents=bytes(contents), copies=copies)
        table = applied(table, whole, (whole.contents,))
        whole = replace(whole, page_sum=table.page_sum)
        made.append(replace(whole, position=position_of(whole, 1, sequence)))
    return made


def pages_of(made: Snapshot) -> dict[int, bytes]:
    """The pages that a snapshot carries, by number."""
    found, offset = {}, 0
    for run in made.runs:
        for address in range(run.start, run.end, PAGE):
            found[(address - START) // PAGE] = bytes(made.contents[offset : offset + PAGE])
            offset += PAGE
    return found


def history(length: int = 4) -> tuple[Snapshot, ...]:
    """A base and its deltas; the state of each is known to `pages_of` of the fold."""
    state: dict[int, bytes] = {number: page(f"base {number}") for number in range(4)}
    made = [snapshot(state, output=(OutputPiece(1, 0, b"ready\n"), OutputPiece(2, 0, b"")))]
    written = 6
    for sequence in range(2, length + 1):
        carried = {sequence: page(f"delta {sequence}"), 20 + sequence: page(f"new {sequence}")}
        gone = frozenset({sequence - 2})
        state = {number: content for number, content in state.items() if number not in gone} | carried
        line = f"line {sequence}\n".encode()
        output = (OutputPiece(1, written, line), OutputPiece(2, 0, b""))
        written += len(line)
        made.append(snapshot(state, carried=carried, cleared=gone, parent=made[-1].position, sequence=sequence, output=output))
    return tuple(made)
