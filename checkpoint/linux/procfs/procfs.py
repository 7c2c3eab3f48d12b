"""Read /proc of one process: each file once, parsed into frozen values.

Every reader raises `ProcessGoneError` when the process has ended and `ProbeError` when we have no permission to read.

Source: proc(5) and the pages it is split into (proc_pid_maps(5), proc_pid_status(5) …).
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from typing import Final

from msgspec import Struct

from checkpoint.errors import MapsFormatError, ProbeError, ProcessGoneError
from checkpoint.linux import abi

DELETED: Final = " (deleted)"
"""The kernel adds this to the path of a file to which no name leads any more."""
READ_SIZE: Final = 1 << 15
"""Bytes asked for at once: more than the kernel gives of most files, and less than what is allocated page by page."""


def is_gone(path: str) -> bool:
    """Whether a path of /proc is one that leads nowhere any more; a name that merely ends in " (deleted)" is not."""
    return path.endswith(DELETED) and not os.path.lexists(path)


def read_bytes(pid: int, name: str) -> bytes:
    """Read ``/proc/PID/name`` whole.

    Raises:
        ProcessGoneError: no such process.
        ProbeError: not permitted, or this kernel has no such file.
    """
    with _explained(pid, name):
        descriptor = os.open(f"/proc/{pid}/{name}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            return _read_whole(descriptor)
        finally:
            os.close(descriptor)


def opened(pid: int, name: str) -> int:
    """A descriptor of ``/proc/PID/name``, to read from; the caller closes it. Raises as `read_bytes`."""
    with _explained(pid, name):
        return os.open(f"/proc/{pid}/{name}", os.O_RDONLY | os.O_CLOEXEC)


@contextlib.contextmanager
def _explained(pid: int, name: str) -> Iterator[None]:
    """Turn the system's errors about a file of /proc into our own words."""
    path = f"/proc/{pid}/{name}"
    try:
        yield
    except (FileNotFoundError, ProcessLookupError) as error:
        if isinstance(error, FileNotFoundError) and os.path.exists(os.path.dirname(path)):
            raise ProbeError(f"cannot read {path}: this kernel does not offer it") from error
        raise ProcessGoneError(f"cannot read {path}: there is no such process or thread") from error
    except PermissionError as error:
        cure = "run as the same user or with CAP_SYS_PTRACE, see systemd/failover-agent.service"
        raise denied(pid, f"cannot read {path}: not permitted; {cure}") from error


def denied(pid: int, sentence: str) -> ProbeError | ProcessGoneError:
    """Why an ordinary user could not read a process's files of /proc: the process is another user's, or has ended. The files of
    an ended process are root's until its parent takes note.

    Args:
        sentence: the sentence about a living process.

    Source: task_dump_owner() in fs/proc/base.c.
    """
    with contextlib.suppress(OSError), open(f"/proc/{pid}/stat", "rb") as file:
        if file.read().rpartition(b")")[2].split()[:1] in ([b"Z"], [b"X"]):
            return ProcessGoneError(f"pid {pid} has ended")
    return ProbeError(sentence)


def _read_whole(descriptor: int) -> bytes:
    pieces: list[bytes] = []
    size = 0
    while piece := os.pread(descriptor, READ_SIZE, size):
        pieces.append(piece)
        size += len(piece)
    return b"".join(pieces)  # once: the smaps of ten thousand mappings come in thousands of pieces


