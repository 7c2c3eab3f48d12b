"""The values of the package `checkpoint`: a process at one instant, as frozen data.

Read this file first. This module opens, reads and asks nothing. Every type is immutable, so a captured value can move between
threads, processes and machines and no code changes it.

Words: a *VMA* is one mapping ``[start, end)``; a *page* is ``page_size`` bytes; a *run* is consecutive pages. Addresses are
absolute, in bytes. Instants are integer nanoseconds.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

from msgspec import Struct, field

Fact = int | str | bytes | bool | float | None | list["Fact"] | dict[str, "Fact"]
"""One thing that a resource says about itself: any value that msgpack can carry."""


class VmaKind(enum.StrEnum):
    """The backing of a mapping, which decides how it comes back."""

    ANONYMOUS = "anonymous"
    HEAP = "heap"
    STACK = "stack"
    FILE = "file"
    VDSO = "vdso"
    VVAR = "vvar"
    VSYSCALL = "vsyscall"
    CARRIED_FILE = "carried_file"
    """None of the process's: the content of a file that travels with it, see `checkpoint.snapshot.carried_files`."""


class FileIdentity(Struct, frozen=True):
    """How to tell that a file here is the file that the program had there.

    Attributes:
        path: absolute, as the program's mount namespace names it, without the kernel's " (deleted)".
        size: bytes, at the capture.
        mtime_ns: modification time; a hint only, never compared between machines.
        build_id: the ELF build id, or b"" where there is none.
        digest: blake3 of the whole content, 32 bytes, or b"" where it was not taken (large or unreadable).
        deleted: no name leads to the file any more.
    """

    path: str
    device: int = 0
    inode: int = 0
    mode: int = 0
    size: int = 0
    mtime_ns: int = 0
    build_id: bytes = b""
    digest: bytes = b""
    deleted: bool = False


class PageRun(Struct, frozen=True, order=True):
    """Consecutive pages: ``[start, end)``, both multiples of the page size."""

    start: int
    end: int

    @property
    def size(self) -> int:
        """Bytes covered."""
        return self.end - self.start


class PageCopy(Struct, frozen=True, order=True):
    """Consecutive pages ``[start, end)`` that hold what as many pages from ``source`` on hold."""

    start: int
    end: int
    source: int

    @property
    def size(self) -> int:
        """Bytes covered."""
        return self.end - self.start


class Vma(Struct, frozen=True):
    """One mapping of the address space.

    Attributes:
        protection: bits of mmap(2): 1 read, 2 write, 4 execute.
        shared: MAP_SHARED; otherwise writes are private.
        offset: bytes into the file.
        name: what /proc/PID/maps prints last: a path, "[heap]", "" …
        file: identity of the backing file, for ``kind`` FILE.
        flags: the two-letter codes of VmFlags in smaps that matter on restore ("gd" grows down, "dc" don't copy on
            fork, "dd" don't dump, "wf" wipe on fork, "hg"/"nh" huge page advice, "lo" locked, "nr" no reserve,
            "sr"/"rr" read advice, "mg" mergeable, "ht" huge pages, "dp" droppable, "sl" sealed, "mw" may be
            made writable), and two-letter codes of our own
            (`checkpoint.linux.procfs.vm_flags`): "gb" huge pages of 1 GiB, "k1" to "kf" a protection key.
        guards: pages that MADV_GUARD_INSTALL (madvise(2)) makes inaccessible, in address order; they hold nothing.
    """

    start: int
    end: int
    protection: int
    shared: bool
    kind: VmaKind
    offset: int = 0
    name: str = ""
    file: FileIdentity | None = None
    flags: tuple[str, ...] = ()
    guards: tuple[PageRun, ...] = ()

    @property
    def size(self) -> int:
        """Bytes covered."""
        return self.end - self.start


class SignalAction(Struct, frozen=True):
    """The action of one signal (rt_sigaction(2)): the kernel's own four words."""

    signal: int
    handler: int
    flags: int
    restorer: int
    mask: int


class Rseq(Struct, frozen=True):
    """A registered restartable-sequences area (rseq(2))."""

    address: int
    size: int
    signature: int
    flags: int = 0


