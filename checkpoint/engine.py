"""The contract of an engine: how to capture a process and how to restore it.

An engine finds out what it can preserve (`Engine.probe`), protects a process (`Engine.protect` opens a `Session`) and restores
it. A user of an engine needs nothing from the packages below this file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final, Protocol

from msgspec import Struct

from checkpoint.device_rules import DeviceRule
from checkpoint.errors import RestoreError
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot.credentials import Owner
from checkpoint.store.digest_cache import DigestOf

if TYPE_CHECKING:
    from checkpoint.store.base_in_process import UnreadBase
    from checkpoint.store.base_on_disk import StoredBase

PTRACE: Final = "ptrace"
COOPERATIVE: Final = "cooperative"
"""Names of the engines, see `checkpoint.engines.registry`."""
AUTO: Final = "auto"
"""The cooperative engine for a program that says that it keeps its state, before that and for all others ptrace."""

KEPT: Final = "kept"
REFUSED: Final = "refused"
NOTED: Final = "noted"


GOES_ALONG: Final = "should the program crash; a handover takes it along"
"""End of the note about a TCP connection that is taken along where the program is handed over."""


class Finding(Struct, frozen=True):
    """One thing that a process holds.

    Attributes:
        kind: which file of ``checkpoint.resources`` speaks ("files", "unsupported" …), or "process", "memory", "tracking".
        name: what holds it: "fd 7", "thread 413", "VMA 7f00-7f01".
        verdict: `KEPT` (comes back as it was), `NOTED` (comes back, with the difference told in ``text``), `REFUSED`.
        text: one sentence; for a refusal it says what to do about it.
    """

    kind: str
    name: str
    verdict: str
    text: str


class Report(Struct, frozen=True):
    """The things that a capture of one process would preserve, found without touching it.

    Attributes:
        command: its arguments, joined by blanks.
        resident_size: bytes of memory in use.
        tracking: how its written pages would be found: "pagemap", "soft-dirty" or "digest".
    """

    pid: int
    command: str
    resident_size: int
    tracking: str
    findings: tuple[Finding, ...] = ()

    @property
    def supported(self) -> bool:
        """Whether nothing stands against a capture."""
        return not self.reasons

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why not, one sentence each."""
        return tuple(finding.text for finding in self.findings if finding.verdict == REFUSED)

    @property
    def notes(self) -> tuple[str, ...]:
        """Differences to come, one sentence each."""
        return tuple(finding.text for finding in self.findings if finding.verdict == NOTED)


class Streams(Struct, frozen=True):
    """The guard's end of a component's standard streams: descriptors of *this* process.

    Attributes:
        counters: memfd, little-endian u64 ``[busy1, count1, busy2, count2, first1, first2]`` (docs/internals.md §5).
        outputs: read ends of the pipes (or the pseudo-terminal's masters) of standard output and standard error.
        logs: the files that the guard appends what it has read to.
    """

    counters: int
    outputs: tuple[int, int]
    logs: tuple[int, int]


CARRIED_SIZE_MAX: Final = 256 << 20
"""Bytes that the carried files of one component may hold, unless its operator says otherwise: the keeper holds a copy."""


class Carry(Struct, frozen=True):
    """Which files travel with a component (rule ``carry``).

    Attributes:
        paths: of files, and of folders with all that is in them; absolute.
        size_max: bytes that they may hold together.
        places: (path in a snapshot, path on this robot) of those that this robot lays down at another path.
    """

    paths: tuple[str, ...] = ()
    size_max: int = CARRIED_SIZE_MAX
    places: tuple[tuple[str, str], ...] = ()


NOTHING_CARRIED: Final = Carry()


class Terms(Struct, frozen=True):
    """The operator's rules for the things that one component holds, for one robot.

    Attributes:
        carry: its files that travel with it.
        devices: what becomes of devices that it has open.
        connections: TCP connections with others go along where it goes on from the state in which it stood still for good.
        refuses_connections: a connection with others, of TCP or of unix sockets, stands against a capture; else it ends where the
            program goes on without it.
        freeze_budget_ns: how long it may stand still for a snapshot, so that pages are copied beforehand as
            far as needed; a freeze that would take longer is given up; 0: as short as can be.
        freeze_overrun_ns: when no capture has kept to that for so long, one may take longer; 0: none may.
        owner: with whose rights its files are opened, and beyond whose rights nothing of it is captured: each capture asks again.
            None: with those that its process has; it may have any, for its owner is root, or the keeper has no rights to lend.
        shared: files, and folders with all that is in them, that others write to as well: they keep the content that they have
            where the program goes on, and only its offsets are set; absolute.
        detaches_memory: shared memory that other processes have mapped, too, becomes the program's own copy where it resumes;
            otherwise the program is refused (`checkpoint.resources.ipc.shared_memory`).
    """

    carry: Carry = NOTHING_CARRIED
    devices: tuple[DeviceRule, ...] = ()
    connections: bool = False
    freeze_budget_ns: int = 0
    shared: tuple[str, ...] = ()
    owner: Owner | None = None
    detaches_memory: bool = False
    refuses_connections: bool = False
    freeze_overrun_ns: int = 0

    def is_shared(self, path: str) -> bool:
        """Whether a file is one of those that are shared, or lies in such a folder."""
        return _leads_into(path, self.shared)

    def is_carried(self, path: str) -> bool:
        """Whether a file is one of those that travel, or lies in such a folder."""
        return _leads_into(path, self.carry.paths)


