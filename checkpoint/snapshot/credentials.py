"""The rights that a snapshot gets when it is restored: what its threads ask for, limited to the rights of its owner.

`bounded` is the only limit: a snapshot goes through it wherever it is restored for an owner other than root. `excess` lists the
rights that it takes away, and `beyond` lists rights that only root can have (an agent refuses that). Threads with other rights
than their first one are in a resource of their own kind, which `checkpoint.resources.process.thread_credentials` makes.

Sources: credentials(7); capabilities(7), on securebits; sched(7); getrlimit(2).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import Credentials, Fact, Member, ProcessState, Resource, Snapshot, ThreadState

if TYPE_CHECKING:
    from checkpoint.snapshot.canonical_state import State

KIND: Final = "thread_rights"
CONFINED: Final = "seccomp"
"""The kind of resource of `checkpoint.resources.process.seccomp`."""
LOGIN: Final = "logins"
"""The kind of resource of `checkpoint.resources.process.audit_login`."""
SECBIT_KEEP_CAPS: Final = 1 << 4
"""The one of the securebits that any process may set; execve(2) takes it back."""
SCHED_DEADLINE: Final = 6
REAL_TIME: Final = (os.SCHED_FIFO, os.SCHED_RR, SCHED_DEADLINE)
IO_REAL_TIME: Final = 1
"""Class of an I/O priority, from bit 13 on. Source: ioprio_set(2)."""
IO_CLASS_SHIFT: Final = 13
RLIMIT_NICE: Final = 13
RLIMIT_RTPRIO: Final = 14
LIMITS_OF_PRIORITY: Final = {RLIMIT_NICE: "RLIMIT_NICE", RLIMIT_RTPRIO: "RLIMIT_RTPRIO"}
NOTHING: Final = (0, 0, 0, 0, 0)
MALFORMED: Final = "this version does not understand the rights of its threads: use the version that captured it"


class Owner(Struct, frozen=True):
    """Whose rights a program gets at most.

    Attributes:
        gid: the group of the account; ``groups``: all that it is in, that one too; None: not known, any single group is its own.
    """

    uid: int
    gid: int = -1
    groups: tuple[int, ...] | None = None

    def may_have(self, gids: Iterable[int]) -> bool:
        """Whether these groups are the owner's."""
        return self.groups is None or {self.gid, *self.groups}.issuperset(gids)


Process = TypeVar("Process", Snapshot, Member)


def at_most(theirs: Credentials, owner: Owner) -> Credentials:
    """The part of these rights that an owner has: the user, those of the groups that are the owner's, and nothing above that."""
    gid = theirs.gids[1] if owner.may_have(theirs.gids[1:2]) else owner.gid
    groups = tuple(group for group in theirs.groups if owner.may_have((group,)))
    return Credentials((owner.uid,) * 4, (gid,) * 4, groups, NOTHING, theirs.no_new_privs)


def bounded(state: Snapshot, owner: Owner) -> Snapshot:
    """The same snapshot with the rights of its owner at most, in all threads of all processes.

    The kernel bounds the rest (priorities, limits, files, devices): the process that restores it has become the owner by then.
    """
    members = tuple(_bounded(member, owner) for member in state.members)
    return replace(_bounded(state, owner), members=members)


def _bounded(one: Process, owner: Owner) -> Process:
    process = replace(one.process, credentials=at_most(one.process.credentials, owner), keep_caps=False)
    kept = tuple(held for held in one.resources if held.kind != KIND and not (held.kind == LOGIN and _login(held) != owner.uid))
    return replace(one, process=process, resources=kept)


def excess(state: Snapshot | State, owner: Owner) -> tuple[str, ...]:
    """The rights that a snapshot asks for beyond those of an owner, each with its figure; none if the owner has them all.

    Raises:
        FormatError: it is told in another way than we know.
    """
    found = dict.fromkeys(beyond(state, owner))
    for one in (state, *state.members):
        found |= dict.fromkeys((*_of_process(one.process), *_of_resources(one.resources, owner)))
        found |= dict.fromkeys(text for thread in one.threads for text in _of_thread(thread))
    return tuple(found)


def refusal(asked: Iterable[str], owner: Owner) -> str:
    """Why a program is not its owner's to have captured, or to come back, of what `beyond` tells; "" if it tells nothing."""
    if not (told := ", ".join(dict.fromkeys(asked))):
        return ""
    reason = f"it runs with other rights than those of its owner, uid {owner.uid}: it has {told}"
    return f"{reason}: only a program of root may; start it as root"


def beyond(state: Snapshot | State, owner: Owner) -> Iterator[str]:
    """Rights that only root can give: users, groups, capabilities, securebits, filters and root directories. As `excess`."""
    for theirs in everybodys(state):
        yield from above(theirs, owner)
    if could_gain(state):
        yield "a seccomp filter, and may gain rights by programs that it executes (no_new_privs is off)"
    for directory in sorted({one.process.root_directory for one in (state, *state.members)} - {"/"}):
        yield f"a root directory of its own ({directory}), by whose files it may gain rights"


