"""Client of the agent's control socket: one request, then its replies.

Wire: a unix stream socket, 0600. Every message is four bytes of length (big endian) and that many bytes of msgpack: from the
client one `Request`, from the agent any number of `Update` and `Output`, and at last one `Result` or `Refused`. Closing the
connection ends a request that has no end of its own (`status` with ``watch``, `logs` with ``follow``); it never ends the
component.

Verbs, their arguments and what ``Result.value`` holds (every argument has a default unless marked *must*):

=============  =======================================================  ========================================================
verb           arguments                                                result, updates
=============  =======================================================  ========================================================
``ping``                                                                ``robot team pid version insecure``
``status``     ``watch`` false, ``every_ms`` 500, ``team`` false        see `STATUS`; with ``watch`` each picture is an Update
``run``        ``argv`` *must*, ``name`` = argv[0]'s, ``env``, ``cwd``,  Update ``{"started": {name, pid, inner_pid, isolated,
               ``umask`` 18, ``isolate`` true, ``wait`` true,           notes}}``; with ``wait`` Output … and Result
               ``user`` "", ``engine`` "auto", ``output`` "immediate",  ``{name, exit_status}`` (a wait status); else at once
               ``devices`` {}: path → rule, ``carry`` [], ``shared`` [],
               ``connections`` "": reset, carry or refuse,
               ``shared_memory`` "": refuse, or detach,
               ``hooks`` {}: occasion → words of a command,
               ``portable`` "": a level, or "no"
``protect``    ``pid`` *must*, ``name`` *must*                          ``{name, pid, notes}``
``release``    ``name`` *must*                                          ``{name, pid}``; the program runs on, unprotected
``start``      ``name`` *must*                                          ``{name, robot, notes}``: of agent.toml, after its end
``stop``       ``name`` *must*, ``signal`` 15                           ``{name, exit_status}`` once it has ended
``logs``       ``name`` *must*, ``follow`` false, ``offsets`` [0, 0]:    Output …, Result ``{name, totals, exit_status}``
               below zero, from the end of the stream; ``since_ms``
               0: not what is older; ``times`` false: with instants
``why``        ``name`` "", ``robot`` "", ``age_ms_max`` 0               see `WHY`
``rights``     ``user``, ``right``, ``path``, all *must*                ``{allow, because, groups, place}``
``may``        ``rights`` *must*, ``paths`` *must*                      ``{robot, team, answers: {right: {path: because}}}``:
                                                                        may this user; "" if so, else why not; 512 at most
``handover``   ``name`` *must*, ``to`` ""                               ``{name, to, epoch, took_ms, moved, sentence}``
``failback``   ``name`` *must*, ``to`` "": the target expected          as ``handover``
``prefer``     ``name`` *must*, ``robot`` *must*                        ``{name, robot}``
``drain``      ``robot`` *must*, ``on`` true                            ``{robot, drained, sentence}``; for root
``reserve``    ``name`` *must*: a component, or a path above,           ``{path, left_ms, sentence, untold}``: robots that did not
               ``span_ms`` *must*: 4 h at most, ``why`` ""              answer, and hear it later
``unreserve``  ``name`` *must*, ``breaks`` false: also another user's   ``{path, user, sentence, untold}``
``team``       ``act`` *must*: add, remove or rotate, ``robot``         ``{team, robots, change, waiting}``: members that take it
               *must* ("": this one), ``member``: {beats, bulk, role,   when they are back; of rotate also ``robot public_key``;
               public_key}                                              for root
``promote``    ``name`` *must*, ``robot`` = newest checkpoint's,         ``{name, to, epoch, promoted, sentence, risks}``; unless
               ``sure`` false                                           ``sure`` nothing is done, and they tell what would be
=============  =======================================================  ========================================================

The orders ``release``, ``stop`` and ``handover`` to ``promote`` also take ``epoch``: the epoch that the user saw; if the
component has another one when the order is obeyed, nothing is done. 0, the default: any.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from checkpoint.errors import UNDECODABLE
from checkpoint.linux.unix_address import address_of
from failover.errors import AgentRefusedError, LostAgentError, NoAgentError, RequestError

STATUS: Final = """
robot, team, role, pid, lanes_pid, version: of this agent; life: count of its starts
insecure: links are neither authenticated nor encrypted
realtime: the main loop runs at real-time priority with its memory locked
drained: an operator has drained this robot
rule, promise: the rule by which the team decides, and one sentence: what holds if this robot dies now
fencing: one sentence: what freezes a program that may not act, and what this robot does not have for the worst case
rights: one sentence: by which rules and whose groups rights are decided here, and what is wrong; "" without rights.toml
memory: {agent, keepers, remembered, remembered_max}: bytes of private memory of main loop and worker, and of the keepers of
    components that run here; remembered: of these, what pages are remembered in, of all components together, and its bound
    (xor_cache of agent.toml); None of a witness