def _leads_into(path: str, places: Iterable[str]) -> bool:
    return any(path == one or path.startswith(f"{one}/") for one in places)


NO_TERMS: Final = Terms()


class ProtectOrder(Struct, frozen=True):
    """How a process is to be followed.

    Attributes:
        component: its name.
        streams: the guard's ends of its standard streams, if it lives under a guard; the session owns them from now on.
        names: of a store that keeps the program's files by content (`checkpoint.store.content_store`): the paths by which the
            program knows those that it has from there; snapshots name them so. None: no store keeps them.
        verb: what the user asked for, as a refusal says it.
    """

    component: str
    streams: Streams | None = None
    terms: Terms = NO_TERMS
    names: Mapping[str, str] | None = None
    verb: str = "protect"

    @property
    def is_guarded(self) -> bool:
        """Whether it has a guard, which may hold it by SIGSTOP: that the whole of it is stopped says nothing then."""
        return self.streams is not None or self.names is not None


def contradiction(carry: Iterable[str], shared: tuple[str, ...]) -> str:
    """Why files cannot both travel with a program and be shared with others; "" where none are to do both."""
    for path in carry:
        if Terms(shared=shared).is_shared(path) or any(one.startswith(f"{path}/") for one in shared):
            what = "a carried file becomes what it was, a shared one keeps what it has"
            return f"{path} is to be carried and shared: {what}; choose one"
    return ""


class Gate(Protocol):
    """Tells when a program may stand still. Of one component; calls come from the thread that captures it."""

    def opens(self, pids: tuple[int, ...]) -> bool:
        """Wait until it may: True. False: not yet; copy the pages that were written meanwhile, and ask again.

        Args:
            pids: of all its processes.
        """
        ...

    def closes(self, *, stood_still: bool) -> None:
        """It runs again, or nothing has come of it."""
        ...


class CaptureOrder(Struct, frozen=True):
    """An order for the next snapshot.

    Attributes:
        gate: to be asked before the program stands still; None: it may at any time.
        base: make a base, also after an acknowledgement. A delta needs False here and an acknowledged position.
        generation, sequence: of the position that it gets.
        robot: name of the robot, "" for a one-shot capture.
        hold: leave the program standing still afterwards, until the session is closed.
    """

    base: bool = True
    generation: int = 1
    sequence: int = 1
    epoch: int = 0
    robot: str = ""
    hold: bool = False
    gate: Gate | None = None


class RestoreOptions(Struct, frozen=True):
    """How a program is to come back.

    Attributes:
        elapsed_ns: time between the snapshot and now, as far as known; the program's clocks go on by this much.
        accept_changed: paths of files that may differ from what the snapshot recorded, as the restore itself finds; what an
            operator rules to be shared stands in ``terms``.
        epoch: of the primacy under which it goes on; a program that was born with one finds it in its environment. 0: none.
        terms: this robot's, for its devices; its carried files have been named as they are laid down here.
        own_eyes: open its files with its own user's rights, not with ours: that user could have put other files in their place.
        contents: directory of files that were brought along (`checkpoint.store.content_store`), for what this machine lacks or
            has in another version; "": there are none.
        stood_still: nothing of it has run since the capture, so that TCP connections that were taken along can be taken up.
        all_connections: refuse the restore where a TCP connection with another program cannot be taken up; else it is reset.
        bound: whose rights it gets at most, although it may ask for more (`checkpoint.snapshot.credentials.bounded`); None: all
            that it asks for. The vessel is that user's already, so that the kernel keeps to it, too.
    """

    elapsed_ns: int = 0
    accept_changed: tuple[str, ...] = ()
    own_eyes: bool = False
    epoch: int = 0
    contents: str = ""
    terms: Terms = NO_TERMS
    stood_still: bool = False
    all_connections: bool = False
    bound: Owner | None = None


COPY_CLOCKS_AHEAD_NS: Final = 250_000_000
"""How far ahead a ready copy's clocks begin: they are fixed at its birth, and a later snapshot may have come quicker than the one
that they were taken from. A clock never goes back."""


