"""The snapshot format: what it costs to make bytes of pages and pages of bytes, beside the tools that one would reach for."""

from __future__ import annotations

import ctypes
import ctypes.util
import gzip
import io
import os
import pickle
import random
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import zstandard

from benchmarks import engine
from benchmarks.figures import OURS, Absent, Figure, Findings
from benchmarks.programs import heap
from benchmarks.running import running
from checkpoint.keeper import messages
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from failover.cli.keeper_client import Keeper

CELLS: Final = 60_000
CHANGES: Final = 300
"""Of the map's cells, and how many are replaced each 50 ms."""

DELTAS: Final = 6
REPETITIONS: Final = 15
SLOW_REPETITIONS: Final = 3
"""Of what takes longer than `SLOW_S` a time."""

SLOW_S: Final = 0.3

LEVELS: Final = (-1, 1, 3)
"""zstd's: ours, and two slower ones that a slow link might want."""

Pages = dict[int, bytes]


@dataclass(frozen=True, slots=True)
class Way:
    """One way to make bytes of a snapshot's pages, and back; both answer what they made."""

    who: str
    pack: Callable[[], bytes]
    unpack: Callable[[bytes], object]


def encoding(quick: bool, directory: Path) -> Findings:
    """A base and a delta of a Python program's heap, packed and unpacked in every way."""
    cells = CELLS // 4 if quick else CELLS
    base, delta, before = _snapshots(cells, directory)
    figures: list[Figure] = []
    for name, snapshot in (("base", base), ("delta", delta)):
        case = f"{name} of a Python heap, {len(snapshot.contents) / 1e6:.1f} MB of pages"
        ways = [_ours(snapshot), *_of_pages(bytes(snapshot.contents))]
        if snapshot is delta:
            ways += [_changes_only(delta, before), _of_objects(cells)]
        for way in ways:
            figures += _measured(way, case)
    return Findings(
        "The format, beside what one would reach for",
        f"Pages as captured from a Python program with {cells:,} objects in a dictionary, {CHANGES} of them replaced each 50 "
        "ms. Ours checks the snapshot, packs pages and state by zstd −1 and seals every byte by a digest; reading verifies it "
        "all. The bare tools pack the same pages and prove nothing. “XOR” packs the difference from the pages' last content; "
        "so does our keeper where it has that at hand, which it has not here. “pickle” is what a program does for itself: "
        "all its objects each time, and it stands still "
        "meanwhile.",
        tuple(sorted(figures, key=lambda figure: (figure.benchmark, figure.case))),
        () if _lz4() else (Absent("lz4", "liblz4.so.1 is not installed"),),
    )


def _snapshots(cells: int, directory: Path) -> tuple[Snapshot, Snapshot, Pages]:
    """A base, the last of some deltas, and what the delta's pages held before it."""
    pages: Pages = {}
    with running("heap", cells, CHANGES, directory=directory) as program, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(program.pid, "/benchmark"), messages.Protected)
        base = newest = _captured(keeper, 1)
        for sequence in range(2, DELTAS + 2):
            pages.update(_pages_of(newest))
            time.sleep(engine.PERIOD_S)
            newest = _captured(keeper, sequence)
        keeper.ask(messages.Release(), messages.Released)
    zeros = bytes(newest.machine.page_size)
    return base, newest, {address: pages.get(address, zeros) for address in _pages_of(newest)}


def _captured(keeper: Keeper, sequence: int) -> Snapshot:
    asked = messages.Capture(base=sequence == 1, generation=1, sequence=sequence)
    captured, (content,) = keeper.ask(asked, messages.Captured)
    keeper.tell(messages.Acknowledge(captured.position))
    try:
        return format.decode(content)
    finally:
        os.close(content)


def _pages_of(snapshot: Snapshot) -> Pages:
    size = snapshot.machine.page_size
    addresses = [address for run in snapshot.runs for address in range(run.start, run.end, size)]
    contents = bytes(snapshot.contents)
    return {address: contents[index * size : (index + 1) * size] for index, address in enumerate(addresses)}