class ThreadState(Struct, frozen=True):
    """One thread, as it stood when it was frozen.

    Attributes:
        registers: register sets by name as the kernel gives them ("prstatus", "xstate" …), see ``checkpoint.arch``; with those of
            the first thread "xstate_layout": where the processor has put the components of every "xstate".
            They stand where the program must go on: an interrupted system call is already set to be made again.
        signal_mask: blocked signals, bit 0 is signal 1.
        pending: signals pending for this thread alone, each a whole siginfo (128 bytes).
        altstack: (address, flags, size) of sigaltstack(2).
        robust_list: (head address, length).
        clear_tid: address given to set_tid_address(2), 0 if none.
        policy, priority: of sched_setscheduler(2); ``affinity`` is the list of allowed processors.
        interrupted: name of the system call that was interrupted and will be made again, "" if none.
    """

    tid: int
    name: str
    registers: Mapping[str, bytes]
    signal_mask: int = 0
    pending: tuple[bytes, ...] = ()
    altstack: tuple[int, int, int] = (0, 2, 0)
    robust_list: tuple[int, int] = (0, 0)
    clear_tid: int = 0
    rseq: Rseq | None = None
    policy: int = 0
    priority: int = 0
    nice: int = 0
    io_priority: int = 0
    affinity: tuple[int, ...] = ()
    timer_slack_ns: int = 50_000
    interrupted: str = ""


class IntervalTimer(Struct, frozen=True):
    """An alarm of setitimer(2); ``which`` is 0 real, 1 virtual, 2 profiling. All in microseconds; ``value`` is what was left."""

    which: int
    interval_us: int
    value_us: int


class PosixTimer(Struct, frozen=True):
    """A timer of timer_create(2), with what was left of it.

    Attributes:
        notify: SIGEV_SIGNAL 0, SIGEV_NONE 1, SIGEV_THREAD_ID 4.
        value: the sigev_value that the program chose.
        overrun: expirations not yet told.
    """

    timer_id: int
    clock: int
    notify: int
    signal: int
    value: int
    tid: int
    interval_ns: int
    value_ns: int
    overrun: int = 0


class Clocks(Struct, frozen=True):
    """The machine's clocks as the *program* reads them (inside its time namespace), at the freeze."""

    realtime_ns: int
    monotonic_ns: int
    boottime_ns: int


class Credentials(Struct, frozen=True):
    """User and group ids: (real, effective, saved, filesystem); capabilities as the five words of /proc/PID/status."""

    uids: tuple[int, int, int, int]
    gids: tuple[int, int, int, int]
    groups: tuple[int, ...] = ()
    capabilities: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)
    no_new_privs: bool = False
    securebits: int = 0


class MemoryLayout(Struct, frozen=True):
    """The kernel's own marks in an address space (struct prctl_mm_map of prctl(2), without the exe)."""

    start_code: int
    end_code: int
    start_data: int
    end_data: int
    start_brk: int
    brk: int
    start_stack: int
    arg_start: int
    arg_end: int
    env_start: int
    env_end: int
    auxv: bytes = b""


class ProcessState(Struct, frozen=True):
    """The state that belongs to the process as a whole.

    Attributes:
        pid: as the program itself sees it (innermost PID namespace).
        ppid, pgid, sid: likewise; 0 where they lie outside its namespace.
        limits: RLIMIT number → (soft, hard); -1 is infinity.
        switches: calls of prctl(2) that set again what it has switched, see `checkpoint.engines.ptrace.facts.prctl_state`.
        coredump_filter: which mappings a core dump holds (core(5)); -1 where the kernel makes none.
        pending: signals pending for the process, each a whole siginfo (128 bytes).
        isolated: it lives in PID and time namespaces of its own.
    """

    pid: int
    ppid: int
    pgid: int
    sid: int
    executable: FileIdentity
    arguments: tuple[str, ...]
    layout: MemoryLayout
    working_directory: str
    root_directory: str
    umask: int
    credentials: Credentials
    personality: int = 0
    limits: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    oom_score_adj: int = 0
    dumpable: int = 1
    keep_caps: bool = False
    child_subreaper: bool = False
    parent_death_signal: int = 0
    thp_disabled: bool = False
    switches: tuple[tuple[int, int, int], ...] = ()
    coredump_filter: int = -1
    signal_actions: tuple[SignalAction, ...] = ()
    pending: tuple[bytes, ...] = ()
    interval_timers: tuple[IntervalTimer, ...] = ()
    posix_timers: tuple[PosixTimer, ...] = ()
    isolated: bool = False


class Resource(Struct, frozen=True):
    """One thing that a process holds besides memory, described by its file in ``checkpoint.resources``.

    Attributes:
        kind: the file's name there: "files", "devices", "streams" …
        name: its holder: for descriptors the number, as "fd 7".
        facts: documented in that file; unknown facts of a newer writer are refused, not ignored.
    """

    kind: str
    name: str
    facts: Mapping[str, Fact] = field(default_factory=dict)


