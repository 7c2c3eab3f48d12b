"""Refuse state that cannot be kept yet, with its name and a cure. This module does not touch the process.

It is the last check of every kind: an open file that no other kind took, a mapping that cannot be made again, a process that is
not by itself. The limits for threads are in `checkpoint.resources.process.refused_threads`.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.memory.tracker import is_orphan
from checkpoint.linux.procfs import procfs, vm_flags
from checkpoint.linux.procfs.particulars import OURS, Afresh, Told
from checkpoint.linux.procfs.procfs import MapsLine, Status
from checkpoint.linux.trace import seccomp as trace_seccomp
from checkpoint.model import Resource
from checkpoint.resources.files import proc_and_sys
from checkpoint.resources.ipc import shared_memory
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.process import refused_threads, seccomp
from checkpoint.resources.sockets import sockets

KIND: Final = "unsupported"

CAPABILITIES: Final = (
    refused(
        Area.PIPES,
        "io_uring",
        "use poll(2) or epoll on descriptors that are preserved",
        "an io_uring",
        "the rings of an io_uring",
    ),
    refused(Area.PIPES, "fanotify", "use inotify, which is preserved", "a fanotify group"),
    refused(Area.PIPES, "perf events", "run the program without them", "a perf event", "the buffer of a perf event"),
    refused(
        Area.PIPES,
        "open files of any other kind (BPF …)",
        "protect the program while it has none open",
        "a pipe ({})",
        "a named pipe (fifo {})",
        "an open {}",
        "of a kind that failover does not know",
    ),
    refused(
        Area.SOCKETS,
        "sockets of other families (CAN, vsock, Bluetooth …) and protocols (SCTP, MPTCP …)",
        "open them only for a moment, then close them: failover captures in between",
        "a socket ({}, {})",
    ),
    refused(Area.SOCKETS, "mapped rings of a packet socket", "read its frames by recv(2)", "the rings of a packet socket"),
    refused(Area.DEVICES, "memory of a device", "let a driver process of its own map it", "memory of a device"),
    refused(Area.MEMORY, "secret memory that is mapped", "run the program without it", "secret memory"),
    refused(
        Area.MEMORY,
        "huge pages of a file or memory file (hugetlbfs); more than 64 MiB of private huge pages in one piece",
        "use MAP_HUGETLB in smaller pieces, or transparent huge pages, which come back as ordinary pages",
        "huge pages of a file (hugetlbfs)",
        "MiB of huge pages, which every checkpoint compares",
    ),
    refused(
        Area.MEMORY, "files that are stored by touching memory (DAX, MAP_SYNC)", "map them without it", "memory that is stored"
    ),
    refused(
        Area.MEMORY,
        "memory that the program itself watches by userfaultfd",
        "run the program without it",
        "a userfaultfd",
        "own userfaultfd watches",
        "own userfaultfd write-protects",
    ),
    refused(Area.MEMORY, "shadow stacks", "run the program without them", "a shadow stack"),
    refused(
        Area.MEMORY,
        "tagged memory, and code with guarded branch targets (MTE, BTI; arm64)",
        "boot with arm64.nomte or arm64.nobti",
        "memory with tags",
        "code whose branch targets are guarded",
    ),
    preserved(
        Area.MEMORY,
        "mapped files that were replaced or deleted since the program started",
        "the old files are carried, up to 64 MiB each, and compared at every checkpoint; writes to an old file "
        "still show in its mappings",
        "KiB of the old one are carried",
    ),
    refused(
        Area.MEMORY,
        "a mapping of more than 64 MiB of a deleted file",
        "restart the program, then protect it",
        "replaced since the program started",
        "and larger than",
    ),
    refused(Area.PROCESS, "programs of 32 bits", "use a 64-bit build", "it is a program of 32 bits"),
    refused(Area.PROCESS, "a program without the kernel’s vdso", "let the program keep it mapped", "it has no vdso"),
    refused(
        Area.PROCESS,
        "a program whose own file is gone",
        "restart the program, then protect it",
        "is no longer there: restart the program",
    ),
    refused(
        Area.PROCESS,
        "a working directory of /sys, or a root directory of its own (chroot), that is gone",
        "change the directory; run the program in one that stays",
        "its working directory",
        "its root directory",
    ),
    refused(
        Area.PROCESS,
        "network, IPC, UTS, cgroup, mount and user namespaces of its own (containers)",
        "run the program and failover in the same namespaces",
        "namespace of its own, which is not kept yet: run it",
        "its children are to live in a {} namespace of their own",
    ),
    refused(
        Area.PROCESS,
        "kernel threads, zombies, threads named as processes, programs under a debugger, failover itself",
        "name a program that runs, and end the debugger",
        "it is a thread of process",
        "it is a kernel thread",
        "it has ended and is a zombie",
        "a process cannot trace itself",
        "is its tracer already",
        "it is traced by pid",
    ),
)

_ADVICE: Final = (
    "is not kept yet: protect the program while it has none, or let the program keep its state itself (docs/decorator.md)"
)

ANONYMOUS_INODES: Final[Mapping[str, str]] = {
    "fanotify": "a fanotify group",
    "io_uring": "an io_uring",
    "userfaultfd": "a userfaultfd",
    "perf_event": "a perf event",
}
"""/proc's name for a descriptor without a path → the usual name."""

