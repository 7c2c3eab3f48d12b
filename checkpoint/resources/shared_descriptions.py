"""Find the open files that several processes of a component share.

An open file (its offset, its flags) that several of them share is restored as one that they share; pipes and sockets lead from
one process to another. All of these get a number, and the restore makes them before it creates the processes
(`checkpoint.engines.ptrace.restore.tree`): the processes inherit them.

Source: kcmp(2), KCMP_FILE; pipe(7).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.linux import abi
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.resources.events import pidfd
from checkpoint.resources.ipc import pipes, pseudo_terminals
from checkpoint.resources.open_file import Kin, Opened, OpenFile
from checkpoint.resources.sockets import sockets

_OTHER_END: Final = {os.O_RDONLY: os.O_WRONLY, os.O_WRONLY: os.O_RDONLY}
OpenedByAll = dict[int, Opened]
"""By process, the first process of the component first."""


def together(opened: Mapping[int, Sequence[OpenFile]]) -> OpenedByAll:
    """The same; each open file knows the processes that share it, and each pipe whether its other end is one of theirs."""
    every = [held for ours in opened.values() for held in ours]
    kin = _kin(opened, every)
    numbers, echoes = _numbered(every)
    return {
        pid: Opened(
            replace(
                held,
                kin=kin,
                both_ends=held.both_ends or held.first.target in kin.pipes,
                description=numbers.get((pid, held.first.number), 0),
                is_echo=(pid, held.first.number) in echoes,
            )
            for held in ours
        )
        for pid, ours in opened.items()
    }


def _kin(opened: Iterable[int], every: Sequence[OpenFile]) -> Kin:
    ends = {(held.first.target, held.first.flags & os.O_ACCMODE) for held in every if pipes.is_pipe(held.first)}
    whole = {target for target, mode in ends if (target, _OTHER_END.get(mode)) in ends}
    inodes = (held.first.inode for held in every if sockets.is_socket(held.first))
    return Kin(frozenset(opened), frozenset(inodes), frozenset(whole), pseudo_terminals.masters(every))


Place = tuple[int, int]
"""A process and the number of a descriptor there."""


def _numbered(every: Sequence[OpenFile]) -> tuple[dict[Place, int], set[Place]]:
    """The number of every open file that needs one, and those that were told of before."""
    groups: list[list[OpenFile]] = []
    alike: dict[tuple[int | str, ...], list[list[OpenFile]]] = {}
    for held in every:
        one = held.first
        bucket = alike.setdefault((one.device, one.inode, one.offset, one.flags & ~os.O_CLOEXEC, one.target), [])
        group = next((group for group in bucket if group[0].pid != held.pid and _is_same(group[0], held)), None)
        if group is None:
            group = []
            bucket.append(group)
            groups.append(group)
        group.append(held)
    ended = _ended_for_several(every)
    numbers: dict[Place, int] = {}
    echoes: set[Place] = set()
    for group in groups:
        one = group[0].first
        if len(group) > 1 or _leads_somewhere(one) or (one.inode in ended and pidfd.is_of_ended(one)):
            number = len(numbers) + 1
            numbers |= {(held.pid, held.first.number): number for held in group}
            echoes |= {(held.pid, held.first.number) for held in group[1:]}
    return numbers, echoes


def _ended_for_several(every: Iterable[OpenFile]) -> set[int]:
    """Processes that have ended, by the number of their pidfds, of which several have one: it must stay one and the same."""
    holders: dict[int, set[int]] = {}
    for held in every:
        if pidfd.is_of_ended(held.first):
            holders.setdefault(held.first.inode, set()).add(held.pid)
    return {inode for inode, pids in holders.items() if len(pids) > 1}


def _leads_somewhere(one: Descriptor) -> bool:
    """Whether it may have another end, which another of the processes has."""
    return pipes.is_pipe(one) or sockets.is_socket(one) or pseudo_terminals.is_terminal(one)


def _is_same(one: OpenFile, other: OpenFile) -> bool:
    return abi.kcmp(one.pid, other.pid, abi.KCMP_FILE, one.first.number, other.first.number) == 0