class Member(Struct, frozen=True):
    """One more process of a component, besides the first: a child, or a child's child.

    Attributes:
        slot: from 1; its own pages stand in the snapshot's runs at address + slot × 2⁴⁸ (see
            `checkpoint.snapshot.process_tree`).
        exit_signal: what its parent is sent when it ends; SIGCHLD as a rule.
        process: its ``ppid`` is a pid of the component; 0 when its parent has ended.
    """

    slot: int
    exit_signal: int
    process: ProcessState
    threads: tuple[ThreadState, ...]
    vmas: tuple[Vma, ...]
    resources: tuple[Resource, ...] = ()


class Zombie(Struct, frozen=True):
    """A process that has ended, and whose parent has not asked for it yet.

    Attributes:
        pid, ppid, pgid, sid: as in `ProcessState`.
        status: as wait(2) tells it.
        exit_signal: as in `Member`.
    """

    name: str
    pid: int
    ppid: int
    pgid: int
    sid: int
    status: int
    exit_signal: int


class Machine(Struct, frozen=True):
    """Where a snapshot was taken.

    Attributes:
        architecture: as uname(2) says ("x86_64").
        features: processor features that the program may have chosen code by: all that there were, or those of the level that it
            was started for (see `checkpoint.program.cpu_baseline`).
        vdso_digest: blake3 of the vdso image, 32 bytes.
        robot: name of the robot, "" for a one-shot capture.
    """

    architecture: str
    page_size: int
    kernel: str
    boot_id: str
    hostname: str
    features: tuple[str, ...] = ()
    xstate_mask: int = 0
    vdso_digest: bytes = b""
    robot: str = ""


class Position(Struct, frozen=True, order=True):
    """A point in a component's history. Equal numbers with unequal digests mean the histories diverged.

    Attributes:
        generation: of one primacy: an epoch and the robot that runs it then, however often it is started there.
        sequence: of the snapshot inside its generation, from 1.
        digest: state digest, 16 bytes (see `checkpoint.store.chain`).
    """

    generation: int
    sequence: int
    digest: bytes


class OutputPiece(Struct, frozen=True):
    """Bytes that the component wrote to one of its streams since the parent position.

    Attributes:
        stream: 1 standard output, 2 standard error.
        offset: of the first byte in the whole stream, from its beginning.
    """

    stream: int
    offset: int
    content: bytes


class Snapshot(Struct, frozen=True):
    """The immutable state of one component at one instant: a base (whole), or a delta since ``parent``.

    A page that no snapshot of a chain holds is what a fresh mapping holds: zeros, or the file's content.

    Attributes:
        parent: None for a base.
        page_sum: sum of the page digests of the *whole* state, 16 bytes (see ``checkpoint.pages``).
        cleared: runs whose earlier pages are forgotten before ``contents`` is applied (fresh mappings, zeroed pages).
        runs: the pages that this snapshot carries, in address order, disjoint.
        contents: the bytes of ``runs``, concatenated in the same order; ``sum(run.size)`` bytes.
        epoch: number of the primacy under which it was taken; 0 for a one-shot capture.
        freeze_us: how long the program stood still for it; where that was several times, the longest.
        members, zombies: of a component of several processes, those besides the first, which the other fields are of.
        copies: pages that it carries by naming others that it carries, of processes that have memory in common since a fork.
        differences: those of ``runs`` whose bytes in ``contents`` are to be XORed with what the parent's state holds there
            (see `checkpoint.pages.xor_delta`); none in a base.
    """

    component: str
    engine: str
    position: Position
    parent: Position | None
    machine: Machine
    clocks: Clocks
    process: ProcessState
    threads: tuple[ThreadState, ...]
    vmas: tuple[Vma, ...]
    resources: tuple[Resource, ...] = ()
    cleared: tuple[PageRun, ...] = ()
    runs: tuple[PageRun, ...] = ()
    contents: bytes | memoryview = b""
    page_sum: bytes = b""
    output: tuple[OutputPiece, ...] = ()
    epoch: int = 0
    freeze_us: int = 0
    notes: tuple[str, ...] = ()
    members: tuple[Member, ...] = ()
    zombies: tuple[Zombie, ...] = ()
    copies: tuple[PageCopy, ...] = ()
    differences: tuple[PageRun, ...] = ()

    @property
    def is_base(self) -> bool:
        """Whether it stands alone."""
        return self.parent is None

    @property
    def processes(self) -> tuple[Snapshot | Member, ...]:
        """Each process of the component, as the first one and its members are told, the first one first."""
        return self, *self.members

    @property
    def is_tree(self) -> bool:
        """Whether it is of several processes."""
        return bool(self.members or self.zombies)