class KeptFiles:
    """Files of one process that are read again and again, kept open: a third of what it takes to open one anew.

    Of a process that has executed another program they tell as ever; not so its maps and pagemap.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._files: dict[str, int] = {}

    def descriptor(self, name: str) -> int:
        """A descriptor of ``/proc/PID/name``. Raises as `read_bytes`."""
        file = self._files.get(name)
        if file is None:
            file = self._files[name] = opened(self._pid, name)
        return file

    def read(self, name: str) -> bytes:
        """Read ``/proc/PID/name`` whole. Raises as `read_bytes`."""
        file = self.descriptor(name)
        try:
            return _read_whole(file)
        except OSError:
            with _explained(self._pid, name):
                raise

    def close(self) -> None:
        """Give the descriptors back."""
        for file in self._files.values():
            os.close(file)
        self._files.clear()


def read_kept(descriptor: int, pid: int, name: str) -> bytes:
    """As `read_line`, of a file that `opened` has opened and that stays so."""
    with _explained(pid, name):
        return os.pread(descriptor, READ_SIZE, 0)


def read_line(pid: int, name: str) -> bytes:
    """As `read_bytes`, for a file that the kernel gives in one piece."""
    with _explained(pid, name):
        descriptor = os.open(f"/proc/{pid}/{name}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            return os.read(descriptor, READ_SIZE)
        finally:
            os.close(descriptor)


def read_text(pid: int, name: str) -> str:
    """Read ``/proc/PID/name`` as text; bytes that are no UTF-8 survive as surrogates, like file names do."""
    return os.fsdecode(read_bytes(pid, name))


def read_link(pid: int, name: str) -> str:
    """Where the link ``/proc/PID/name`` leads, in the kernel's words."""
    try:
        return os.readlink(f"/proc/{pid}/{name}")
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"cannot read the link /proc/{pid}/{name}: it is not there (any more)") from error
    except PermissionError as error:
        what = f"cannot read the link /proc/{pid}/{name}: not permitted"
        raise denied(pid, f"{what}; run as the same user or with CAP_SYS_PTRACE") from error


def head_of_program(pid: int, size: int) -> bytes:
    """The first bytes of the program file of a process.

    Raises:
        ProcessGoneError: it has ended, or is about to become another program.
        ProbeError: we may not read it.
    """
    try:
        with open(f"/proc/{pid}/exe", "rb", buffering=0) as file:
            return file.read(size)
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"cannot read the program file of pid {pid}: it has ended, or becomes another program") from error
    except PermissionError as error:
        what = f"cannot read the program file of pid {pid}: not permitted"
        raise denied(pid, f"{what}; run as the same user or as root") from error


def outlook(pid: int) -> str:
    """The prefix for an absolute path that the kernel tells of a process, so that we find the same file as the process.

    The kernel tells paths from the root of the mount namespace, also of a process that has another root directory (chroot).
    Of a process that is gone, or not ours to look at, the answer leads nowhere.

    Source: d_path() in fs/d_path.c; path_resolution(7): ".." is held back at our own root directory only.
    """
    root = f"/proc/{pid}/root"
    with contextlib.suppress(OSError):
        return root + "/.." * len([name for name in os.readlink(root).split("/") if name])
    return root


# Mappings


class MapsLine(Struct, frozen=True):
    """One line of /proc/PID/maps."""

    start: int
    end: int
    protection: int
    shared: bool
    offset: int
    device: int
    inode: int
    name: str

    @property
    def size(self) -> int:
        """Bytes covered."""
        return self.end - self.start

    @property
    def has_file(self) -> bool:
        """Whether a file stands behind it (shared anonymous memory has one without a path)."""
        return self.inode != 0


_MAPS_LINE: Final = re.compile(
    r"([0-9a-f]+)-([0-9a-f]+) ([r-])([w-])([x-])([ps]) ([0-9a-f]+) ([0-9a-f]+):([0-9a-f]+) ([0-9]+) *(.*)", re.DOTALL
)


def parse_maps_line(line: str) -> MapsLine:
    """Read one line.

    Raises:
        MapsFormatError: it is not of the documented form.
    """
    match = _MAPS_LINE.fullmatch(line)
    if match is None:
        raise MapsFormatError(f"cannot read this line of /proc/PID/maps: {line!r}")
    start, end, read, write, execute, sharing, offset, major, minor, inode, name = match.groups()
    protection = abi.PROT_READ * (read == "r") | abi.PROT_WRITE * (write == "w") | abi.PROT_EXEC * (execute == "x")
    return MapsLine(
        start=int(start, 16),
        end=int(end, 16),
        protection=protection,
        shared=sharing == "s",
        offset=int(offset, 16),
        device=os.makedev(int(major, 16), int(minor, 16)),
        inode=int(inode),
        name=name.replace("\\012", "\n"),
    )


def lines_of(text: str) -> list[str]:
    """The lines of a text as the kernel ends them.

    `str.splitlines` sees ends of its own (a carriage return, for one) also inside the name of a process or file. A process
    chooses such names, so it could forge lines about itself.
    """
    return [line for line in text.split("\n") if line]