descriptors: {main_loop, worker}: open descriptors of the agent's processes
healthy: nothing is degraded, nothing has failed, no robot is silent, as far as this robot knows; with ``team`` as far as any
    robot that answered knows, which is what the exit status of ``failover status`` says, too (`failover.client.health`)
notes: [sentence, …]: what is missing or degraded on this robot
reservations: [{path, user, why, left_ms, until}]: what users have reserved; until: seconds since 1970 by this robot's calendar
beats: {sent, heard, unsent, refused, late_us_max, gap_us_max, gaps, items}: of this life; refused: {reason: count}
    items: {reason: count} of the board's values that other robots did not get, or got a round later
links: [{name, medium, because, carrier, addresses, snapshots, bytes_in, bytes_out}]: interfaces with an address of this robot
    medium: wired | wireless | loopback; because: the fact that tells; carrier: its cable is in; snapshots: they may travel there
    bytes_in, bytes_out: all that the kernel counted on it
media: [{link, cast, because, by_unicast, period_ms, no_slots, bytes, slots}]: how frames leave over each beat address
    cast: multicast | broadcast | unicast; because: why not multicast; by_unicast: members that get frames by unicast besides, for
        they did not say that they hear the cast; period_ms: between two frames; no_slots: why a radio has none
    bytes: {robot: bytes} of frames that came from each member on that link; of this robot, that it has sent there
    slots: {own, why, round, count, place, members, reference, round_us, offset_us, jitter_us, least_gap_us, late_us, late_us_max,
        followed, outside, ignored, deaf,
        peers: [{robot, seen, missed, lost, awaited, offset_us, jitter_us, transit_us, hears}]}:
        see `failover.core.frames.terms.SlotsView`; None: no slots
        own: listening | running | silent, why; count: K, robots that share the round; place: this robot's among them, from 0
        reference: the robot whose frames give the phase; round_us: the last round, longer than period_ms where it was stretched
        offset_us: from a member's slot to its last frame; lost: of the awaited frames those that did not come
        deaf: [[listener, speaker], …]; hears: whom a member hears; seen: not | insert | run | remove
coordinator: {name: etcd, state: unknown | live | dead, last_heard_ms}: where it has a vote; null by another rule
peers: [{name, role, state, last_heard_ms, hears_us, load, beats_lost, links, lane, doubted, drained, notes}]
    role: robot | server | witness; state: unknown | live | suspect | restarting | dead; links: ours, by which it was heard lately
    lane: connected | connecting | refused | down
    drained: it is to run nothing, as an operator ordered; of this robot itself: drained above
    doubted: it said lately what it may not say (its notes tell what): its key may be stolen
far: [{name, site, role, lane, items_heard_ms, notes}]: members of other sites, which have no part in any decision here
    lane: as above; items_heard_ms: since it told its items last; null: not in this life, or it has none