_MAPPINGS: Final = (
    (re.compile(r"anon_inode:\[io_uring\]"), "the rings of an io_uring"),
    (re.compile(r"anon_inode:\[perf_event\]"), "the buffer of a perf event"),
    (re.compile(r"socket:"), "the rings of a packet socket"),
    (re.compile(r"/secretmem"), "secret memory"),
    (re.compile(r"/dev/(?!zero|shm/|hugepages/)"), "memory of a device"),
)

_VM_FLAGS: Final[Mapping[str, str]] = {
    "ht": "huge pages of a file (hugetlbfs)",
    "sf": "memory that is stored by touching it (DAX, MAP_SYNC)",
    "um": "memory that the program's own userfaultfd watches",
    "uw": "memory that the program's own userfaultfd write-protects",
    "ui": "memory that the program's own userfaultfd watches",
    "pf": "memory of a device",
    "io": "memory of a device",
    "ss": "a shadow stack",
    "mt": "memory with tags (PROT_MTE)",
    "bt": "code whose branch targets are guarded (PROT_BTI)",
}
"""VmFlags of proc_pid_smaps(5) that no fresh mapping can be given."""

HUGE_NAME: Final = "/anon_hugepage"
"""The kernel's name for memory of huge pages that has no file."""
ORPHAN_LIMIT: Final = 64 << 20
"""Bytes of one mapping of a deleted file that are carried: every freeze reads them all, a millisecond for 4 MiB."""

KERNEL_PLACES: Final = ("/proc/", "/sys/")
"""Places where no program can make a directory."""

_KERNEL_PAGES: Final = ("[vvar", "[vdso", "[vsyscall")
"""Mappings that the kernel gives every process: they move, see `checkpoint.engines.ptrace.restore.memory`."""


# --- Descriptors -----------------------------------------------------------------------------------------------------


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Nothing is described here."""
    return None


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Refuse, by name, an open file that no other kind took."""
    return f"{held.name} is {_called(held)}, which {_ADVICE}"


def _called(held: OpenFile) -> str:
    target, mode = held.first.target, held.first.mode
    if stat.S_ISSOCK(mode):
        return f"a socket ({socket_family(held)}, {target})"
    if stat.S_ISFIFO(mode):
        return f"a pipe ({target})" if target.startswith("pipe:") else f"a named pipe (fifo {target})"
    match = re.fullmatch(r"anon_inode:\[?([a-z_-]+)\]?", target)
    if match:
        return ANONYMOUS_INODES.get(match[1], f"an open {match[1]}")
    return f"{target}, of a kind that failover does not know"


SOCKET_FAMILIES: Final[Mapping[int, str]] = {
    16: "netlink",
    17: "packet",
    29: "CAN",
    31: "Bluetooth",
    38: "AF_ALG",
    40: "vsock",
    44: "XDP",
}
"""By the number of socket(2), which not every kernel's headers name."""