def parse_maps(text: str) -> tuple[MapsLine, ...]:
    """Read the mappings of one process, in address order.

    Raises:
        MapsFormatError: a line is not of the documented form; names the line.

    Source: proc_pid_maps(5).
    """
    return tuple(map(parse_maps_line, lines_of(text)))


# The process


def parse_fields(text: str) -> dict[str, str]:
    """Read "Key:\tvalue" lines, as of /proc/PID/status and fdinfo; the first of several lines of one key counts."""
    fields: dict[str, str] = {}
    for line in lines_of(text):
        key, colon, value = line.partition(":")
        if colon:
            fields.setdefault(key, value.strip())
    return fields


class Status(Struct, frozen=True):
    """/proc/PID/status, as far as we use it.

    Attributes:
        state: one letter: R, S, D, T, t, Z, X.
        tgid: of its process.
        tgids, pids, pgids, sids: from our namespace inwards; pids are those of the very thread that was asked about.
        capabilities: inheritable, permitted, effective, bounding, ambient.
    """

    name: str
    state: str
    umask: int
    tgid: int
    tgids: tuple[int, ...]
    ppid: int
    tracer: int
    uids: tuple[int, int, int, int]
    gids: tuple[int, int, int, int]
    groups: tuple[int, ...]
    pids: tuple[int, ...]
    pgids: tuple[int, ...]
    sids: tuple[int, ...]
    resident_size: int
    threads: int
    capabilities: tuple[int, int, int, int, int]
    no_new_privs: bool
    seccomp: int

    @property
    def has_ended(self) -> bool:
        """Whether all of it has: a first thread that has ended while others live has not ended its process."""
        return self.state in "ZX" and self.threads <= 1


_ESCAPED: Final = re.compile(r"\\n|\\\\")
"""Escaped characters of a name: a line feed and a backslash. Source: proc_task_name() in fs/proc/array.c."""


_OF_STATUS: Final = re.compile(
    r"^(State|Umask|Tgid|NStgid|PPid|TracerPid|Uid|Gid|Groups|Pid|NSpid|NSpgid|NSsid|VmRSS|Threads"
    r"|CapInh|CapPrm|CapEff|CapBnd|CapAmb|NoNewPrivs|Seccomp):[ \t]*(.*)$",
    re.MULTILINE,
)
"""Lines that tell what `Status` holds: a third of all."""


def _name_in(status: str) -> str:
    """The name of a process, with the spaces at its ends; the kernel escapes two characters of it."""
    name = status.partition("\n")[0].partition("\t")[2]
    return _ESCAPED.sub(lambda found: "\n" if found[0] == r"\n" else "\\", name)


def parse_status(text: str) -> Status:
    """Read /proc/PID/status.

    Source: proc_pid_status(5).
    """
    fields = dict(reversed(_OF_STATUS.findall(text)))  # the first of several lines of one key counts

    def numbers(key: str, base: int = 10) -> tuple[int, ...]:
        return tuple(int(word, base) for word in fields.get(key, "").split())

    return Status(
        name=_name_in(text),
        state=fields.get("State", "?")[:1],
        umask=int(fields.get("Umask", "0"), 8),
        tgid=int(fields["Tgid"]),
        tgids=numbers("NStgid") or (int(fields["Tgid"]),),
        ppid=int(fields["PPid"]),
        tracer=int(fields["TracerPid"]),
        uids=_four(numbers("Uid")),
        gids=_four(numbers("Gid")),
        groups=numbers("Groups"),
        pids=numbers("NSpid") or (int(fields["Pid"]),),
        pgids=numbers("NSpgid"),
        sids=numbers("NSsid"),
        resident_size=int((fields.get("VmRSS") or "0 kB").split()[0]) * 1024,
        threads=int(fields.get("Threads", "1")),
        capabilities=_five(tuple(int(fields.get(f"Cap{which}", "0"), 16) for which in ("Inh", "Prm", "Eff", "Bnd", "Amb"))),
        no_new_privs=fields.get("NoNewPrivs") == "1",
        seccomp=int(fields.get("Seccomp", "0")),
    )


def _four(words: tuple[int, ...]) -> tuple[int, int, int, int]:
    first, second, third, fourth = words
    return first, second, third, fourth


def _five(words: tuple[int, ...]) -> tuple[int, int, int, int, int]:
    first, second, third, fourth, fifth = words
    return first, second, third, fourth, fifth