doubted_elsewhere: {robot: [peer, …]}: with ``team``, of whom each of the others heard lately what it may not say
peers_elsewhere: {robot: {peer: state}}: with ``team``, the same as the others see it
components: [{name, role, primary, home, prefer, state, protection, epoch, generation, sequence, engine, pid, inner_pid,
    isolated, standby, standby_sequence, lag_ms, took_ms, period_ms, commit_age_ms, commit_usual_ms, commit_overdue, freeze_us,
    freeze_us_max, freeze_budget_missed, slack, snapshot_size, dirty_bytes, xor_hit_rate, snapshots, restores, crashes, outage_ms,
    restarts, exit_status, promise, promise_differs, kept, unstored, lacks, contested, prepared_first, owner, reserved, arriving,
    sealed, reasons, output, output_waiting, notes, elsewhere, warm, cold, ready, ready_copy, resumed}]
    freeze_budget_missed: its snapshots that took longer than the freeze_budget_ms of its table in agent.toml; notes say more
    took_ms: at its primary, from the order of the newest delta until it was a checkpoint: captured, sent, stored, acknowledged
    slack: {task, captures, squeezed, slack_us, freeze_us, waited_us, began_ns, ended_ns}: at the primary of a program that runs
        tasks of the schedule: its captures, and those of them that delayed an activation; of the newest: the longest time between
        two activations that was seen, how long the freeze was expected to take, how long it waited for its moment, and when it
        began and ended (CLOCK_MONOTONIC); task: the one that was due first; None of any other component
    snapshot_size, dirty_bytes: of the newest one: bytes on the wire, and of pages; xor_hit_rate: which part of what the
        deltas of this life carried was in the cache of last contents (xor_cache of agent.toml); None before the first one
    output: immediate | committed (--output); output_waiting: bytes that wait until another robot holds them
    warm: its program waits at its standby, started in advance; None where nothing could: it is restored from its memory
    cold: why it does not wait at this robot, where it should and something went wrong; "" otherwise
    ready: of any other program: a stopped process holds the newest checkpoint's memory at its standby
    ready_copy: {ready, wanted, size, position: {generation, sequence}, why}: of that process, at this robot, where it stands by:
        bytes of memory that it takes, or why there is none; wanted: ready_copy of agent.toml; None elsewhere
    owner: uid of the user who may give orders about it and read its output, besides root
    reserved: {path, user, why, left_ms, until}: the reservation in which it is, as above; None: no user has reserved it
    promise: what holds for it; promise_differs: from the team's, by what was chosen for it, or because a server stands by
    kept: {checkpoints, older, size, newest_age_s, oldest_age_s} of this robot's store: positions to which the team may go back,
        further whole ones that are kept for people, bytes of all; None where it has nothing
    lacks: what this robot, a standby, would need to resume it and has not: a device, a file, a feature; by
        sentence, None before the first look; prepared_first: a hook gets it ready before, and may bring that
    contested: at its primary: which of its files others hold open for writing, so that a restore is refused; by sentence
    arriving: [{to, what, arrived, size}]: at its primary, what is on its way to other robots, and how many bytes of it have
        arrived, by their own word; what: checkpoint | files (those of the program that the robot lacks)
    sealed: {at, age_s, copies, size}: of its sealed copies at a witness (at), age of the newest; at a robot or server that puts
        them, copies and size are None; at the witness: how many, and their bytes; None: there is none; none of them is a standby
    unstored: why the last snapshot that came to this robot was not stored there; "" otherwise
    role: primary | standby | none; protection: none | protected | degraded | stopped
    resumed: {at, robot, state_at, sequence}: of its last restore at this robot: when its program acted here first (seconds
        since 1970, by this robot's calendar); whose checkpoint that was, its number, and when that robot took it, by its own
        calendar (of a program that keeps its state: when it made the commit); None: none in this life of the agent
    restarts: of a program that agent.toml declares: how often it was started anew after an end, in this life of the agent
    state: starting | running | restarting | frozen | held | restoring | ended | degraded | failed | released
    lag_ms: age of what the standby holds: since its capture began, or, where a program keeps its state, since its commit
    commit_…: of a program that keeps its state, at its primary: age of its newest commit, the longest time that lay between two
        of the last ones, whether the newest is much older than that
    elsewhere: with ``team``: {robot: the same fields, as that robot sees the component}
"""
"""The fields of the answer to ``status``. A value that is not known is None."""

WHY: Final = """
robots: [{robot, answered, reason, lines, damaged, clock_offset_ms, clock_doubt_ms}]: the robots that were asked
    reason: why it did not answer; damaged: lines of its event log that cannot be read any more
    clock_offset_ms: by how much its calendar is ahead of the asked robot's, known within clock_doubt_ms
story: [{at, doubt_ms, robot, component, did, life, number, repeats, epoch_before, epoch, state, late_ms, lease_left_ms,
    checkpoint, checkpoint_age_ms, output_pending, seen}]: in the order in which it happened
    at: seconds since 1970 by the calendar of the robot that was asked, whichever robot decided; known within doubt_ms
    component: "" for what concerns the robot itself; did: a sentence
    life, number: of that robot's agent, and of the line in it; repeats: how often the line before was said again
    epoch_before, epoch, state: of the component at that robot; late_ms: the most that its own loop had been late lately
    lease_left_ms: until it had to stand still; None without a lease
    checkpoint, checkpoint_age_ms: the newest from which a robot could resume it: younger work would have been lost
    output_pending: bytes the program had written that are in no checkpoint
    seen: [{robot, state, silent_ms, limit_ms, links, hears_us, says, life, beat}]: every peer as that robot heard it
        links: {link: silent_ms}; says: what that peer last said about the component
"""
"""The fields of the answer to ``why``. A value that is not known is None."""

MESSAGE_LIMIT: Final = 16 << 20
"""Bytes of one message either way: a status of thousands of components fits, a runaway peer does not fill the memory."""

REQUEST_LIMIT: Final = 4 << 20
"""Bytes of one request: the kernel takes no program with more arguments and environment than 6 MB, and by default with 2 MB."""

ON_BEHALF: Final = frozenset(
    ("ping", "status", "why", "may", "logs", "start", "stop", "release", "handover", "failback", "prefer", "promote")
    + ("reserve", "unreserve")
)
"""What one user's process may ask for another user: nothing that starts a program or takes a process in."""

LENGTH: Final = struct.Struct(">I")
SOCKET_NAME: Final = "control.sock"
SYSTEM_SOCKET: Final = Path("/run/failover") / SOCKET_NAME
SYSTEM_CONFIG: Final = Path("/etc/failover/agent.toml")
SYSTEM_TEAM: Final = Path("/etc/failover/team/team.toml")
SOCKET_VARIABLE: Final = "FAILOVER_SOCKET"
CONNECT_TIMEOUT_S: Final = 5
_CREDENTIALS: Final = struct.Struct("iII")
_TIMEVAL: Final = struct.Struct("@ll")
"""Source: socket(7), SO_SNDTIMEO; unix(7)."""


class Request(msgspec.Struct, frozen=True):
    """One request of a client.

    Attributes:
        on_behalf: uid of the user for whom it is made; None: for the client itself. The agent takes it from root, from its own
            user, and from ``page_user`` of agent.toml; never for root, and only for the verbs in `ON_BEHALF`.
    """

    verb: str
    arguments: dict[str, Any] = {}
    on_behalf: int | None = None


class Update(msgspec.Struct, frozen=True, tag="update"):
    """Something to show while the answer is still being made."""

    value: dict[str, Any]


class Output(msgspec.Struct, frozen=True, tag="output"):
    """Bytes that the component wrote; ``stream`` 1 or 2, ``offset`` of the first byte in the whole stream.

    ``times``: where they were asked for: (offset from which on, ns since 1970 by the calendar of the robot that has the logs).
    """

    stream: Annotated[int, msgspec.Meta(ge=1, le=2)]
    offset: Annotated[int, msgspec.Meta(ge=0)]
    content: bytes
    times: tuple[tuple[int, int], ...] = ()


class Result(msgspec.Struct, frozen=True, tag="result"):
    """The answer; nothing follows."""

    value: dict[str, Any]


class Refused(msgspec.Struct, frozen=True, tag="refused"):
    """It cannot be done; nothing follows. See `failover.errors.AgentRefusedError`."""

    kind: str
    message: str
    reasons: tuple[str, ...] = ()


Reply = Update | Output | Result | Refused


class Answer(dict[str, Any]):
    """A result's value; a key that an agent of another version left out is an error in words."""

    def __missing__(self, key: str) -> Any:
        raise LostAgentError(f"the agent's answer has no {key!r}; agent and command are of different versions: restart the agent")


_encoder = msgspec.msgpack.Encoder()
_reply_decoder: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)


