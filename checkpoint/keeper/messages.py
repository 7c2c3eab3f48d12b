"""Messages and descriptors between two processes of one robot, and the keeper's own requests and answers.

A channel is one end of a ``SOCK_SEQPACKET`` unix socket pair. Every packet is one byte of form and then msgpack of a tagged
struct (`INLINE`), or nothing more, with the struct in a memfd that travels as the first descriptor (`IN_MEMFD`; hidden here).
Both ends belong to one user. Packets are still decoded strictly, and a wrong message is an error, never a guess.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import mmap
import os
import socket
from typing import Any, Final, Generic, TypeVar

import msgspec

from checkpoint.capability import Capability
from checkpoint.engine import NO_TERMS, PTRACE, Report, Terms
from checkpoint.errors import UNDECODABLE, CheckpointError
from checkpoint.model import Position
from checkpoint.sentences import in_words
from checkpoint.snapshot.credentials import Owner
from checkpoint.store.digest_cache import KnownDigest
from checkpoint.store.whole_file import write_all

INLINE: Final = b"\x00"
IN_MEMFD: Final = b"\x01"
INLINE_LIMIT: Final = 64 << 10
"""Bytes of a message that travel in the packet itself; a larger one would not fit a socket's default buffer."""
MEMFD_LIMIT: Final = 64 << 20
"""Bytes of a message in a memfd; larger things (pages, streams) travel as descriptors of its own."""
DESCRIPTOR_LIMIT: Final = 250
"""Descriptors in one message: SCM_MAX_FD is 253; a chain of more files is folded by its sender first."""
LARGE_SIZE: Final = 16 << 20
"""Bytes of pages of a snapshot that is encoded into a spare file, where there is one: else memory holds it once more."""

M = TypeVar("M")


class ChannelError(CheckpointError):
    """The other end sent something that is no message, or cannot be sent to."""


class ChannelClosedError(ChannelError):
    """The other end has gone."""


class Channel(Generic[M]):
    """One end of a conversation.

    Args:
        end: a connected SOCK_SEQPACKET unix socket; the channel owns it.
        incoming: the union of the message types that may arrive, e.g. ``Request``.
    """

    def __init__(self, end: socket.socket, incoming: Any) -> None:
        self._socket = end
        self._decoder: msgspec.msgpack.Decoder[M] = msgspec.msgpack.Decoder(incoming)
        self._encoder = msgspec.msgpack.Encoder()

    def fileno(self) -> int:
        """For select and poll: readable means that `receive` returns at once."""
        return self._socket.fileno()

    def send(self, message: msgspec.Struct, descriptors: tuple[int, ...] = ()) -> None:
        """Send one message; the descriptors are copied, ours stay open.

        Raises:
            ChannelClosedError: the other end is closed.
            ChannelError: the socket does not take it (full while non-blocking, or too many descriptors).
        """
        if len(descriptors) > DESCRIPTOR_LIMIT:
            raise ChannelError(
                f"cannot send {type(message).__name__} with {len(descriptors)} descriptors: {DESCRIPTOR_LIMIT} is the limit"
            )
        body = self._encoder.encode(message)
        if len(body) <= INLINE_LIMIT:
            self._send_packet(INLINE + body, descriptors)
            return
        memfd = memfd_holding(body, "message")
        try:
            self._send_packet(IN_MEMFD, (memfd, *descriptors))
        finally:
            os.close(memfd)

    def _send_packet(self, packet: bytes, descriptors: tuple[int, ...]) -> None:
        ancillary = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))] if descriptors else []
        try:
            self._socket.sendmsg([packet], ancillary, socket.MSG_NOSIGNAL)
        except (BrokenPipeError, ConnectionResetError) as error:
            raise ChannelClosedError("cannot send: the other end of the local socket has gone") from error
        except OSError as error:
            raise ChannelError(f"cannot send on the local socket: {error.strerror}") from error

    def receive(self) -> tuple[M, tuple[int, ...]]:
        """Wait for one message (as long as the socket's timeout says): it, and its descriptors, now ours to close.

        Raises:
            ChannelClosedError: the other end has gone.
            ChannelError: the bytes are no message; their descriptors were closed.
            TimeoutError: the socket has a timeout and nothing came.
        """
        try:
            packet, descriptors = self._receive_packet()
        except ConnectionResetError as error:
            raise ChannelClosedError("the other end of the local socket has gone") from error
        if not packet:
            close_all(descriptors)
            raise ChannelClosedError("the other end of the local socket has gone")
        try:
            if packet == IN_MEMFD and descriptors:
                message = self._decoder.decode(_sealed_content_of(descriptors[0]))
                os.close(descriptors[0])
                return message, descriptors[1:]
            if packet[:1] != INLINE:
                raise ValueError(f"form {packet[0]} of a packet of {len(packet)} bytes")
            return self._decoder.decode(packet[1:]), descriptors
        except (*UNDECODABLE, OSError) as error:
            close_all(descriptors)
            raise ChannelError(
                f"the other end of the local socket sent something that is no message: {in_words(error)}"
            ) from error

    def _receive_packet(self) -> tuple[bytes, tuple[int, ...]]:
        room = socket.CMSG_SPACE((DESCRIPTOR_LIMIT + 1) * array.array("i").itemsize)
        packet, ancillary, flags, _ = self._socket.recvmsg(INLINE_LIMIT + 1, room, socket.MSG_CMSG_CLOEXEC)
        found = array.array("i")
        for level, kind, content in ancillary:
            if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
                found.frombytes(content[: len(content) - len(content) % found.itemsize])
        if flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
            close_all(tuple(found))
            raise ChannelError("the other end of the local socket sent a message that is too long")
        return packet, tuple(found)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