def signal_sets(text: bytes) -> tuple[int, int, int]:
    """Signals in an unparsed /proc/PID/status: with an action of their own, pending for the thread, pending for the process."""

    def mask(key: bytes) -> int:
        begin = text.index(key) + len(key)
        return int(text[begin : begin + 16], 16)

    return mask(b"\nSigCgt:\t") | mask(b"\nSigIgn:\t"), mask(b"\nSigPnd:\t"), mask(b"\nShdPnd:\t")


def swapped_size(pid: int) -> int:
    """Bytes of a process that are swapped out."""
    return sizes_in(read_bytes(pid, "status"), "VmSwap")[0]


def sizes_in(text: bytes, *keys: str) -> list[int]:
    """Bytes of memory by an unparsed /proc/PID/status; 0 for what it does not tell, as of a process that has ended."""
    found = []
    for key in keys:
        begin = text.find(f"\n{key}:".encode())
        found.append(int(text[begin + len(key) + 2 :].split(maxsplit=1)[0]) * 1024 if begin >= 0 else 0)
    return found


def pid_max() -> int:
    """The limit: every pid is smaller."""
    with open("/proc/sys/kernel/pid_max") as file:
        return int(file.read())


def status(pid: int) -> Status:
    """Read and parse /proc/PID/status."""
    return parse_status(read_text(pid, "status"))


class Stat(Struct, frozen=True):
    """/proc/PID/stat, as far as we use it. Addresses are 0 where we may not see them.

    Attributes:
        state: one letter, as `Status.state`.
        exit_signal: what its parent is sent when it ends.
        exit_code: of one that has ended: as wait(2) tells it.
    """

    name: str
    state: str
    nice: int
    priority: int
    policy: int
    start_time: int
    flags: int
    start_code: int
    end_code: int
    start_stack: int
    start_data: int
    end_data: int
    start_brk: int
    arg_start: int
    arg_end: int
    env_start: int
    env_end: int
    ppid: int
    exit_signal: int
    exit_code: int


PF_EXITING: Final = 0x00000004
PF_KTHREAD: Final = 0x00200000
"""Bits of `Stat.flags`. Source: linux/sched.h."""


def parse_stat(text: str) -> Stat:
    """Read /proc/PID/stat; the name in parentheses may hold anything.

    Source: proc_pid_stat(5); its fields are numbered from 1, the third one follows the name.
    """
    words = text[text.rindex(")") + 2 :].split()

    def field(number: int) -> int:
        return int(words[number - 3])

    return Stat(
        name=text[text.index("(") + 1 : text.rindex(")")],
        state=words[0],
        nice=field(19),
        priority=field(40),
        policy=field(41),
        start_time=field(22),
        flags=field(9),
        start_code=field(26),
        end_code=field(27),
        start_stack=field(28),
        start_data=field(45),
        end_data=field(46),
        start_brk=field(47),
        arg_start=field(48),
        arg_end=field(49),
        env_start=field(50),
        env_end=field(51),
        ppid=field(4),
        exit_signal=field(38),
        exit_code=field(52),
    )


def stat(pid: int) -> Stat:
    """Read and parse /proc/PID/stat."""
    return parse_stat(read_text(pid, "stat"))


def thread_stat(pid: int, tid: int) -> Stat:
    """Read and parse /proc/PID/task/TID/stat."""
    return parse_stat(read_text(pid, f"task/{tid}/stat"))


# Limits


LIMIT_COUNT: Final = 16
"""RLIMIT numbers of Linux. Source: asm-generic/resource.h."""

_LIMIT_LINE: Final = re.compile(r" (unlimited|[0-9]+) +(unlimited|[0-9]+) ")


def parse_limits(text: str) -> dict[int, tuple[int, int]]:
    """Soft and hard limits from /proc/PID/limits, whose lines stand in the order of the numbers; -1 is infinity.

    prlimit(2) would need CAP_SYS_RESOURCE for a process of another user.
    """
    lines = text.splitlines()[1 : LIMIT_COUNT + 1]
    found = (_LIMIT_LINE.search(line) for line in lines)
    return {number: (_limit(match[1]), _limit(match[2])) for number, match in enumerate(found) if match}


def _limit(word: str) -> int:
    return -1 if word == "unlimited" else int(word)