class Session(Protocol):
    """One protected process. Every call comes from the thread that opened it."""

    @property
    def totals(self) -> tuple[int, int]:
        """Bytes that the component had written to its standard output and error at the last capture."""
        ...

    @property
    def frozen_size(self) -> int:
        """Bytes of pages that the last capture copied while the program stood still."""
        ...

    notes: tuple[str, ...]
    """Sentences about a fallback that was taken, or a difference to come."""

    def capture(self, order: CaptureOrder) -> Snapshot:
        """Take one snapshot; the program runs on, also when that fails.

        Raises:
            ProcessGoneError: it ended.
            UnsupportedError: it has turned into something that cannot be captured.
            CaptureError: this one did not work; nothing was forgotten, a later one may.
        """
        ...

    def capture_standing(self, order: CaptureOrder) -> Snapshot | UnreadBase:
        """As `capture`, of what is to stand still until the session is closed: a large program's pages may stay where they are,
        to be read once, when they are written to a file. It cannot be acknowledged."""
        ...

    def unchanged(self, epoch: int) -> Position | None:
        """The newest acknowledged position, if a delta now would say nothing new; None: capture.

        Args:
            epoch: of the primacy; the program has yet to be told of a newer one by a capture.
        """
        ...

    def acknowledge(self, position: Position) -> None:
        """A standby holds everything up to ``position``: the session may forget the pages written before it."""
        ...

    def open_file(self, path: str, digest: bytes) -> int:
        """A descriptor of a file that the program needs, as it has it, the caller's to close.

        Args:
            digest: of its content at a capture; the file may have been written to since.

        Raises:
            CaptureError: it has no such file.
        """
        ...

    def close(self) -> None:
        """Let go; the program runs on unchanged. Further calls do nothing."""
        ...


RESET_NOTE: Final = "its connections were reset"
COPY_NOTE: Final = "its shared memory"
LASTING_NOTES: Final = (RESET_NOTE, COPY_NOTE)
"""How those notes of a restore begin that an operator should find in the status while the program runs."""


class Restored(Protocol):
    """A restored program, which stands still until `resume`."""

    position: Position
    """The position of the snapshot that it stands at."""
    notes: tuple[str, ...]

    @property
    def connections(self) -> int:
        """How many TCP connections it had open at the capture."""
        ...

    @property
    def pid(self) -> int:
        """As this process sees it."""
        ...

    def resume(self) -> None:
        """Let it go on."""
        ...


def pid_taken(pid: int) -> RestoreError:
    """Why no ready copy stands in a vessel that did not get the PID by which the program knows itself."""
    return RestoreError(f"pid {pid}, by which it knows itself, is not free here")


class Copy(Protocol):
    """A ready copy: a stopped process that has a program's mappings and memory. Calls come from the thread that laid it."""

    position: Position
    """The position that it stands at."""

    @property
    def state(self) -> Snapshot:
        """The same, without its pages."""
        ...

    @property
    def size(self) -> int:
        """Bytes of memory that it takes."""
        ...

    def advance(self, delta: Snapshot) -> None:
        """Bring it to the position of a delta: all of it, or it can be used no more.

        Raises:
            ChainError: the delta does not continue its position.
            UnsupportedError: its program can have no ready copy any more.
            MismatchError: this machine lacks a file that is mapped now.
            RestoreError: it must be laid again.
        """
        ...

    def require_clocks(self, elapsed_ns: int) -> None:
        """Refuse it where its clocks have come too far from the program's.

        Args:
            elapsed_ns: since the snapshot that it stands at was taken.

        Raises:
            RestoreError: it must be laid again.
        """
        ...

    def finish(self, options: RestoreOptions) -> Restored:
        """Make it the program, which stands still.

        Raises:
            MismatchError: this machine lacks something.
            RestoreError: it did not work; the caller kills the vessel, and may restore from the chain.
        """
        ...

    def end(self) -> None:
        """Kill it."""
        ...


class Engine(Protocol):
    """A way to capture and restore."""

    name: str

    def probe(self, pid: int) -> Report:
        """Look at a process without touching it.

        Raises:
            ProbeError: it cannot be looked into at all.
        """
        ...

    def protect(self, pid: int, order: ProtectOrder) -> Session:
        """Begin to follow a process.

        Raises:
            ProbeError: it cannot be looked into at all.
            UnsupportedError: it holds something that cannot be preserved; it was not touched.
        """
        ...

    def lacks(self, outline: Snapshot, options: RestoreOptions, digest_of: DigestOf = ...) -> tuple[str, ...]:
        """What this machine lacks for a program that runs on another one, one sentence each; without touching anything.

        Args:
            outline: of its newest snapshot (`checkpoint.snapshot.format.read_outline`).
            digest_of: tells what files of this machine contain (`checkpoint.store.digest_cache`).
        """
        ...

    def contested(self, outline: Snapshot, options: RestoreOptions, pid: int, components: Mapping[str, int]) -> tuple[str, ...]:
        """Which files of a program that runs here are held open for writing by others, so that a restore would be refused.

        Args:
            pid: of its first process.
            components: the first process of every component that runs here, by name.
        """
        ...

    def restore(self, vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Restored:
        """Turn a waiting vessel into the program of a base.

        Raises:
            FormatError, ChainError: its pages, where they still were in a file, are not what they were; as RestoreError.
            MismatchError: this machine lacks something; nothing was started.
            RestoreError: it did not work; the caller kills the vessel and nothing is left.
        """
        ...

    def lay(self, vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Copy:
        """Begin a ready copy in a waiting vessel.

        Raises:
            UnsupportedError: the program can have none, with the reasons.
            MismatchError: this machine lacks a file that is mapped.
            RestoreError: it did not work; the caller kills the vessel.
        """
        ...