def above(theirs: Credentials, owner: Owner) -> Iterator[str]:
    """As `beyond`, of the rights of one thread."""
    if others := sorted(set(theirs.uids) - {owner.uid}):
        yield f"uid {', '.join(map(str, others))}"
    gids = {*theirs.gids, *theirs.groups} if owner.groups is not None else set(theirs.gids)
    if others := sorted(gid for gid in gids if not owner.may_have((gid,))):
        yield f"gid {', '.join(map(str, others))}"
    if owner.groups is None and len(gids) > 1:
        yield f"several groups ({', '.join(map(str, sorted(gids)))})"
    _, permitted, effective, _, ambient = theirs.capabilities
    if permitted | effective | ambient:
        yield f"capabilities {permitted | effective | ambient:#x}"
    if theirs.securebits & ~SECBIT_KEEP_CAPS:
        yield f"securebits {theirs.securebits:#x}"


def _of_process(process: ProcessState) -> Iterator[str]:
    if process.oom_score_adj < 0:
        yield f"oom_score_adj {process.oom_score_adj}"
    for number, name in LIMITS_OF_PRIORITY.items():
        if hard := process.limits.get(number, (0, 0))[1]:
            yield f"{name} {'unlimited' if hard == -1 else hard}"
    if process.credentials.capabilities[0]:
        yield f"inheritable capabilities {process.credentials.capabilities[0]:#x}"


def _of_thread(thread: ThreadState) -> Iterator[str]:
    if thread.nice < 0:
        yield f"nice {thread.nice}"
    if thread.policy & ~os.SCHED_RESET_ON_FORK in REAL_TIME:
        yield f"scheduling policy {thread.policy} with priority {thread.priority}"
    if thread.io_priority >> IO_CLASS_SHIFT == IO_REAL_TIME:
        yield "I/O priority of real time"


def _of_resources(resources: Iterable[Resource], owner: Owner) -> Iterator[str]:
    for held in resources:
        if held.kind == LOGIN and _login(held) not in (-1, owner.uid):
            yield f"the login of uid {_login(held)!r}"
        for fact, what in (("maker", 1), ("user", 0)):
            told = held.facts.get(fact)
            if isinstance(told, list) and len(told) > what and told[what] != owner.uid:
                yield f"{held.name}, a socket of uid {told[what]!r}"
        if held.facts.get("deleted") and held.facts.get("uid", owner.uid) != owner.uid:
            yield f"{held.name}, a deleted file of uid {held.facts['uid']!r}"


def _login(held: Resource) -> Fact:
    return held.facts.get("user")


def everybodys(outline: Snapshot | State) -> Iterator[Credentials]:
    """The rights of every thread of every process."""
    for one in (outline, *outline.members):
        first = one.process.credentials
        yield first
        yield from (of_thread(one.resources, thread.tid, first) for thread in one.threads)


def could_gain(outline: Snapshot | State) -> bool:
    """Whether a thread has filters of seccomp(2), and gets new rights by an execve(2) all the same: only root's program may.

    Source: seccomp(2), on PR_SET_NO_NEW_PRIVS: a set-user-ID program could be kept from giving its rights up.

    Raises:
        FormatError: as `of_thread`.
    """
    return any(
        not of_thread(one.resources, tid, one.process.credentials).no_new_privs
        for one in (outline, *outline.members)
        for tid in _filtered(one.resources)
    )


def _filtered(resources: Iterable[Resource]) -> Iterator[int]:
    """The ids of threads that have filters. Strict mode is left out: no thread of strict mode is born with other rights."""
    for held in resources:
        for fact in _listed(held.facts.get("threads")) if held.kind == CONFINED else ():
            match _listed(fact):
                case [int(tid), _, list(filters), *_]:
                    yield from (tid,) if filters else ()
                case _:
                    raise FormatError(MALFORMED)


def of_thread(resources: Iterable[Resource], tid: int, first: Credentials) -> Credentials:
    """The rights of a thread: its own, or those of the first.

    Raises:
        FormatError: they are told in another way than we know.
    """
    for held in resources:
        for one in _listed(held.facts.get("threads")) if held.kind == KIND else ():
            match _listed(one):
                case [number, user, group, groups, capabilities, no_new_privs, *_] if number == tid:
                    ids = _four(_numbers(user)), _four(_numbers(group)), _numbers(groups)
                    return Credentials(*ids, _five(_numbers(capabilities)), bool(no_new_privs), first.securebits)
                case [number, *_] if number == tid:
                    raise FormatError(MALFORMED)
    return first


def _listed(fact: Fact) -> list[Fact]:
    if not isinstance(fact, list):
        raise FormatError(MALFORMED)
    return fact


def _numbers(fact: Fact) -> tuple[int, ...]:
    numbers = tuple(number for number in _listed(fact) if isinstance(number, int))
    if len(numbers) != len(_listed(fact)):
        raise FormatError(MALFORMED)
    return numbers


def _four(numbers: tuple[int, ...]) -> tuple[int, int, int, int]:
    if len(numbers) != 4:
        raise FormatError(MALFORMED)
    real, effective, saved, of_files = numbers
    return real, effective, saved, of_files


def _five(numbers: tuple[int, ...]) -> tuple[int, int, int, int, int]:
    if len(numbers) != 5:
        raise FormatError(MALFORMED)
    inheritable, permitted, effective, bounding, ambient = numbers
    return inheritable, permitted, effective, bounding, ambient