def close_all(descriptors: tuple[int, ...]) -> None:
    """Close descriptors that came with a message."""
    for descriptor in descriptors:
        with contextlib.suppress(OSError):
            os.close(descriptor)


def memfd_holding(content: bytes | memoryview, name: str) -> int:
    """Make a sealed memory file; the caller owns the descriptor.

    Sealed: neither end can change or cut what the other is reading.
    """
    descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    write_all(descriptor, content)
    seal(descriptor)
    return descriptor


def seal(descriptor: int) -> None:
    """Close a memory file to every change, for all processes and for good."""
    seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)


def _sealed_content_of(descriptor: int) -> bytes:
    """Read a message's memory file.

    Raises:
        OSError: it is no memory file.
        ValueError: it is too large, or its sender could still cut it while it is read (SIGBUS).
    """
    missing = ~fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & (fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_WRITE)
    size = os.fstat(descriptor).st_size
    if missing or size > MEMFD_LIMIT:
        raise ValueError(f"a memory file of {size} bytes that is {'not sealed' if missing else f'over {MEMFD_LIMIT}'}")
    return content_of(descriptor)


def content_of(descriptor: int) -> bytes:
    """Read the whole of a memory file or a regular file, wherever its offset stands."""
    size = os.fstat(descriptor).st_size
    if not size:
        return b""
    with mmap.mmap(descriptor, size, prot=mmap.PROT_READ) as view:
        return view[:]