def socket_path() -> Path:
    """Where the agent listens: ``$FAILOVER_SOCKET``, else the user's own agent if its socket is there, else the system's."""
    chosen = os.environ.get(SOCKET_VARIABLE)
    if chosen:
        return Path(chosen)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    own = Path(runtime) / "failover" / SOCKET_NAME if runtime else None
    return own if own is not None and own.exists() else SYSTEM_SOCKET


class Control:
    """One connection to one agent; one request at a time. A context manager, or call `close`."""

    def __init__(self, link: socket.socket, path: Path) -> None:
        self._link = link
        self._path = path

    @classmethod
    def open(cls, path: Path | None = None) -> Control:
        """Connect to the agent.

        Raises:
            NoAgentError: no agent listens there, or not for this user.
        """
        path = path or socket_path()
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        # Of the kernel, which has us wait for our turn: with Python's own, a socket refuses at once while too many others wait.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(CONNECT_TIMEOUT_S, 0))
        try:
            with address_of(path) as address:
                link.connect(address)
        except OSError as error:
            link.close()
            raise NoAgentError(why_unreachable(path, error)) from error
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(0, 0))
        return cls(link, path)

    @property
    def peer_pid(self) -> int:
        """The pid by which we see the process that answers; 0 if it lives in a PID namespace that we do not see into."""
        return int(_CREDENTIALS.unpack(self._link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0])

    def ask(self, verb: str, **arguments: Any) -> dict[str, Any]:
        """Make a request and wait for its result, past any updates and output.

        Raises:
            AgentRefusedError: the agent says no.
            LostAgentError: it went away before it answered.
        """
        for reply in self.stream(verb, **arguments):
            if isinstance(reply, Result):
                return Answer(reply.value)
        raise LostAgentError(f"the agent at {self._path} ended its answer to {verb} without a result; see its log")

    def stream(self, verb: str, **arguments: Any) -> Iterator[Update | Output | Result]:
        """Make a request and yield everything that comes back, the result last.

        Raises:
            AgentRefusedError, LostAgentError: as for `ask`.
            RequestError: it cannot be said.
        """
        self._send(encoded(Request(verb, arguments)), verb)
        while True:
            reply = self._receive(verb)
            if isinstance(reply, Refused):
                raise AgentRefusedError(reply.message, reply.kind, reply.reasons)
            yield reply
            if isinstance(reply, Result):
                return

    def fileno(self) -> int:
        """To wait for the next reply together with other things."""
        return self._link.fileno()

    def close(self) -> None:
        """End the connection; a request that still goes on is dropped, the component is not."""
        with contextlib.suppress(OSError):
            self._link.close()

    def __enter__(self) -> Control:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self, body: bytes, verb: str) -> None:
        """Send a request; an agent that has hung up has perhaps said why.

        Raises:
            AgentRefusedError, LostAgentError: as for `ask`.
        """
        try:
            self._link.sendall(LENGTH.pack(len(body)) + body)
        except OSError as error:
            with contextlib.suppress(LostAgentError):
                if isinstance(last := self._receive(verb), Refused):
                    raise AgentRefusedError(last.message, last.kind, last.reasons) from error
            raise LostAgentError(f"cannot send to the agent at {self._path}: {error.strerror}; is it still running?") from error

    def _receive(self, verb: str) -> Reply:
        (size,) = LENGTH.unpack(self._exactly(LENGTH.size, verb))
        if size > MESSAGE_LIMIT:
            raise LostAgentError(f"{self._path} announced a reply of {size} bytes, over {MESSAGE_LIMIT}; is it an agent?")
        return decoded(self._exactly(size, verb), self._path, verb)

    def _exactly(self, size: int, verb: str) -> bytes:
        parts = bytearray()
        while len(parts) < size:
            try:
                part = self._link.recv(size - len(parts))
            except OSError as error:
                raise LostAgentError(f"lost the agent at {self._path} during {verb}: {error.strerror}") from error
            if not part:
                raise LostAgentError(f"the agent at {self._path} ended during {verb}; components run on, see failover status")
            parts += part
        return bytes(parts)