def socket_family(held: OpenFile) -> str:
    """TCP, UDP, unix, netlink … as far as the socket itself or /proc/PID/net tells."""
    with contextlib.suppress(OSError), sockets.looked_into(held.pid, held.first.number) as looked:
        if looked.family in SOCKET_FAMILIES:
            return SOCKET_FAMILIES[looked.family]
    for table in ("tcp", "tcp6", "udp", "udp6", "unix", "netlink", "packet", "raw"):
        try:
            text = procfs.read_text(held.pid, f"net/{table}")
        except (ProbeError, ProcessGoneError):
            continue
        if re.search(rf"\b{held.first.inode}\b", text):
            return table.upper() if table[:3] in ("tcp", "udp") else table
    return "unbound"


# --- Mappings --------------------------------------------------------------------------------------------------------


def refuse_mapping(line: MapsLine, flags: tuple[str, ...]) -> str | None:
    """Why a mapping cannot be made again; None if it can.

    Args:
        flags: its VmFlags.
    """
    where = f"mapping {line.start:x}-{line.end:x}"
    for pattern, what in _MAPPINGS:
        if pattern.match(line.name):
            return f"{where} is {what} ({line.name}), which {_ADVICE}"
    if vm_flags.HUGE in flags and line.name.startswith(HUGE_NAME):
        if is_orphan(line) and line.size > ORPHAN_LIMIT:
            cure = f"let the program map them in pieces of {ORPHAN_LIMIT >> 20} MiB at most"
            return f"{where} is {line.size >> 20} MiB of huge pages, which every checkpoint compares: {cure}"
        return None
    for flag in flags if not line.name.startswith(_KERNEL_PAGES) else ():
        if flag in _VM_FLAGS:
            return f"{where} is {_VM_FLAGS[flag]}, which {_ADVICE}"
    if line.has_file and line.name.endswith(procfs.DELETED) and not is_shared_anonymous(line):
        replaced = f"{where} is of {line.name}, replaced since the program started"
        if is_orphan(line) and line.size > ORPHAN_LIMIT:
            return f"{replaced}, and larger than {ORPHAN_LIMIT >> 20} MiB: restart the program, then protect it"
    return None


def note_mappings(lines: Iterable[MapsLine]) -> Iterator[tuple[str, str]]:
    """Deleted files that mappings hold on to: the path of each, and what an operator should know of it."""
    carried: dict[str, int] = {}
    for line in filter(is_orphan, lines):
        if line.name.startswith(HUGE_NAME):
            continue
        path = line.name.removesuffix(procfs.DELETED)
        carried[path] = carried.get(path, 0) + line.size
    for path, size in carried.items():
        yield (
            path,
            (
                f"{path} was replaced since the program started: {size >> 10} KiB of the old one are carried, and compared at "
                "every snapshot; restart the program when that suits"
            ),
        )


def is_shared_anonymous(line: MapsLine) -> bool:
    """Whether this is MAP_SHARED|MAP_ANONYMOUS, which the kernel shows as a deleted /dev/zero."""
    return line.shared and line.name == f"/dev/zero{procfs.DELETED}"


# --- The process as a whole --------------------------------------------------------------------------------------------


_VDSO: Final = "[vdso]"


def require_traceable(pid: int, status: Status, verb: str) -> None:
    """Raise `ProbeError` where no tracer can or should go; ``verb``: what the user asked for."""
    if status.tgid != pid:
        raise ProbeError(f"cannot {verb} {pid}: it is a thread of process {status.tgid}; name that one")
    if procfs.stat(pid).flags & procfs.PF_KTHREAD:
        raise ProbeError(f"cannot {verb} pid {pid} ({status.name}): it is a kernel thread; choose a program")
    if status.has_ended:
        raise ProbeError(f"cannot {verb} pid {pid} ({status.name}): it has ended and is a zombie, waiting for its parent")
    if pid == os.getpid():
        raise ProbeError(f"cannot {verb} pid {pid}: a process cannot trace itself; run failover from another one")
    if status.tracer not in (0, os.getpid()):
        raise ProbeError(f"cannot {verb} pid {pid} ({status.name}): pid {status.tracer} is its tracer already; end that debugger")


