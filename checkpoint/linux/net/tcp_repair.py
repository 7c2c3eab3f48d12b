"""Read a TCP connection as values, and make a connection from such values, by the kernel's TCP_REPAIR.

The reader must make sure that no packet arrives for the connection meanwhile (`checkpoint.linux.net.packet_drop`).

Source: tcp(7); do_tcp_setsockopt() and tcp_sendmsg_locked() in net/ipv4/tcp.c; linux/tcp.h.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import socket
import struct
import termios
from collections.abc import Iterator, Sequence
from typing import Final

from msgspec import Struct

TCP_REPAIR: Final = 19
TCP_REPAIR_QUEUE: Final = 20
TCP_QUEUE_SEQ: Final = 21
TCP_REPAIR_OPTIONS: Final = 22
TCP_TIMESTAMP: Final = 24
TCP_REPAIR_WINDOW: Final = 29
TCP_ULP: Final = 31
_ON: Final = 1
_OFF: Final = 0
_OFF_QUIETLY: Final = -1
"""TCP_REPAIR_OFF_NO_WP: without the probe by which the peer is asked where it stands."""
_NO_QUEUE: Final = 0
_RECEIVED: Final = 1
_SENT: Final = 2
IP_TRANSPARENT: Final = 19
IPV6_TRANSPARENT: Final = 75
SIOCOUTQNSD: Final = 0x894B
SO_PEEK_OFF: Final = 42
SO_BUF_LOCK: Final = 72
SO_SNDBUFFORCE: Final = 32
SO_RCVBUFFORCE: Final = 33

ESTABLISHED: Final = 1
FIN_WAIT_1: Final = 4
FIN_WAIT_2: Final = 5
CLOSE_WAIT: Final = 8
LAST_ACK: Final = 9
CLOSING: Final = 11
WE_ENDED: Final = (FIN_WAIT_1, FIN_WAIT_2, LAST_ACK, CLOSING)
"""Our end of the stream was sent, and takes a number."""
LIVING: Final = (ESTABLISHED, CLOSE_WAIT, *WE_ENDED)

QUEUE_MAX: Final = 16 << 20
"""Bytes in one direction that are taken along: more than the kernel lets wait unless it is told to (tcp_rmem, tcp_wmem)."""
PIECE_SIZE: Final = 1 << 15
"""Bytes that are laid into a queue at once: the kernel wants memory in one piece for each."""
_ROOM: Final = 4
"""How much more memory than bytes a queue may take that is filled in such pieces."""
_WITH_TIMESTAMPS: Final = 1
_WITH_SACK: Final = 2
_WITH_SCALE: Final = 4
"""tcpi_options."""
_OPTION_MSS: Final = 2
_OPTION_SCALE: Final = 3
_OPTION_SACK: Final = 4
_OPTION_TIMESTAMPS: Final = 8
_WINDOW: Final = struct.Struct("<5I")
"""struct tcp_repair_window: snd_wl1, snd_wnd, max_window, rcv_wnd, rcv_wup."""
_SEQUENCES: Final = 1 << 32


class CannotCarryError(Exception):
    """Why a connection cannot be taken along, or taken up: a clause."""


class InUseError(CannotCarryError):
    """Another socket on this machine has it, perhaps not for long."""


class Kept(Struct, frozen=True):
    """All facts of a connection that another machine needs to take it up.

    Attributes:
        state: of tcp(7).
        sent: bytes that the peer has not acknowledged, oldest first; ``unsent`` of them, the last ones, never left.
        received: bytes that the program has not read.
        sent_end, received_end: sequence numbers after them.
        options: tcpi_options.
        scales: by how much windows are shifted: the peer's in the lower four bits, ours in the higher.
        mss: as the peer announced it.
        timestamp: of our clock for the peer, 0 where the ends use none.
        window: struct tcp_repair_window.
        reads_end: nothing more comes, for the peer has ended its side, or the program does not want it.
        buffers: bytes of the send and the receive buffer; which of them the program has chosen (SO_BUF_LOCK).
    """

    state: int
    sent: bytes
    unsent: int
    received: bytes
    sent_end: int
    received_end: int
    options: int
    scales: int
    mss: int
    timestamp: int
    window: bytes
    buffers: tuple[int, int, int]
    reads_end: bool = False


@contextlib.contextmanager
def _in_repair(looked: socket.socket) -> Iterator[None]:
    """Look behind a connection for the body; it goes on as if nothing had been."""
    reuse = looked.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)
    _set(looked, TCP_REPAIR, _ON)
    try:
        yield
    finally:
        _leave_repair(looked, _OFF_QUIETLY, reuse)


def read(looked: socket.socket) -> Kept:
    """Look at a connection of a program that stands still; the peer hears nothing of it.

    Raises:
        CannotCarryError: it is of a kind that could not be made again.
        OSError: we may not (CAP_NET_ADMIN).
    """
    _require_plain(looked)
    buffers, reads_end = _buffers(looked), _reads_end(looked)
    with _in_repair(looked):
        state, options, scales = struct.unpack("<B4xBB", looked.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 7))
        if state not in LIVING:
            raise CannotCarryError("it has just ended")
        _set(looked, TCP_REPAIR_QUEUE, _SENT)
        ended = int(state in WE_ENDED)
        sent_end = looked.getsockopt(socket.IPPROTO_TCP, TCP_QUEUE_SEQ) & (_SEQUENCES - 1)
        sent = _peeked(looked, _asked(looked, termios.TIOCOUTQ) - ended)
        unsent = max(_asked(looked, SIOCOUTQNSD) - ended, 0)
        _set(looked, TCP_REPAIR_QUEUE, _RECEIVED)
        received_end = looked.getsockopt(socket.IPPROTO_TCP, TCP_QUEUE_SEQ) & (_SEQUENCES - 1)
        received = _peeked(looked, _asked(looked, termios.FIONREAD))
        return Kept(
            state=state,
            sent=sent,
            unsent=unsent,
            received=received,
            sent_end=sent_end,
            received_end=received_end,
            options=options,
            scales=scales,
            mss=looked.getsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG),
            timestamp=looked.getsockopt(socket.IPPROTO_TCP, TCP_TIMESTAMP) & (_SEQUENCES - 1) if options & 1 else 0,
            window=looked.getsockopt(socket.IPPROTO_TCP, TCP_REPAIR_WINDOW, _WINDOW.size),
            buffers=buffers,
            reads_end=reads_end,
        )


def leave_behind(looked: socket.socket) -> None:
    """Set a connection free that a process of ours left in repair when it died. Its SO_REUSEADDR is not known any more.

    Raises:
        OSError: we may not.
    """
    if looked.getsockopt(socket.IPPROTO_TCP, TCP_REPAIR):
        _leave_repair(looked, _OFF_QUIETLY, 0)


def _require_plain(looked: socket.socket) -> None:
    """Refuse a connection with state that the kernel does not tell."""
    if is_encrypted(looked):
        raise CannotCarryError("the kernel encrypts it (TCP_ULP)")
    if looked.getsockopt(socket.SOL_SOCKET, SO_PEEK_OFF) >= 0:
        raise CannotCarryError("the program looks ahead in it (SO_PEEK_OFF)")


def is_encrypted(looked: socket.socket) -> bool:
    """Whether the kernel has a protocol of its own between the program and TCP (kTLS)."""
    try:
        return bool(looked.getsockopt(socket.IPPROTO_TCP, TCP_ULP, 16).strip(b"\0"))
    except OSError:
        return False


def _asked(looked: socket.socket, question: int) -> int:
    return int.from_bytes(fcntl.ioctl(looked.fileno(), question, bytes(4)), "little", signed=True)


def _peeked(looked: socket.socket, size: int) -> bytes:
    """The whole content of the queue that is chosen."""
    if size <= 0:
        return b""
    if size > QUEUE_MAX:
        raise CannotCarryError(f"more than {QUEUE_MAX >> 20} MiB wait in it")
    found = looked.recv(size, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    if len(found) != size:
        raise CannotCarryError("urgent bytes wait in it")
    return found


def _reads_end(looked: socket.socket) -> bool:
    poll = select.poll()
    poll.register(looked, select.POLLRDHUP)
    return any(events & select.POLLRDHUP for _, events in poll.poll(0))


def _buffers(looked: socket.socket) -> tuple[int, int, int]:
    sizes = (looked.getsockopt(socket.SOL_SOCKET, name) for name in (socket.SO_SNDBUF, socket.SO_RCVBUF))
    try:
        locks = looked.getsockopt(socket.SOL_SOCKET, SO_BUF_LOCK)
    except OSError:  # Linux before 5.16
        locks = 0
    sending, receiving = sizes
    return sending, receiving, locks


# --- Made again --------------------------------------------------------------------------------------------------------


Address = tuple[str, int] | tuple[str, int, int, int]


def connect(made: socket.socket, kept: Kept, ours: Address, peer: Address) -> None:
    """Turn a fresh socket into the connection, without a word to the peer. It stays in repair until `set_free`: a close before
    that tells the peer nothing.

    Raises:
        CannotCarryError: this machine cannot have it.
        OSError: we may not.
    """
    _set(made, TCP_REPAIR, _ON)
    ended = int(kept.state in WE_ENDED)
    _set(made, TCP_REPAIR_QUEUE, _SENT)
    _set(made, TCP_QUEUE_SEQ, _signed(kept.sent_end - ended - len(kept.sent)))
    _set(made, TCP_REPAIR_QUEUE, _RECEIVED)
    _set(made, TCP_QUEUE_SEQ, _signed(kept.received_end - len(kept.received)))  # the peer's end counts as acknowledged
    with _anywhere(made):
        try:
            made.bind(ours)
        except OSError as error:
            raise CannotCarryError(f"it cannot be at {ours[0]} port {ours[1]}: {error.strerror}") from error
        try:
            made.connect(peer)
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise InUseError("a process on this machine has the same connection") from error
            raise CannotCarryError(f"no route leads to {peer[0]} from here: {error.strerror}") from error


@contextlib.contextmanager
def _anywhere(made: socket.socket) -> Iterator[None]:
    """Let a socket have an address for the body that this machine has not got yet."""
    options = [(socket.IPPROTO_IP, IP_TRANSPARENT)]
    if made.family == socket.AF_INET6:
        options.append((socket.IPPROTO_IPV6, IPV6_TRANSPARENT))
    before = [made.getsockopt(*option) for option in options]
    for option in options:
        made.setsockopt(*option, 1)
    try:
        yield
    finally:
        for option, value in zip(options, before, strict=True):
            made.setsockopt(*option, value)


def fill(made: socket.socket, kept: Kept) -> None:
    """Give a connection that was just made what the ends have agreed upon, and what waits in it.

    Raises:
        OSError: the kernel does not take it.
    """
    made.setsockopt(socket.IPPROTO_TCP, TCP_REPAIR_OPTIONS, b"".join(_agreed(kept)))
    if kept.options & _WITH_TIMESTAMPS:
        _set(made, TCP_TIMESTAMP, _signed(kept.timestamp))
    for option, size in ((SO_SNDBUFFORCE, len(kept.sent)), (SO_RCVBUFFORCE, len(kept.received))):
        made.setsockopt(socket.SOL_SOCKET, option, max(_ROOM * size, max(kept.buffers[:2])))
    _lay(made, _RECEIVED, kept.received)
    _lay(made, _SENT, kept.sent[: len(kept.sent) - kept.unsent])
    made.setsockopt(socket.IPPROTO_TCP, TCP_REPAIR_WINDOW, kept.window)
    if kept.reads_end:  # no packet can bring it a second time: as far as the program sees it is the same
        made.shutdown(socket.SHUT_RD)


def _agreed(kept: Kept) -> Iterator[bytes]:
    """The options on which the ends agreed when they connected. Source: struct tcp_repair_opt."""
    option = struct.Struct("<II")
    if kept.options & _WITH_SACK:
        yield option.pack(_OPTION_SACK, 0)
    if kept.options & _WITH_SCALE:
        yield option.pack(_OPTION_SCALE, kept.scales & 0xF | kept.scales >> 4 << 16)
    if kept.options & _WITH_TIMESTAMPS:
        yield option.pack(_OPTION_TIMESTAMPS, 0)
    yield option.pack(_OPTION_MSS, kept.mss)


def _lay(made: socket.socket, queue: int, content: bytes) -> None:
    _set(made, TCP_REPAIR_QUEUE, queue)
    for start in range(0, len(content), PIECE_SIZE):
        piece = content[start : start + PIECE_SIZE]
        if made.send(piece, socket.MSG_DONTWAIT) != len(piece):
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))


def set_free(made: socket.socket, kept: Kept, reuse: int) -> None:
    """Have a connection live that is silent still: what never left waits to be sent.

    Args:
        reuse: SO_REUSEADDR of the program's.

    Raises:
        OSError: the kernel does not take it.
    """
    _leave_repair(made, _OFF_QUIETLY, reuse)
    unsent = memoryview(kept.sent)[len(kept.sent) - kept.unsent :]
    while unsent:
        unsent = unsent[made.send(unsent, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL) :]
    sending, receiving, locks = kept.buffers
    made.setsockopt(socket.SOL_SOCKET, SO_SNDBUFFORCE, sending // 2)
    made.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receiving // 2)
    with contextlib.suppress(OSError):  # Linux before 5.16
        made.setsockopt(socket.SOL_SOCKET, SO_BUF_LOCK, locks)


def ask_peer(made: socket.socket, kept: Kept, reuse: int) -> None:
    """Have the kernel ask the peer where it stands, now that it is heard; waiting bytes are sent upon the answer.

    Raises:
        OSError: we may not.
    """
    _set(made, TCP_REPAIR, _ON)
    _leave_repair(made, _OFF, reuse)
    if kept.state in WE_ENDED:
        with contextlib.suppress(OSError):  # the peer has answered, and does not know it any more: the program will hear
            made.shutdown(socket.SHUT_WR)


def _leave_repair(made: socket.socket, how: int, reuse: int) -> None:
    """Which sets SO_REUSEADDR back. Source: tcp_repair_set() in net/ipv4/tcp.c."""
    _set(made, TCP_REPAIR_QUEUE, _NO_QUEUE)
    _set(made, TCP_REPAIR, how)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, reuse)


def _set(changed: socket.socket, option: int, value: int) -> None:
    changed.setsockopt(socket.IPPROTO_TCP, option, value)


def _signed(value: int) -> int:
    """A sequence number as setsockopt(2) takes it from Python."""
    value %= _SEQUENCES
    return value - _SEQUENCES if value >= _SEQUENCES // 2 else value


def address_of(address: Sequence[object]) -> Address:
    """As socket calls take it."""
    host, port = str(address[0]), int(str(address[1]))
    if len(address) == 4:
        return host, port, int(str(address[2])), int(str(address[3]))
    return host, port