def encoded(request: Request) -> bytes:
    """A request as it is sent, without its length.

    Raises:
        RequestError: it cannot be said.
    """
    try:
        body = _encoder.encode(request)
    except (UnicodeEncodeError, OverflowError) as error:
        odd = error.object[:ODD_SHOWN] if isinstance(error, UnicodeEncodeError) else "so large a number"
        raise RequestError(f"cannot ask for {request.verb}: {odd!r} is not UTF-8 text, so it cannot be sent") from error
    if len(body) > REQUEST_LIMIT:
        raise RequestError(f"cannot ask for {request.verb}: {len(body)} bytes of arguments are over the limit of {REQUEST_LIMIT}")
    return body


def decoded(body: bytes, path: Path, verb: str) -> Reply:
    """A reply of the agent at ``path`` to ``verb``.

    Raises:
        LostAgentError: it is none that this version understands.
    """
    try:
        return _reply_decoder.decode(body)
    except UNDECODABLE as error:
        raise LostAgentError(f"cannot understand the answer of {path} to {verb}: {error}; same version?") from error


ODD_SHOWN: Final = 60
"""Characters of a text that cannot be sent, in the message about it."""


def _is_absent(path: Path) -> bool:
    """Whether a file is known not to be there: this user may be one who must not look."""
    try:
        path.stat()
    except OSError as error:
        return isinstance(error, FileNotFoundError)
    return False