def pair() -> tuple[socket.socket, socket.socket]:
    """Make both ends of a channel's socket."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)


# What the process that forks keepers is asked


class Fork(msgspec.Struct, frozen=True, tag=True):
    """Start a keeper, which is to serve the socket that comes as a descriptor. Answer: `Forked`, or `Failed`."""


class Forked(msgspec.Struct, frozen=True, tag=True):
    """The keeper has begun. ``pid``: of its process."""

    pid: int


# What a keeper is asked


class Probe(msgspec.Struct, frozen=True, tag=True):
    """Look at a process without touching it. Answer: `Probed`."""

    pid: int


class Tabulate(msgspec.Struct, frozen=True, tag=True):
    """Tell what this version preserves and refuses, of any program. Answer: `Tabulated`."""


class Protect(msgspec.Struct, frozen=True, tag=True):
    """Begin to follow a process. Answer: `Protected`.

    With descriptors, if ``streams``: the counters' memfd, two pipe read ends, two log files.

    Attributes:
        names: see `checkpoint.engine.ProtectOrder`, which is told them if ``robot`` is one: its agent keeps files by content.
        verb: what the user asked for, as a refusal says it.
    """

    pid: int
    component: str
    streams: bool = False
    robot: str = ""
    engine: str = PTRACE
    terms: Terms = NO_TERMS
    names: dict[str, str] = {}
    verb: str = "protect"


class Capture(msgspec.Struct, frozen=True, tag=True):
    """Take a snapshot. Answer: `Captured` with a sealed memfd that holds it encoded.

    With a descriptor, of an empty file: it is encoded there, and the answer brings none.

    Attributes:
        spare: that file is for a large snapshot (`LARGE_SIZE`) alone; a small one comes in a memfd, and leaves the file empty.
        hold: leave the program standing still afterwards, until `Release`: an end now ends it in exactly this state.
        xor_cache: bytes in which the keeper may remember pages, to tell deltas as differences from them; 0: not at all.
        lag_ns: how long it may wait for a moment between two activations of the program's tasks; 0: it does not wait.
        if_changed: answer `Unchanged` where a delta would say nothing new.
    """

    base: bool
    generation: int
    sequence: int
    epoch: int = 0
    hold: bool = False
    xor_cache: int = 0
    lag_ns: int = 0
    if_changed: bool = False
    spare: bool = False


class Acknowledge(msgspec.Struct, frozen=True, tag=True):
    """A standby holds everything up to here. No answer."""

    position: Position


class Restore(msgspec.Struct, frozen=True, tag=True):
    """Turn the vessel ``pid`` into the program; with descriptors: the chain's files, oldest first. Answer: `Restored`.

    Attributes:
        streams: the last five descriptors are the streams, as with `Protect`.
        own_eyes, epoch, contents, stood_still, all_connections: see `checkpoint.engine.RestoreOptions`.
        terms: those under which it is restored, and followed from then on.
        follow: protect it again as soon as it runs.
        bound: see `checkpoint.engine.RestoreOptions`; the keeper becomes that user for good, before it looks at the snapshot.
    """

    pid: int
    component: str
    elapsed_ns: int = 0
    accept_changed: tuple[str, ...] = ()
    streams: bool = False
    robot: str = ""
    own_eyes: bool = False
    epoch: int = 0
    contents: str = ""
    terms: Terms = NO_TERMS
    stood_still: bool = False
    all_connections: bool = False
    follow: bool = True
    bound: Owner | None = None


class Lay(msgspec.Struct, frozen=True, tag=True):
    """Make the vessel ``pid`` a ready copy; with descriptors: the chain's files, oldest first. Answer: `Laid`.

    Attributes:
        elapsed_ns: since the newest was taken.
        own_eyes, contents, terms: see `checkpoint.engine.RestoreOptions`.
    """

    pid: int
    component: str
    elapsed_ns: int = 0
    own_eyes: bool = False
    contents: str = ""
    terms: Terms = NO_TERMS


class Advance(msgspec.Struct, frozen=True, tag=True):
    """Bring the ready copy on; with descriptors: deltas, oldest first. Answer: `Laid`. A copy for which that fails is ended.

    Attributes:
        elapsed_ns: since the newest was taken.
    """

    elapsed_ns: int = 0


class Finish(msgspec.Struct, frozen=True, tag=True):
    """Make the ready copy the program, as a restore would; its streams come with `Resume`. Answer: `Restored`.

    Attributes:
        position: that it must stand at.
    """

    order: Restore
    position: Position


class Compare(msgspec.Struct, frozen=True, tag=True):
    """Look whether the program of a snapshot could go on here; with a descriptor: its newest snapshot. Answer: `Compared`.

    Attributes:
        contents, terms, own_eyes: see `checkpoint.engine.RestoreOptions`.
        known: the files of the last `Compared`, so that only files that have changed are read again.
        running: the program runs here, as this pid: tell only which of its files others hold open for writing; 0: it does not.
        components: see `checkpoint.engine.Engine.contested`.
    """

    contents: str = ""
    terms: Terms = NO_TERMS
    known: tuple[KnownDigest, ...] = ()
    own_eyes: bool = False
    running: int = 0
    components: dict[str, int] = {}


class OpenFile(msgspec.Struct, frozen=True, tag=True):
    """Open a file as the followed program has it: perhaps no name leads to it any more. Answer: `Opened` with the descriptor.

    Attributes:
        digest: of its content when it was captured; the asking process compares it.
    """

    path: str
    digest: bytes


class Fill(msgspec.Struct, frozen=True, tag=True):
    """Make a segment that holds the state of a cooperative chain, and lay its carried files down; with descriptors: the chain's
    files, oldest first. Answer: `Filled`.

    Attributes:
        own_eyes: see `checkpoint.engine.RestoreOptions`.
        places: see `checkpoint.engine.Carry`.
    """

    component: str
    own_eyes: bool = False
    places: tuple[tuple[str, str], ...] = ()


class Resume(msgspec.Struct, frozen=True, tag=True):
    """Let the restored program go on. Answer: `Resumed`; it is protected from now on.

    Attributes:
        streams: with descriptors, as with `Protect`: those of a ready copy, which had none before.
    """

    streams: bool = False


class Release(msgspec.Struct, frozen=True, tag=True):
    """Let go of the process; it runs on. Answer: `Released`."""


# What a keeper answers


class Probed(msgspec.Struct, frozen=True, tag=True):
    """The things that a capture would preserve."""

    report: Report


class Tabulated(msgspec.Struct, frozen=True, tag=True):
    """The table of what comes back, in its order."""

    rows: tuple[Capability, ...]


class Protected(msgspec.Struct, frozen=True, tag=True):
    """The process is followed."""

    notes: tuple[str, ...] = ()


class Slack(msgspec.Struct, frozen=True):
    """How a capture met the activations of the program's tasks. Instants: CLOCK_MONOTONIC of the initial time namespace.

    Attributes:
        task: of those, the one that was due first; ``period_ns``: its period, 0: it has none.
        began_ns, ended_ns: when it was to stand still, and when it ran again.
        waited_ns: for that.
        slack_ns: the longest time between two activations that was seen; ``freeze_ns``: how long the freeze was expected to take.
        is_squeezed: it was made although that does not fit.
    """

    task: str
    period_ns: int
    began_ns: int
    ended_ns: int
    waited_ns: int
    slack_ns: int
    freeze_ns: int
    is_squeezed: bool


class Captured(msgspec.Struct, frozen=True, tag=True):
    """A snapshot was taken.

    Attributes:
        size: bytes of the encoded snapshot.
        dirty_bytes: of the pages that it carries, before compression.
        known_bytes: of those whose last content was remembered.
        frozen_bytes: of those that were copied while the program stood still.
        remembered_bytes: of all pages that the keeper remembers; ``wanted_bytes``: with room for all, 0: not known yet.
        slack: None: the program runs no task of the schedule, or the capture was not to wait.
        totals: bytes that the component had written to standard output and standard error at the freeze, or the commit.
        commit: its number, of a cooperative snapshot; ``age_ns``: how old it was by then.
        cpu_us: processor time that it took of the keeper, in µs.
    """

    position: Position
    parent: Position | None
    size: int
    freeze_us: int
    dirty_bytes: int
    notes: tuple[str, ...] = ()
    totals: tuple[int, int] = (0, 0)
    commit: int = 0
    age_ns: int = 0
    known_bytes: int = 0
    frozen_bytes: int = 0
    remembered_bytes: int = 0
    wanted_bytes: int = 0
    slack: Slack | None = None
    cpu_us: int = 0


class Unchanged(msgspec.Struct, frozen=True, tag=True):
    """The program is as the newest acknowledged position has it, or has committed nothing since: no snapshot was made.

    Attributes:
        age_ns: how old that commit is.
        is_current: what it is now was looked at; the last commit of a program that commits grows older.
    """

    position: Position
    commit: int
    age_ns: int
    is_current: bool = False


class Filled(msgspec.Struct, frozen=True, tag=True):
    """The segment, as a descriptor; ``notes`` tell of carried files."""

    position: Position
    notes: tuple[str, ...] = ()


class Opened(msgspec.Struct, frozen=True, tag=True):
    """The file, as a descriptor."""


class Restored(msgspec.Struct, frozen=True, tag=True):
    """The program stands in the vessel, still stopped."""

    pid: int
    position: Position
    notes: tuple[str, ...] = ()


class Laid(msgspec.Struct, frozen=True, tag=True):
    """The ready copy stands at a position, and takes ``size`` bytes of memory."""

    position: Position
    size: int


UNPROTECTED: Final = "it runs, unprotected"
"""Begins the note of a `Resumed` whose program could not be followed again: another keeper may."""


class Compared(msgspec.Struct, frozen=True, tag=True):
    """The things that this machine lacks, one sentence each; and the files that were read for that."""

    lacks: tuple[str, ...] = ()
    known: tuple[KnownDigest, ...] = ()


class Resumed(msgspec.Struct, frozen=True, tag=True):
    """The program goes on, and is protected again.

    Attributes:
        notes: as of `Protected`, or `UNPROTECTED` and why.
        let_go_ns: when it went on, by this machine's CLOCK_BOOTTIME; to be protected again takes longer the more memory it has.
    """

    notes: tuple[str, ...] = ()
    let_go_ns: int = 0


class Released(msgspec.Struct, frozen=True, tag=True):
    """The process runs on by itself."""


class Failed(msgspec.Struct, frozen=True, tag=True):
    """It did not work.

    Attributes:
        error: name of a class in ``checkpoint.errors``.
        reasons: of `UnsupportedError` and `MismatchError`: one sentence each.
    """

    error: str
    message: str
    reasons: tuple[str, ...] = ()


def failed(error: CheckpointError) -> Failed:
    """The answer of a keeper when a request failed.

    The receiver knows only the classes of ``checkpoint.errors``. So the answer names the nearest of those: a `MovedError` is told
    as the `CaptureError` that it is.
    """
    known = next(kind for kind in type(error).__mro__ if kind.__module__ == CheckpointError.__module__)
    return Failed(known.__name__, str(error), getattr(error, "reasons", ()))


Request = (
    Probe
    | Tabulate
    | Protect
    | Capture
    | Acknowledge
    | Restore
    | Lay
    | Advance
    | Finish
    | Compare
    | OpenFile
    | Fill
    | Resume
    | Release
)
Reply = (
    Probed
    | Tabulated
    | Protected
    | Captured
    | Unchanged
    | Restored
    | Laid
    | Compared
    | Opened
    | Filled
    | Resumed
    | Released
    | Failed
)