def refuse_process(
    pid: int,
    status: Status,
    kin: Collection[int] = (),
    *,
    files_kept: bool = False,
    detaches_memory: bool = False,
    lines: Sequence[MapsLine] | None = None,
    facts: Told | None = None,
) -> Iterator[str]:
    """Why a process as a whole cannot be captured.

    Args:
        kin: all processes of its component, if there are several.
        files_kept: a store keeps its program file by content, so that it need not be there any more.
        detaches_memory: shared memory that others have mapped, too, becomes its own copy.
        lines: its mappings, where they are known.
        facts: where they have been asked for already.
    """
    lines = procfs.parse_maps(procfs.read_text(pid, "maps")) if lines is None else lines
    facts = facts or Afresh(pid)
    yield from refused_threads.refuse(pid, status)
    if not detaches_memory:
        yield from shared_memory.refuse(pid, lines, kin)
    yield from refuse_entering(pid, status, files_kept=files_kept, lines=lines, facts=facts)
    yield from _refuse_places(facts)
    yield from _refuse_namespaces(pid, facts)


def refuse_entering(
    pid: int,
    status: Status,
    *,
    files_kept: bool = False,
    lines: Sequence[MapsLine] | None = None,
    facts: Told | None = None,
) -> Iterator[str]:
    """Why a process cannot even be asked; arguments as of `refuse_process`."""
    if status.tracer not in (0, os.getpid()):
        yield f"it is traced by pid {status.tracer}: end that debugger"
    if status.seccomp and (why := trace_seccomp.why_not()):
        yield seccomp.not_ours(why)
    yield from _refuse_image(pid, facts or Afresh(pid), files_kept)
    yield from _refuse_memory(procfs.parse_maps(procfs.read_text(pid, "maps")) if lines is None else lines)


def _refuse_image(pid: int, facts: Told, files_kept: bool) -> Iterator[str]:
    executable = facts.link("exe")
    if executable.endswith(procfs.DELETED) and not files_kept:
        yield f"its program file {executable} is no longer there: restart the program, then protect it"
        return
    if procfs.head_of_program(pid, 5)[4:] != b"\x02":
        yield f"it is a program of 32 bits ({executable}), which is not supported: use a 64-bit build"


def _refuse_memory(lines: Sequence[MapsLine]) -> Iterator[str]:
    """Why our own calls inside it are impossible."""
    if all(line.name != _VDSO for line in lines):
        yield "it has no vdso (it unmapped it, or the kernel was started with vdso=0), by which a capture enters it"


def _refuse_places(facts: Told) -> Iterator[str]:
    directory = facts.link("cwd")
    is_kernels = directory.startswith(KERNEL_PLACES) and not proc_and_sys.left_by_ended(directory)
    if procfs.is_gone(directory) and is_kernels:
        yield f"its working directory {directory} is gone: let the program change to another one"
    root = facts.link("root")
    if procfs.is_gone(root):
        yield f"its root directory {root} is gone: run it in one that stays"


def _refuse_namespaces(pid: int, facts: Told) -> Iterator[str]:
    """Namespaces of its own, except those that we give: `failover run` PID and time, a restore time; with them mount and user."""

    def differs(kind: str) -> bool:
        try:
            return facts.link(f"ns/{kind}") != facts.link(f"{OURS}{kind}")
        except (ProcessGoneError, FileNotFoundError):
            return False  # a kernel without this kind

    isolated = differs("pid")
    allowed = ("mnt", "user", "time") if isolated else ("user", "time") if differs("time") else ()
    for kind in ("net", "ipc", "uts", "cgroup", "mnt", "user", "time"):
        if kind not in allowed and differs(kind):
            yield f"it lives in a {kind} namespace of its own, which is not kept yet: run it, and failover, in the same one"
    for kind in ("pid", "time"):
        if _has_other_for_children(pid, kind, facts):
            yield f"its children are to live in a {kind} namespace of their own (unshare), which is not kept yet: run it without"


def _has_other_for_children(pid: int, kind: str, facts: Told) -> bool:
    """Whether its children live in another namespace than it; the link leads nowhere before the first child.

    Source: exit_task_namespaces() in do_exit(): of a process that ends, long before it is told, no link but those of ``pid`` and
    ``user`` leads anywhere.
    """
    try:
        return facts.link(f"ns/{kind}_for_children") != facts.link(f"ns/{kind}")
    except ProcessGoneError:
        lives = os.path.exists(f"/proc/{pid}/ns/mnt")
        return lives and os.path.lexists(f"/proc/{pid}/ns/{kind}_for_children")
    except (ProbeError, OSError):  # gone, or not ours to look at: others say so
        return False