def _has_no_team() -> bool:
    """Whether this machine is known to have none: its agent.toml may name another place of it."""
    import tomllib  # here: only this message needs it

    try:
        config = tomllib.loads(SYSTEM_CONFIG.read_text())
    except FileNotFoundError:
        config = {}
    except (OSError, ValueError):
        return False
    place = config.get("team_directory", str(SYSTEM_TEAM.parent))
    return isinstance(place, str) and _is_absent(Path(place) / SYSTEM_TEAM.name)


def why_unreachable(path: Path, error: OSError) -> str:
    """One sentence, with the cure."""
    if path == SYSTEM_SOCKET and isinstance(error, FileNotFoundError) and _has_no_team():
        return "this machine has no team yet: failover team create NAME begins one, failover team join enters another robot's"
    cure = {
        FileNotFoundError: f"no agent has been started there; start failover-agent, or set {SOCKET_VARIABLE}",
        ConnectionRefusedError: "the agent of this socket has ended; start failover-agent again",
        BlockingIOError: f"it has taken no connection for {CONNECT_TIMEOUT_S} s; too many others wait, or it hangs: see its log",
        PermissionError: "this user may not; use sudo, or join the group that owns the socket",
    }.get(type(error), error.strerror or str(error))
    return f"cannot reach the agent at {path}: {cure}"
