"""Combine the pages of all processes of a component for one snapshot (see `checkpoint.snapshot.process_tree`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from checkpoint.engines.ptrace.capture.process import CapturedProcess, Look
from checkpoint.linux import abi
from checkpoint.model import PageCopy, PageRun
from checkpoint.pages import page_set
from checkpoint.resources.carried.capture import Parcel
from checkpoint.snapshot import process_tree


class Pages(Struct, frozen=True):
    """The pages that a snapshot carries; the fields are those of ``checkpoint.model.Snapshot``.

    Attributes:
        forgotten: its ``cleared``.
        frozen_size: bytes that were copied while the program stood still.
    """

    runs: tuple[PageRun, ...]
    contents: memoryview
    forgotten: tuple[PageRun, ...]
    frozen_size: int
    copies: tuple[PageCopy, ...] = ()


def joined(looks: Sequence[tuple[CapturedProcess, Look]], *, is_base: bool) -> Pages:
    """The pages of all processes, in the order of their slots."""
    parts = [_of_one(process, look, is_base=is_base) for process, look in sorted(looks, key=lambda pair: pair[0].slot)]
    if len(parts) == 1:
        return parts[0]
    every = np.concatenate([np.frombuffer(part.contents, np.uint8) for part in parts])
    runs, contents, copies = process_tree.told_once([run for part in parts for run in part.runs], every.data, abi.PAGE_SIZE)
    return Pages(
        runs=runs,
        contents=contents,
        copies=copies,
        forgotten=tuple(run for part in parts for run in part.forgotten),
        frozen_size=sum(part.frozen_size for part in parts),
    )


def with_parcel(taken: Pages, parcel: Parcel, *, is_base: bool) -> Pages:
    """With those of carried files, which have the highest addresses."""
    if not len(parcel.addresses) and not parcel.cleared:
        return taken
    runs = page_set.page_runs(page_set.extents_of_addresses(parcel.addresses, abi.PAGE_SIZE))
    return Pages(
        runs=(*taken.runs, *runs),
        contents=memoryview(b"".join((taken.contents, parcel.content))),
        forgotten=() if is_base else (*taken.forgotten, *parcel.cleared),
        frozen_size=taken.frozen_size,
        copies=taken.copies,
    )


def _of_one(process: CapturedProcess, look: Look, *, is_base: bool) -> Pages:
    taken = look.taken
    addresses, contents, zero = taken.contents()
    runs = page_set.page_runs(page_set.extents_of_addresses(addresses, abi.PAGE_SIZE))
    if is_base:
        forgotten: tuple[PageRun, ...] = ()
    elif process.memory.acknowledged is None:  # its slot held another process before
        forgotten = (process_tree.whole(process.slot),)
    else:
        forgotten = process_tree.shifted_runs(page_set.page_runs(page_set.union(taken.cleared, zero)), process.slot)
    return Pages(process_tree.shifted_runs(runs, process.slot), contents, forgotten, taken.frozen_size)