# --- Ways ----------------------------------------------------------------------------------------------------------------


def _ours(snapshot: Snapshot) -> Way:
    def pack() -> bytes:
        file = io.BytesIO()
        format.encode(snapshot, file)
        return file.getvalue()

    return Way(OURS, pack, format.decode)


def _of_pages(pages: bytes) -> list[Way]:
    """The bare tools on the bare pages."""
    lz4 = _lz4()
    return [
        *(_zstd(level, pages) for level in LEVELS),
        *([Way("lz4", lambda: lz4.pack(pages), lambda packed: lz4.unpack(packed, len(pages)))] if lz4 else []),
        Way("zlib, level 1", lambda: zlib.compress(pages, 1), zlib.decompress),
        Way(
            "pickle of the pages, gzip, level 1",
            lambda: gzip.compress(pickle.dumps(pages), 1),
            lambda packed: pickle.loads(gzip.decompress(packed)),
        ),
    ]


def _zstd(level: int, pages: bytes) -> Way:
    """zstd at one of its levels."""
    packer, unpacker = zstandard.ZstdCompressor(level=level), zstandard.ZstdDecompressor()
    return Way(f"zstd {level}".replace("-", "−"), lambda: packer.compress(pages), unpacker.decompress)


def _changes_only(delta: Snapshot, before: Pages) -> Way:
    """zstd on the difference from what the pages held before."""
    packer, unpacker = zstandard.ZstdCompressor(level=-1), zstandard.ZstdDecompressor()
    earlier = np.frombuffer(b"".join(before[address] for address in _pages_of(delta)), dtype=np.uint64)
    now = np.frombuffer(delta.contents, dtype=np.uint64)
    return Way(
        "XOR with the last content, zstd −1",
        lambda: packer.compress((now ^ earlier).data),
        lambda packed: np.frombuffer(unpacker.decompress(packed), dtype=np.uint64) ^ earlier,
    )


def _of_objects(cells: int) -> Way:
    """The way of a program that saves itself: all its objects, each time."""
    found = heap.cells(cells, random.Random(1))
    return Way(
        "pickle of the program's objects, gzip, level 1",
        lambda: gzip.compress(pickle.dumps(found, pickle.HIGHEST_PROTOCOL), 1),
        lambda packed: pickle.loads(gzip.decompress(packed)),
    )


def _measured(way: Way, case: str) -> list[Figure]:
    """Times of packing and of unpacking, and the size."""
    packed = way.pack()  # once without measuring, so that every way is warm
    packing, unpacking = _times(way.pack), _times(lambda: way.unpack(packed))
    return [
        Figure("packing", case, "ms", packing, way.who),
        Figure("reading back", case, "ms", unpacking, way.who),
        Figure("size", case, "MB", (len(packed) / 1e6,), way.who),
    ]


def _times(act: Callable[[], object]) -> tuple[float, ...]:
    """Milliseconds of each of some repetitions."""
    found: list[float] = []
    while len(found) < (SLOW_REPETITIONS if sum(found) / 1000 > SLOW_S * SLOW_REPETITIONS else REPETITIONS):
        began = time.perf_counter()
        act()
        found.append((time.perf_counter() - began) * 1000)
    return tuple(found)


# --- lz4 ----------------------------------------------------------------------------------------------------------------


class Lz4:
    """The C library's block functions. Source: lz4.h."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library

    def pack(self, raw: bytes) -> bytes:
        """One block."""
        room = ctypes.create_string_buffer(self._library.LZ4_compressBound(len(raw)))
        size = self._library.LZ4_compress_default(raw, room, len(raw), len(room))
        return ctypes.string_at(room, size)

    def unpack(self, packed: bytes, size: int) -> bytes:
        """A block whose content has ``size`` bytes."""
        room = ctypes.create_string_buffer(size)
        self._library.LZ4_decompress_safe(packed, room, len(packed), size)
        return ctypes.string_at(room, size)


def _lz4() -> Lz4 | None:
    try:
        return Lz4(ctypes.CDLL("liblz4.so.1"))
    except OSError:
        return None
